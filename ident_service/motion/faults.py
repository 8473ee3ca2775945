"""List every fault with its reaction in one table, and keep active faults until a person acknowledges each by its name.

Reactions, from mild to severe; a motion only ever goes from a milder one to a more severe one.

* **warn**: the cycle goes on; a single axis without usable feedback is taken to go on as it went. The same warning in
  too many of the last 100 cycles becomes a controlled stop.
* **controlled stop**: the loop stays closed on a stop within limits. The arm must then be measured at rest
  within `SETTLE` of the end of the stop, and is held: gravity compensated, motion damped, what else it needed to stand
  kept on, no position asked for, so that it yields when it is pushed. After `HOLD` seconds the drives of an arm
  with brakes are told to quick-stop. Without brakes (`after_stop.py`) it is held until a person confirms that it is
  supported or home, or lowered; either ends without torque when the arm rests.
* **damped lowering**: for an arm that does not follow although it can be measured. No position is asked for any more:
  `LOWER_AFTER` seconds of damped gravity compensation, which is then taken away as fast as the arm sinks slowly
  (`after_stop.py`). With brakes a quick stop follows `LOWER` seconds later, without them when the arm rests.
* **quick stop**: in the same cycle the drives brake by themselves; for faults of ours or of single axes, where the
  drives still know what they do.
* **torque off**: in the same cycle; where the drives' own measurement or sign cannot be believed either.

A run that ends in DONE stands where it stood, supported, before it began; its torque is just taken off.

Where this table differs from FIELDBUS.md 5.2: a frozen encoder takes the torque (decision 0008); beyond a position
limit the stop is controlled as long as the arm is no further out than a following error, because these limits are
ours and lie inside the hardware's; faults of the program and of single axes quick-stop instead of dropping the arm.

The state machine refuses to arm the arm while there are any (`state_machine.py`).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import IntEnum

from drivers.arm import StopKind
from ident_service.errors import UsageError

SETTLE = 0.5  # s after the end of a stop or pause within which the arm must be at rest
HOLD = 2.0  # s that a stopped arm is held
LOWER_AFTER, LOWER = 0.5, 2.0  # s
WINDOW = 100  # cycles over which warnings are counted (libfranka's success rate looks at as many)


class Reaction(IntEnum):
    """Name the reactions to a fault, from mild to severe."""

    WARN = 0
    CONTROLLED_STOP = 1
    DAMPED_LOWERING = 2
    QUICK_STOP = 3
    TORQUE_OFF = 4

    @property
    def stop_kind(self) -> StopKind:
        """Return how drives end torque after this reaction: at once for `TORQUE_OFF`, else by a quick stop."""
        return StopKind.TORQUE_OFF if self is Reaction.TORQUE_OFF else StopKind.QUICK_STOP


class Severity(IntEnum):
    """Name the severities of faults, as levels of rcl_interfaces/msg/Log."""

    WARNING = 30
    ERROR = 40
    FATAL = 50


@dataclass(frozen=True)
class Rule:
    """Represent one row of the fault table.

    Attributes:
        reaction: reaction to the fault.
        means: the possible cause, the end of the sentence that a person reads.
        often: for a warning, the largest number of the last 100 cycles in which it is found and still is only a
            warning.
        becomes: name of the fault that one more such cycle makes of it.
        each: whether every message of a warning is told, not only the first of its code.
    """

    reaction: Reaction
    means: str
    often: int = 20
    becomes: str = "repeated_warnings"
    each: bool = False

    @property
    def severity(self) -> Severity:
        """Return the severity by the reaction: WARNING for `WARN`, FATAL from `QUICK_STOP` on, else ERROR."""
        if self.reaction is Reaction.WARN:
            return Severity.WARNING
        return Severity.FATAL if self.reaction >= Reaction.QUICK_STOP else Severity.ERROR


_WARN, _STOP, _LOWER, _QUICK, _OFF = Reaction

FAULTS: dict[str, Rule] = {
    # Counted and bridged.
    "lost_feedback": Rule(_WARN, "a frame was lost or came too late"),
    "encoder_jump": Rule(_WARN, "a reading was disturbed, and was not used"),
    "torque_saturated": Rule(_WARN, "the motion asks for more than the arm may give; the torque was limited"),
    "torque_rate": Rule(_WARN, "the torque jumped, from noise or a gain that is too high; its change was limited"),
    # Of drives that are given positions, which alone limit their torque.
    "torque_exceeded": Rule(_WARN, "it pushes against something, or is heavier than described", often=5),
    "position_rate": Rule(_WARN, "cycles were late or lost; the target position caught up within the limits"),
    "torque_not_applied": Rule(_WARN, "a drive limits, delays or ignores its target"),
    "drive_notice": Rule(_WARN, "information from the drive, which goes on; see the code in its manual", each=True),
    "drive_warning": Rule(_WARN, "temperature, voltage or current near its limit; see the drive's manual"),
    "torque_limited": Rule(_WARN, "the drive itself gives less torque than it was asked for"),
    "strange_frame": Rule(_WARN, "a bus that is too full, a wrong node number, or another device on it"),
    # `cycle_timing.py` decides when a cycle is too late, or too many are; fewer in a second are tolerated.
    "late_cycle": Rule(_WARN, "this computer was busy with something else", often=WINDOW - 1),
    # The loop can still be trusted to stop the arm.
    "repeated_warnings": Rule(_STOP, "a warning is tolerated once, not repeatedly"),
    "late_cycles": Rule(_STOP, "this computer does not keep the rate; check its load and scheduling"),
    "encoder_jumps": Rule(_STOP, "the encoder or its cable is disturbed, or its drive was late"),
    "position_envelope": Rule(_STOP, "it could hardly be stopped before its position limit"),
    "position_limit": Rule(_STOP, "it overshot, or was pushed"),
    "over_velocity": Rule(_STOP, "it was pushed, or model or gains are wrong"),
    "following_error": Rule(_STOP, "something blocks or pushes it, or model or gains are wrong"),
    "workspace": Rule(_STOP, "the arm touches itself or something, or left the space it may move in"),
    "lease_lost": Rule(_STOP, "the program that started the motion no longer renews its lease"),
    "controls_failed": Rule(_STOP, "stop requests would no longer arrive"),
    "no_way_back": Rule(_STOP, "the motion cannot be resumed"),
    "status_stale": Rule(
        _STOP, "a drive that switches off would go unnoticed; its report is lost, or the bus too full"
    ),
    "joint_encoder_lost": Rule(_STOP, "a cable that slips would go unnoticed; the encoder or its cable failed"),
    "bus_degraded": Rule(_STOP, "a bad cable, connector or termination, or a wrong bit rate"),
    "recorder_behind": Rule(_STOP, "the motion would not be recorded"),
    # The arm can be measured, but does not follow.
    "following_lost": Rule(_LOWER, "it is blocked, loaded, or a drive does not give its torque"),
    # The host, the bus or single axes; the other drives can brake.
    "feedback_gone": Rule(
        _QUICK, "a drive is late, or it, its encoder or cable failed; if several: the bus, or this machine stalled"
    ),
    "drive_fault": Rule(_QUICK, "the drive gives no torque; read its own fault code before anything else"),
    "drive_emergency": Rule(_QUICK, "the drive reports an error; see the code in its manual"),
    "drive_silent": Rule(_QUICK, "it lost its power or its cable, or its firmware hangs"),
    "drive_restarted": Rule(_QUICK, "its power failed for a moment, or its firmware restarted"),
    "drive_left": Rule(_QUICK, "it accepts no torque any more; another host commands it, or it lost this host"),
    "torque_ignored": Rule(_QUICK, "it is at its own speed or position limit, or its encoder is wrong"),
    # Motors stop the best by themselves: where the joint is, their positions do not say any more.
    "transmission_slipped": Rule(_QUICK, "a cable slipped or broke, or the motor's or the joint's encoder is wrong"),
    "second_host": Rule(_QUICK, "another program or device drives the same arm"),
    "bus_off": Rule(_QUICK, "a short circuit, a wrong bit rate, or no other node on the bus"),
    "drive_watchdog": Rule(_QUICK, "the drive received nothing from the host in time"),
    "not_at_rest": Rule(_QUICK, "an external force moves the arm"),
    "hold_lost": Rule(_QUICK, "the model's gravity is wrong, or somebody pushes"),
    "bus_silent": Rule(_QUICK, "the arm was not monitored in between"),
    "clock_jump": Rule(_QUICK, "time stamps cannot be trusted"),
    "torque_not_finite": Rule(_QUICK, "an error in the program or the model"),
    # A controlled stop would go on pushing.
    "torque_unexplained": Rule(_QUICK, "it pushes against something or somebody, or its encoder or model is wrong"),
    "position_not_finite": Rule(_QUICK, "an error in the program or the model"),
    "position_outside": Rule(_QUICK, "an error in the program or the motion"),
    "torque_absurd": Rule(_QUICK, "the arm is overloaded, or program or model are wrong"),
    "driver": Rule(_QUICK, "the bus or its adapter failed"),
    "program": Rule(_QUICK, "the program failed or was interrupted"),
    # What the axis itself measures or does cannot be believed.
    "emergency_stop": Rule(_OFF, "somebody pressed it, or its circuit is open"),
    "feedback_not_finite": Rule(_OFF, "the driver does not know where the axis is"),
    # A controlled stop would turn against a position that never comes (decision 0008).
    "frozen_encoder": Rule(
        _OFF, "the encoder stands still, the joint is jammed, or its friction is above design.friction_guess"
    ),
    "far_outside": Rule(_OFF, "no controller can have moved it there: a wrong zero, or it was pushed"),
    "runaway": Rule(_OFF, "a sign may be wrong"),
}


@dataclass(frozen=True)
class Fault:
    """Represent a fault found in one cycle.

    Attributes:
        code: name of the fault in the table.
        reaction: reaction to the fault.
        message: one plain sentence: which joint, what was measured, what is allowed, what it may mean.
    """

    code: str
    reaction: Reaction
    message: str

    @property
    def severity(self) -> Severity:
        """Return the severity that the fault table gives to this fault's code."""
        return FAULTS[self.code].severity


class FaultCounter:
    """Create faults from the table, and turn repeated warnings into a fault.

    Attributes:
        cycle: number of the present cycle, advanced by the caller.
        warnings: number of times that each warning was found, by code.
    """

    def __init__(self) -> None:
        self.cycle = 0
        self.warnings: dict[str, int] = {}
        self._recent: dict[str, deque[int]] = {}

    def count_fault(self, code: str, finding: str) -> Fault:
        """Create the fault of a code; a warning found in too many recent cycles gives the graver fault it becomes.

        Args:
            code: name of the fault in the table.
            finding: beginning of the sentence: which joint, what was measured, what is allowed.
        """
        rule = FAULTS[code]
        if rule.reaction is Reaction.WARN:
            self.warnings[code] = self.warnings.get(code, 0) + 1
            recent = self._recent.setdefault(code, deque(maxlen=rule.often + 1))
            if not recent or recent[-1] != self.cycle:  # seven drives that are late once are late in one cycle
                recent.append(self.cycle)
            if len(recent) > rule.often and recent[0] > self.cycle - WINDOW:
                finding = f"{code} in more than {rule.often} of the last {WINDOW} cycles ({finding})"
                code, rule = rule.becomes, FAULTS[rule.becomes]
        return Fault(code, rule.reaction, f"{finding}: {rule.means}")


@dataclass(frozen=True)
class ActiveFault:
    """Represent an unacknowledged fault in memory.

    Attributes:
        code: name of the fault.
        cause: one plain sentence.
        since_ns: time when it was found, on the loop's clock [ns].
    """

    code: str
    cause: str
    since_ns: int


class ActiveFaults:
    """Hold the unacknowledged faults of one arm, the earliest first, beyond the single run."""

    def __init__(self) -> None:
        self._faults: dict[str, ActiveFault] = {}

    @property
    def faults(self) -> tuple[ActiveFault, ...]:
        """Return the active faults, the earliest first."""
        return tuple(self._faults.values())

    def set(self, code: str, cause: str, since_ns: int) -> None:
        """Add a fault to the active ones; one that is active already keeps its first cause and time."""
        self._faults.setdefault(code, ActiveFault(code, cause, since_ns))

    def acknowledge(self, code: str) -> ActiveFault:
        """Remove an active fault by its code and return it; raises UsageError where it is not active.

        Raises:
            UsageError: no fault of this code is latched; a person must acknowledge a known fault.
        """
        if code not in self._faults:
            known = ", ".join(self._faults) or "none"
            raise UsageError(f"no active fault {code!r} (active: {known})")
        return self._faults.pop(code)
