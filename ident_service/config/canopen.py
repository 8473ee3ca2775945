"""Describe CANopen drives (CiA 301, CiA 402) on one to four buses, and how each stops when its host is gone.

Frames and their cost on the wire are `drivers/canopen`, gears and couplings the section `transmission` of the arm,
whose motors are the drives here, in this order.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import Field, model_validator

from ident_service.config.can_bus import CanBus
from ident_service.config.drive_family import Family, parse_family
from ident_service.config.eds import DataSheet, data_sheet
from ident_service.config.quantities import (
    AnyTextBeside,
    Count,
    ExtendedSection,
    ParameterTable,
    PerJoint,
    Positive,
    Section,
    Seed,
    TextBeside,
    TextFile,
)
from ident_service.config.recording import Transmission, motor_disagreements
from ident_service.config.simulation import SimulatedFault, WindingsOff
from ident_service.errors import DriverError

NodeId = Annotated[int, Field(strict=True, ge=1, le=127)]
Seconds = Annotated[float, Field(strict=True, ge=0.001, le=60.0)]  # whole ms of 16 bits in the drive
WatchdogKind = Literal["rpdo_timer", "heartbeat", "sync_loss", "node_guarding", "vendor"]
# Watchdogs whose reaction 6007h selects; a maker's own watchdog may have a reaction of its own.
ABORTING: Final = ("rpdo_timer", "heartbeat", "sync_loss", "node_guarding")
_MAKERS = range(0x2000, 0x6000)  # indices that CiA 301 leaves to makers of drives


class WatchdogEntry(Section):
    """Maker-specific entry that sets a drive's watchdog; it is written and read back."""

    index: Annotated[int, Field(strict=True, ge=_MAKERS.start, lt=_MAKERS.stop)]
    """Index of the object [1], as hexadecimal in the manual."""
    sub: Annotated[int, Field(strict=True, ge=0, le=0xFF)] = 0
    """Sub-index [1]."""
    type: Literal["i8", "u8", "i16", "u16", "i32", "u32"]
    """Type of the object."""
    value: Annotated[int, Field(strict=True)]
    """Value that is written and read back [1]."""

    @model_validator(mode="after")
    def _fits(self) -> WatchdogEntry:
        bits = int(self.type[1:])
        low, high = (0, 2**bits) if self.type.startswith("u") else (-(2 ** (bits - 1)), 2 ** (bits - 1))
        if not low <= self.value < high:
            raise ValueError(f"{self.value} is no {self.type}")
        return self


class Heartbeats(ExtendedSection):
    """Heartbeats of host and drives (1017h, 1016h)."""

    node: NodeId = 127
    """Node number of the host [1]."""
    period: Seconds = 0.1
    """Period of the host's heartbeat [s]."""
    drives: Seconds = 0.1
    """Period of the drives' heartbeats (1017h) [s]."""
    timeout: Seconds = 0.3
    """Time without a drive's heartbeat after which it counts as gone [s]."""
    host_timeout: Seconds | None = None
    """Time that drives whose watchdog it is wait for the host's (1016h) [s]; `timeout` when left out."""
    later = frozenset({"host_timeout"})

    @property
    def waits(self) -> float:
        """Return how long drives wait for the host's heartbeat [s]: `host_timeout`, or `timeout` without it."""
        return self.timeout if self.host_timeout is None else self.host_timeout

    @model_validator(mode="after")
    def _patient(self) -> Heartbeats:
        if self.timeout <= max(self.period, self.drives):
            raise ValueError(f"a timeout of {self.timeout:g} s is not longer than the heartbeats' periods")
        if self.waits <= self.period:
            raise ValueError(f"drives that wait for {self.waits:g} s would miss a heartbeat every {self.period:g} s")
        return self


class NodeGuarding(Section):
    """Timing of `watchdog: node_guarding`."""

    period: Seconds = 0.02
    """Guard time (100Ch) [s]."""
    factor: Annotated[int, Field(strict=True, ge=2, le=255)] = 3
    """Guard times that may be missed (100Dh) [1]."""


InhibitTime = Annotated[float, Field(strict=True, ge=0.0001, le=6.5)]  # 100 us of 16 bits
_SLOTS = 4  # torques of 16 bits in a frame of eight bytes
_DUMMIES = frozenset({2, 3, 5, 6})  # data types of 8 or 16 bits, which fill the 16 bits of a torque
_MOST_PER_MILLE = 32_767  # of a torque of 16 bits
EmergencyCode = Annotated[int, Field(strict=True, ge=1, le=0xFFFF)]
# CiA 301, table 26: CAN controller in error passive; no heartbeat, or no torque frame, of the host.
BUS_EMERGENCIES = frozenset({0x8120, 0x8130, 0x8250})
Unsigned32 = Annotated[int, Field(strict=True, ge=0, le=0xFFFF_FFFF)]


class DriveIdentity(Section):
    """Expected identity of a drive (object 1018h); fields left out are logged but not compared."""

    vendor: Unsigned32 | None = None
    """Vendor identity (1018h:01) [1]."""
    product: Unsigned32 | None = None
    """Product code (1018h:02) [1]."""
    revision: Unsigned32 | None = None
    """Revision (1018h:03) [1]."""
    serial: Unsigned32 | None = None
    """Serial number (1018h:04) [1]."""


class CanopenDrive(ExtendedSection):
    """One drive and its motor."""

    node: NodeId
    """Node number [1]."""
    bus: Annotated[int, Field(strict=True, ge=0)] = 0
    """Number of its bus in `buses`, from 0 [1]."""
    identity: DriveIdentity = DriveIdentity()
    """Expected identity; keys that are left out are logged but not compared."""
    counts: Count = 4096
    """Counts of a motor turn (6064h) [1]."""
    rated_torque: Positive
    """Torque at the motor that 6076h is set to, or must be where the drive does not let it be set [N m]; torques are
    sent in thousandths of it."""
    torque_scale: Positive = 1.0
    """Torque that the motor really gives per torque that was asked for [1]."""
    max_torque: Positive
    """Largest torque of the motor (6072h) [N m]."""
    max_speed: Positive
    """Largest speed of the motor (6080h) [turns/min]."""
    notices: tuple[EmergencyCode, ...] = ()
    """Emergency codes by which this drive, as its manual says, only informs [1]: they are reported and recorded, and
    stop nothing."""
    watchdog: WatchdogKind = "rpdo_timer"
    """Signal of the host whose loss makes the drive stop by itself: torque frames (`rpdo_timer`, 1400h:05), heartbeat
    (1016h), SYNC, node guarding, or something of its maker's that watches torque frames."""
    watchdog_time: Seconds | None = None
    """Time after which a watchdog `sync_loss` or `vendor` trips, by the maker [s]."""
    watchdog_entry: WatchdogEntry | None = None
    """Maker's object that sets the watchdog `vendor`."""
    quick_stop_deceleration: Annotated[Unsigned32, Field(ge=1)] | None = None
    """Value of 6085h [drive's unit]; left out, it stops the joints at their acceleration limits, in counts per square
    second."""
    eds: AnyTextBeside | None = None
    """Data sheet of this drive, where it is another type than the others; a file beside the description."""
    torque_constant: Positive | None = None
    """Torque per current of the motor [N m/A], for drives whose thousandths are of a current."""
    current_unit: Positive | None = None
    """Current of one count of the target [A], for drives that count it in a unit of their own (Technosoft iPOS: twice
    the drive's peak current by 65520)."""
    torque_shift: Annotated[int, Field(strict=True, ge=0, le=16)] | None = None
    """Bits by which a torque is shifted in a target of 32 bits [1], where the drive has such a one (`ident bus probe`
    says so); left out, targets have 16 bits."""
    later = frozenset(
        {
            *("watchdog", "watchdog_time", "watchdog_entry", "quick_stop_deceleration"),
            *("eds", "torque_constant", "current_unit", "torque_shift"),
        }
    )

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
    def _require_drive_notices(self) -> CanopenDrive:
        if bad := [f"{code:04X}h" for code in self.notices if code in BUS_EMERGENCIES]:
            raise ValueError(f"notices: {', '.join(bad)} tells that the drive does not hear its host; it always counts")
        return self

    @model_validator(mode="after")
    def _fits_the_objects(self) -> CanopenDrive:
        micro = 1e6 * self.rated_torque
        if round(micro) < 1 or abs(micro - round(micro)) > 1e-3:
            raise ValueError(f"rated_torque {self.rated_torque:g} is not whole uN m, the finest that drives hold")
        share = 1000.0 * self.max_torque / self.rated_torque
        if not 1.0 <= share <= _MOST_PER_MILLE + 1e-6:
            raise ValueError(
                f"max_torque {self.max_torque:g} is {share / 1000.0:g} times rated_torque; a torque is sent in"
                f" thousandths of it, from 1 to {_MOST_PER_MILLE}: choose another rated_torque"
            )
        return self


class Reactions(Section):
    """Reactions of a drive to faults and stops: option codes of CiA 402, as its manual numbers them."""

    quick_stop: Annotated[int, Field(strict=True)] | None = (
        None  # 605Ah: 2 and 6 ramp, then switch-on disabled, or stay
    )
    """Reaction to quick stop (605Ah) [1]: 2 and 6 ramp, then switch on disabled, or stay. Left out it is 2, or 6 for an
    arm without brakes (`control.after_stop` is `hold` or `lower`), which the drive goes on holding."""
    fault: Annotated[int, Field(strict=True)] = 2  # 605Eh: quick-stop ramp
    """Reaction to a fault (605Eh) [1]: 2 is the quick-stop ramp."""
    abort_connection: Annotated[int, Field(strict=True)] = 3  # 6007h: quick stop
    """Reaction to the loss of the host (6007h) [1]: 3 is quick stop."""


class StatusReports(ExtendedSection):
    """Status word and torque, sent on change (TPDO2), or with each position (TPDO1)."""

    period: Seconds = 0.1
    """Longest time between two reports (TPDO2) [s]."""
    inhibit: InhibitTime = 0.05
    """Shortest time between two reports [s]."""
    frame: Literal["own", "position"] | None = None
    """Frame of the status word: its own (TPDO2), or that of the position (TPDO1), in every cycle; left out, the latter
    where the EDS has no TPDO2."""
    later = frozenset({"frame"})


class Emulation(ExtendedSection):
    """Simulated arm behind emulated drives, with true parameters, noise and faults, as `SimulatedDriver` has."""

    seed: Seed = 0
    """Seed of the random numbers [1]."""
    truth: ParameterTable | None = None
    """True parameters [SI]; the prior's when left out."""
    torque_noise: PerJoint = 0.0
    """Standard deviation of the torque in each cycle [N m or N], one or per joint."""
    braking: PerJoint | None = None
    """Damping of drives that are off [N m s/rad or N s/m], one or per joint."""
    windings_off: WindingsOff = "open"
    """Windings of a drive whose power stage is off: `open` coasts, `shorted` brakes."""
    eds: tuple[AnyTextBeside, ...] = ()
    """Data sheets by which the drives are emulated instead of the described ones, one after the other and then from
    the first again."""
    later = frozenset({"windings_off", "eds"})
    faults: tuple[SimulatedFault, ...] = ()
    """Faults to inject."""


class CanopenDriver(ExtendedSection):
    """CANopen drives in cyclic synchronous torque mode, or position mode."""

    kind: Literal["canopen"]
    """CANopen drives (CiA 402)."""
    eds: AnyTextBeside
    """Electronic data sheet of the drives, their maker's; a file beside the description."""
    buses: Annotated[tuple[CanBus, ...], Field(min_length=1, max_length=4)] = (CanBus(),)
    """CAN buses, at most four."""
    drives: Annotated[tuple[CanopenDrive, ...], Field(min_length=1)]
    """Drives, in the order of `transmission.ratios`."""
    torque_frames: Literal["shared", "single"] = "shared"
    """Up to four drives share a torque frame, by dummy mapping, or each has its own."""
    torque_deadline: Seconds = 0.01
    """Time without torque frames after which a drive stops by itself (1400h:05) [s]."""
    lost_cycles: Annotated[int, Field(ge=3, le=20)] = 3
    """Cycles in a row without its position after which a joint counts as gone [1]: 3 to 5, or what takes 10 ms, as long
    as a stall may last."""
    bring_up: Positive = 0.5
    """Time that all drives together may take for one step to `operation enabled` [s]."""
    zero: Literal["absolute", "at_home"] = "absolute"
    """Encoders know where they stand (`absolute`), or count from where they were when power came. Then a person leads
    the arm to the joints' `home` and says so, `ident set-home ARM`, after every loss of power."""
    measured_torque: Literal["cyclic", "status", "none"] | None = None
    """Drives report the torque that they measure (6077h) with their positions in every cycle, with their status, or not
    at all; left out, with their status where the EDS has the object."""
    watchdog_reason: Annotated[str, Field(max_length=200)] = ""
    """Reason why drives of an arm that can fall may take longer than 0.1 s to notice that the host is gone."""
    guarding: NodeGuarding = NodeGuarding()
    """Timing of `watchdog: node_guarding`."""
    profiles: tuple[TextBeside, ...] = ()
    """Files of families of drives, which count before the shipped ones."""
    streams: Literal["torque", "position"] = "torque"
    """Torque of each drive in every cycle, or its position (cyclic synchronous position): then the drives close the
    position loop, and tell the torque that they measure."""
    later = frozenset({"measured_torque", "watchdog_reason", "guarding", "profiles", "streams"})
    heartbeats: Heartbeats = Heartbeats()
    """Heartbeats of host and drives."""
    reactions: Reactions = Reactions()
    """Reactions of drives to faults and stops."""
    status: StatusReports = StatusReports()
    """Timing of status reports."""
    emulation: Emulation = Emulation()
    """Simulated arm behind emulated drives."""

    @property
    def watchdog(self) -> float:
        """Return the longest time that any drive keeps its torque after the host is gone [s]."""
        return max(self.watchdog_seconds(drive) for drive in self.drives)

    def watchdog_seconds(self, drive: CanopenDrive) -> float:
        """Return after how long without its signal a drive's watchdog trips [s]: its own setting, or its signal's."""
        times = {
            "rpdo_timer": self.torque_deadline,
            "heartbeat": self.heartbeats.waits,
            "node_guarding": self.guarding.period * self.guarding.factor,
        }
        return times[drive.watchdog] if drive.watchdog_time is None else drive.watchdog_time

    @property
    def sheets(self) -> tuple[DataSheet, ...]:
        """Return the parsed data sheet (EDS) of each drive, in the order of `drives`."""
        return tuple(data_sheet(self.sheet_file(number).text) for number in range(len(self.drives)))

    def sheet_file(self, drive_index: int) -> TextFile:
        """Return the data sheet's file of the drive with this index: its own `eds`, or the one common to all."""
        return self.drives[drive_index].eds or self.eds

    @property
    def sheets_allow_short_dummies(self) -> bool:
        """Return whether each drive's EDS allows dummies of 8 or 16 bits (DummyUsage), for shared torque frames."""
        return all(sheet.dummies & _DUMMIES for sheet in self.sheets)

    @property
    def families(self) -> tuple[Family, ...]:
        """Return the drive families that `profiles` add; raises DriverError for a file that describes none."""
        return tuple(parse_family(one.name, one.text) for one in self.profiles)

    @property
    def torque_reports(self) -> Literal["cyclic", "status", "none"]:
        """Return how measured torque is reported: as described, else `cyclic` for streamed positions, else by EDS."""
        if self.measured_torque is not None:
            return self.measured_torque
        if self.streams == "position":
            return "cyclic"
        return "status" if all(sheet.has(0x6077) for sheet in self.sheets) else "none"

    @property
    def status_frame(self) -> Literal["own", "position"]:
        """Return `own` if the status word has its own PDO, `position` if it is sent there: as described, or by EDS."""
        if self.status.frame is not None:
            return self.status.frame
        lacking = any(sheet.has(0x1800, 1) and not sheet.has(0x1801, 1) for sheet in self.sheets)
        return "position" if lacking else "own"

    @property
    def drives_per_frame(self) -> int:
        """Return the largest number of drives per frame of targets: 4, or 1 for 32-bit targets and `single` frames.

        Four torques of 16 bits share a frame. Two of 32 bits would fit, but no dummies do.
        """
        wide = self.streams == "position" or any(drive.torque_shift is not None for drive in self.drives)
        return 1 if wide or self.torque_frames == "single" else _SLOTS

    @property
    def report_delay(self) -> float:
        """Return the longest delay of a status change [s] beyond a cycle: the inhibit time, 0 without own frame."""
        return self.status.inhibit if self.status_frame == "own" else 0.0

    @model_validator(mode="after")
    def _require_distinct_nodes(self) -> CanopenDriver:
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
    """Return the motor speeds [turns per minute] when all joints move at their velocity limits.

    Args:
        transmission: the arm's.
        velocities: velocity limits of the joints [rad/s or m/s]; None where one has no limit, which counts as standing
            still.
    """
    known = np.array([0.0 if one is None else one for one in velocities])
    motors = np.abs(np.array(transmission.ratios)) * (np.abs(transmission.coupling_matrix) @ known)
    return [float(speed) for speed in motors * 60.0 / (2.0 * math.pi)]


def joint_torques(driver: CanopenDriver, transmission: Transmission) -> list[float]:
    """Return the largest torque or force that each joint's motors can give while other joints get none [N m or N].

    Args:
        driver: the section `driver`, with as many drives as ratios.
        transmission: the arm's.
    """
    motors = np.array([drive.max_torque * drive.torque_scale for drive in driver.drives])
    # tau_motor = J^-T tau: a joint alone asks each of its motors for a share.
    shares = np.abs(
        np.linalg.inv(np.array(transmission.ratios)[:, None] * transmission.coupling_matrix)
    )  # (joints, motors)
    with np.errstate(divide="ignore"):
        return [float(most) for most in (motors / np.where(shares > 1e-12, shares, 0.0)).min(axis=1)]


def motor_torques(driver: CanopenDriver, transmission: Transmission, torques: Sequence[float | None]) -> list[float]:
    """Return the largest torque to ask each motor for [N m] that keeps all joints within limits, whatever others give.

    A motor gives `torque_scale` times what it is asked for.

    Args:
        driver: the section `driver`, with as many drives as ratios.
        transmission: the arm's.
        torques: torque limits of the joints [N m or N]; None where one has none.
    """
    # (motors, joints): tau = J^T tau_motor
    reach = np.abs(np.array(transmission.ratios)[:, None] * transmission.coupling_matrix)
    asked = np.array([drive.max_torque for drive in driver.drives])
    given = asked * np.array([drive.torque_scale for drive in driver.drives])
    allowed = np.array([np.inf if one is None else one for one in torques])
    share = np.minimum(
        allowed / (reach.T @ given), 1.0
    )  # of every joint, when all of its motors give all that they have
    return [float(torque * share[row > 0.0].min()) for torque, row in zip(asked, reach, strict=True)]


def quick_stop_decelerations(
    driver: CanopenDriver, transmission: Transmission, accelerations: Sequence[float | None]
) -> list[int | None]:
    """Return 6085h of each drive [counts/s^2]: its own setting, else by joint `accelerations`; None without either.

    Args:
        driver: the section `driver`.
        transmission: the arm's.
        accelerations: acceleration limits of the joints [rad/s^2 or m/s^2], by which the motors brake in counts per
            square second where a drive's section does not say otherwise; None where a joint has none.
    """
    turns = motor_speeds(transmission, accelerations)
    found: list[int | None] = []
    for drive, perminute in zip(driver.drives, turns, strict=True):
        counts = round(perminute / 60.0 * drive.counts)
        own = drive.quick_stop_deceleration
        found.append(own if own is not None else min(counts, 0xFFFF_FFFF) if counts else None)
    return found


_ASKED = 0.7  # of the guard time, after which a drive is asked again; all must be asked within it
_WHOLE_TURNS = 0.999  # 6080h holds whole turns per minute
_ANOTHER_UNIT = 100.0  # times between a joint's torque limit and what its motors give: no choice is so far off
_POSITION_RATES = 100.0, 500.0  # Hz; slower the guard sees too little, faster a torque path is what a drive has
_LEAST_DEADLINE = 2.0  # cycles: one frame may be late


def disagreements(
    driver: CanopenDriver,
    transmission: Transmission | None,
    joints: Sequence[str],
    rate: float,
    joints_without_home: Sequence[str] = (),
    velocities: Sequence[float | None] = (),
    torques: Sequence[float | None] = (),
) -> Iterator[tuple[tuple[str | int, ...], str]]:
    """Yield (key path, message) for each contradiction of section `driver` with joints, homes, gears, rate or limits.

    Args:
        driver: the section `driver`.
        transmission: the arm's.
        joints: names of the arm's joints; none where the file does not name them.
        rate: cycles per second.
        joints_without_home: names of joints without a `home`.
        velocities: velocity limits of the joints [rad/s or m/s], None where one has no limit; none where the file names
            no joints.
        torques: torque limits of the joints [N m or N], likewise.
    """
    if driver.zero == "at_home" and joints_without_home:
        yield (
            ("driver", "zero"),
            "driver.zero: at_home needs every joint's home, the posture in which a person zeroes the arm; missing: "
            + ", ".join(f"joints.{name}.home" for name in joints_without_home),
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
    motors = len(driver.drives)
    what = "CANopen drives", "drives"
    yield from motor_disagreements(what, motors, driver.lost_cycles, transmission, joints, rate)
    if transmission is not None and len(transmission.ratios) == len(velocities) == motors:
        for k, (drive, speed) in enumerate(zip(driver.drives, motor_speeds(transmission, velocities), strict=True)):
            if drive.max_speed < _WHOLE_TURNS * speed:
                yield (
                    ("driver", "drives", k),
                    f"driver.drives: node {drive.node} would give no torque above max_speed {drive.max_speed:g} turns"
                    f" per minute (6080h), but its motor turns at {speed:.0f} when joints move at their limits:"
                    " raise max_speed, or lower joints.NAME.velocity",
                )
    if transmission is not None and len(torques) == len(transmission.ratios) == motors:
        for k, (limit, reach) in enumerate(zip(torques, joint_torques(driver, transmission), strict=True)):
            ratio = 1.0 if limit is None else max(reach / limit, limit / reach)
            if ratio > _ANOTHER_UNIT:
                yield (
                    ("driver", "drives", k),
                    f"driver.drives: joint {joints[k]} can be given {reach:.4g} by its gears and max_torque, but"
                    f" joints.{joints[k]}.torque is {limit:g}: {ratio:.3g} times apart, which is another unit or gear",
                )
    yield from _positions(driver, rate)
    shares = driver.drives_per_frame > 1 and any(
        sum(drive.bus == bus for drive in driver.drives) > 1 for bus in range(len(driver.buses))
    )
    if why := data_sheet(driver.eds.text).mistake:
        yield ("driver", "eds"), f"driver.eds: {driver.eds.name} is not an EDS (CiA 306): {why}; take the drive maker's"
    elif shares and not driver.sheets_allow_short_dummies:
        yield (
            ("driver", "eds"),
            f"driver.eds: {driver.eds.name} has no Dummy0003=1 under [DummyUsage], nor another dummy of 8 or 16"
            " bits, so that these drives cannot share torque frames; set driver.torque_frames to single, at a rate"
            " that it fits",
        )
    elif driver.measured_torque in ("cyclic", "status") and not all(sheet.has(0x6077) for sheet in driver.sheets):
        yield (
            ("driver", "measured_torque"),
            f"driver.measured_torque: {driver.eds.name} has no 6077h, so that these drives do not tell their torque",
        )
    try:
        driver.families  # noqa: B018 - reading them checks them
    except DriverError as error:
        yield ("driver", "profiles"), f"driver.profiles: {error}"


def _positions(driver: CanopenDriver, rate: float) -> Iterator[tuple[tuple[str | int, ...], str]]:
    """Yield what is inconsistent with drives that are given positions."""
    if driver.streams != "position":
        return
    if driver.torque_reports != "cyclic":
        yield (
            ("driver", "measured_torque"),
            "driver.measured_torque: drives that are given positions (driver.streams) must tell their torque in every"
            " cycle, as nobody else knows it; leave it out, or set it to cyclic",
        )
    least, most = _POSITION_RATES
    if not least <= rate <= most:
        yield (
            ("driver", "streams"),
            f"driver.streams: positions are streamed at {least:g} to {most:g} Hz, between which drives interpolate"
            f" (60C2h); control.rate is {rate:g}",
        )
    elif abs(1e6 / rate - round(1e6 / rate)) > 1e-6:
        yield ("driver", "streams"), f"driver.streams: a period of 1/{rate:g} s is not whole microseconds (60C2h)"
