"""Format preflight tickets and readings of an arm as text and as JSON values, and write the ticket's file."""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from typing import Any

from drivers.axis_status import AxisStatus
from ident_service.motion.preflight_check import Check, Measure, Verdict
from ident_service.motion.ticket import Ticket, ticket_values
from ident_service.motion.watch import Watched
from ident_service.results.files import write_atomically

_TITLES = {
    "configuration": "the description is complete",
    "motion_fits": "the motion was made for it",
    "motion_proven": "the motion is proven to keep all limits",
    "stability": "gains are stable at this rate and delay",
    "identities": "every axis answers and is the one expected",
    "at_rest": "the arm is at rest, inside its limits",
    "ways_clear": "ways to the motion and back are clear",
    "rate": "this machine keeps the rate",
    "noise": "feedback is quiet",
    "gravity": "gravity torque is the model's",
    "direction": "direction and scale of every joint",
    "watchdog": "drives stop when we fall silent",
}
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


def ticket_document(ticket: Ticket) -> dict[str, Any]:
    """Return the ticket as JSON values, as in its file."""
    return ticket_values(ticket)


def ticket_text(ticket: Ticket, *, every_measure: bool = False) -> str:
    """Format the ticket as text.

    Args:
        ticket: to be shown.
        every_measure: every number of every check, and not only the one nearest to its limit.
    """
    motion = ticket.subject.excitation
    lines = [f"preflight of {ticket.subject.arm} for {f'the {motion} motion' if motion else 'a way home'}", ""]
    for check in ticket.checks:
        lines += _check_lines(check, every_measure)
    lines.append("")
    until = ticket.expires.isoformat(sep=" ", timespec="seconds").removesuffix("+00:00")
    if ticket.verdict is Verdict.PASSED:
        lines.append(f"the arm may move until {until} UTC, if nothing is changed")
    elif ticket.verdict is Verdict.NEEDS_PERSON:
        lines.append("NOT YET ALLOWED TO MOVE: a check needs a person")
    else:
        lines.append("NOT ALLOWED TO MOVE")
    return "\n".join([*lines, ""])


def _check_lines(check: Check, every_measure: bool) -> list[str]:
    lines = [f"  {_WORDS[check.verdict]:<10} {_TITLES[check.code]}"]
    shown = list(check.measures) if every_measure else [one for one in [_nearest(check)] if one is not None]
    if check.verdict is Verdict.PASSED or every_measure:
        lines += [f"{'':13}{one}" for one in shown]
    if check.reason:
        lines.append(f"{'':13}{check.reason}")
    if check.remedy and check.verdict is not Verdict.PASSED:
        lines.append(f"{'':13}-> {check.remedy}")
    return lines


def _nearest(check: Check) -> Measure | None:
    """Return the measure that is nearest to its limit."""

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
    """Format the readings of an arm at rest as text."""
    width = max(5, *(len(name) for name in seen.joint_names))
    lines = [
        f"{seen.cycles} cycles, {seen.lost} frames lost",
        f"  {'joint':<{width}} {'position':>10} {'lowest':>10} {'highest':>10} {'velocity':>11} {'noise':>10} "
        f"{'missing':>8} {'oldest':>7}  drive",
    ]
    for k, name in enumerate(seen.joint_names):
        lines.append(
            f"  {name:<{width}} {seen.position[k]:>10.5f} {seen.lowest[k]:>10.5f} {seen.highest[k]:>10.5f} "
            f"{seen.velocity[k]:>11.2e} {seen.noise[k]:>10.2e} {seen.missing[k]:>8d} {seen.oldest[k]:>7d}  "
            f"{_drive(seen, k)}"
        )
    return "\n".join([*lines, *(f"  {words}" for words in seen.drives), ""])


def watch_document(seen: Watched) -> dict[str, Any]:
    """Return the readings of an arm at rest as JSON values."""

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
