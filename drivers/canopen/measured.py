"""Convert the torque that drives measure (6077h) to the joints, and compare it with the commanded torque.

A drive's torque follows its command within a millisecond or two, and many drives average what they report over some
more. So a measured torque is compared with all that the drive was told within the last `WINDOW`. Only what lies outside
of that, in two reports in a row, is a difference.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drivers.arm import Vector
from drivers.canopen.motor_units import Coordinates
from drivers.canopen.pdo_codec import Drive

WINDOW = 0.01  # s


class MeasuredTorque:
    """Collect the torques that the drives of an arm measure.

    Attributes:
        torque: by the newest reports, where one came since the cycle before, else NaN [N m or N], shape (joints,);
            None where no drive has reported.
        difference: how much more than they were told drives measured in their last two reports, the smaller of both
            [N m or N], shape (joints,); None likewise.
    """

    def __init__(self, coordinates: Coordinates, rate: float) -> None:
        """Start with drives without a commanded torque; `rate` is in cycles per second."""
        self._coordinates = coordinates
        self._told = np.zeros((max(2, round(WINDOW * rate)), len(coordinates.limit)))
        self._cycle = 0
        self._outside, self._before = [0.0] * len(coordinates.limit), [0.0] * len(coordinates.limit)
        self._reports = [0] * len(coordinates.limit)
        self.torque: Vector | None = None
        self.difference: Vector | None = None

    def cycle(self, counts: Sequence[int], drives: Sequence[Drive]) -> None:
        """Process the torques sent and the reports received in a cycle.

        Args:
            counts: sent with its SYNC [per mille of rated torque], by drive.
            drives: as they are at its end.
        """
        self._told[self._cycle % len(self._told)] = counts
        self._cycle += 1
        new = [drive.torques > known for drive, known in zip(drives, self._reports, strict=True)]
        if not any(new):
            if self.torque is not None:
                self.torque = np.full(len(new), np.nan)
            return
        least, most = self._told.min(axis=0).tolist(), self._told.max(axis=0).tolist()
        for k, drive in enumerate(drives):
            if new[k]:
                now, before = drive.torque - min(max(drive.torque, least[k]), most[k]), self._before[k]
                self._outside[k] = min(now, before, key=abs) if now * before > 0.0 else 0.0
                self._before[k] = now
        self._reports = [drive.torques for drive in drives]
        torque = self._coordinates.joint_torque([drive.torque for drive in drives])
        for motors, joints in self._coordinates.groups:
            if not (all(self._reports[k] for k in motors) and any(new[k] for k in motors)):
                torque[list(joints)] = np.nan
        self.torque, self.difference = torque, self._coordinates.joint_torque(self._outside)
