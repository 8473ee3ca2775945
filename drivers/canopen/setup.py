"""What every drive is told before anything moves: who it must be, what it protects by itself, which frames it speaks.

Everything that protects is written and read back (FIELDBUS.md 2.5). Entries that a drive may lack are left out where
it does: position limits, SYNC's period and window, the interpolation period, PDOs that are only switched off.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from drivers.arm import Watchdog
from drivers.canopen import dictionary as od
from drivers.canopen.coordinates import Coordinates, torque_limit_counts
from drivers.canopen.dictionary import Entry, Kind
from drivers.canopen.profile import BusProfile, Write
from drivers.canopen.sdo import DOES_NOT_EXIST, READ_ONLY, Objects, SdoRefused
from drivers.canopen.words import POWER_OFF, state_of
from drivers.canopen.zero import Zeros
from ident_service.config.canopen import (
    CanopenDrive,
    CanopenDriver,
    DriveIdentity,
    Reactions,
    motor_speeds,
    quick_stop_decelerations,
)
from ident_service.config.schema import ArmConfig
from ident_service.errors import AnotherDrive, DriverError

LIMIT_SLACK = 0.05  # rad or m beyond the joints' limits that the drives are told of
DRIVE_PROFILE = 402  # low word of 1000h
_FIRMWARE = 0x100A
_COUNTS_PER_LINE = (1.0, 4.0)
_GENTLER = 0.5  # of the wanted deceleration, that a drive's own may be: the ramp takes twice as long
_LETS_GO, _STAYS = 2, 6  # values of 605Ah: a ramp, then power off, or hold on
IDENTITY = {"vendor": od.VENDOR, "product": od.PRODUCT, "revision": od.REVISION, "serial": od.SERIAL}


@dataclass(frozen=True)
class MotorLimits:
    """Keep what the joints' limits mean for one motor.

    Attributes:
        positions: lowest and highest [counts], for a drive that heeds them; None where joints have none.
        speed: at which it turns when all joints move at their velocity limits [turns per minute].
        deceleration: 6085h, in the drive's unit; None where neither the drive's section nor the joints say one.
    """

    positions: tuple[int, int] | None
    speed: float = 0.0
    deceleration: int | None = None


@dataclass(frozen=True)
class Setup:
    """One drive's part of the configuration.

    Attributes:
        drive: its section.
        profile: of its bus.
        reactions: to what it finds by itself.
        quick_stop: 605Ah, in place of what `reactions` leaves open.
        motor: what the joints' limits mean for it.
    """

    drive: CanopenDrive
    profile: BusProfile
    reactions: Reactions
    quick_stop: int
    motor: MotorLimits

    def protections(self) -> list[Write]:
        """What the drive keeps to by itself."""
        drive = self.drive
        return [
            Write(od.MAX_TORQUE, torque_limit_counts(drive.max_torque, drive.rated_torque)),
            Write(od.QUICK_STOP_OPTION, self.quick_stop),
            Write(od.FAULT_OPTION, self.reactions.fault),
            Write(od.ABORT_CONNECTION, self.reactions.abort_connection),
            *self.watchdog(),
        ]

    def watchdog(self) -> list[Write]:
        """Return what sets a watchdog of the maker's."""
        if (own := self.drive.watchdog_entry) is None:
            return []
        return [Write(Entry(own.index, own.sub, Kind[own.type.upper()], "watchdog of the drive's maker"), own.value)]

    def positions(self) -> list[Write]:
        """Return the position limits: no protection, since drives in torque mode give torque beyond them."""
        if self.motor.positions is None:
            return []
        return [Write(od.LOWER_LIMIT, self.motor.positions[0]), Write(od.UPPER_LIMIT, self.motor.positions[1])]

    def timing(self) -> list[Write]:
        """The cycle, for drives that want to know it."""
        period_us = round(1e6 / self.profile.rate)
        power = next(power for power in (-3, -4, -5, -6) if period_us % 10 ** (6 + power) == 0)
        number = period_us // 10 ** (6 + power)
        todo = [Write(od.SYNC_PERIOD, period_us), Write(od.SYNC_WINDOW, 0)]
        if number <= 0xFF:
            todo += [Write(od.PERIOD_POWER, power), Write(od.PERIOD_NUMBER, number)]
        return todo


def motor_limits(config: ArmConfig, found: Coordinates) -> list[MotorLimits]:
    """Return what the limits of an arm's joints mean for each of its motors.

    Args:
        config: with a CANopen driver and a transmission.
        found: its coordinates, of the zero that the drives have.
    """
    driver, gears, joints = config.driver, config.transmission, list(config.joints.values())
    assert isinstance(driver, CanopenDriver)  # noqa: S101 - refused in the beginning
    assert gears is not None  # noqa: S101 - likewise
    lowest, highest = np.array([joint.position or (-np.inf, np.inf) for joint in joints]).T
    limits = found.count_limits(lowest - LIMIT_SLACK, highest + LIMIT_SLACK)
    speeds = motor_speeds(gears, [joint.velocity for joint in joints])
    brakes = quick_stop_decelerations(driver, gears, [joint.acceleration for joint in joints])
    return [MotorLimits(*one) for one in zip(limits, speeds, brakes, strict=True)]


def watchdogs_of(driver: CanopenDriver, names: Sequence[str]) -> tuple[Watchdog, ...]:
    """Return what the watchdog of each drive watches; `names` are what people call the drives."""
    found, of_torque = zip(names, driver.drives, strict=True), ("rpdo_timer", "vendor")
    seconds = driver.watchdog_seconds
    return tuple(Watchdog(name, one.watchdog, seconds(one), one.watchdog in of_torque) for name, one in found)


def differences(found: Mapping[str, int], wanted: DriveIdentity) -> list[str]:
    """What of an identity (1018h), by the keys of `IDENTITY`, is another than the configuration wants; in words."""
    return [
        f"{name} is {found[name]:08X}h instead of {value:08X}h" if name in found else f"{name} is not told"
        for name, value in wanted.model_dump(exclude_none=True).items()
        if found.get(name) != value
    ]


def quick_stop_option(config: ArmConfig) -> int:
    """Return what 605Ah is set to: as described, else to stay in quick stop where the arm has no brakes."""
    assert isinstance(config.driver, CanopenDriver)  # noqa: S101 - of an arm of CANopen drives
    described = config.driver.reactions.quick_stop
    if described is not None:
        return described
    return _STAYS if config.control.after_stop in ("hold", "lower") else _LETS_GO


def identify(objects: Objects, wanted: DriveIdentity) -> str:
    """Ask a drive who it is.

    Returns:
        `node 3: vendor 0000019Eh, product ..., revision ..., serial ..., firmware ...`.

    Raises:
        DriverError: it does not answer, is no drive, or not the one that the configuration names.
    """
    kind = objects.read(od.DEVICE_TYPE)
    if kind & 0xFFFF != DRIVE_PROFILE:
        raise DriverError(f"node {objects.node}: is no drive of CiA 402 (1000h is {kind:08X}h)")
    found = {}
    for name, entry in IDENTITY.items():
        try:
            found[name] = objects.read(entry)
        except SdoRefused as refused:  # all but the vendor are optional (CiA 301, 7.5.2.19)
            if refused.code not in DOES_NOT_EXIST:
                raise
    if others := differences(found, wanted):
        raise AnotherDrive(f"node {objects.node}: is not the drive that the configuration names: {', '.join(others)}")
    try:
        firmware = objects.read_bytes(_FIRMWARE, 0, "software version").decode("ascii", "replace").strip("\0 ")
    except SdoRefused:
        firmware = "not told"
    words = ", ".join(f"{name} {value:08X}h" for name, value in found.items())
    return f"node {objects.node}: {words}, firmware {firmware}"


def configure(objects: Objects, setup: Setup) -> None:
    """Make a pre-operational drive speak the profile and protect itself.

    Raises:
        DriverError: it refuses or forgets something; the message names the entry and says why.
    """
    _encoder(objects, setup.drive)
    _rated_torque(objects, setup.drive)
    _max_speed(objects, setup)
    _deceleration(objects, setup)
    for write in setup.protections():
        objects.set(write)
    for write in (*setup.positions(), *setup.timing()):
        _if_there(objects, write)
    if not objects.read(od.SUPPORTED_MODES) & od.CST_SUPPORTED:
        raise DriverError(f"node {objects.node}: does not support cyclic synchronous torque mode (6502h, bit 9)")
    objects.write(Write(od.MODE, od.CST))
    silenced = setup.profile.silenced(setup.drive.node)
    writes = setup.profile.writes(setup.drive.node)
    kind = setup.drive.watchdog
    # Who neither waits for heartbeats nor has a torque frame's deadline may have no 1016h at all.
    spare = (od.ERROR_BEHAVIOUR, *(() if kind in ("rpdo_timer", "heartbeat") else (od.HEARTBEAT_CONSUMER,)))
    for write in writes:
        if write in silenced or write.entry in spare:
            _if_there(objects, write)
        else:
            objects.write(write)
    for write in writes:
        guarded = write.entry in (od.RPDO_DEADLINE, od.HEARTBEAT_CONSUMER, od.GUARD_TIME, od.LIFE_FACTOR)
        if guarded and write.entry not in spare and objects.read(write.entry) != write.value:
            raise DriverError(
                f"node {objects.node}: {write.entry} does not hold {write.value}: it would not stop by itself"
            )
    if (mode := objects.read(od.MODE_DISPLAY)) != od.CST:
        raise DriverError(f"node {objects.node}: is in mode {mode} (6061h) although {od.CST} was set")


def released(objects: Objects, zeros: Zeros | None, number: int, restarted: Callable[[], bool]) -> Iterator[None]:
    """Let a drive that is off forget that a host will be missed; one that is not shall miss it, and stop.

    It comes in steps of a few frames each, for cycles between them. What a drive vouches for (`zero.py`) it vouches for
    afterwards too, and nothing else: one that restarted in the session has lost its zero.

    Args:
        objects: of the drive.
        zeros: of the arm, None where drives know their position.
        number: of the drive.
        restarted: whether it has sent a boot-up message in the session.

    Raises:
        DriverError: it does not answer, or refuses.
    """
    # Asked for: a status report may be held back by its inhibit time.
    if state_of(objects.read(od.STATUS_WORD)) not in POWER_OFF:
        return
    counts = None
    if zeros is not None:
        counts = zeros.held(objects, number)
        yield
    objects.write(Write(od.ABORT_CONNECTION, 0))
    for entry in (od.HEARTBEAT_CONSUMER, od.GUARD_TIME):  # or 8130h would follow every session
        _if_there(objects, Write(entry, 0))
    if zeros is not None and counts is not None:
        yield
        zeros.keep_on(objects, number, counts, restarted)


def _encoder(objects: Objects, drive: CanopenDrive) -> None:
    """Compare the described counts of a motor turn with those that the drive's own scaling says, where it has them.

    A drive with a gear ratio of its own (6091h) tells positions in another unit. Some give the lines of an encoder, of
    which each has four counts.
    """
    counts, turns, motor, shaft = (
        _perhaps(objects, entry) for entry in (od.ENCODER_COUNTS, od.ENCODER_TURNS, od.GEAR_MOTOR, od.GEAR_SHAFT)
    )
    if not counts or not turns or motor != shaft:
        return
    ratio = drive.counts * turns / counts
    if ratio not in _COUNTS_PER_LINE:
        raise DriverError(
            f"node {objects.node}: a motor turn has {counts / turns:g} counts by the drive (608Fh), {drive.counts} by "
            f"the description (drives.counts): the scale of its positions is wrong by {ratio:g}"
        )


def _perhaps(objects: Objects, entry: Entry) -> int | None:
    """Read an entry; None where the drive has no such entry."""
    try:
        return objects.read(entry)
    except SdoRefused as refused:
        if refused.code not in DOES_NOT_EXIST:
            raise
        return None


def _rated_torque(objects: Objects, drive: CanopenDrive) -> None:
    """Set what a thousandth is of, or make sure that it is so where the drive alone decides."""
    wanted = Write(od.RATED_TORQUE, round(1e3 * drive.rated_torque))
    try:
        objects.set(wanted)
    except SdoRefused as refused:
        if refused.code not in READ_ONLY:
            raise
        held = objects.read(od.RATED_TORQUE)
        if held != wanted.value:
            raise DriverError(
                f"node {objects.node}: its rated torque is {held} mN m and cannot be set; "
                f"the configuration says rated_torque: {drive.rated_torque:g}"
            ) from None


def _max_speed(objects: Objects, setup: Setup) -> None:
    """Set the motor's largest speed, or make sure that the drive's own leaves the joints their velocities.

    Above it a drive takes its torque back, in the middle of a motion.
    """
    wanted = Write(od.MAX_SPEED, round(setup.drive.max_speed))
    try:
        objects.set(wanted)
    except SdoRefused as refused:
        if refused.code not in READ_ONLY:
            raise
        held = objects.read(od.MAX_SPEED)
        if held < round(setup.motor.speed):
            raise DriverError(
                f"node {objects.node}: gives no torque above {held} turns per minute (6080h, which cannot be set), "
                f"but its motor turns at {setup.motor.speed:.0f} at the joints' limits; lower joints.NAME.velocity"
            ) from None


def _deceleration(objects: Objects, setup: Setup) -> None:
    """Set the deceleration of quick stops (6085h), where a drive has one; it may have a better one of its own."""
    if setup.motor.deceleration is None:
        return
    wanted = Write(od.QUICK_STOP_DECELERATION, setup.motor.deceleration)
    try:
        objects.set(wanted)
    except SdoRefused as refused:
        if refused.code in DOES_NOT_EXIST and setup.drive.quick_stop_deceleration is None:
            return
        if refused.code not in READ_ONLY:
            raise
        held = objects.read(od.QUICK_STOP_DECELERATION)
        if held < _GENTLER * wanted.value:
            raise DriverError(
                f"node {objects.node}: brakes by {held} in a quick stop (6085h, which cannot be set), {wanted.value} "
                "wanted; give its drives.quick_stop_deceleration where its unit is not counts per square second"
            ) from None


def _if_there(objects: Objects, write: Write) -> None:
    try:
        objects.write(write)
    except SdoRefused as refused:
        if refused.code not in DOES_NOT_EXIST:
            raise
