"""CANopen drives (CiA 301, CiA 402) on one or two buses, as an arm's description names them.

Boundary: data only. Frames and their cost on the wire are `drivers/canopen`, gears and couplings the section
`transmission` of the arm, whose motors are the drives here, in this order.
"""

from __future__ import annotations

import configparser
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Annotated, Literal

from pydantic import Field, model_validator

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

NodeId = Annotated[int, Field(strict=True, ge=1, le=127)]
Seconds = Annotated[float, Field(strict=True, ge=0.001, le=60.0)]  # whole ms of 16 bits in the drive
InhibitTime = Annotated[float, Field(strict=True, ge=0.0001, le=6.5)]  # 100 us of 16 bits
_KERNELS = ("raw", "socketcan")  # two ways to the same interfaces
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


class CanopenDrive(Section):
    """One drive and its motor.

    `counts` are those of a motor turn (6064h); `rated_torque` [N m] at the motor is what 6076h is set to, or must be
    where the drive does not let it be set; a torque is sent in thousandths of it. `torque_scale` is how much torque
    the motor really gives for one that was asked for. `max_torque` [N m] and `max_speed` [turns per minute] of the
    motor are set as 6072h and 6080h. `notices` are the emergency codes by which this drive, as its manual says, only
    informs: they are told and recorded, and stop nothing.
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


class Heartbeats(Section):
    """Who says that it lives, how often, and how long the others wait for it [s] (1017h, 1016h)."""

    node: NodeId = 127
    period: Seconds = 0.1
    drives: Seconds = 0.1
    timeout: Seconds = 0.3

    @model_validator(mode="after")
    def _patient(self) -> Heartbeats:
        if self.timeout <= max(self.period, self.drives):
            raise ValueError(f"a timeout of {self.timeout:g} s is not longer than the heartbeats' periods")
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
    all; left out, with their status where the EDS has the object.
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
    later = frozenset({"measured_torque"})
    heartbeats: Heartbeats = Heartbeats()
    reactions: Reactions = Reactions()
    status: StatusReports = StatusReports()
    emulation: Emulation = Emulation()

    @property
    def watchdog(self) -> float:
        """How long a drive goes on without torque frames [s]."""
        return self.torque_deadline

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


@lru_cache(maxsize=8)
def maps_dummies(eds: str) -> bool:
    """Whether a drive lets 16 bits of a torque frame be another drive's: `Dummy0003=1` of its EDS (CiA 306-1).

    Args:
        eds: the EDS's text; one that cannot be read says no.
    """
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    try:
        parser.read_string(eds)
        section = next((name for name in parser.sections() if name.lower() == "dummyusage"), None)
        return section is not None and int(parser.get(section, "Dummy0003", fallback="0"), 0) == 1
    except (configparser.Error, ValueError):
        return False


@lru_cache(maxsize=8)
def has_object(eds: str, index: int) -> bool:
    """Return whether an EDS (CiA 306-1) lists an object; one that cannot be read lists none."""
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    try:
        parser.read_string(eds)
    except configparser.Error:
        return False
    return any(name.upper() == f"{index:04X}" for name in parser.sections())


@lru_cache(maxsize=8)
def eds_mistake(eds: str) -> str | None:
    """Why a text is no EDS (CiA 306-1: an ini file with the section DeviceInfo); None where it may be one."""
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    try:
        parser.read_string(eds)
    except configparser.Error as error:
        return str(error).splitlines()[0].removesuffix(" file: '<string>'")
    if not any(name.lower() == "deviceinfo" for name in parser.sections()):
        return "it has no section [DeviceInfo]"
    return None


def disagreements(
    driver: CanopenDriver,
    transmission: Transmission | None,
    joints: Sequence[str],
    rate: float,
    homeless: Sequence[str] = (),
) -> Iterator[tuple[tuple[str | int, ...], str]]:
    """What does not fit an arm of these joints: the place in the arm's file, and what is wrong.

    Args:
        driver: the section `driver`.
        transmission: the arm's.
        joints: names of the arm's joints; none where the file does not name them.
        rate: cycles per second.
        homeless: those without a `home`.
    """
    if driver.zero == "at_home" and homeless:
        yield (
            ("driver", "zero"),
            "driver.zero: at_home needs every joint's home, the posture in which a person zeroes the arm; missing: "
            + ", ".join(f"joints.{name}.home" for name in homeless),
        )
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
