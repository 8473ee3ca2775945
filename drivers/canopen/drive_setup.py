"""Configure drives before anything moves: who each must be, what it must have, its PDOs; only differences are written.

All that differ are switched off before one of them is written, so that no two share a COB-ID even for a moment. Some
drives have fixed COB-IDs, which must then be the wanted ones. Two dummies of 8 bits take the room of one of 16.

Everything is compared first, written where it differs, and read back (FIELDBUS.md 2.5; DRIVES.md 2 and 4). What a drive
lacks of it was judged before (`capabilities.py`): what is indispensable has been refused, what may be missing is left
out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from drivers.arm import Watchdog
from drivers.canopen import object_dictionary as od
from drivers.canopen.capabilities import DRIVE_PROFILE, TORQUE_UNITS, Capabilities, entry_text, parse_entry
from drivers.canopen.cia402 import (
    COMMUNICATION_ERROR,
    DISABLE_VOLTAGE,
    ERROR_PASSIVE,
    FAULTS,
    POWER_OFF,
    RESET_FAULT,
    DriveState,
    state_of,
)
from drivers.canopen.motor_units import count_limits, torque_limit_counts
from drivers.canopen.object_dictionary import Entry, Kind, OperationMode
from drivers.canopen.pdo_mapping import BusProfile, Pdo, Write
from drivers.canopen.sdo import (
    DOES_NOT_EXIST,
    READ_ONLY,
    WRONG_VALUE,
    Objects,
    SdoRefused,
    WriteNotVerified,
    none_if_missing,
)
from drivers.canopen.stored_zero import Zeros
from drivers.motor_units import Coordinates
from ident_service.config.arm import ArmConfig
from ident_service.config.canopen import (
    CanopenDrive,
    CanopenDriver,
    DriveIdentity,
    Reactions,
    motor_speeds,
    motor_torques,
    quick_stop_decelerations,
)
from ident_service.config.drive_family import PositionPath, TorquePath
from ident_service.errors import AnotherDrive, DriverError

_SMALL = {0x0002: Kind.I8, 0x0005: Kind.U8}
_DUMMIES = {0x0003: Kind.I16, 0x0006: Kind.U16} | _SMALL
_NOT_VALID = 1 << 31
_AT_SYNC = (1, 0, 255)  # types of frames of targets, in the order in which they are tried


def configure_pdos(objects: Objects, pdos: Sequence[Pdo], unused: Sequence[Pdo], dummies: Sequence[int]) -> bool:
    """Configure a pre-operational drive's PDOs; return whether targets act on arrival instead of at a SYNC.

    Args:
        objects: of the drive.
        pdos: PDOs that the drive shall have; slots of other drives are `od.DUMMY_INT16`.
        unused: PDOs that the drive shall not have; they may be missing.
        dummies: indices of dummies that may take the room of others' slots, in the order in which they are tried.

    Returns:
        Whether frames of targets act when they come, not at a SYNC, as the drive can do no better.

    Raises:
        SdoRefused: it does not take one of them.
        DriverError: it does not answer, or forgets something.
    """
    for pdo in unused:
        none_if_missing(lambda one: _off(objects, one), pdo)
    variants = {pdo: _variants(pdo, dummies) for pdo in pdos}
    waiting = [pdo for pdo in pdos if not any(_is_there(objects, one) for one in variants[pdo])]
    at_once = False
    for pdo in waiting:
        _off(objects, pdo)
    for pdo in waiting:
        _map(objects, variants[pdo])
        for write in pdo.parameters:
            if write.entry.sub == od.RPDO_TYPE.sub and not pdo.sent and pdo.type == _AT_SYNC[0]:
                at_once = _synchronous(objects, write) == _AT_SYNC[-1]
            elif write.entry.sub == od.TPDO_INHIBIT.sub:
                objects.write_if_present(write)
            else:
                objects.ensure(write)
        try:
            objects.ensure(pdo.on)
        except SdoRefused as refused:
            if refused.code not in READ_ONLY:
                raise
            words = "where COB-IDs are fixed, driver.torque_frames must be single"
            raise SdoRefused(f"{refused}; {words}", refused.code) from None
    for pdo in pdos:
        if not pdo.sent and not pdo.timer:
            objects.write_if_present(
                pdo.timing
            )  # a deadline left by another host could report a silence where there is none
    return at_once


def _synchronous(objects: Objects, wanted: Write) -> int:
    """Set the type of a frame of targets: at every SYNC, where a drive lacks that at the next, or at once; return it.

    At once, a target acts by the time that its frames need on the wire before the stamp of its cycle.
    """
    for kind in _AT_SYNC:
        try:
            objects.ensure(replace(wanted, value=kind))
        except SdoRefused as refused:
            if kind == _AT_SYNC[-1] or refused.code not in (*WRONG_VALUE, *READ_ONLY):
                raise
            if refused.code in READ_ONLY and (held := objects.read(wanted.entry)) in _AT_SYNC:
                return held
        else:
            return kind
    raise AssertionError("the last type is set or refused")


def _is_timed(objects: Objects, pdo: Pdo, write: Write) -> bool:
    """Return whether an entry holds a value; the type of a frame of targets may be that of the next SYNC.

    One that acts at once is the type from the factory: whether the drive has a better one shows when it is written.
    """
    if write.entry.sub == od.RPDO_TYPE.sub and not pdo.sent and pdo.type == _AT_SYNC[0]:
        return objects.read(write.entry) in _AT_SYNC[:2]
    return none_if_missing(objects.holds, write) is not False


def _variants(pdo: Pdo, dummies: Sequence[int]) -> list[Pdo]:
    """Return a PDO with each kind of dummy in the slots of other drives."""
    if od.DUMMY_INT16 not in pdo.slots:
        return [pdo]
    return [
        replace(pdo, slots=tuple(one for slot in pdo.slots for one in _room(slot, index)))
        for index in dummies or (od.DUMMY_INT16.index,)
    ]


def _room(slot: Entry, index: int) -> tuple[Entry, ...]:
    if slot != od.DUMMY_INT16:
        return (slot,)
    return (Entry(index, 0, _DUMMIES[index], "dummy"),) * (2 if index in _SMALL else 1)


def _is_there(objects: Objects, pdo: Pdo) -> bool:
    return _is_mapped(objects, pdo) and all(_is_timed(objects, pdo, write) for write in (*pdo.parameters, pdo.on))


def _is_mapped(objects: Objects, pdo: Pdo) -> bool:
    _, *slots, count = pdo.mapping
    return objects.holds(count) and all(objects.holds(slot) for slot in slots)


def _off(objects: Objects, pdo: Pdo) -> None:
    if objects.read(pdo.off.entry) & _NOT_VALID:
        return
    try:
        objects.write_verified(pdo.off)
    except SdoRefused as refused:
        if refused.code not in READ_ONLY:
            raise
        objects.ensure(pdo.mapping[0])  # what cannot be switched off exists by what it maps


def _map(objects: Objects, variants: Sequence[Pdo]) -> None:
    """Map the first variant of a PDO that the drive takes."""
    refusals = []
    for pdo in variants:
        if _is_mapped(objects, pdo):
            return
        try:
            for write in pdo.mapping:
                objects.write_verified(write)
        except SdoRefused as refused:
            refusals.append(refused)
        else:
            return
    why = refusals[0]
    if len(variants[0].slots) == 1:
        raise why
    raise SdoRefused(f"{why}; where it takes no dummy, driver.torque_frames must be single", why.code)


LIMIT_SLACK = 0.05  # rad or m by which the drives' position limits exceed the joints'
_FIRMWARE = 0x100A
_COUNTS_PER_LINE = (1.0, 4.0)
_GENTLER = 0.5  # of the wanted deceleration, that a drive's own may be: the ramp takes twice as long
_MODE_PATIENCE, _MODE_AGAIN_NS = 0.5, 10_000_000  # s for drives that show it while off, ns between two reads
_ROUNDING = 1e-6
_RESET_PATIENCE, _RESET_STEP_NS = 0.2, 3_000_000  # s, ns
_TARGETS = (od.TARGET_TORQUE, od.TARGET_TORQUE_WIDE, od.TARGET_POSITION)
_LETS_GO, _STAYS = 2, 6  # values of 605Ah: a ramp, then power off, or hold on
IDENTITY = {"vendor": od.VENDOR, "product": od.PRODUCT, "revision": od.REVISION, "serial": od.SERIAL}


@dataclass(frozen=True)
class MotorLimits:
    """Keep what the joints' limits mean for one motor.

    Attributes:
        positions: lowest and highest [counts], for a drive that heeds them; None where joints have none.
        speed: speed of the motor when all joints move at their velocity limits [turns per minute].
        deceleration: 6085h, in the drive's unit; None where neither the drive's section nor the joints say one.
        torque: torque that keeps its joints within their torque limits, whatever the others give [N m].
    """

    positions: tuple[int, int] | None
    speed: float = 0.0
    deceleration: int | None = None
    torque: float = np.inf


@dataclass(frozen=True)
class DriveConfiguration:
    """Hold one drive's part of the configuration.

    Attributes:
        drive: section of the description for the drive.
        profile: of its bus.
        reactions: reactions to faults that the drive finds by itself.
        quick_stop: 605Ah, in place of what `reactions` leaves open.
        motor: the joints' limits converted to this motor.
        can: capabilities of the drive.
    """

    drive: CanopenDrive
    profile: BusProfile
    reactions: Reactions
    quick_stop: int
    motor: MotorLimits

    can: Capabilities

    @property
    def torque(self) -> TorquePath | PositionPath:
        """Return the path, mode and target entry, by which torques or positions are streamed to the drive."""
        assert self.can.torque is not None  # noqa: S101 - else it has been refused
        return self.can.torque

    @property
    def limit_counts(self) -> int:
        """Return the drive's torque limit [per mille of rated]; with positions streamed the joint's limit counts, too.

        Where positions are streamed the drive alone can keep the joints' limits; else the host does, cycle by cycle.
        """
        most = min(self.drive.max_torque, self.motor.torque) if self.streams_positions else self.drive.max_torque
        return torque_limit_counts(most, self.drive.rated_torque)

    @property
    def streams_positions(self) -> bool:
        """Return whether positions are streamed."""
        return isinstance(self.can.torque, PositionPath)

    def watchdog(self) -> list[Write]:
        """Return the downloads that set the watchdog of the drive's maker; empty where none is described."""
        if (own := self.drive.watchdog_entry) is None:
            return []
        return [Write(Entry(own.index, own.sub, Kind[own.type.upper()], "watchdog of the drive's maker"), own.value)]

    def options(self) -> list[Write]:
        """Return the downloads of the drive's reactions to quick stop, fault and loss of connection."""
        return [
            Write(od.QUICK_STOP_OPTION, self.quick_stop),
            Write(od.FAULT_OPTION, self.reactions.fault),
            Write(od.ABORT_CONNECTION, self.reactions.abort_connection),
        ]

    def hints(self) -> list[Write]:
        """Return optional downloads: the cycle's period and, in torque mode, position limits and interpolation.

        They protect nothing: drives in torque mode give torque beyond the position limits.
        """
        todo = [Write(od.SYNC_PERIOD, self.period_us)]
        return todo if self.streams_positions else [*todo, *self.position_limits(), *self.interpolation()]

    def position_limits(self) -> list[Write]:
        """Return the downloads of the position limits; empty for a motor without any."""
        if self.motor.positions is None:
            return []
        lowest, highest = self.motor.positions
        return [Write(od.LOWER_LIMIT, lowest), Write(od.UPPER_LIMIT, highest)]

    def interpolation(self) -> list[Write]:
        """Return the downloads of the interpolation period; none where 8 bits do not hold it."""
        power = next(power for power in (-3, -4, -5, -6) if self.period_us % 10 ** (6 + power) == 0)
        number = self.period_us // 10 ** (6 + power)
        return [Write(od.PERIOD_POWER, power), Write(od.PERIOD_NUMBER, number)] if number <= 0xFF else []

    @property
    def period_us(self) -> int:
        """Return the cycle's period [us]."""
        return round(1e6 / self.profile.rate)

    def pdos(self) -> list[Pdo]:
        """Return the PDOs that the drive shall have; without a timer it reports its status at every n-th SYNC."""
        target = parse_entry(
            self.torque.target, "target position" if self.streams_positions else "target torque", "counts"
        )
        found = []
        for pdo in self.profile.pdos(self.drive.node):
            own = tuple(target if slot in _TARGETS else slot for slot in pdo.slots)
            found.append(replace(pdo, slots=own))
            if pdo.sent and pdo.number == 2 and not self.can.event:
                found[-1] = replace(pdo, type=self.profile.status_syncs, inhibit=0, timer=0)
        return found


def motor_limits(config: ArmConfig, coordinates: Coordinates) -> list[MotorLimits]:
    """Return each motor's limits of position, speed, deceleration and torque, converted from the joints'.

    Args:
        config: configuration with a CANopen driver and a transmission.
        coordinates: coordinates of the arm with the zero that the drives have.
    """
    driver, gears, joints = config.driver, config.transmission, list(config.joints.values())
    assert isinstance(driver, CanopenDriver)  # noqa: S101 - refused in the beginning
    assert gears is not None  # noqa: S101 - likewise
    lowest, highest = np.array([joint.position or (-np.inf, np.inf) for joint in joints]).T
    limits = count_limits(coordinates, lowest - LIMIT_SLACK, highest + LIMIT_SLACK)
    speeds = motor_speeds(gears, [joint.velocity for joint in joints])
    brakes = quick_stop_decelerations(driver, gears, [joint.acceleration for joint in joints])
    torques = motor_torques(driver, gears, [joint.torque for joint in joints])
    return [MotorLimits(*one) for one in zip(limits, speeds, brakes, torques, strict=True)]


def watchdogs_of(driver: CanopenDriver, drive_names: Sequence[str]) -> tuple[Watchdog, ...]:
    """Return the watchdog of each drive; `drive_names` are what people call the drives."""
    found, of_torque = zip(drive_names, driver.drives, strict=True), ("rpdo_timer", "vendor")
    seconds = driver.watchdog_seconds
    return tuple(Watchdog(name, one.watchdog, seconds(one), one.watchdog in of_torque) for name, one in found)


def identity_differences(reported: Mapping[str, int], configured: DriveIdentity) -> list[str]:
    """Describe each value of an identity (1018h) that is missing or not the configured one; empty if all agree."""
    return [
        f"{name} is {reported[name]:08X}h instead of {value:08X}h" if name in reported else f"{name} is not told"
        for name, value in configured.model_dump(exclude_none=True).items()
        if reported.get(name) != value
    ]


def quick_stop_option(config: ArmConfig) -> int:
    """Return the value for 605Ah: as described, else to stay in quick stop if `after_stop` is hold or lower."""
    assert isinstance(config.driver, CanopenDriver)  # noqa: S101 - of an arm of CANopen drives
    described = config.driver.reactions.quick_stop
    if described is not None:
        return described
    return _STAYS if config.control.after_stop in ("hold", "lower") else _LETS_GO


def identify(objects: Objects, configured: DriveIdentity) -> str:
    """Read a drive's identity and return it in words; raises DriverError where it is not the wanted one.

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
    if others := identity_differences(found, configured):
        raise AnotherDrive(f"node {objects.node}: is not the drive that the configuration names: {', '.join(others)}")
    try:
        firmware = objects.read_bytes(_FIRMWARE, 0, "software version").decode("ascii", "replace").strip("\0 ")
    except SdoRefused:
        firmware = "not told"
    words = ", ".join(f"{name} {value:08X}h" for name, value in found.items())
    return f"node {objects.node}: {words}, firmware {firmware}"


def is_error_passive(objects: Objects) -> bool:
    """Return whether a drive's CAN controller is error-passive by its error register and history (1001h, 1003h).

    Its emergency message may have been sent before anybody listened.

    Raises:
        DriverError: it does not answer.
    """
    try:
        bad = objects.read(od.ERROR_REGISTER) & COMMUNICATION_ERROR
        return bool(bad) and objects.read(od.LAST_ERROR) & 0xFFFF == ERROR_PASSIVE
    except SdoRefused:
        return False  # without a history, or one that is empty


def configure(objects: Objects, setup: DriveConfiguration) -> OperationMode:
    """Configure a pre-operational drive, writing only what differs; return its mode of operation.

    Returns:
        The mode of operation, which is sent with every control word.

    Raises:
        DriverError: it lacks, refuses or forgets something; the message names the entry and says why.
    """
    _encoder(objects, setup.drive)
    _timing(objects, setup)
    unused = setup.profile.unused_pdos(setup.drive.node)
    at_once = configure_pdos(objects, setup.pdos(), unused, setup.can.dummies)
    _rated_torque(objects, setup)
    _largest_torque(objects, setup)
    _max_speed(objects, setup)
    _deceleration(objects, setup)
    for write in setup.options():
        objects.write_if_present(write)
    objects.ensure(setup.profile.heartbeat(setup.drive.node))
    # Supervision of the host comes last: from then on the host must be present.
    spare = (od.ERROR_BEHAVIOUR, *(() if setup.drive.watchdog == "heartbeat" else (od.HEARTBEAT_CONSUMER,)))
    for write in setup.profile.host_supervision(setup.drive.node):
        (objects.write_if_present if write.entry in spare else objects.ensure)(write)
    for write in setup.watchdog():
        objects.ensure(write)
    for write in setup.position_limits() + setup.interpolation() if setup.streams_positions else ():
        objects.write_if_present(write)  # here they count: a drive moves by them
    for write in setup.hints():
        with suppress(SdoRefused, WriteNotVerified):
            objects.write_if_present(write)
    return replace(_mode(objects, setup), at_once=at_once)


def _timing(objects: Objects, setup: DriveConfiguration) -> None:
    """Configure SYNC without counter and window; 1019h is only written while 1006h is 0 (CiA 301, 7.5.2.22)."""
    for write in setup.profile.identifiers(setup.drive.node):
        objects.write_if_present(write)
    counter = Write(od.SYNC_OVERFLOW, 0)
    if none_if_missing(objects.holds, counter) is False:
        objects.write_if_present(Write(od.SYNC_PERIOD, 0))
        objects.ensure(counter)
    objects.write_if_present(Write(od.SYNC_WINDOW, 0))  # torques come just before the next SYNC


def _largest_torque(objects: Objects, setup: DriveConfiguration) -> None:
    """Set the largest torque that the drive gives, in its own entry and unit."""
    limit, value = setup.can.limit, setup.limit_counts
    assert limit is not None  # noqa: S101 - else it has been refused
    if limit.per is not None:
        value = value * objects.read(parse_entry(limit.per, "what the largest torque is per mille of")) // 1000
    for text in (limit.entry, limit.negative):
        try:
            if text is not None:
                objects.ensure(Write(parse_entry(text, "largest torque"), limit.entry_or_limit(value)))
        except SdoRefused as refused:
            words = f"drives.max_torque is {setup.drive.max_torque:g} N m"
            raise SdoRefused(
                f"{refused}; {words}, which the drive must be able to limit itself to", refused.code
            ) from None
    if setup.torque.slope is not None:  # mode 4 would turn a step into a ramp: the whole torque within 1 ms
        objects.ensure(Write(parse_entry(setup.torque.slope, "torque slope"), 1000 * setup.limit_counts))


def _mode(objects: Objects, setup: DriveConfiguration) -> OperationMode:
    """Set the mode of operation, and give the drive a moment to report it; before it is enabled it must have."""
    by, clock, mode, path = setup.torque.by, objects.clock, setup.torque.mode, setup.torque
    for text, value in path.writes.items():
        objects.ensure(Write(parse_entry(text, f"what mode {mode} needs"), value))
    entry, display = (od.MODE, od.MODE_DISPLAY) if by is None else map(_mode_entry, (by.entry, by.display))
    if not objects.holds(wanted := Write(entry, mode)):
        objects.write(wanted)  # the display is what reads it back; 6060h itself may be write-only
    shows = setup.can.family.mode_shown == "off" and not objects.dry
    last = clock.now_ns() + (round(_MODE_PATIENCE * 1e9) if shows else 0)
    while objects.read(display) != mode and clock.now_ns() < last:
        clock.sleep_until_ns(clock.now_ns() + _MODE_AGAIN_NS)
    return OperationMode(mode if by is None else objects.read(od.MODE), display, mode, path.enabling)


def _mode_entry(text: str) -> Entry:
    return parse_entry(text, "mode of operation of the maker's")


@dataclass(frozen=True)
class LeftDrive:
    """Represent a drive that its host is about to leave.

    Attributes:
        state: state in which it is.
        reacts: whether it is off, and may answer with a fault that it is left: its reaction to a lost host (6007h) is
            missing or cannot be set to nothing.
    """

    state: DriveState
    reacts: bool = False


def disable_supervision(
    objects: Objects, zeros: Zeros | None, drive_index: int, restarted: Callable[[], bool]
) -> LeftDrive:
    """End a drive's supervision of its host unless it has power; return its state, and if a lost host may fault it.

    A zero that the drive has confirmed it confirms afterwards too, and nothing else: one that restarted in the session
    has lost its zero. A part that it refuses does not keep it from the others.

    Args:
        objects: of the drive.
        zeros: zeros of the arm, None where drives know their position.
        drive_index: of the drive.
        restarted: whether it has sent a boot-up message in the session.

    Raises:
        DriverError: it does not answer.
        SdoRefused: it refuses a part, other than as an entry that can only be read for 6007h; all others are done.
    """
    # Asked for: a status report may be held back by its inhibit time.
    state = state_of(objects.read(od.STATUS_WORD))
    if state not in POWER_OFF:
        return LeftDrive(state)
    counts = zeros.stored_counts(objects, drive_index) if zeros is not None else None
    kept: SdoRefused | None = None
    reacts = False
    for entry in (od.ABORT_CONNECTION, od.HEARTBEAT_CONSUMER, od.GUARD_TIME):  # or 8130h would follow every session
        try:
            objects.write(Write(entry, 0))
        except SdoRefused as refused:
            missing = refused.code in DOES_NOT_EXIST
            fixed = entry is od.ABORT_CONNECTION and (missing or refused.code in READ_ONLY)
            reacts = reacts or (fixed and state not in FAULTS)
            if not missing and not fixed:
                kept = kept or refused
    if zeros is not None and counts is not None:
        zeros.restore_mark(objects, drive_index, counts, restarted)
    if kept is not None:
        raise kept
    return LeftDrive(state, reacts)


def reset_farewell_fault(objects: Objects, unrelated: Callable[[], bool]) -> DriveState:
    """Reset a drive's fault, taken as due to its host having left unless `unrelated()`; return its last state.

    No next session could enable the drive, and closing the one that resets it would leave the fault behind again.

    Args:
        objects: of a drive that was off, without a fault, before it was left.
        unrelated: whether the drive gives another reason for its fault, which then stays.

    Raises:
        DriverError: it does not answer, or refuses control words.
    """
    clock = objects.clock
    last_ns = clock.now_ns() + round(_RESET_PATIENCE * 1e9)
    while (state := state_of(objects.read(od.STATUS_WORD))) in FAULTS and not unrelated() and clock.now_ns() < last_ns:
        for word in (DISABLE_VOLTAGE, RESET_FAULT):  # a rising edge; some drives look once in a millisecond
            objects.write(Write(od.CONTROL_WORD, word))
            clock.sleep_until_ns(clock.now_ns() + _RESET_STEP_NS)
    return state


def _encoder(objects: Objects, drive: CanopenDrive) -> None:
    """Compare the described counts of a motor turn with the drive's own scaling, where it has one.

    A drive with a gear ratio of its own (6091h) tells positions in another unit. Some give the lines of an encoder, of
    which each has four counts.
    """
    counts, turns, motor, shaft = (
        none_if_missing(objects.read, entry)
        for entry in (od.ENCODER_COUNTS, od.ENCODER_TURNS, od.GEAR_MOTOR, od.GEAR_SHAFT)
    )
    if not counts or not turns or motor != shaft:
        return
    ratio = drive.counts * turns / counts
    if ratio not in _COUNTS_PER_LINE:
        raise DriverError(
            f"node {objects.node}: a motor turn has {counts / turns:g} counts by the drive (608Fh), {drive.counts} by "
            f"the description (drives.counts): the scale of its positions is wrong by {ratio:g}"
        )


def _rated_torque(objects: Objects, setup: DriveConfiguration) -> None:
    """Set the rated torque where the family lets it be set, or check that the drive's own is the described one."""
    unit, rated = setup.can.family.unit, setup.drive.rated_torque
    if unit is None or unit.rated is None or not unit.writable:
        return  # compared already
    entry, size = parse_entry(unit.rated, "rated torque"), TORQUE_UNITS[unit.unit]
    wanted = Write(entry, round(rated / size))
    if wanted.value < 1 or abs(wanted.value * size - rated) > _ROUNDING * rated:
        words = f"rated_torque {rated:g} N m is not whole {unit.unit}, which is what {entry_text(entry)} holds"
        raise DriverError(f"node {objects.node}: {words}")
    try:
        objects.ensure(wanted)
    except SdoRefused as refused:
        if refused.code not in READ_ONLY:
            raise
        raise DriverError(
            f"node {objects.node}: its rated torque is {objects.read(entry) * size:g} N m and cannot be set; "
            f"the configuration says rated_torque: {rated:g}"
        ) from None


def _max_speed(objects: Objects, setup: DriveConfiguration) -> None:
    """Set the motor's largest speed, or check that the drive's own leaves the joints their velocities.

    Above it a drive takes its torque back, in the middle of a motion.
    """
    if (entry := setup.can.speed) is None:
        return
    size = setup.can.speed_size
    try:
        # Not 0, which would be no torque at all, however coarse the unit is.
        objects.ensure(Write(entry, min(max(1, round(setup.drive.max_speed * size)), 0xFFFF_FFFF)))
    except SdoRefused as refused:
        if refused.code not in READ_ONLY:
            raise
        held = objects.read(entry) / size
        if held < round(setup.motor.speed):
            raise DriverError(
                f"node {objects.node}: gives no torque above {held:.0f} turns per minute ({entry.index:04X}h, which"
                f" cannot be set), but its motor turns at {setup.motor.speed:.0f} at the joints' limits; lower"
                " joints.NAME.velocity"
            ) from None


def _deceleration(objects: Objects, setup: DriveConfiguration) -> None:
    """Set the deceleration of quick stops (6085h), where a drive has it; a sufficient one of its own may stay."""
    if setup.motor.deceleration is None:
        return
    wanted = Write(od.QUICK_STOP_DECELERATION, setup.motor.deceleration)
    try:
        objects.ensure(wanted)
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
