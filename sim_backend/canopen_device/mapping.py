"""Map values to the bytes of a PDO: mapping parameters to a struct layout, and rules for both (CiA 301, 7.5.2).

A dummy object takes its bytes and stands for nothing.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from sim_backend.canopen_device.objects import (
    NO_OBJECT,
    NOT_MAPPABLE,
    PDO_LENGTH,
    WRONG_STATE,
    WRONG_VALUE,
    Objects,
    SdoAbort,
)

INVALID = 1 << 31
EXTENDED = 1 << 29
COMMUNICATION = (range(0x1400, 0x1404), range(0x1800, 0x1804))
MAPPING = (range(0x1600, 0x1604), range(0x1A00, 0x1A04))
# Identifiers that are no PDO's (CiA 301, table 24).
_RESTRICTED = (
    range(0x080),
    range(0x080, 0x081),
    range(0x101, 0x181),
    range(0x581, 0x600),
    range(0x601, 0x680),
    range(0x6E0, 0x700),
    range(0x701, 0x800),
)


@dataclass(frozen=True)
class Layout:
    """Hold the byte layout of one PDO.

    Attributes:
        packing: of all its bytes.
        keys: of the objects, in order, without dummies.
    """

    packing: struct.Struct
    keys: tuple[int, ...]


def layout(objects: Objects, index: int, count: int | None = None) -> Layout:
    """Derive the layout from a mapping parameter.

    Args:
        objects: that hold it.
        index: of the mapping parameter.
        count: entries that count; by default as sub-index 0 says.

    Raises:
        SdoAbort: an entry that cannot be mapped, or more than 8 bytes.
    """
    receives = index in MAPPING[0]
    form, keys = "<", []
    for subindex in range(1, (objects.number(index) if count is None else count) + 1):
        entry = objects.number(index, subindex)
        key, bits = entry >> 8, entry & 0xFF
        if receives and key & 0xFF == 0 and bits and objects.dummies.get(key >> 8, 0) * 8 == bits:
            form += f"{bits // 8}x"
            continue
        mapped = objects.entries.get(key)
        if mapped is None:
            raise SdoAbort(NO_OBJECT)
        allowed = mapped.writable if receives else mapped.readable
        if not (mapped.mappable and allowed) or mapped.form is None or mapped.size * 8 != bits:
            raise SdoAbort(NOT_MAPPABLE)
        form += mapped.form
        keys.append(key)
    packing = struct.Struct(form)
    if packing.size > 8:
        raise SdoAbort(PDO_LENGTH)
    return Layout(packing, tuple(keys))


def check_write(objects: Objects, key: int, value: int) -> None:
    """Check whether a host may write this value into a PDO parameter now; raises SdoAbort where not.

    A PDO's identifier and mapping only change while it does not exist (bit 31), entries only while there are none.
    Where the identifier is fixed, the number of entries alone says whether it exists.
    """
    index, subindex = key >> 8, key & 0xFF
    if any(index in indices for indices in COMMUNICATION):
        if subindex == 1:
            _check_identifier(objects, key, value)
        elif subindex == 2 and 241 <= value <= 253:  # reserved, or on remote frames only
            raise SdoAbort(WRONG_VALUE)
        elif subindex in (3, 6) and _exists(objects, index):
            raise SdoAbort(WRONG_STATE)
    elif any(index in indices for indices in MAPPING):
        if _exists(objects, index - 0x200):
            raise SdoAbort(WRONG_STATE)
        if subindex == 0:
            layout(objects, index, value)
        elif objects.number(index):
            raise SdoAbort(WRONG_STATE)


def _exists(objects: Objects, index: int) -> bool:
    changes = (entry := objects.entries.get(index << 8 | 1)) is not None and entry.writable
    return changes and not objects.number(index, 1) & INVALID


def _check_identifier(objects: Objects, key: int, value: int) -> None:
    before = objects.values[key]
    identifier = value & 0x7FF
    if value & EXTENDED or value & 0x1FFF_F800:
        raise SdoAbort(WRONG_VALUE)
    if value & INVALID:
        return
    if any(identifier in forbidden for forbidden in _RESTRICTED):
        raise SdoAbort(WRONG_VALUE)
    if isinstance(before, int) and not before & INVALID and before & 0x7FF != identifier:
        raise SdoAbort(WRONG_STATE)
