"""Check a description before use: its mistakes, its bus budget, its gains; format the result."""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from drivers.can.bus_load import Budget
from ident_service.config.load import config_error, load_arm
from ident_service.config.motion_limits import motion_limits
from ident_service.config.quantities import ParameterTable
from ident_service.errors import ModelError, MotionRefused, ParameterError
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.base_parameters import base_parameters, remarks_on_angles
from ident_service.motion.after_stop import StopSecuring, after_stop, falling_joints
from ident_service.operations.fieldbus import bus_lines, require_budget
from ident_service.preflight.stability import StabilityReport, delay_of, stability

_NAMED = re.compile(r"kinematics\.(\w+): ")  # the key that a complaint about a mechanism begins with


@dataclass(frozen=True)
class CheckedDescription:
    """Description without mistakes.

    Attributes:
        model: of its arm.
        budget: of its buses; None for an arm without drives on CAN.
        gains: how stable they are; None for an arm that can be identified but not moved.
        after_stop: what follows a stop, or why nothing may move; None likewise.
        falling: joints that gravity moves when their drives are off.
        warnings: what is allowed but probably a mistake, in words.
    """

    model: ArmModel
    budget: Budget | None
    gains: StabilityReport | None
    after_stop: StopSecuring | str | None
    warnings: tuple[str, ...] = ()
    falling: tuple[str, ...] = ()

    @property
    def assumed_brakes(self) -> tuple[str, ...]:
        """Return the joints that would fall but for a brake that only a simulated drive is taken to have."""
        joints = self.model.config.joints
        return tuple(name for name in self.falling if name not in joints or joints[name].brake is None)

    @property
    def good(self) -> bool:
        """Return whether there are no objections to the gains or to what follows a stop."""
        return (self.gains is None or self.gains.stable) and not isinstance(self.after_stop, str)


def check_description(arm: str | Path, *, upload: bool = False) -> CheckedDescription:
    """Check a description: load it, build its model, and judge bus budget, gains and stop behaviour.

    Args:
        arm: its file, or its name if it is shipped.
        upload: whether somebody has sent it (`load_arm`).

    Raises:
        ConfigError: every mistake in it, each with line and column; also for an invalid mechanism, and for a bus
            budget that does not fit.
    """
    config = load_arm(arm, upload=upload)
    try:
        model = arm_model(config)
    except (ModelError, ParameterError) as error:
        raise config_error(arm, _place(str(error)), _NAMED.sub("", str(error), count=1)) from None
    for where in (("driver", "truth"), ("driver", "emulation", "truth")):
        _require_names(arm, model, where)
    budget = require_budget(arm, model.config)
    warnings = remarks_on_angles(base_parameters(model.chain, model.layout))
    try:
        limits = motion_limits(model.config)
    except MotionRefused:  # an arm that is only identified needs none
        return CheckedDescription(model, budget, None, None, warnings)
    try:
        follows: StopSecuring | str | None = None if model.prior is None else after_stop(model, limits)
    except MotionRefused as refusal:
        follows = str(refusal)
    falling = () if model.prior is None else falling_joints(model, limits)
    gains = stability(model, limits, delay_of(model.config))
    return CheckedDescription(model, budget, gains, follows, warnings, falling)


def _place(message: str) -> tuple[str, ...]:
    """Return the keys of the description that a model's error message is about."""
    if named := _NAMED.search(message):
        return ("kinematics", named.group(1))
    about = {
        "payload.link": "payload",
        "joints are configured as": "joints",
        "columns": "recording",
        "parameters this arm does not have": "prior",
    }
    return (next((key for words, key in about.items() if words in message), "kinematics"),)


def _require_names(arm: str | Path, model: ArmModel, where: tuple[str, ...]) -> None:
    """Check that a simulated plant's parameters are those of this arm."""
    section: Any = model.config
    for key in where:
        section = getattr(section, key, None)
    if isinstance(section, ParameterTable):
        try:
            model.layout.vector(section)
        except ParameterError as error:
            raise config_error(arm, where, str(error)) from None


def description_document(checked: CheckedDescription) -> dict[str, Any]:
    """Return a checked description as JSON values."""
    config, report = checked.model.config, checked.gains
    gains = None if report is None else {"stable": report.stable, "objections": report.objections()}
    return {
        "arm": config.name,
        "sha256": config.sha256,
        "problems": [],
        "warnings": list(checked.warnings),
        "payload": None if config.payload is None else config.payload.model_dump(mode="json"),
        "stability": None if report is None or gains is None else asdict(report) | gains,
        "after_stop": checked.after_stop.value if isinstance(checked.after_stop, StopSecuring) else None,
        "objection": checked.after_stop if isinstance(checked.after_stop, str) else None,
        "falling": list(checked.falling),
        "assumed_brakes": list(checked.assumed_brakes) if checked.after_stop is StopSecuring.BRAKE else [],
    }


def description_text(arm: str, checked: CheckedDescription) -> str:
    """Format a checked description as text; `arm` as the user named it."""
    model = checked.model
    head = f"{arm}: {model.config.name}, {model.chain.joints} joints, {model.layout.size} parameters: good\n"
    if (payload := model.config.payload) is not None:
        unknown = "; no prior, so no model has it" if model.prior is None else ""
        head += f"payload: {payload.words}{unknown}\n"
    head += "".join(f"WARNING: {line}\n" for line in checked.warnings)
    head += "" if checked.budget is None else bus_lines(checked.budget)
    if checked.gains is None:
        return head + "gains: not checked; limits or gains are missing, so this arm can be identified but not moved\n"
    return head + _after_stop_text(checked) + _gains_text(checked.gains)


def _after_stop_text(checked: CheckedDescription) -> str:
    """Format what follows a stop; empty for an arm without a model."""
    follows, assumed = checked.after_stop, checked.assumed_brakes
    held = f"they hold {', '.join(checked.falling)}" if checked.falling else "gravity moves no joint"
    if assumed:
        held += (
            f"\n  ASSUMED: brakes of {', '.join(assumed)}, because the drives are simulated; for real ones, each joint"
            " that has one needs `brake: true`, or control.after_stop is hold or lower"
        )
    words = {
        StopSecuring.BRAKE: f"held for two seconds, then released to its brakes; {held}",
        StopSecuring.HOLD: "held until a person confirms that the arm is supported (`ident supported`)",
        StopSecuring.LOWER: "lowered until it rests",
    }
    if follows is None:
        return ""
    return f"after a stop: {words[follows]}\n" if isinstance(follows, StopSecuring) else f"CANNOT MOVE: {follows}\n"


def _gains_text(report: StabilityReport) -> str:
    """Format the stability margins per joint, and the objections to them."""
    joints = report.joints
    width = max(5, *(len(one.joint) for one in joints))
    cycles = "one cycle" if report.delay_cycles == 1 else f"{report.delay_cycles} cycles"
    lines = [
        f"gains at {1.0 / report.period:g} Hz with {cycles} of delay: "
        + ("stable" if report.stable else "NOT STABLE ENOUGH; lower kp and kd, or raise the rate or the cut-off"),
        f"  {'joint':<{width}} {'gain margin':>12} {'delay margin':>13}",
        *(f"  {one.joint:<{width}} {one.gain_margin:>12.2f} {1e3 * one.delay_margin:>10.2f} ms" for one in joints),
    ]
    if report.coupled_radius is None:
        lines.append("  without a prior, each joint is checked by itself")
    else:
        lines.append(f"  all joints together: spectral radius {report.coupled_radius:.6f}, below 1 is stable")
    return "\n".join([*lines, *(f"  {words}" for words in report.objections()), ""])
