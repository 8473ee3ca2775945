"""Check a description before use: its mistakes, its bus budget, its gains; format the result."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from drivers.can.bus_load import Budget
from ident_service.config.arm import ArmConfig, Joint
from ident_service.config.load import load_arm, located_problem
from ident_service.config.motion_limits import NEEDED, motion_limits
from ident_service.config.quantities import ParameterTable, did_you_mean
from ident_service.errors import ConfigError, ModelError, MotionRefused, ParameterError, Problem
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.base_parameters import base_parameters, remarks_on_angles
from ident_service.model.collision import CollisionModel
from ident_service.motion.after_stop import StopSecuring, after_stop, joints_with_weight
from ident_service.motion.arm_factory import GROUP
from ident_service.preflight.stability import StabilityReport, delay_of, stability

_MASS = re.compile(r"m\d+")
_NAMED = re.compile(r"kinematics\.(\w+): ")  # the key that a complaint about a mechanism begins with


@dataclass(frozen=True)
class CheckedDescription:
    """Description without mistakes.

    Attributes:
        model: model of the arm.
        budget: budget of the arm's buses; None for an arm without drives on CAN.
        gains: stability of the gains; None for an arm without limits or gains.
        after_stop: description of what follows a stop; None where nothing may move, or for an arm without a model.
        objections: reasons why the arm cannot be moved, each at its place in the file; none where it can be, and where
            the description has no driver and does not ask for it.
        missing: limits and gains, by joint, that a motion of an arm without a driver would need.
        warnings: what is allowed but probably a mistake, in words.
        falling: joints that gravity moves when their drives are off.
    """

    model: ArmModel
    budget: Budget | None
    gains: StabilityReport | None
    after_stop: StopSecuring | None
    objections: tuple[Problem, ...] = ()
    missing: tuple[Problem, ...] = ()
    warnings: tuple[str, ...] = ()
    falling: tuple[str, ...] = ()

    @property
    def assumed_brakes(self) -> tuple[str, ...]:
        """Return the joints that gravity moves without torque and for which the description gives no `brake`."""
        joints = self.model.config.joints
        return tuple(name for name in self.falling if name not in joints or joints[name].brake is None)

    @property
    def good(self) -> bool:
        """Return whether there are no objections; `missing`, what only a motion would need, does not count."""
        return not self.objections


def check_description(description: str | Path, *, upload: bool = False) -> CheckedDescription:
    """Load a description, ConfigError for mistakes; judge bus budget, gains, stop behaviour; return what was found.

    Args:
        description: file of the description, or name of a shipped one.
        upload: whether somebody has sent it (`load_arm`).

    Raises:
        ConfigError: every mistake in it, each with line and column; also for an invalid mechanism, a driver that is
            not installed, and for a bus budget that does not fit.
    """
    config = load_arm(description, upload=upload)
    problems, model = [*_driver_problems(description, config), *_mass_problems(description, config)], None
    try:
        model = arm_model(config)
        names = model.layout.names
    except ParameterError as error:
        names = arm_model(config.model_copy(update={"prior": None, "payload": None})).layout.names
        unknown = list(_name_problems(description, names, config, ("prior",)))
        problems += unknown or [located_problem(description, ("prior",), f"prior: {error}")]
    except ModelError as error:
        message = _NAMED.sub("", str(error), count=1)
        where = _place(str(error))
        raise ConfigError([*problems, located_problem(description, where, f"{'.'.join(where)}: {message}")]) from None
    for where in (("driver", "truth"), ("driver", "emulation", "truth")):
        problems += _name_problems(description, names, config, where)
    if problems or model is None:
        raise ConfigError(problems)
    budget, cut_off = _bus(description, config)
    warnings = (*cut_off, *remarks_on_angles(base_parameters(model.chain, model.layout)))
    if missing := _missing(description, model):
        checked = CheckedDescription(model, budget, None, None, warnings=warnings)
        # An arm without a driver is identified from recordings, and needs none of them.
        return replace(checked, missing=missing) if config.driver is None else replace(checked, objections=missing)
    limits = motion_limits(model.config)
    objections: list[Problem] = []
    follows: StopSecuring | None = None
    try:
        follows = None if model.prior is None else after_stop(model, limits)
    except MotionRefused as refusal:
        # Its remedies are several keys; the joints are where brakes would stand.
        objections.append(located_problem(description, ("control", "after_stop"), str(refusal)))
    falling = () if model.prior is None else joints_with_weight(model, limits)
    if model.prior is None and config.driver is not None:
        remedy = "give `prior`, or a URDF or MJCF with the masses of its links"
        objections.append(
            located_problem(
                description, ("kinematics",), f"kinematics: computed torque needs a model of the links; {remedy}"
            )
        )
    if config.driver is not None:
        try:
            CollisionModel(model)
        except ModelError as error:
            objections.append(located_problem(description, ("kinematics",), f"kinematics: {error}"))
    gains = stability(model, limits, delay_of(model.config))
    for words in gains.objections():
        joint = words.partition(":")[0]
        where = ("joints", joint, "kp") if joint in config.joints else ("control", "rate")
        remedy = "lower kp and kd, or raise control.rate or control.velocity_cutoff"
        objections.append(located_problem(description, where, f"gains: {words}; {remedy}"))
    return CheckedDescription(model, budget, gains, follows, tuple(objections), (), warnings, falling)


def _missing(arm: str | Path, model: ArmModel) -> tuple[Problem, ...]:
    """Return the limits and gains that a motion needs and a description lacks, a joint at a time."""
    found = []
    for name in model.chain.names:
        joint = model.config.joints.get(name, Joint())
        if lacking := [key for key in NEEDED if getattr(joint, key) is None]:
            what = f"joints.{name}: a motion needs {', '.join(lacking)}"
            found.append(located_problem(arm, ("joints", name), f"{what}; `ident new` guesses them from a mechanism"))
    return tuple(found)


def _bus(arm: str | Path, config: ArmConfig) -> tuple[Budget | None, tuple[str, ...]]:
    """Return the budget of the arm's buses, which must fit, and warnings of data sheets; none without drives on CAN."""
    if not config.can_buses:
        return None, ()
    from ident_service.operations.fieldbus import cut_sheets, require_budget  # loads the CAN stack for 0.1 s

    return require_budget(arm, config), tuple(cut_sheets(config))


def _driver_problems(arm: str | Path, config: ArmConfig) -> Iterator[Problem]:
    """Yield what is wrong with a kind of driver that nothing registers on this computer."""
    if config.driver is None:
        return
    kinds = sorted(entry.name for entry in entry_points(group=GROUP))
    if config.driver.kind not in kinds:
        near = did_you_mean(config.driver.kind, kinds) or "; install the package that brings it, or take one of these"
        known = ", ".join(kinds)
        words = f"driver.kind: no driver is called {config.driver.kind!r}; known: {known}{near}"
        yield located_problem(arm, ("driver", "kind"), words)


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


def _mass_problems(arm: str | Path, config: ArmConfig) -> Iterator[Problem]:
    """Yield masses of the prior that no body has, each at its place."""
    table = config.prior
    for name, value in () if table is None else zip(table.names, table.values, strict=True):
        if _MASS.fullmatch(name) and not value > 0.0:
            words = f"prior.{name}: a link's mass is above 0, not {value:g} kg; give the masses of CAD, or no prior"
            yield located_problem(arm, ("prior", name), words)


def _name_problems(
    arm: str | Path, known: Sequence[str], config: ArmConfig, where: tuple[str, ...]
) -> Iterator[Problem]:
    """Yield names in a table of parameters that are not among the known ones of this arm, each at its place."""
    section: Any = config
    for key in where:
        section = getattr(section, key, None)
    for name in section.names if isinstance(section, ParameterTable) else ():
        if name not in known:
            near = did_you_mean(name, known) or f"; it has {known[0]} ... {known[-1]}"
            words = f"{'.'.join(where)}: parameters this arm does not have: {name}{near}"
            yield located_problem(arm, (*where, name), words)


def description_document(checked: CheckedDescription) -> dict[str, Any]:
    """Return a checked description as JSON values."""
    config, report = checked.model.config, checked.gains
    gains = None if report is None else {"stable": report.stable, "objections": report.objections()}
    movable = checked.good and not checked.missing
    return {
        "arm": config.name,
        "sha256": config.sha256,
        "problems": [],
        "good": checked.good,
        "movable": movable,
        "objections": [f"{one.line}:{one.column}: {one.message}" for one in checked.objections],
        "missing": [f"{one.line}:{one.column}: {one.message}" for one in checked.missing],
        "warnings": list(checked.warnings),
        "payload": None if config.payload is None else config.payload.model_dump(mode="json"),
        "stability": None if report is None or gains is None else asdict(report) | gains,
        "after_stop": None if checked.after_stop is None else checked.after_stop.value,
        "objection": "; ".join(one.message for one in checked.objections) or None,
        "falling": list(checked.falling),
        "assumed_brakes": list(checked.assumed_brakes) if checked.after_stop is StopSecuring.BRAKE else [],
    }


def description_text(named_as: str, checked: CheckedDescription) -> str:
    """Format a checked description as text, the verdict first; `named_as` as the user named it."""
    model = checked.model
    verdict = "good"
    if checked.missing:
        verdict = "good for identification from recordings; it cannot be moved"
    if checked.objections:
        verdict = "CANNOT MOVE"
    head = f"{named_as}: {model.config.name}, {model.chain.joints} joints, {model.layout.size} parameters: {verdict}\n"
    head += "".join(f"  {one}\n" for one in (*checked.objections, *checked.missing))
    if (payload := model.config.payload) is not None:
        unknown = "; no prior, so no model has it" if model.prior is None else ""
        head += f"payload: {payload.words}{unknown}\n"
    head += "".join(f"WARNING: {line}\n" for line in checked.warnings)
    if checked.budget is not None:
        from ident_service.operations.fieldbus import bus_lines

        head += bus_lines(checked.budget)
    if checked.gains is None:
        return head + "gains: not checked, because limits or gains are missing\n"
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
    return "" if follows is None else f"after a stop: {words[follows]}\n"


def _gains_text(report: StabilityReport) -> str:
    """Format the stability margins per joint, and the objections to them."""
    joints = report.joints
    width = max(5, *(len(one.joint) for one in joints))
    cycles = "one cycle" if report.delay_cycles == 1 else f"{report.delay_cycles} cycles"
    lines = [
        f"gains at {1.0 / report.period:g} Hz with {cycles} of delay: "
        + ("stable" if report.stable else "NOT STABLE ENOUGH"),
        f"  {'joint':<{width}} {'gain margin':>12} {'delay margin':>13}",
        *(f"  {one.joint:<{width}} {one.gain_margin:>12.2f} {1e3 * one.delay_margin:>10.2f} ms" for one in joints),
    ]
    if report.coupled_radius is None:
        lines.append("  without a prior, each joint is checked by itself")
    else:
        lines.append(f"  all joints together: spectral radius {report.coupled_radius:.6f}, below 1 is stable")
    return "\n".join([*lines, ""])
