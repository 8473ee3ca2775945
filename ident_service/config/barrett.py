"""Describe Barrett's pucks: the motor controllers of a WAM and its safety puck, in their own protocol on one CAN bus.

Keys of a puck are the names of its properties: `cts` counts a motor turn, `ipnm` torque counts per N m at the motor,
`mt` the largest torque count, `poles` of the motor. Sources disagree about IPNM by a quarter, so that nothing is taken
for granted: what each puck reports of itself is read when the arm is opened, and must be what stands here.

Gears and couplings are the section `transmission` of the arm, whose motors are the pucks here, in this order.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Annotated, Final, Literal

from pydantic import Field, model_validator

from ident_service.config.can_bus import CanBus
from ident_service.config.quantities import (
    Count,
    NonNegative,
    ParameterTable,
    PerJoint,
    Positive,
    Section,
    Seed,
)
from ident_service.config.recording import Transmission, motor_disagreements
from ident_service.config.simulation import SimulatedFault

LOWER: Final = range(1, 5)  # nodes whose torques share the first frame; 5 to 7 share the second
MOST_COUNTS: Final = 8191  # of a torque slot of 14 bits, either way: -8192 has no opposite
WARNING: Final = 0.9  # of a fault's limit, as libbarrett has it
VELOCITY_UNIT: Final = 4096  # counts of VL1 and VL2 per m/s (Q4.12)
_LEAST_HEARTBEAT = 2.0  # cycles: one may be late
Seconds = Annotated[float, Field(strict=True, ge=0.001, le=60.0)]


class Puck(Section):
    """One motor puck."""

    node: Annotated[int, Field(strict=True, ge=1, le=7)]
    """Node number on the bus [1]: 1 to 4 lower arm, 5 to 7 wrist."""
    cts: Count = 4096
    """Counts of a motor turn (CTS) [1]."""
    ipnm: Annotated[Count, Field(le=0x7FFF)]
    """Torque counts per N m at the motor (IPNM) [1/(N m)]."""
    mt: Annotated[Count, Field(le=MOST_COUNTS)]
    """Largest torque (MT) [counts]."""
    poles: Count | None = None
    """Poles of the motor (POLES) [1]; not compared when left out."""
    torque_scale: Positive = 1.0
    """Torque that the motor really gives per torque that was asked for [1]."""
    zero_angle: Annotated[float, Field(strict=True, ge=0.0, le=2.0 * math.pi)] | None = None
    """Calibrated angle of a motor with an absolute encoder when the arm is at home [rad]; without, the posture in which
    a person zeroes the arm is all that is known."""

    joint_counts: Annotated[int, Field(strict=True, ge=-0x7FFFFF, le=0x7FFFFF)] | None = None
    """Counts of the joint encoder that this puck reads, per turn of the joint of the same place [1]; negative where it
    counts the other way; none when left out."""

    @property
    def max_torque(self) -> float:
        """Return the largest torque that the puck's setting MT lets through, at the motor [N m]."""
        return self.mt / self.ipnm

    @property
    def group(self) -> int:
        """Return the number of the group torque frame that carries this puck's torque: 1 lower arm, 2 wrist."""
        return 1 if self.node in LOWER else 2

    @property
    def slot(self) -> int:
        """Return the puck's place in its group's torque frame, 1 to 4 (property PIDX)."""
        return (self.node - 1) % 4 + 1


class SafetyLimits(Section):
    """Limits at which the safety puck takes the arm out of ACTIVE.

    It warns at 0.9 of them. They revert to its defaults when it loses power, and are written at each start.
    """

    velocity: Annotated[float, Field(strict=True, gt=0.0, le=7.9)] = 1.0
    """Speed of tip and elbow [m/s]."""
    torque: Annotated[Count, Field(le=0x7FFF)] = 5204
    """Torque of any puck [counts]."""


class PuckEmulation(Section):
    """Simulated arm behind emulated pucks, with true parameters, noise and faults, and the person at the pendant."""

    seed: Seed = 0
    """Seed of the random numbers [1]."""
    truth: ParameterTable | None = None
    """True parameters [SI]; the prior's when left out."""
    torque_noise: PerJoint = 0.0
    """Standard deviation of the torque in each cycle [N m or N], one or per joint."""
    braking: PerJoint | None = None
    """Damping of drives that are off [N m s/rad or N s/m], one or per joint."""
    firmware: Annotated[Count, Field(le=0x7FFF)] = 200
    """Version (VERS) that every puck reports [1]."""
    ipnm: tuple[Count, ...] | None = None
    """IPNM that pucks report [1/(N m)]; what the description says when left out."""
    operator: NonNegative | None = None
    """Time after which a person presses Shift-Activate, from when torque frames begin [s]; nobody does when left out.
    """
    heartbeat: Positive = 0.05
    """Time without positions or torques after which the safety puck leaves ACTIVE [s]."""
    velocity: Positive | None = None
    """Speed of elbow and tip at which the safety puck really trips [m/s]; what it was told when left out."""
    zeroed: bool = False
    """The arm has been zeroed since power came."""
    faults: tuple[SimulatedFault, ...] = ()
    """Faults to inject."""


class BarrettDriver(Section):
    """Motor pucks and a safety puck.

    The host never raises MODE: a person does, by Shift-Activate on the pendant.
    """

    kind: Literal["barrett"]
    """Barrett's pucks."""
    bus: CanBus = CanBus()
    """Bus of the pucks."""
    pucks: Annotated[tuple[Puck, ...], Field(min_length=1, max_length=7)]
    """Motor pucks, in the order of `transmission.ratios`."""
    safety_node: Annotated[int, Field(strict=True, ge=8, le=31)] = 10
    """Node number of the safety puck [1]."""
    limits: SafetyLimits = SafetyLimits()
    """Limits at which the safety puck stops the arm."""
    joint_encoders: tuple[int, ...] = ()
    """Nodes that answer with a second position, of an encoder at the joint [1]; their pucks need `joint_counts`."""
    joint_tolerance: Annotated[float, Field(strict=True, gt=0.0, le=0.5)] = 0.05
    """Angle by which a joint's encoder and its motors may have moved apart since the arm was opened [rad]: cables are
    elastic. Beyond it, the transmission has slipped."""
    heartbeat: Seconds = 0.1
    """Time without positions and torques after which the safety puck lets the arm go [s]; no public source says it, and
    preflight proves it."""
    watchdog_reason: Annotated[str, Field(max_length=200)] = ""
    """Reason why an arm that can fall may go on for longer than 0.1 s."""
    lost_cycles: Annotated[int, Field(ge=3, le=20)] = 5
    """Cycles in a row without its position after which a joint counts as gone [1]."""
    status_period: Seconds = 0.05
    """Time between two readings of every puck's MODE [s]."""
    activate_within: Positive = 300.0
    """Time that a person has for Shift-Activate on the pendant [s]."""
    emulation: PuckEmulation = PuckEmulation()
    """Emulated pucks in place of real ones."""

    @property
    def watchdog(self) -> float:
        """Return the longest time that pucks keep their torque after the host is gone [s]."""
        return self.heartbeat

    @property
    def report_delay(self) -> float:
        """Return the longest time until a puck's change of status is seen [s]: two periods of the status."""
        return 2.0 * self.status_period

    @model_validator(mode="after")
    def _nodes_apart(self) -> BarrettDriver:
        nodes = [puck.node for puck in self.pucks]
        if twice := sorted({node for node in nodes if nodes.count(node) > 1}):
            raise ValueError(f"node {', '.join(map(str, twice))} stands twice")
        if foreign := sorted(set(self.joint_encoders) - set(nodes)):
            raise ValueError(f"joint_encoders: {', '.join(map(str, foreign))} is none of the nodes")
        read = {puck.node for puck in self.pucks if puck.joint_counts}
        if odd := sorted(set(self.joint_encoders) ^ read):
            raise ValueError(
                f"joint_encoders: node {', '.join(map(str, odd))} must be among them, and its puck have joint_counts, "
                "not 0, or neither"
            )
        if self.bus.data_bitrate is not None:
            raise ValueError("pucks do not speak CAN FD; leave bus.data_bitrate out")
        if trips := [puck.node for puck in self.pucks if puck.mt > self.limits.torque]:
            raise ValueError(
                f"the safety puck would trip on what node {', '.join(map(str, trips))} may be told: mt is above "
                f"limits.torque {self.limits.torque}"
            )
        return self


def disagreements(
    driver: BarrettDriver,
    transmission: Transmission | None,
    joints: Sequence[str],
    rate: float,
    joints_without_home: Sequence[str] = (),
) -> Iterator[tuple[tuple[str | int, ...], str]]:
    """Yield (key path, message): no home, short heartbeat, wrong gears, joints, `lost_cycles` or `ipnm`.

    Args:
        driver: the section `driver`.
        transmission: the arm's.
        joints: names of the arm's joints; none where the file does not name them.
        rate: cycles per second.
        joints_without_home: names of joints without a `home`.
    """
    if joints_without_home:
        yield (
            ("driver",),
            "pucks count from where they were when power came, and need every joint's home, the posture in which a "
            "person zeroes the arm; missing: " + ", ".join(f"joints.{name}.home" for name in joints_without_home),
        )
    if driver.heartbeat * rate < _LEAST_HEARTBEAT:
        yield (
            ("driver", "heartbeat"),
            f"driver.heartbeat: {driver.heartbeat:g} s at {rate:g} Hz has no room for a late cycle; at least "
            f"{_LEAST_HEARTBEAT:g} cycles are needed, {_LEAST_HEARTBEAT / rate:g} s",
        )
    count = len(driver.pucks)
    yield from motor_disagreements(("pucks", "pucks"), count, driver.lost_cycles, transmission, joints, rate)
    if driver.emulation.ipnm is not None and len(driver.emulation.ipnm) != count:
        yield (
            ("driver", "emulation", "ipnm"),
            f"driver.emulation.ipnm: {len(driver.emulation.ipnm)} values for {count} pucks",
        )
