"""Represent the result of a preflight check: code, verdict, measured values with limits, and what to do about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from math import isfinite

from ident_service.config.limits import Vector


class Verdict(Enum):
    """Name the outcomes of a check."""

    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "skipped"  # it could not be made, or not safely; the reason says why
    NEEDS_PERSON = "needs a person"  # it could be made, but no person has agreed to it


# Every check there is, in the order in which they are made.
CODES = (
    "configuration",
    "motion_fits",
    "motion_proven",
    "stability",
    "identities",
    "at_rest",
    "ways_clear",
    "rate",
    "noise",
    "gravity",
    "direction",
    "watchdog",
)

# What these find is wrong with the motion, or with where the arm stands for it; the arm may be held, and sent home.
ABOUT_THE_MOTION = ("motion_fits", "motion_proven", "ways_clear")
# Nothing replaces these, so that a ticket without them allows nothing, whatever its other checks say.
INDISPENSABLE = ("gravity", "direction", "watchdog")


@dataclass(frozen=True)
class Measure:
    """Represent one measured number and its limits.

    Attributes:
        what: name of the quantity.
        value: None where it could not be measured or is no finite number.
        unit: of the value and the limits.
        joint: name of the joint concerned, or None.
        least: the value must not be below it, if given.
        most: the value must not be above it, if given.
    """

    what: str
    value: float | None
    unit: str
    joint: str | None = None
    least: float | None = None
    most: float | None = None

    @property
    def kept(self) -> bool:
        """Return whether the value keeps its limits; a missing value keeps none."""
        if self.least is None and self.most is None:
            return True
        if self.value is None:
            return False
        return (self.least is None or self.value >= self.least) and (self.most is None or self.value <= self.most)

    def __str__(self) -> str:
        value = "unknown" if self.value is None else f"{self.value:.4g}"
        limits = [f"at least {self.least:.4g}"] if self.least is not None else []
        limits += [f"at most {self.most:.4g}"] if self.most is not None else []
        words = f"{self.what} {value} {self.unit}".rstrip() + (f", {' and '.join(limits)}" if limits else "")
        return words if self.joint is None else f"{self.joint}: {words}"


@dataclass(frozen=True)
class Check:
    """Represent the result of one check.

    Attributes:
        code: one of `CODES`.
        verdict: how it ended.
        measures: the measured numbers and their limits.
        reason: failure, or why the check was not made; empty when all is well.
        remedy: one sentence that says what to do; empty when there is nothing to do.
    """

    code: str
    verdict: Verdict
    measures: tuple[Measure, ...] = ()
    reason: str = ""
    remedy: str = ""


def measure(
    what: str,
    value: float | None,
    unit: str,
    *,
    joint: str | None = None,
    least: float | None = None,
    most: float | None = None,
) -> Measure:
    """Create a measure from plain numbers; a number that is not finite counts as not measured."""

    def plain(number: float | None) -> float | None:
        return None if number is None or not isfinite(number) else float(number)

    return Measure(what, plain(value), unit, joint, plain(least), plain(most))


def measures(
    what: str,
    values: Vector,
    units: Sequence[str],
    names: Sequence[str],
    *,
    least: Vector | None = None,
    most: Vector | None = None,
) -> tuple[Measure, ...]:
    """Create one measure per joint, from arrays of shape (joints,)."""
    return tuple(
        measure(
            what,
            float(values[k]),
            units[k],
            joint=name,
            least=None if least is None else float(least[k]),
            most=None if most is None else float(most[k]),
        )
        for k, name in enumerate(names)
    )


def judged(code: str, found: Sequence[Measure], remedy: str) -> Check:
    """Return a check that passed where every measure keeps its limits, else failed, naming each that does not."""
    broken = [str(one) for one in found if not one.kept]
    if broken:
        return Check(code, Verdict.FAILED, tuple(found), "; ".join(broken), remedy)
    return Check(code, Verdict.PASSED, tuple(found))


def failed(code: str, reason: str, remedy: str, found: Sequence[Measure] = ()) -> Check:
    """Return a check that failed."""
    return Check(code, Verdict.FAILED, tuple(found), reason, remedy)


def skipped(code: str, reason: str, remedy: str = "") -> Check:
    """Return a check that was not made."""
    return Check(code, Verdict.SKIPPED, (), reason, remedy)


def joint_units(revolute: Sequence[bool], turning: str, sliding: str) -> tuple[str, ...]:
    """Return the unit of each joint's quantity."""
    return tuple(turning if turns else sliding for turns in revolute)
