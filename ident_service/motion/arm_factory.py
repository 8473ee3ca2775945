"""Create the `Arm` of a configuration from drivers registered under an entry point, and try such a driver.

Drivers may be anybody's (docs/drivers.md). `try_driver` holds one to the promises of the contract (`drivers/arm.py`),
on a virtual or a real arm. No torque but zero is ever sent. What needs the arm to be energised is tried only once a
person has typed its name: with zero torque, an arm without brakes sinks onto its support. That a torque acts from one
stamp to the next only a simulator can tell, which knows how the arm really moved; preflight measures it on a real one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from importlib.metadata import entry_points
from typing import cast

import numpy as np

from drivers.arm import Arm, ArmDescription, Sample, StopKind
from drivers.axis_status import TRIPPED, AxisStatus
from drivers.clock import Clock
from ident_service.config.arm import ArmConfig
from ident_service.errors import DriverError, IdentError, UsageError

GROUP = "ident_service.drivers"


def make_arm(config: ArmConfig, clock: Clock | None = None) -> Arm:
    """Create the arm of a configuration with the driver that its `driver.kind` names; it is not opened yet.

    Args:
        config: configuration whose `driver.kind` names an entry point of the group `ident_service.drivers`.
        clock: the loop's clock; by default the one the driver section asks for.

    Raises:
        UsageError: the description has no driver section, or nothing is registered under its kind.
    """
    if config.driver is None:
        raise UsageError(f"{config.name}: the arm has no driver section, so it cannot be moved")
    found = entry_points(group=GROUP, name=config.driver.kind)
    if not found:
        known = ", ".join(sorted(entry.name for entry in entry_points(group=GROUP)))
        raise UsageError(
            f"{config.name}: no driver is called {config.driver.kind!r}; installed: {known}; `ident config check ARM` "
            "shows where it stands"
        )
    return cast(Arm, next(iter(found)).load()(config, clock))


_CYCLES = 50
_MEDIAN = 0.02  # of a period: what the median may differ by
_STANDS = 0.05  # rad or m
_LATE = 1.0  # s within which a stop must show in the status
_MOST_STATUS = sum(AxisStatus)


class Outcome(StrEnum):
    """Name the outcomes of one promise."""

    KEPT = "kept"
    BROKEN = "BROKEN"
    NOT_TRIED = "not tried"


@dataclass(frozen=True)
class Promise:
    """Represent one promise of the contract and what came of trying it.

    Attributes:
        words: the promise.
        outcome: result of trying it.
        why: reason why it is broken or was not tried; empty where it is kept.
    """

    words: str
    outcome: Outcome
    why: str = ""


class _BrokenPromise(Exception):
    """Signal in words what a driver did instead."""


Step = tuple[str, Callable[[Arm], None]]


def try_driver(config: ArmConfig, confirm: Callable[[str], str], arm: Arm | None = None) -> tuple[Promise, ...]:
    """Try the driver contract's promises on an arm, energised only if `confirm` returns its name; return the outcomes.

    Args:
        config: of the arm.
        confirm: function that shows a question and returns what a person typed; called before the arm is energised,
            unless a promise is broken by then.
        arm: the arm, not open; the configured one when None.

    Raises:
        UsageError: the description has no driver section, or no driver of its kind is installed.
    """
    arm = make_arm(config) if arm is None else arm
    found = [_tried(arm, words, act) for words, act in _closed()]
    try:
        arm.open()
    except IdentError as error:
        return (*found, Promise("it opens", Outcome.BROKEN, str(error)))
    try:
        found += [_tried(arm, words, act) for words, act in (*_open(config), *_looking())]
        question = (
            f"Now the arm is energised, with zero torque alone. If {config.name} is supported where it stands and "
            "nobody is within its reach, type its name: "
        )
        energised = list(_energised())
        if any(one.outcome is Outcome.BROKEN for one in found):
            why = "a promise that the arm's safety rests on is broken"
        elif confirm(question).strip() != config.name:
            why = "nobody typed the arm's name"
        else:
            why = ""
        for words, act in energised:
            found.append(Promise(words, Outcome.NOT_TRIED, why) if why else _tried(arm, words, act))
    finally:
        arm.stop(StopKind.TORQUE_OFF)
        arm.close()
    return (*found, *(_tried(arm, words, act) for words, act in _afterwards()))


def _tried(arm: Arm, words: str, act: Callable[[Arm], None]) -> Promise:
    try:
        act(arm)
    except _BrokenPromise as broken:
        return Promise(words, Outcome.BROKEN, str(broken))
    except Exception as error:  # noqa: BLE001 - a driver may raise anything, and that is what is to be told
        return Promise(words, Outcome.BROKEN, f"it raised {type(error).__name__}: {error}")
    return Promise(words, Outcome.KEPT)


def _refused(act: Callable[[], object], what: str) -> None:
    try:
        act()
    except DriverError:
        return
    raise _BrokenPromise(f"{what} was not refused with a DriverError")


def _require(kept: bool, instead: str) -> None:
    if not kept:
        raise _BrokenPromise(instead)


def _closed() -> Iterator[Step]:
    def nothing(arm: Arm) -> None:
        for what, act in (
            ("describe", arm.describe),
            ("enable", arm.enable),
            ("reset", arm.reset),
            ("exchange", lambda: arm.exchange(None)),
        ):
            _refused(act, f"{what} of a closed arm")

    def stops(arm: Arm) -> None:
        for kind in StopKind:
            arm.stop(kind)
        arm.close()
        arm.close()

    yield "a closed arm does nothing", nothing
    yield "stop and close are safe on a closed arm, any number of times", stops


def _open(config: ArmConfig) -> Iterator[Step]:
    joints = len(config.joints)

    def twice(arm: Arm) -> None:
        _refused(arm.open, "opening an open arm")

    def described(arm: Arm) -> None:
        says = arm.describe()
        _require(isinstance(says, ArmDescription), "describe returns no ArmDescription")
        _require(len(says.joint_names) == joints, f"{len(says.joint_names)} joints instead of {joints}")
        _require(len(says.identities) == joints, "not one identity an axis")
        _require(bool(says.software), "the driver does not name itself")
        for name in ("torque_limit", "torque_resolution", "position_resolution"):
            value = np.asarray(getattr(says, name))
            _require(value.shape == (joints,) and bool((value >= 0.0).all()), f"{name} is {value}")

    def samples(arm: Arm) -> None:
        last: Sample | None = None
        for _ in range(_CYCLES):
            sample = arm.exchange(None)
            for name in ("position", "torque", "valid", "age"):
                _require(getattr(sample, name).shape == (joints,), f"{name} has not one value a joint")
            _require(not sample.torque.any(), "a torque acts in an arm that is not enabled")
            _require(bool((sample.age[sample.valid] == 0).all()), "a valid axis has an age")
            _require(not sample.status or len(sample.status) == joints, "not one status a joint")
            _require(
                all(0 <= word <= _MOST_STATUS for word in sample.status), f"status {sample.status} has unknown bits"
            )
            if last is not None:
                _require(sample.cycle == last.cycle + 1, f"cycle {sample.cycle} after {last.cycle}")
                _require(sample.stamp_ns > last.stamp_ns, "stamps do not rise")
                _require(sample.lost >= last.lost, "lost frames become fewer")
            last = sample
        _require(last is not None and bool(last.valid.any()), "no axis answers")

    def period(arm: Arm) -> None:
        stamps = [arm.exchange(None).stamp_ns for _ in range(_CYCLES)]
        median, rate = float(np.median(np.diff(stamps))) * 1e-9, arm.describe().rate
        _require(abs(median * rate - 1.0) <= _MEDIAN, f"a median period of {1e3 * median:.3g} ms at {rate:g} Hz")
        behind = arm.clock.now_ns() - stamps[-1]
        _require(0 <= behind <= 10e9 / rate, "stamps are not of the arm's own clock")

    def kept(arm: Arm) -> None:
        first = arm.exchange(None)
        copies = [np.array(value) for value in (first.position, first.torque, first.valid, first.age)]
        arm.exchange(None)
        same = zip((first.position, first.torque, first.valid, first.age), copies, strict=True)
        _require(all(np.array_equal(value, copy) for value, copy in same), "a sample changed after it was returned")

    def needs_enabling(arm: Arm) -> None:
        _refused(lambda: arm.exchange(np.zeros(joints)), "a torque for an arm that is not enabled")

    yield "opening an open arm is refused", twice
    yield "it describes itself: joints, rate, limits, resolutions, identities", described
    yield "samples have one value a joint, count cycles, and their stamps rise", samples
    yield "a cycle takes the period that it describes, on the arm's own clock", period
    yield "samples stay what they were", kept
    yield "a torque needs enabling", needs_enabling


def _looking() -> Iterator[Step]:
    def looks(arm: Arm) -> None:
        before = arm.exchange(None).position
        arm.close()
        try:
            with arm.look() as looking:
                seen = looking.exchange(None)
                _require(not seen.torque.any(), "looking sends a torque")
                _require(not any(word & AxisStatus.POWERED for word in seen.status), "looking energises the arm")
        finally:
            arm.open()
        after = arm.exchange(None).position
        _require(
            bool((np.abs(after - before) < _STANDS).all()), "the arm has moved, or counts from elsewhere when reopened"
        )

    yield "an arm that is only looked at stays as it is, and is opened again", looks


def _energised() -> Iterator[Step]:
    def enables(arm: Arm) -> None:
        zero = np.zeros(len(arm.describe().joint_names))
        arm.enable()
        first = arm.exchange(zero)
        _require(not first.torque.any(), "enabling does not begin with zero torque")
        arm.enable()
        _require(not arm.exchange(zero).torque.any(), "enabling again does not begin with zero torque")

    def refuses(arm: Arm) -> None:
        joints = len(arm.describe().joint_names)
        for what, bad in (
            ("a torque that is not a number", np.full(joints, np.nan)),
            ("an infinite torque", np.full(joints, np.inf)),
            ("a torque of another shape", np.zeros(joints + 1)),
        ):
            before = arm.exchange(np.zeros(joints))
            _refused(lambda bad=bad: arm.exchange(bad), what)  # type: ignore[misc]
            after = arm.exchange(np.zeros(joints))
            _require(after.cycle == before.cycle + 1, f"{what} took a cycle")
        _refused(arm.reset, "a reset of an enabled arm")

    def stops(arm: Arm) -> None:
        zero = np.zeros(len(arm.describe().joint_names))
        for kind in StopKind:
            arm.enable()
            arm.exchange(zero)
            arm.stop(kind)
            arm.stop(kind)
            _refused(lambda: arm.exchange(zero), "a torque after a stop")
            begun = arm.exchange(None)
            sample = begun
            while any(word & AxisStatus.POWERED for word in sample.status):
                sample = arm.exchange(None)
                late = (sample.stamp_ns - begun.stamp_ns) * 1e-9 > _LATE
                _require(not late, f"energised a second after {kind.value}, by its status")

    def resets(arm: Arm) -> None:
        before = arm.exchange(None)
        if any(word & TRIPPED for word in before.status):
            return
        arm.reset()
        _require(not any(w & AxisStatus.POWERED for w in arm.exchange(None).status), "a reset energises the arm")

    yield "enabling begins with zero torque, also a second time", enables
    yield "a torque that is refused has not been sent, and takes no cycle", refuses
    yield "either stop takes the torque and the enabling, within a second by the status", stops
    yield "a reset without a fault changes nothing", resets


def _afterwards() -> Iterator[Step]:
    def closes(arm: Arm) -> None:
        arm.close()
        _refused(lambda: arm.exchange(None), "an exchange with a closed arm")
        arm.open()
        try:
            _require(arm.exchange(None).cycle == 0, "cycles are not counted anew")
        finally:
            arm.close()

    yield "closing is safe, and reopening counts cycles anew", closes


def contract_text(arm_name: str, promises: tuple[Promise, ...]) -> str:
    """Format the tested promises as text: a summary line, then each with its outcome, and the reason if not kept."""
    broken = sum(one.outcome is Outcome.BROKEN for one in promises)
    skipped = sum(one.outcome is Outcome.NOT_TRIED for one in promises)
    verdict = f"{broken} broken" if broken else f"all kept, {skipped} not tried" if skipped else "all kept"
    lines = [f"{arm_name}: {len(promises)} promises of the Arm contract, {verdict}", ""]
    for one in promises:
        lines.append(f"{one.outcome.value:<10} {one.words}")
        lines += [f"{'':<10}   {one.why}"] if one.why else []
    return "\n".join([*lines, ""])
