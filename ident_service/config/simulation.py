"""Describe the simulated arm, and the faults to inject: kind, joint, time, duration, size.

`sim_backend` implements the effect of each kind on readings and plant.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Annotated, Literal

from pydantic import Field, model_validator

from ident_service.config.quantities import (
    Count,
    ExtendedSection,
    NonNegative,
    Number,
    ParameterTable,
    PerJoint,
    Positive,
    Section,
    Seed,
    Vector3,
    did_you_mean,
)


class FaultKind(Enum):
    """Kinds of faults that can be injected; `FAULT_RULES` describes each."""

    LOST_FEEDBACK = "lost_feedback"
    DELAYED_FEEDBACK = "delayed_feedback"
    HIDDEN_DELAY = "hidden_delay"
    ENCODER_JUMP = "encoder_jump"
    ENCODER_OFFSET = "encoder_offset"
    FROZEN_ENCODER = "frozen_encoder"
    NAN_POSITION = "nan_position"
    POSITION_SIGN = "position_sign"
    STUCK_TORQUE = "stuck_torque"
    TORQUE_SIGN = "torque_sign"
    TORQUE_SATURATION = "torque_saturation"
    DRIVE_FAULT = "drive_fault"
    NODE_SILENT = "node_silent"
    EMERGENCY_STOP = "emergency_stop"
    LOAD_ATTACHED = "load_attached"
    BUS_GONE = "bus_gone"
    LATE_CYCLE = "late_cycle"
    CLOCK_JUMP = "clock_jump"


@dataclass(frozen=True)
class FaultRule:
    """Rule for the description of one kind of fault.

    Attributes:
        does: effect of the fault, in words.
        size: meaning of its size, with the unit; None where it has none.
        of_joint: whether the fault may be one joint's.
        stays: whether it stays when no duration is given, instead of striking for one cycle.
    """

    does: str
    size: str | None = None
    of_joint: bool = True
    stays: bool = False


FAULT_RULES: dict[FaultKind, FaultRule] = {
    # Faults of what the host reads; the plant is not affected.
    FaultKind.LOST_FEEDBACK: FaultRule("no answer: invalid, ageing, the last position repeated, counted as lost"),
    FaultKind.DELAYED_FEEDBACK: FaultRule("old positions, invalid and of that age", "delay [s]", stays=True),
    FaultKind.HIDDEN_DELAY: FaultRule("old positions are sent as new", "delay [s]", stays=True),
    FaultKind.ENCODER_JUMP: FaultRule("size added to the position", "[rad or m]"),
    FaultKind.ENCODER_OFFSET: FaultRule("size added to the position for good", "[rad or m]", stays=True),
    FaultKind.FROZEN_ENCODER: FaultRule("the last position repeated, as if it were fresh"),
    FaultKind.NAN_POSITION: FaultRule("not a number, as if it were one"),
    FaultKind.POSITION_SIGN: FaultRule("the position with the wrong sign", stays=True),
    # Faults of the torque that acts; a sample reports that torque, unless the fault is that it does not.
    FaultKind.STUCK_TORQUE: FaultRule("the torque of the cycle before goes on acting"),
    FaultKind.TORQUE_SIGN: FaultRule("the opposite torque acts, and the sample does not say so", stays=True),
    FaultKind.TORQUE_SATURATION: FaultRule("torques clipped below the limit", "share of the limit", stays=True),
    FaultKind.DRIVE_FAULT: FaultRule("no torque until reset, the axis coasts; status says fault", stays=True),
    FaultKind.NODE_SILENT: FaultRule(
        "as lost feedback, and no torque until enabled again, which no sample says",
        stays=True,
    ),
    FaultKind.EMERGENCY_STOP: FaultRule("no torque until reset; status says so", of_joint=False, stays=True),
    # Faults of the plant.
    FaultKind.LOAD_ATTACHED: FaultRule("a point mass on the last link", "mass [kg]", of_joint=False, stays=True),
    # Faults of the communication.
    FaultKind.BUS_GONE: FaultRule("exchange raises; drives hear nothing, their watchdogs run", of_joint=False),
    FaultKind.LATE_CYCLE: FaultRule("exchange returns late", "lateness [s]", of_joint=False),
    FaultKind.CLOCK_JUMP: FaultRule("stamps are wrong by size", "[s]", of_joint=False, stays=True),
}
WindingsOff = Literal["open", "shorted"]  # of a drive whose power stage is off
_LEAST_WATCHDOG = 2.0  # cycles, so that a torque frame may be late
_NOT_NEGATIVE = (
    FaultKind.DELAYED_FEEDBACK,
    FaultKind.HIDDEN_DELAY,
    FaultKind.TORQUE_SATURATION,
    FaultKind.LOAD_ATTACHED,
    FaultKind.LATE_CYCLE,
)


class SimulatedFault(Section):
    """One fault to inject, at a time or in a cycle; `FAULT_RULES` describes each kind."""

    kind: FaultKind
    """Fault to inject."""
    joint: str | None = None
    """Joint that it strikes; all of them when left out."""
    at: NonNegative | None = None
    """Time after the arm was opened [s]."""
    cycle: Annotated[int, Field(strict=True, ge=0)] | None = None
    """Cycle after the arm was opened, instead of `at` [1]."""
    duration: Positive | None = None
    """Duration [s]; when left out, one cycle or for good, as its kind is."""
    size: Number | None = None
    """Size, in the unit of its kind [of the kind]."""
    offset: Vector3 | None = None
    """Place of an attached load in the frame of the last link [m]."""

    @model_validator(mode="after")
    def _fits_its_kind(self) -> SimulatedFault:
        rule, name = FAULT_RULES[self.kind], self.kind.value
        if (self.at is None) == (self.cycle is None):
            raise ValueError("give exactly one of at and cycle")
        if (self.size is None) != (rule.size is None):
            raise ValueError(f"{name} needs a size: {rule.size}" if rule.size else f"{name} has no size")
        if self.size is not None and self.size < 0.0 and self.kind in _NOT_NEGATIVE:
            raise ValueError(f"{name}: size {self.size:g} is negative; it is the {rule.size}")
        if self.kind is FaultKind.TORQUE_SATURATION and self.size is not None and self.size > 1.0:
            raise ValueError(f"{name}: size {self.size:g} is above 1; it is the {rule.size}")
        if self.joint is not None and not rule.of_joint:
            raise ValueError(f"{name} strikes the whole arm; it has no joint")
        if self.offset is not None and self.kind is not FaultKind.LOAD_ATTACHED:
            raise ValueError(f"{name} has no offset")
        return self


class SimulatedDriver(ExtendedSection):
    """Simulated arm: true parameters and imperfections, all per joint or one number for all."""

    kind: Literal["simulated"]
    """Simulated arm."""
    time: Literal["virtual", "real"] = "virtual"
    """`virtual` runs as fast as it can; `real` by the clock of this computer."""
    process: Literal["own", "separate"] = "own"
    """Plant in the process of the host, or in one of its own."""
    bus: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,64}$")] | None = None
    """Name of a separate plant that other processes may ask for."""
    status: str | None = None
    """File that a separate plant reports to."""
    deadline: Positive | None = None
    """Longest time that an answer of a separate plant may take [s]."""
    seed: Seed = 0
    """Seed of the random numbers [1]."""
    truth: ParameterTable | None = None
    """True parameters [SI]: `{m1: 2.0, ...}`, or a JSON file with `names` and `values`; the prior's when left out,
    which is a perfect model."""
    encoder_resolution: PerJoint = 0.0
    """Step of the encoders at the joint [rad or m], one or per joint."""
    torque_resolution: PerJoint = 0.0
    """Step of the torque at the joint [N m or N], one or per joint."""
    torque_noise: PerJoint = 0.0
    """Standard deviation of the torque in each cycle [N m or N], one or per joint."""
    delay_cycles: Annotated[Count, Field(le=100)] = 1
    """Cycles from a sample to the torque that is computed from it [1]."""
    watchdog: Positive = 0.01
    """Time without a torque frame after which drives are idle [s]."""
    watchdog_reason: Annotated[str, Field(max_length=200)] = ""
    """Reason why drives of an arm that can fall may go on for longer than 0.1 s."""
    braking: PerJoint | None = None
    """Damping of idle drives [N m s/rad or N s/m], one or per joint, for 0.1 s, or for as long as they are off where
    `windings_off` is `shorted`."""
    windings_off: WindingsOff = "open"
    """Windings of a drive whose power stage is off: `open` coasts, `shorted` brakes."""
    stand: Positive | None = None
    """Distance that an arm which nothing holds sinks until it rests on the support that a person has put under it [rad
    or m]; nothing catches it when left out."""
    later = frozenset({"windings_off", "watchdog_reason", "stand"})
    faults: tuple[SimulatedFault, ...] = ()
    """Faults to inject."""


def disagreements(
    driver: SimulatedDriver, joints: Sequence[str], rate: float
) -> Iterator[tuple[tuple[str | int, ...], str]]:
    """Yield (key path, message) for each contradiction of the simulated driver with rate and joints.

    Args:
        driver: the section `driver`.
        joints: names of the arm's joints; none where the file does not name them.
        rate: cycles per second.
    """
    # The value that the message suggests is rounded to six digits.
    if driver.watchdog * rate < _LEAST_WATCHDOG * (1.0 - 1e-5):
        yield (
            ("driver", "watchdog"),
            f"driver.watchdog: {driver.watchdog:g} s at {rate:g} Hz has no room for a late torque frame;"
            f" at least {_LEAST_WATCHDOG:g} cycles are needed: set driver.watchdog to {_LEAST_WATCHDOG / rate:g} s or"
            " more, or raise control.rate",
        )
    if not joints:
        return
    if isinstance(driver.braking, tuple) and len(driver.braking) != len(joints):
        yield ("driver", "braking"), f"driver.braking: {len(driver.braking)} values for {len(joints)} joints"
    for number, fault in enumerate(driver.faults):
        if fault.joint is not None and fault.joint not in joints:
            where = ("driver", "faults", number, "joint")
            near = did_you_mean(fault.joint, joints)
            yield where, f"driver.faults.{number}.joint: {fault.joint!r} is none of {', '.join(joints)}{near}"
