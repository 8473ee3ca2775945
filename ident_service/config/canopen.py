"""CANopen drives (CiA 301, CiA 402) on one or two buses, as an arm's description names them.

Boundary: data only. Frames and their cost on the wire are `drivers/canopen`, gears and couplings the section
`transmission` of the arm, whose motors are the drives here, in this order.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from ident_service.config.eds import eds_mistake, has_object, maps_dummies
from ident_service.config.quantities import (
    Count,
    GrownSection,
    ParameterTable,
    PerJoint,
    Positive,
    Section,
    Seed,
    TextBeside,
)
from ident_service.config.recording import Transmission
from ident_service.config.simulation import SimulatedFault, WindingsOff
from ident_service.config.watchdogs import (
    ABORTING,
    Heartbeats,
    NodeGuarding,
    NodeId,
    Seconds,
    WatchdogEntry,
    WatchdogKind,
)

InhibitTime = Annotated[float, Field(strict=True, ge=0.0001, le=6.5)]  # 100 us of 16 bits
_KERNELS = ("raw", "socketcan")  # two ways to the same interfaces
_ASKED = 0.7  # of the guard time, after which a drive is asked again
_WHOLE_TURNS = 0.999  # 6080h holds whole turns per minute
_LEAST_DEADLINE = 2.0  # cycles: one frame may be late
_MOST_PER_MILLE = 32_767  # of a torque of 16 bits
EmergencyCode = Annotated[int, Field(strict=True, ge=1, le=0xFFFF)]
# CiA 301, table 26: CAN controller in error passive; no heartbeat, or no torque frame, of the host.
BUS_EMERGENCIES = frozenset({0x8120, 0x8130, 0x8250})
Unsigned32 = Annotated[int, Field(strict=True, ge=0, le=0xFFFF_FFFF)]


class CanBus(Section):
    """One bus, and who gives access to it.

    `interface` is python-can's name of an interface, or `raw` for a CAN socket of the kernel without python-can, or
    `lock_step` for emulated drives in this process and in virtual time. `options` go to python-can as they are.
    """

    interface: Annotated[str, Field(min_length=1)] = "socketcan"
    channel: str = "can0"
    bitrate: Annotated[Count, Field(le=1_000_000)] = 1_000_000
    data_bitrate: Count | None = None
    options: dict[str, str | int | float | bool] = Field(default_factory=dict)

    @property
    def medium(self) -> str:
        """Return what `channel` is a name of: `kernel` for CAN interfaces of the kernel, else the interface."""
        return "kernel" if self.interface in _KERNELS else self.interface

    @model_validator(mode="after")
    def _data_not_slower(self) -> CanBus:
        if self.data_bitrate is not None and self.data_bitrate < self.bitrate:
            raise ValueError(f"data_bitrate {self.data_bitrate} is below bitrate {self.bitrate}; CAN FD only speeds up")
        return self


class DriveIdentity(Section):
    """What object 1018h must answer; what is left out is logged but not compared."""

    vendor: Unsigned32 | None = None
    product: Unsigned32 | None = None
    revision: Unsigned32 | None = None
    serial: Unsigned32 | None = None


class CanopenDrive(GrownSection):
    """One drive and its motor.

    `counts` are those of a motor turn (6064h); `rated_torque` [N m] at the motor is what 6076h is set to, or must be
    where the drive does not let it be set; a torque is sent in thousandths of it. `torque_scale` is how much torque
    the motor really gives for one that was asked for. `max_torque` [N m] and `max_speed` [turns per minute] of the
    motor are set as 6072h and 6080h. `notices` are the emergency codes by which this drive, as its manual says, only
    informs: they are told and recorded, and stop nothing.

    `watchdog` says what makes this drive stop by itself when the host is gone: torque frames that stay away
    (`rpdo_timer`, 1400h:05), the host's heartbeat (1016h), SYNC, node guarding (100Ch, 100Dh), or something of its
    maker's that watches torque frames. For `sync_loss` and `vendor`, `watchdog_time` [s] is when, by the maker, and
    `watchdog_entry` what sets it. `quick_stop_deceleration` is what 6085h is set to, in the drive's unit; left
    out, it stops the joints at their acceleration limits, in counts per square second.
    """

    node: NodeId
    bus: Annotated[int, Field(strict=True, ge=0)] = 0
    identity: DriveIdentity = DriveIdentity()
    counts: Count = 4096
    rated_torque: Positive
    torque_scale: Positive = 1.0
    max_torque: Positive
    max_speed: Positive
    notices: tuple[EmergencyCode, ...] = ()
    watchdog: WatchdogKind = "rpdo_timer"
    watchdog_time: Seconds | None = None
    watchdog_entry: WatchdogEntry | None = None
    quick_stop_deceleration: Annotated[Unsigned32, Field(ge=1)] | None = None
    later = frozenset({"watchdog", "watchdog_time", "watchdog_entry", "quick_stop_deceleration"})

    @model_validator(mode="after")
    def _watchdog_is_described(self) -> CanopenDrive:
        own = self.watchdog in ("sync_loss", "vendor")
        if own and self.watchdog_time is None:
            raise ValueError(
                f"watchdog: {self.watchdog} needs watchdog_time, the time that the drive's manual promises"
            )
        if not own and self.watchdog_time is not None:
            raise ValueError(f"watchdog_time is for sync_loss and vendor; the time of {self.watchdog} has its own key")
        if self.watchdog == "vendor" and self.watchdog_entry is None:
            raise ValueError("watchdog: vendor needs watchdog_entry, which the drive's manual names")
        return self

    @model_validator(mode="after")
    def _notices_are_none_of_the_bus(self) -> CanopenDrive:
        if bad := [f"{code:04X}h" for code in self.notices if code in BUS_EMERGENCIES]:
            raise ValueError(f"notices: {', '.join(bad)} tells that the drive does not hear its host; it always counts")
        return self

    @model_validator(mode="after")
    def _fits_the_objects(self) -> CanopenDrive:
        milli = 1000.0 * self.rated_torque
        if round(milli) < 1 or abs(milli - round(milli)) > 1e-6:
            raise ValueError(f"rated_torque {self.rated_torque:g} is not whole mN m, which is what 6076h holds")
        share = 1000.0 * self.max_torque / self.rated_torque
        if not 1.0 <= share <= _MOST_PER_MILLE + 1e-6:
            raise ValueError(
                f"max_torque {self.max_torque:g} is {share / 1000.0:g} times rated_torque; a torque is sent in"
                f" thousandths of it, from 1 to {_MOST_PER_MILLE}: choose another rated_torque"
            )
        return self


class Reactions(Section):
    """Set how a drive reacts by itself: option codes of CiA 402, as its manual numbers them.

    Left out, `quick_stop` is 2, or 6 for an arm whose `control.after_stop` is `hold` or `lower`: it has no brakes, and
    stays in quick stop, where the drive goes on holding the motor.
    """

    quick_stop: Annotated[int, Field(strict=True)] | None = (
        None  # 605Ah: 2 and 6 ramp, then switch-on disabled, or stay
    )
    fault: Annotated[int, Field(strict=True)] = 2  # 605Eh: quick-stop ramp
    abort_connection: Annotated[int, Field(strict=True)] = 3  # 6007h: quick stop


class StatusReports(Section):
    """When a drive sends status word and torque (TPDO2) [s]: on change, not within `inhibit`, and every `period`."""

    period: Seconds = 0.1
    inhibit: InhibitTime = 0.05


class Emulation(GrownSection):
    """Describe the arm behind emulated drives: one with true parameters, noise and faults, as `SimulatedDriver` has.

    A drive whose power stage is off leaves its motor coasting, or braked where `windings_off` is `shorted`.
    """

    seed: Seed = 0
    truth: ParameterTable | None = None
    torque_noise: PerJoint = 0.0
    braking: PerJoint | None = None
    windings_off: WindingsOff = "open"
    later = frozenset({"windings_off"})
    faults: tuple[SimulatedFault, ...] = ()


class CanopenDriver(GrownSection):
    """Drives in cyclic synchronous torque mode.

    `torque_frames` says whether up to four drives share a frame, by dummy mapping, or each has its own.
    `torque_deadline` [s] without torque frames makes a drive stop by itself (1400h:05). After `lost_cycles` in a row
    without its position a joint counts as gone (FIELDBUS.md: 3 to 5). `bring_up` [s] is how long all
    drives together may take for one step to `operation enabled`. `zero` says whether encoders know where they stand
    (`absolute`), or count from where they were when power came; then a person leads the arm to the joints' `home` and
    says so, `ident home ARM --zero`, after every loss of power. `measured_torque` says whether drives report the torque
    that they measure (6077h): with their positions, in every cycle (`cyclic`), with their status (`status`), or not at
    all; left out, with their status where the EDS has the object. `watchdog_reason` says why drives of an arm that can
    fall may take longer than 0.1 s to notice that the host is gone.
    """

    kind: Literal["canopen"]
    eds: TextBeside
    buses: Annotated[tuple[CanBus, ...], Field(min_length=1, max_length=4)] = (CanBus(),)
    drives: Annotated[tuple[CanopenDrive, ...], Field(min_length=1)]
    torque_frames: Literal["shared", "single"] = "shared"
    torque_deadline: Seconds = 0.01
    lost_cycles: Annotated[int, Field(ge=3, le=5)] = 3
    bring_up: Positive = 0.5
    zero: Literal["absolute", "at_home"] = "absolute"
    measured_torque: Literal["cyclic", "status", "none"] | None = None
    watchdog_reason: Annotated[str, Field(max_length=200)] = ""
    guarding: NodeGuarding = NodeGuarding()
    later = frozenset({"measured_torque", "watchdog_reason", "guarding"})
    heartbeats: Heartbeats = Heartbeats()
    reactions: Reactions = Reactions()
    status: StatusReports = StatusReports()
    emulation: Emulation = Emulation()

    @property
    def watchdog(self) -> float:
        """Return how long any drive goes on at most when the host is gone [s]."""
        return max(self.watchdog_seconds(drive) for drive in self.drives)

    def watchdog_seconds(self, drive: CanopenDrive) -> float:
        """Return how long a drive goes on when what its watchdog watches stays away [s]."""
        times = {
            "rpdo_timer": self.torque_deadline,
            "heartbeat": self.heartbeats.waits,
            "node_guarding": self.guarding.period * self.guarding.factor,
        }
        return times[drive.watchdog] if drive.watchdog_time is None else drive.watchdog_time

    @property
    def torque_reports(self) -> Literal["cyclic", "status", "none"]:
        """With what drives report the torque that they measure."""
        if self.measured_torque is not None:
            return self.measured_torque
        return "status" if has_object(self.eds.text, 0x6077) else "none"

    @property
    def report_delay(self) -> float:
        """How much later than it happens a drive may tell it [s]."""
        return self.status.inhibit

    @model_validator(mode="after")
    def _nodes_apart(self) -> CanopenDriver:
        places = [(drive.bus, drive.node) for drive in self.drives]
        for bus, node in places:
            if bus >= len(self.buses):
                raise ValueError(f"node {node} is on bus {bus}, but there are {len(self.buses)} (counted from 0)")
            if node == self.heartbeats.node:
                raise ValueError(f"node {node} is a drive and the host (heartbeats.node); give the host another number")
            if places.count((bus, node)) > 1:
                raise ValueError(f"node {node} stands twice on bus {bus}")
        named = [bus for bus in self.buses if bus.interface != "lock_step"]
        wires = [(bus.medium, bus.channel) for bus in named]
        if twice := next((bus for bus, wire in zip(named, wires, strict=True) if wires.count(wire) > 1), None):
            raise ValueError(f"two buses are {twice.interface} {twice.channel}; give each its own channel")
        used = {bus for bus, _ in places}
        for bus in range(len(self.buses)):
            if bus not in used:
                raise ValueError(f"no drive is on bus {bus} (counted from 0)")
        return self


def motor_speeds(transmission: Transmission, velocities: Sequence[float | None]) -> list[float]:
    """Return how fast each motor turns at most [turns per minute] when all joints move at their velocity limits.

    Args:
        transmission: the arm's.
        velocities: of the joints [rad/s or m/s]; None where one has no limit, which counts as standing still.
    """
    size = len(transmission.ratios)
    coupling = np.eye(size) if transmission.coupling is None else np.array(transmission.coupling)
    known = np.array([0.0 if one is None else one for one in velocities])
    motors = np.abs(np.array(transmission.ratios)) * (np.abs(coupling) @ known)
    return [float(speed) for speed in motors * 60.0 / (2.0 * math.pi)]


def quick_stop_decelerations(
    driver: CanopenDriver, transmission: Transmission, accelerations: Sequence[float | None]
) -> list[int | None]:
    """Return what 6085h of each drive is set to, None where nothing says it.

    Args:
        driver: the section `driver`.
        transmission: the arm's.
        accelerations: limits of the joints [rad/s^2 or m/s^2], by which the motors brake in counts per square second
            where a drive's section does not say otherwise; None where a joint has none.
    """
    turns = motor_speeds(transmission, accelerations)
    found: list[int | None] = []
    for drive, perminute in zip(driver.drives, turns, strict=True):
        counts = round(perminute / 60.0 * drive.counts)
        own = drive.quick_stop_deceleration
        found.append(own if own is not None else min(counts, 0xFFFF_FFFF) if counts else None)
    return found


def disagreements(
    driver: CanopenDriver,
    transmission: Transmission | None,
    joints: Sequence[str],
    rate: float,
    homeless: Sequence[str] = (),
    velocities: Sequence[float | None] = (),
) -> Iterator[tuple[tuple[str | int, ...], str]]:
    """What does not fit an arm of these joints: the place in the arm's file, and what is wrong.

    Args:
        driver: the section `driver`.
        transmission: the arm's.
        joints: names of the arm's joints; none where the file does not name them.
        rate: cycles per second.
        homeless: those without a `home`.
        velocities: of the joints [rad/s or m/s], None where one has no limit; none where the file names no joints.
    """
    if driver.zero == "at_home" and homeless:
        yield (
            ("driver", "zero"),
            "driver.zero: at_home needs every joint's home, the posture in which a person zeroes the arm; missing: "
            + ", ".join(f"joints.{name}.home" for name in homeless),
        )
    if driver.reactions.abort_connection == 0 and any(drive.watchdog in ABORTING for drive in driver.drives):
        yield (
            ("driver", "reactions"),
            "driver.reactions.abort_connection: 0 has drives do nothing when the host is gone (6007h); take what the"
            " drive's manual calls a quick stop or a fault",
        )
    guarded = sum(drive.watchdog == "node_guarding" for drive in driver.drives)
    if guarded / rate > _ASKED * driver.guarding.period:
        yield (
            ("driver", "guarding"),
            f"driver.guarding.period: {driver.guarding.period:g} s is too short to ask {guarded} drives, one a cycle"
            f" at {rate:g} Hz; at least {guarded / rate / _ASKED:.3g} s",
        )
    if guarded and any(b.data_bitrate for b in driver.buses):
        yield ("driver", "buses"), "driver.buses: CAN FD has no remote frames, which node guarding asks with"
    if driver.torque_deadline * rate < _LEAST_DEADLINE:
        yield (
            ("driver", "torque_deadline"),
            f"driver.torque_deadline: {driver.torque_deadline:g} s at {rate:g} Hz has no room for a late torque frame;"
            f" at least {_LEAST_DEADLINE:g} cycles are needed, {_LEAST_DEADLINE / rate:g} s",
        )
    if transmission is None:
        yield ("driver",), "CANopen drives need the section transmission: gear ratios from joints to motors"
    elif len(transmission.ratios) != len(driver.drives):
        yield ("driver", "drives"), f"{len(driver.drives)} drives but {len(transmission.ratios)} ratios in transmission"
    elif len(velocities) == len(driver.drives):
        for k, (drive, speed) in enumerate(zip(driver.drives, motor_speeds(transmission, velocities), strict=True)):
            if drive.max_speed < _WHOLE_TURNS * speed:
                yield (
                    ("driver", "drives", k),
                    f"driver.drives: node {drive.node} would give no torque above max_speed {drive.max_speed:g} turns"
                    f" per minute (6080h), but its motor turns at {speed:.0f} when joints move at their limits:"
                    " raise max_speed, or lower joints.NAME.velocity",
                )
    shares = driver.torque_frames == "shared" and any(
        sum(drive.bus == bus for drive in driver.drives) > 1 for bus in range(len(driver.buses))
    )
    if why := eds_mistake(driver.eds.text):
        yield ("driver", "eds"), f"driver.eds: {driver.eds.name} is not an EDS (CiA 306): {why}; take the drive maker's"
    elif shares and not maps_dummies(driver.eds.text):
        yield (
            ("driver", "eds"),
            f"driver.eds: {driver.eds.name} has no Dummy0003=1 under [DummyUsage], so that these drives cannot share"
            " torque frames; set driver.torque_frames to single, at a rate that it fits",
        )
    elif driver.measured_torque in ("cyclic", "status") and not has_object(driver.eds.text, 0x6077):
        yield (
            ("driver", "measured_torque"),
            f"driver.measured_torque: {driver.eds.name} has no 6077h, so that these drives do not tell their torque",
        )
    if joints and len(joints) != len(driver.drives):
        yield ("driver", "drives"), f"{len(driver.drives)} drives for {len(joints)} joints"
