"""Configure a drive's PDOs as a bus profile wants them (CiA 301, 7.5.2.36): compare first, write where they differ.

All that differ are switched off before one of them is written, so that no two share a COB-ID even for a moment. Some
drives have fixed COB-IDs, which must then be the wanted ones. Two dummies of 8 bits take the room of one of 16.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from drivers.canopen import object_dictionary as od
from drivers.canopen.object_dictionary import Entry, Kind
from drivers.canopen.pdo_mapping import Pdo
from drivers.canopen.sdo import READ_ONLY, Objects, SdoRefused, optional

_SMALL = {0x0002: Kind.I8, 0x0005: Kind.U8}
_DUMMIES = {0x0003: Kind.I16, 0x0006: Kind.U16} | _SMALL
_NOT_VALID = 1 << 31


def configure_pdos(objects: Objects, pdos: Sequence[Pdo], unused: Sequence[Pdo], dummies: Sequence[int]) -> None:
    """Configure a pre-operational drive's PDOs.

    Args:
        objects: of the drive.
        pdos: that it shall have; slots of other drives are `od.DUMMY_INT16`.
        unused: that it shall not have; they may be missing.
        dummies: indices of dummies that may take the room of others' slots, in the order in which they are tried.

    Raises:
        SdoRefused: it does not take one of them.
        DriverError: it does not answer, or forgets something.
    """
    for pdo in unused:
        optional(lambda one: _off(objects, one), pdo)
    variants = {pdo: _variants(pdo, dummies) for pdo in pdos}
    waiting = [pdo for pdo in pdos if not any(_is_there(objects, one) for one in variants[pdo])]
    for pdo in waiting:
        _off(objects, pdo)
    for pdo in waiting:
        _map(objects, variants[pdo])
        for write in pdo.parameters:
            if write.entry.sub == od.TPDO_INHIBIT.sub:
                objects.ensure_if_there(write)
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
            objects.ensure_if_there(
                pdo.timing
            )  # a deadline left by another host could report a silence where there is none


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
    return _is_mapped(objects, pdo) and all(
        optional(objects.holds, write) is not False for write in (*pdo.parameters, pdo.on)
    )


def _is_mapped(objects: Objects, pdo: Pdo) -> bool:
    _, *slots, count = pdo.mapping
    return objects.holds(count) and all(objects.holds(slot) for slot in slots)


def _off(objects: Objects, pdo: Pdo) -> None:
    if objects.read(pdo.off.entry) & _NOT_VALID:
        return
    try:
        objects.set(pdo.off)
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
                objects.set(write)
        except SdoRefused as refused:
            refusals.append(refused)
        else:
            return
    why = refusals[0]
    if len(variants[0].slots) == 1:
        raise why
    raise SdoRefused(f"{why}; where it takes no dummy, driver.torque_frames must be single", why.code)
