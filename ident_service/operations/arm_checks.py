"""Present preflight checks, tickets and looks at an arm, and compare hand-turned angles with positions.

A control loop works with a wrong gear ratio or encoder scale as if nothing were wrong, and the response of a joint to
torque reveals it only where its inertia is known. A turn by hand, measured with a protractor, reveals it directly.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from math import isfinite
from pathlib import Path
from typing import Any, Final

from drivers.arm import Arm, ArmDescription, Sample
from drivers.axis_status import AxisStatus
from ident_service.config.arm import ArmConfig
from ident_service.errors import DriverError, UsageError
from ident_service.model.arm_model import arm_model
from ident_service.motion.arm_factory import make_arm
from ident_service.motion.command_channel import ControlFile
from ident_service.motion.read_only_monitor import Watched
from ident_service.motion.ticket import Check, Measure, Ticket, Verdict
from ident_service.registry.jobs import SAMPLES
from ident_service.registry.state_folder import arm_folder, control_path
from ident_service.results.manifest import write_atomically

TITLES: Final = {
    "configuration": "the description is complete",
    "motion_fits": "the motion was made for it",
    "motion_proven": "the motion keeps all limits (proof)",
    "stability": "gains are stable at this rate and delay",
    "identities": "every axis answers and is the one expected",
    "at_rest": "the arm is at rest, inside its limits",
    "ways_clear": "paths to the motion and back are clear",
    "rate": "this computer keeps the rate",
    "noise": "feedback is quiet",
    "gravity": "gravity torque agrees with the model",
    "direction": "direction and scale of every joint",
    "watchdog": "drives stop when the host is silent",
}
"""Titles of the preflight's checks, by their codes."""
_TOLD_NS: Final = 100_000_000  # between samples of an arm at rest that viewers are told
_WORDS = {
    Verdict.PASSED: "ok",
    Verdict.FAILED: "FAILED",
    Verdict.SKIPPED: "skipped",
    Verdict.NEEDS_PERSON: "NEEDS YOU",
}


def write_ticket(path: Path, ticket: Ticket) -> None:
    """Write a ticket's file, whole or not at all.

    Raises:
        UsageError: the folder does not exist or cannot be written.
    """
    write_atomically(path, ticket.to_json() + "\n")


def ticket_text(ticket: Ticket) -> str:
    """Format the ticket as text: each check's verdict, nearest measure or reason, and whether the arm may move."""
    motion = ticket.subject.excitation
    lines = [f"preflight of {ticket.subject.arm} for {f'the {motion} motion' if motion else 'the path home'}", ""]
    for check in ticket.checks:
        lines += _check_lines(check)
    lines.append("")
    until = ticket.expires.isoformat(sep=" ", timespec="seconds").removesuffix("+00:00")
    if ticket.verdict is Verdict.PASSED:
        lines.append(f"the arm may move until {until} UTC, unless something is changed")
    elif ticket.verdict is Verdict.NEEDS_PERSON:
        lines.append("NOT YET ALLOWED TO MOVE: a check needs a person")
    else:
        lines.append("NOT ALLOWED TO MOVE")
    return "\n".join([*lines, ""])


def _check_lines(check: Check) -> list[str]:
    lines = [f"  {_WORDS[check.verdict]:<10} {TITLES[check.code]}"]
    nearest = nearest_measure(check)
    if check.verdict is Verdict.PASSED and nearest is not None:
        lines.append(f"{'':13}{nearest}")
    if check.reason:
        lines.append(f"{'':13}{check.reason}")
    if check.remedy and check.verdict is not Verdict.PASSED:
        lines.append(f"{'':13}-> {check.remedy}")
    return lines


def nearest_measure(check: Check) -> Measure | None:
    """Return the measure with the least room to its limit, relative to that; None if none has value and limit."""

    def room(one: Measure) -> float:
        assert one.value is not None  # noqa: S101
        rooms = []
        if one.most is not None:
            rooms.append((one.most - one.value) / (abs(one.most) or 1.0))
        if one.least is not None:
            rooms.append((one.value - one.least) / (abs(one.least) or 1.0))
        return min(rooms)

    limited = [one for one in check.measures if one.value is not None and (one.least, one.most) != (None, None)]
    return min(limited, key=room, default=None)


def watch_text(seen: Watched) -> str:
    """Format positions, noise, missing answers and drive states of an arm at rest as text."""
    width = max(5, *(len(name) for name in seen.joint_names))
    lines = [
        f"{seen.cycles} cycles, {seen.lost} frames lost",
        f"  {'joint':<{width}} {'position':>9} {'lowest':>9} {'highest':>9} {'velocity':>9} {'noise':>8} "
        f"{'missing':>7} {'oldest':>6}  drive",
    ]
    for k, name in enumerate(seen.joint_names):
        lines.append(
            f"  {name:<{width}} {seen.position[k]:>9.5f} {seen.lowest[k]:>9.5f} {seen.highest[k]:>9.5f} "
            f"{seen.velocity[k]:>9.2e} {seen.noise[k]:>8.2e} {seen.missing[k]:>7d} {seen.oldest[k]:>6d}  "
            f"{_drive(seen, k)}"
        )
    return "\n".join([*lines, *(f"  {words}" for words in seen.drives), ""])


class SampleLines:
    """Print positions of an arm at rest to stderr, one line of JSON every tenth of a second, for a daemon's viewers."""

    def __init__(self) -> None:
        """Create one that prints the first sample that it is told."""
        self._first_ns: int | None = None
        self._next_ns = 0

    def __call__(self, described: ArmDescription, sample: Sample) -> None:
        """Print a sample if it is time for one; positions [rad or m] of axes that did not answer are null."""
        if self._first_ns is None:
            self._first_ns = sample.stamp_ns
        if (at := sample.stamp_ns - self._first_ns) < self._next_ns:
            return
        self._next_ns = at + _TOLD_NS
        known = zip(sample.position.tolist(), sample.valid.tolist(), strict=True)
        position = [[round(value, 6) if valid and isfinite(value) else None] for value, valid in known]
        shown = {"joints": list(described.joint_names), "time": [round(at * 1e-9, 3)], "position": position}
        print(SAMPLES + json.dumps(shown), file=sys.stderr, flush=True)


def watch_document(seen: Watched) -> dict[str, Any]:
    """Return positions, noise, missing answers and drive states of an arm at rest as JSON values."""

    def number(value: float) -> float | None:
        return float(value) if isfinite(value) else None

    return {
        "cycles": seen.cycles,
        "lost": seen.lost,
        "drives": list(seen.drives),
        "joints": [
            {
                "joint": name,
                **{
                    key: number(float(getattr(seen, key)[k]))
                    for key in ("position", "lowest", "highest", "velocity", "noise")
                },
                "missing": int(seen.missing[k]),
                "oldest": int(seen.oldest[k]),
                "drive": _drive(seen, k),
            }
            for k, name in enumerate(seen.joint_names)
        ],
    }


def _drive(seen: Watched, joint: int) -> str:
    if joint >= len(seen.status):
        return ""
    word = AxisStatus(seen.status[joint])
    return ", ".join(str(bit.name).lower().replace("_", " ") for bit in AxisStatus if bit in word) or "off"


FILE = "scale.json"  # in the arm's folder
LEAST = math.radians(20.0)  # a tenth of it in m for prismatic joints: less cannot be judged well enough by eye
WRONG, SLACK = 0.1, math.radians(3.0)  # allowed share of the angle, and error of a person's eye [rad]
_SAMPLES = 5


@dataclass(frozen=True)
class ScaleCheck:
    """Scale check of one joint that was turned by hand.

    Attributes:
        joint: name of the joint.
        typed: turn that a person typed [rad or m].
        measured: turn that the drives measured, likewise.
        good: whether the two agree.
        words: result in words, for people.
    """

    joint: str
    typed: float
    measured: float
    good: bool
    words: str


def check_scale(config: ArmConfig, state: Path, ask: Callable[[str], str], arm: Arm | None = None) -> list[ScaleCheck]:
    """Have a person turn joints by hand, compare with the drives' positions, write `scale.json`, return what was found.

    Args:
        config: of the arm; nothing is energised.
        state: the state folder.
        ask: function that shows a question and returns what a person typed.
        arm: the arm, not open; the configured one when None.

    Returns:
        What was found of the joints that were turned; an empty answer leaves one out.

    Raises:
        UsageError: an answer that is no angle, or too small a one.
        DriverError: the arm does not answer, or another process has it.
    """
    chain = arm_model(config).chain
    found = []
    with (
        ControlFile.take(control_path(state, config.name), None),
        (make_arm(config) if arm is None else arm).look() as seen,
    ):
        for number, (name, revolute) in enumerate(zip(chain.names, chain.revolute, strict=True)):
            unit, scale = ("degrees", math.pi / 180.0) if revolute else ("mm", 1e-3)
            before = _position(seen, number)
            act = "turn it by hand, by 90 degrees or to its stop" if revolute else "push it by hand, by 100 mm or more"
            question = f"{name}: {act}, and leave it there. By how many {unit}, signed (empty: leave this joint out)?"
            answer = ask(question).strip()
            if answer:
                found.append(_turned(name, answer, scale, revolute, _position(seen, number) - before))
    if found:
        _keep(arm_folder(state, config.name) / FILE, config, found)
    return found


def _turned(name: str, answer: str, scale: float, revolute: bool, measured: float) -> ScaleCheck:
    try:
        typed = float(answer) * scale
    except ValueError:
        raise UsageError(f"{name}: {answer!r} is no number; this joint was skipped") from None
    least = LEAST if revolute else 0.1 * LEAST
    if not math.isfinite(typed) or abs(typed) < least:
        raise UsageError(
            f"{name}: {answer} is too little to tell a scale by, or no number; at least {least / scale:.0f}"
        )
    ratio = measured / typed
    good = abs(measured - typed) <= WRONG * abs(typed) + (SLACK if revolute else 0.1 * SLACK)
    words = f"{name}: the drives saw {ratio:.3g} times what was turned"
    if good:
        words += ", as they should"
    elif ratio < 0.0:
        words += ": the sign of transmission.ratios is wrong"
    else:
        words += (
            f": the scale is wrong; transmission.ratios is {1.0 / ratio:.3g} times too large, or drives.counts"
            if ratio > 1e-3
            else ": its encoder does not count, or is another joint's"
        )
    return ScaleCheck(name, typed, measured, good, words)


def _position(arm: Arm, number: int) -> float:
    for _ in range(_SAMPLES):
        sample = arm.exchange(None)
    if not sample.valid[number] or not math.isfinite(float(sample.position[number])):
        raise DriverError("the joint's drive does not answer; check its power and its cable")
    return float(sample.position[number])


def _keep(path: Path, config: ArmConfig, found: list[ScaleCheck]) -> None:
    """Write the results, together with earlier ones of other joints of the same description."""
    kept: dict[str, object] = {}
    try:
        before = json.loads(path.read_text(encoding="utf-8"))
        kept = dict(before["joints"]) if before.get("arm_sha256") == config.sha256 else {}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        pass  # no file yet, or an unreadable one, which the present results replace
    when = datetime.now(UTC).isoformat(timespec="seconds")
    kept |= {one.joint: asdict(one) | {"when": when} for one in found}
    write_atomically(path, json.dumps({"arm_sha256": config.sha256, "joints": kept}, indent=1) + "\n")
