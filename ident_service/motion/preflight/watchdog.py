"""Whether the drives stop by themselves when we fall silent: the one protection that works when the host dies.

Done last, where the arm has just been held: no torque is sent any more, only looked at what the drives say of
themselves. An arm without brakes then sinks onto its support, so a person must have typed the arm's name first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from drivers.arm import Arm, Sample, StopKind
from drivers.status import AxisStatus
from ident_service.model.arm_model import ArmModel
from ident_service.motion.preflight.check import Check, Verdict, failed, judged, measure, skipped

CODE = "watchdog"
# What a drive may take where the driver's section does not say: the longest that others use (moteus 0.1 s).
LONGEST_SILENCE = 0.1
_LATER = 2.0  # times the configured time, some cycles, and what its report may wait, until a drive has said so
_CYCLES = 10
REMEDY = (
    "Set the drives' own deadline for torque frames (CANopen: RPDO event timer 1400h:05, and 1016h with 6007h), or "
    "stop here: without it nothing stops the arm when this computer dies."
)

Confirm = Callable[[str], str]


@dataclass(frozen=True)
class Consent:
    """Whether the drives' watchdog may be tried.

    Attributes:
        given: it may.
        check: what is said where it may not, else None.
    """

    given: bool
    check: Check | None


def consent(model: ArmModel, sample: Sample, confirm: Confirm) -> Consent:
    """Ask, if there is anything to ask about, before anything is energised.

    Args:
        model: of the arm; its name must be typed.
        sample: of looking at the arm; without status words nobody can see what the drives do.
        confirm: shows a question and returns what the person typed.
    """
    if not sample.status:
        why = "the driver does not tell what the drives do, so their watchdog cannot be seen to act"
        return Consent(False, skipped(CODE, why, "Prove it by hand: pull the bus cable while the arm is supported."))
    name = model.config.name
    typed = confirm(
        f"The drives' own watchdog is tried at the end: they are left without torque frames, must give up torque by "
        f"themselves, and an arm without brakes sinks. If {name} is supported where it stands and nobody is within its "
        f"reach, type its name: "
    )
    if typed.strip() == name:
        return Consent(True, None)
    wrong = f"{typed.strip()!r} is not" if typed.strip() else "nobody typed"
    why = f"{wrong} the arm's name, {name}, so the drives' watchdog was not tried"
    remedy = "Support the arm, step out of its reach, check again and type its name when asked."
    return Consent(False, Check(CODE, Verdict.NEEDS_PERSON, (), why, remedy))


def watchdog_check(arm: Arm, model: ArmModel, period: float) -> Check:
    """Fall silent on an arm that is held, and look at what its drives do; the arm is without torque afterwards.

    Args:
        arm: enabled, held by the last torque sent, which goes on acting until a drive gives it up.
        model: for names, and the watchdog's time in the driver's section.
        period: [s].

    Raises:
        DriverError: the arm does not answer.
    """
    driver = model.config.driver
    configured, told = getattr(driver, "watchdog", None), getattr(driver, "report_delay", 0.0)
    most = _LATER * configured + _CYCLES * period + told if isinstance(configured, int | float) else LONGEST_SILENCE
    names = model.chain.names
    begin_ns: int | None = None
    gave_up: dict[str, float] = {}
    words: tuple[int, ...] = ()
    try:
        while True:
            sample = arm.exchange(None)
            if begin_ns is None:
                begin_ns = sample.stamp_ns
                if not all(word & AxisStatus.POWERED for word in sample.status):
                    return failed(CODE, "the drives do not report that they have power", REMEDY)
            silent = (sample.stamp_ns - begin_ns) * 1e-9
            words = sample.status
            for name, word in zip(names, words, strict=False):
                if not word & AxisStatus.POWERED:
                    gave_up.setdefault(name, silent)
            if len(gave_up) == len(names) or silent > most:
                break
    finally:
        arm.stop(StopKind.TORQUE_OFF)
    found = [measure("torque given up after", gave_up.get(name), "s", joint=name, most=most) for name in names]
    other = [
        f"{name} gave up for another reason ({AxisStatus(word)!r})"
        for name, word in zip(names, words, strict=False)
        if name in gave_up and word & (AxisStatus.FAULT | AxisStatus.EMERGENCY_STOP)
    ]
    return failed(CODE, "; ".join(other), REMEDY, found) if other else judged(CODE, found, REMEDY)
