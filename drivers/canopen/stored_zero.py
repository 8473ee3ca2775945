"""Store the zero of an arm in its drives, whose encoders count from where they were at power-up (`zero: at_home`).

There it is lost together with the count that it is about; no file of a host can be out of date. Object 1020h (CiA 301,
verify configuration) is two numbers that a host may store in a drive:

    sub 1   6064h of this motor while the joints stood at the home of the arm's description, as 32 bits
    sub 2   CRC-32 of these counts and of all that their meaning depends on; never 0, which a drive has after power-up

A description with another home, gear or encoder has another mark, so that what was zeroed with the old one is void. It
is never stored (1010h): a drive that had it back after power-up would confirm a count that is gone.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence

import numpy as np

from drivers.canopen import object_dictionary as od
from drivers.canopen.motor_units import signed
from drivers.canopen.pdo_mapping import Write
from drivers.canopen.sdo import DOES_NOT_EXIST, Objects, SdoRefused
from drivers.motor_units import Vector
from ident_service.config.arm import ArmConfig
from ident_service.config.canopen import CanopenDriver
from ident_service.errors import DriverError, PositionUnknown

_WHOSE = "ident: counts at home, 1"
_STORES_BY_ITSELF = 1 << 1  # of 1010h


class Zeros:
    """Hold the zeros of all drives of one arm.

    Attributes:
        home: the posture to which the zeros belong [rad or m], shape (joints,), read-only.
    """

    def __init__(self, config: ArmConfig) -> None:
        """Use the description of an arm with `zero: at_home`.

        Raises:
            DriverError: its encoders need no zero, or the description has no posture to say it in.
        """
        driver, gears = config.driver, config.transmission
        if not isinstance(driver, CanopenDriver) or gears is None or driver.zero != "at_home":
            raise DriverError(f"{config.name}: driver.zero is absolute: its encoders know where the arm stands")
        homes = [joint.home for joint in config.joints.values()]
        if len(homes) != len(driver.drives) or None in homes:
            raise DriverError(f"{config.name}: driver.zero is at_home, which needs joints.*.home for every joint")
        self.home: Vector = np.array(homes, dtype=float)
        self.home.setflags(write=False)
        self._about = [
            # Numbers, not their rounded text: what is nearly the same is another arm.
            (drive.bus, drive.node, drive.counts, (ratio * row).tolist(), self.home[row != 0.0].tolist())
            for drive, ratio, row in zip(driver.drives, gears.ratios, gears.coupling_matrix, strict=True)
        ]

    def mark(self, drive_index: int, counts: int) -> int:
        """Return the value of 1020h:02 that marks these counts of a drive as its counts at home."""
        return zlib.crc32(repr((_WHOSE, self._about[drive_index], counts)).encode()) or 1

    def stored_counts(self, objects: Objects, drive_index: int) -> int | None:
        """Return the signed counts at home that a drive stores with a mark that fits them; else None."""
        try:
            mark = objects.read(od.ZERO_MARK)
            counts = signed(objects.read(od.ZERO_COUNTS)) if mark else 0
        except SdoRefused as refused:
            if refused.code not in DOES_NOT_EXIST:
                raise
            return None
        return counts if mark == self.mark(drive_index, counts) and mark else None

    def store(self, objects: Objects, drive_index: int, counts: int) -> None:
        """Store counts at home and their mark in a drive, and read them back; raises as `Objects.write_verified`."""
        objects.write_verified(Write(od.ZERO_COUNTS, counts & 0xFFFF_FFFF))
        objects.write_verified(Write(od.ZERO_MARK, self.mark(drive_index, counts)))

    def restore_mark(self, objects: Objects, drive_index: int, counts: int, restarted: Callable[[], bool]) -> bool:
        """Store a drive's counts at home again, or delete its mark if it has restarted; return True if stored.

        Args:
            objects: of the drive.
            drive_index: number of the drive.
            counts: counts at home.
            restarted: whether it has sent a boot-up message; asked before, and when its answers have been heard.

        Returns:
            Whether the drive confirms them; otherwise its mark has been deleted.

        Raises:
            DriverError: as `Objects.write_verified`.
        """
        if not restarted():
            self.store(objects, drive_index, counts)
            if not restarted():
                return True
        self.delete_mark(objects)
        return False

    def delete_mark(self, objects: Objects) -> None:
        """Set a drive's mark to 0, which confirms no zero, and read it back; raises as `Objects.write_verified`."""
        objects.write_verified(Write(od.ZERO_MARK, 0))

    def require_volatile_storage(self, objects: Objects) -> None:
        """Raise DriverError where a drive has no object 1020h for a zero, or would keep it without power.

        Raises:
            DriverError: it has no object 1020h, or stores parameters by itself.
        """
        try:
            for entry in (od.ZERO_COUNTS, od.ZERO_MARK):
                objects.read(entry)
        except SdoRefused as refused:
            if refused.code not in DOES_NOT_EXIST:
                raise
            raise DriverError(
                f"node {objects.node}: has no object 1020h, in which its zero would be kept; "
                "such drives need encoders that know their position (zero: absolute)"
            ) from None
        try:
            stores = objects.read(od.STORED)
        except SdoRefused:
            return
        if stores & _STORES_BY_ITSELF:
            raise DriverError(
                f"node {objects.node}: stores parameters by itself (1010h): its zero would outlive its count"
            )

    def home_counts(self, stored: Sequence[int | None]) -> list[int]:
        """Return `stored`, the counts at home of all drives; raises PositionUnknown where one is None.

        Args:
            stored: counts that each drive confirms.

        Raises:
            PositionUnknown: some confirm nothing; the message names them and says what to do.
        """
        lost = [about[1] for about, counts in zip(self._about, stored, strict=True) if counts is None]
        if lost:
            raise PositionUnknown(self.lost_text(lost))
        return [counts for counts in stored if counts is not None]

    def lost_text(self, nodes: Sequence[int]) -> str:
        """Return the message that drives have lost their zero, and what to do about it."""
        return (
            f"drives {', '.join(map(str, sorted(nodes)))} do not know where the arm stands: their encoders count from "
            "where they were when power came, and nobody has zeroed them since (with this description); lead the arm "
            "to its home by hand, then `ident set-home ARM`"
        )


def zeros_of(config: ArmConfig) -> Zeros | None:
    """Return the zeros of an arm whose encoders need them (`zero: at_home`), else None; DriverError without homes."""
    needed = isinstance(config.driver, CanopenDriver) and config.driver.zero == "at_home"
    return Zeros(config) if needed else None
