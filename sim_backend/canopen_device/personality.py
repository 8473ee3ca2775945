"""Describe an emulated drive: how it makes torque, and how promptly its firmware works.

The shipped data sheet's drive does all at once. A drive made from a maker's file is like its family says
(`drivers/canopen/profiles`), and where neither says anything like the worst drive known: two control words within a
millisecond are read as one, a mode of operation takes effect late, PDO parameters do not change while operational.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from drivers.canopen import object_dictionary as od
from drivers.canopen.capabilities import family_of, parse_entry, speed_units_per_rpm, torque_unit_size
from ident_service.config.canopen import CanopenDrive
from ident_service.config.drive_family import Family, TorquePath, TorqueUnit
from ident_service.config.eds import DataSheet, data_sheet
from sim_backend.canopen_device.node import Node
from sim_backend.canopen_device.objects import Objects

_MODE, _CONTROL = "mode of operation", "control word"
_ON = (0x23, 0x27)  # of the statusword: switched on, operation enabled
_LOOP_NS, _MODE_NS = 1_000_000, 20_000_000
_SOME_CONSTANT = 0.05  # N m/A, of a motor whose description has none
# Objects without which a mode makes no sense, by the mode's number (CiA 402-2).
_MODES = {1: (0x607A,), 3: (0x60FF,), 4: (0x6071, 0x6087), 6: (0x6098,), 8: (0x607A, 0x60C2), 10: (0x6071,)}
_SERVO = 0x0002_0192


def _key(text: str) -> int:
    entry = parse_entry(text, "")
    return entry.index << 8 | entry.sub


@dataclass(frozen=True)
class DriveProperties:
    """Describe the properties of one drive; the defaults are the shipped data sheet's.

    Attributes:
        modes: modes of operation in which it follows a torque, as 6061h tells them.
        target: key of the entry that takes the torque.
        shift: bits by which counts are shifted in it.
        needs: values of entries, by key, without which no torque follows the target.
        enabling: bits of the control word without which none does either.
        limits: keys of what limits it, in counts, or in thousandths of the second key's value, and the number that the
            entry's value is taken from.
        speed: key of what limits its speed, and how many of its unit a turn per minute is; None for nothing.
        rated: key of what a thousandth is of; None where a count is `scale`.
        scale: N m per unit of `rated`, or per count.
        shipped: whether it is the shipped data sheet's drive: it does at once what frames ask for, and has the
            watchdogs of `drive.py`.
        motor: values that its maker's tool has entered, by key.
        mode_when_on: whether a mode of operation takes effect only while it is switched on.
    """

    modes: tuple[int, ...] = (10,)
    target: int = 0x607100
    shift: int = 0
    needs: tuple[tuple[int, int], ...] = ()
    enabling: int = 0
    limits: tuple[tuple[int, int | None, int | None], ...] = ((0x607200, None, None), (0x607300, None, None))
    speed: tuple[int, float] | None = (0x608000, 1.0)
    rated: int | None = 0x607600
    scale: float = 1e-3
    shipped: bool = True
    motor: tuple[tuple[int, int], ...] = ()
    mode_when_on: bool = False

    def torque_limit(self, objects: Objects) -> int:
        """Return the smallest of the drive's torque limits [counts], at most 32767."""
        found = [0x7FFF]
        for key, per, below in self.limits:
            if key in objects.entries:
                value = objects.number(key >> 8, key & 0xFF)
                value = value if below is None else max(below - value, 0)
                whole = 1000 if per is None else objects.number(per >> 8, per & 0xFF)
                found.append(1000 * value // whole if whole else 0)
        return min(found)

    def target_torque(self, objects: Objects) -> int:
        """Return the target torque [counts]; 0 while the drive does not follow it."""
        follows = objects.number(0x6040) & self.enabling == self.enabling
        if not follows or any(objects.number(key >> 8, key & 0xFF) != value for key, value in self.needs):
            return 0
        return objects.number(self.target >> 8, self.target & 0xFF) >> self.shift

    def speed_limit(self, objects: Objects) -> float | None:
        """Return the speed limit above which no accelerating torque acts [turns per minute]; None without one."""
        if self.speed is None or self.speed[0] not in objects.entries:
            return None
        key, size = self.speed
        return objects.number(key >> 8, key & 0xFF) / size

    def torque_of_counts(self, counts: float, objects: Objects) -> float:
        """Convert counts of torque to [N m]."""
        if self.rated is None:
            return counts * self.scale
        return counts * self.scale * objects.number(self.rated >> 8, self.rated & 0xFF) * 1e-3


LIKE_NEW = DriveProperties()
_SHIPPED = {1: 0, 2: 1}  # vendor and product that `configs/emulated_drive.eds` tells; no maker has vendor 0


def described_personality(text: str, drive: CanopenDrive, families: Sequence[Family] = ()) -> DriveProperties:
    """Return `LIKE_NEW` if the EDS has the identity of the shipped drive, else the properties by `personality_of`."""
    told = data_sheet(text).identity
    shipped = all(told.get(sub) == value for sub, value in _SHIPPED.items())
    return LIKE_NEW if shipped else personality_of(text, drive, families)


def personality_of(text: str, drive: CanopenDrive, families: Sequence[Family] = ()) -> DriveProperties:
    """Derive a drive's properties from its maker's EDS or DCF, with the motor of a description.

    Args:
        text: of the EDS or DCF.
        drive: the section that describes it.
        families: families of the description, which take precedence over the shipped ones.
    """
    sheet = data_sheet(text)
    told = {name: sheet.identity[sub] for sub, name in ((1, "vendor"), (2, "product")) if sub in sheet.identity}
    family = family_of(told, families)
    paths = [path for path in family.torque if sheet.has(_key(path.target) >> 8)]
    unit = family.unit or TorqueUnit(rated="6076:0/u32", unit="mNm")
    constant = drive.torque_constant or _SOME_CONSTANT
    scale = torque_unit_size(unit, drive.model_copy(update={"torque_constant": constant})) * (unit.count or 1.0)
    limits = {(_key(one.entry), None if one.per is None else _key(one.per), one.below) for one in family.torque_limit}
    path = paths[0] if paths else TorquePath(mode=10, target="6071:0/i16")
    amperes = drive.rated_torque / constant
    motor = {0x607500: round(1e3 * amperes), 0x607600: round(1e3 * drive.rated_torque)}
    if unit.rated is not None:
        motor[_key(unit.rated)] = round(drive.rated_torque / scale)
    return DriveProperties(
        modes=tuple(path.mode for path in paths),
        target=_key(path.target),
        shift=path.shift,
        needs=tuple((_key(text), value) for text, value in path.writes.items()),
        enabling=path.enabling,
        speed=_speed(family, sheet, drive),
        limits=tuple(sorted(limits, key=str)),
        rated=None if unit.rated is None else _key(unit.rated),
        scale=scale,
        shipped=False,
        motor=(*_unspecified(sheet, [key for key, _, below in limits if below is None]), *motor.items()),
        mode_when_on=family.mode_shown == "switched_on",
    )


def _speed(family: Family, sheet: DataSheet, drive: CanopenDrive) -> tuple[int, float] | None:
    """Return the entry that limits the speed, and its unit; of those of its family the first that the file lists."""
    unit = sheet.entries.get(od.VELOCITY_UNIT.key)
    told = None if unit is None else unit.number(drive.node)
    for text in family.speed_limit:
        if (
            _key(text) in sheet.entries
            and (size := speed_units_per_rpm(parse_entry(text, ""), told, drive)) is not None
        ):
            return _key(text), size
    return None


def _unspecified(sheet: DataSheet, limits: list[int]) -> list[tuple[int, int]]:
    """Return values that every drive has, for entries that the file lists without a value."""
    modes = sum(1 << mode - 1 for mode, needs in _MODES.items() if all(sheet.has(index) for index in needs))
    values = [(0x100000, _SERVO), (0x650200, modes), (0x608F02, 1), (0x608000, 0xFFFF), (0x608500, 0xFFFF)]
    values += [(0x607F00, 0x7FFF_FFFF)]
    values += [(0x101800 | sub, number) for sub, number in sheet.identity.items()]
    values += [(key, 0xFFFF) for key in limits]
    return [(key, value) for key, value in values if key in sheet.entries and not sheet.entries[key].number(0)]


class Firmware:
    """Delay the effect of modes of operation and control words as a drive's firmware does."""

    def __init__(self, node: Node, personality: DriveProperties, control: Callable[[int], None]) -> None:
        """Use the given node; `control` is called with each control word that takes effect."""
        self._node, self._personality, self._control = node, personality, control

    def entries_written(self, keys: tuple[int, ...]) -> None:
        """Apply a mode or control word among these entries just written: at once in the shipped drive, else delayed."""
        for key, name, delay in ((0x606000, _MODE, _MODE_NS), (0x604000, _CONTROL, _LOOP_NS)):
            if key in keys and self._personality.shipped:
                self.timer_ran_out(name)
            elif key in keys and name not in self._node.timers:
                self._node.start_timer(name, delay)

    def timer_ran_out(self, timer: str) -> None:
        """Let a control word or mode take effect if `timer`, which ran out, is its delay; ignore others."""
        number = self._node.objects.number
        if timer == _CONTROL:
            self._control(number(0x6040))
        elif timer == _MODE and self._personality.mode_when_on and number(0x6041) & 0x6F not in _ON:
            self._node.start_timer(_MODE, _MODE_NS)
        elif timer == _MODE:
            mode = number(0x6060)
            if mode in self._personality.modes or (1 <= mode <= 32 and number(0x6502) >> (mode - 1) & 1):
                self._node.objects.put(0x6061, mode)
