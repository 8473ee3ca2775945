"""Prove that the drives stop by themselves when the host falls silent: the one protection that works when it dies.

Done last, where the arm has just been held, and again in the middle of a small motion: what the drives' watchdogs watch
is withheld, and looked at what the drives report of themselves. An arm without brakes then sinks onto its support, so a
person must have typed the arm's name first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection

import numpy as np

from drivers.arm import Arm, Flags, Sample, StopKind, Vector, Watchdog
from drivers.axis_status import AxisStatus
from ident_service.config.motion_limits import motion_limits
from ident_service.errors import ArmFault
from ident_service.model.arm_model import ArmModel
from ident_service.motion.ticket import Check, Verdict, check_from_measures, failed_check, measure
from ident_service.motion.trajectory import Setpoint
from ident_service.preflight.session import REMEDIES, Session
from ident_service.preflight.static_checks import LONGEST_SILENCE, long_silence_text

CODE = "watchdog"
_STOPS = 0.5  # s that a slow joint is given to come to rest
_WORDS = {
    "heartbeat": "heartbeat",
    "node_guarding": "node guarding",
    "vendor": "torque frames",
    "rpdo_timer": "torque frames",
    "torque_frames": "torque frames",
    "sync_loss": "SYNC",
    "bus_silence": "requests and torques",
}
_BLIND = ("sync_loss", "bus_silence")  # without these no position comes
_ORDER = list(_WORDS)  # what leaves the most of the others alone comes first; without SYNC no position comes
_LATER = 2.0  # times the configured time, plus some cycles and the report's delay, until a drive must have reported
_CYCLES = 10
REMEDY = (
    "Set the drives' own watchdog (CANopen: 1400h:05, or another of drives.watchdog, and 6007h for its reaction), or "
    "stop here: without it nothing stops the arm when this computer dies."
)

Confirm = Callable[[str], str]


def consent_check(model: ArmModel, sample: Sample, confirm: Confirm) -> Check | None:
    """Ask a person for the arm's name; return None if typed, else a check: NEEDS_PERSON, or FAILED if no drive status.

    Without the name nothing is energised.

    Args:
        model: model of the arm, whose name must be typed.
        sample: sample of the arm without torque; without status words the drives' reaction cannot be seen, and nobody
            is asked.
        confirm: function that shows a question and returns what the person typed.
    """
    if not sample.status:
        why = "the driver does not report drive states, so the watchdogs cannot be tested"
        remedy = "Nothing moves without this proof: have the driver report the state of each drive in `Sample.status`."
        return failed_check(CODE, why, remedy)
    refused = consent_refusal(model.config.name, confirm)
    return None if refused is None else Check(CODE, Verdict.NEEDS_PERSON, (), *refused)


def consent_refusal(arm: str, confirm: Confirm) -> tuple[str, str] | None:
    """Ask a person for an arm's name before it gets torque; return None if given, else (reason, remedy).

    Args:
        arm: name of the arm.
        confirm: function that shows a question and returns what the person typed.
    """
    typed = confirm(
        "Now the arm gets torque: it is held where it stands, and every joint moves a little. At the end the drives' "
        "own watchdog is tried, at rest and in a small motion: they hear no more of what it watches, must give up "
        f"torque by themselves, and an arm without brakes sinks. If {arm} is supported where it stands and nobody is "
        "within its reach, type its name: "
    ).strip()
    if typed == arm:
        return None
    wrong = f"{typed!r} is not" if typed else "nobody typed"
    why = f"{wrong} the arm's name, {arm}, so the arm got no torque and the drives' watchdog was not tried"
    return why, f"Support the arm, step out of its reach, check again and type its name when asked, or --confirm {arm}."


def watchdogs_of(arm: Arm, model: ArmModel) -> tuple[Watchdog, ...]:
    """Return each drive's watchdog and the signal that it watches; torque frames, by joint, if none is named."""
    seconds = arm.describe().watchdog
    return arm.watchdogs() or tuple(Watchdog(name, "torque_frames", seconds) for name in model.chain.names)


def watchdog_check(
    arm: Arm,
    model: ArmModel,
    session: Session,
    setpoint_at: Callable[[float], Setpoint],
    moving_joint: int | None = None,
) -> Check:
    """Withhold what each watchdog watches; return a check of whether the drives stop in time; the arm is off then.

    What one kind of watchdog watches is withheld after the other, and everything else goes on: a drive that stops for
    another reason has not proven its watchdog. So do the closed loop and its guard, for the joints whose drives have
    not given up yet; only where SYNC is withheld, and no position comes, the last torque goes on.

    Args:
        arm: the arm, enabled and held by `session`.
        model: model with the joints' names.
        session: the loop that holds the arm; without torque frames the last torque acts until a drive ends it.
        setpoint_at: function from the time since the silence began [s] to the setpoint of the joints that are held.
        moving_joint: number of the joint that moves, whose travel is measured; None at standstill.

    Raises:
        DriverError: the arm does not answer.
    """
    period = session.period
    dogs = watchdogs_of(arm, model)
    delay = arm.describe().report_delay
    where = "at rest" if moving_joint is None else "in motion"
    watchdog_expired: dict[int, tuple[float, AxisStatus]] = {}
    strange: list[str] = []
    begun = 0
    at: Vector = np.zeros(0)
    try:
        for kind in sorted({dog.kind for dog in dogs}, key=_ORDER.index):
            watched = [number for number, dog in enumerate(dogs) if dog.kind == kind]
            most = max(_most(dogs[number], period, delay) for number in watched)
            of_torque = dogs[watched[0]].of_torque
            if not of_torque:
                arm.withhold(kind)
            begin_ns: int | None = None
            while True:
                sample = session.exchange(sends=not of_torque)
                status = arm.drive_status() or tuple(AxisStatus(word) for word in sample.status)
                if begin_ns is None:
                    begin_ns = sample.stamp_ns
                    if not at.size:
                        begun, at = sample.stamp_ns, sample.position
                        if not all(word & AxisStatus.POWERED for word in status):
                            return failed_check(CODE, "the drives do not report that they have power", REMEDY)
                silent = (sample.stamp_ns - begin_ns) * 1e-9
                for number, word in enumerate(status):
                    if word & AxisStatus.EMERGENCY_STOP:
                        strange.append(f"{dogs[number].drive} reports an emergency stop")
                    if number in watchdog_expired or word & AxisStatus.POWERED:
                        continue
                    watchdog_expired[number] = silent, word
                    if number not in watched:
                        strange.append(
                            f"{dogs[number].drive} stopped when {_WORDS[kind]} was missing, not because of its own"
                        )
                if strange:
                    break
                if kind in _BLIND:
                    session.keep_last_target()
                else:
                    setpoint = setpoint_at((sample.stamp_ns - begun) * 1e-9)
                    session.check_without_signal(
                        sample, setpoint, _joints_of(watchdog_expired, model), sends=not of_torque
                    )
                if all(number in watchdog_expired for number in watched) or silent > most:
                    break
            if strange:
                break
        travel = _travel(arm, at, moving_joint) if moving_joint is not None else None
    except ArmFault as ended:
        why = f"{where}, while drives missed {_WORDS[kind]} and before all had said that they stopped: {ended}"
        return failed_check(CODE, f"{why}; the arm was released", REMEDY)
    finally:
        arm.stop(StopKind.TORQUE_OFF)
    found = []
    falls = bool(long_silence_text(model, motion_limits(model.config), math.inf))
    for number, dog in enumerate(dogs):
        seconds, word = watchdog_expired.get(number, (None, AxisStatus(0)))
        what = f"{where}, {_WORDS[dog.kind]} withheld: {_reaction(word) if seconds is not None else 'goes on'} after"
        most = _most(dog, period, delay)
        if falls:  # however long its description says, nobody holds the arm meanwhile
            most = min(most, LONGEST_SILENCE + _unseen(dog, period, delay))
        found.append(measure(what, seconds, "s", joint=dog.drive, most=most))
        # A host that is gone may be a fault to a drive; any other fault is no watchdog.
        fault = bool(word & AxisStatus.FAULT and not word & AxisStatus.WATCHDOG)
        if fault:
            strange.append(f"{dog.drive} stopped for another reason ({word!r})")
    if moving_joint is not None and travel is not None:
        unit = "rad" if model.chain.revolute[moving_joint] else "m"
        name = model.chain.names[moving_joint]
        found.append(measure("in motion, distance until at rest", travel, unit, joint=name))
        if travel == 0.0 and not strange:
            why = f"{name}: position unchanged to the last bit from the middle of a motion until at rest"
            return failed_check(CODE, why, REMEDIES["frozen_encoder"], found)
    return (
        failed_check(CODE, "; ".join(strange), REMEDY, found) if strange else check_from_measures(CODE, found, REMEDY)
    )


def _most(dog: Watchdog, period: float, delay: float) -> float:
    """Return how long a drive may take until it has reported that it stopped [s]."""
    return LONGEST_SILENCE if dog.seconds is None else _LATER * dog.seconds + _unseen(dog, period, delay)


def _unseen(dog: Watchdog, period: float, delay: float) -> float:
    """Return for how long nobody may see that a drive has stopped [s]; `delay` is that of any report of the arm [s]."""
    return _CYCLES * period + (delay if dog.report_delay is None else dog.report_delay)


def _joints_of(drives: Collection[int], model: ArmModel) -> Flags:
    """Return which joints these drives, given by number, move, shape (joints,)."""
    coupling = model.chain.coupling
    return np.asarray((coupling[list(drives)] != 0.0).any(axis=0))


def _reaction(word: AxisStatus) -> str:
    """Describe in words how a drive has reacted by itself."""
    if word & AxisStatus.FAULT:
        return "fault"
    return "quick stop" if word & AxisStatus.IDLE else "torque off"


def _travel(arm: Arm, begin: Vector, joint: int) -> float | None:
    """Measure how far a joint moves from where its host fell silent until it rests, or for `_STOPS` [rad or m].

    None where its drive tells no position any more, as one that misses its host's heartbeat may.
    """
    now, told = begin, False
    last_ns: int | None = None
    while True:
        sample = arm.exchange(None)
        last_ns = sample.stamp_ns if last_ns is None else last_ns
        now, told = np.where(sample.valid, sample.position, now), told or bool(sample.valid[joint])
        if (sample.stamp_ns - last_ns) * 1e-9 > _STOPS:
            return float(abs(now[joint] - begin[joint])) if told else None
