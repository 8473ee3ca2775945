"""Convert between joints, motors, and the integers that drives use: counts of position and of torque.

With the gear ratios r, the coupling C and the offsets q0 of the arm's transmission (`config/recording.py`):

    q = C^-1 diag(1/r) q_motor + q0,    tau = C^T diag(r) tau_motor,

so that power is the same on both sides. A motor's position is `2 pi (counts - zero)/counts_per_turn`; the torque that
it really gives for `n` counts is `n torque_per_count`: thousandths of a rated torque for CANopen drives, counts of
1/IPNM [N m] for pucks.

Clipping. Motors that share joints (a differential) are one group. Where one of them is asked for more than it may
give, all joint torques of its group are scaled by the same factor: the direction is kept, so that no joint of the
group is pushed the other way, and joints outside the group get all they asked for.

Joints are arrays here, values that go over the bus plain integers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import pi

import numpy as np
from numpy.typing import NDArray

from ident_service.config.recording import Transmission
from ident_service.errors import DriverError

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

_ABSURD = 1e12  # N m; beyond, scaling down would not be exact, and no machine means it


@dataclass(frozen=True)
class Coordinates:
    """Convert between n joints and their n motors.

    Attributes:
        joint_per_count: position [rad or m] per count of each motor, shape (n joints, n motors).
        torque_per_count: joint torque [N m or N] per count of each motor, shape (n joints, n motors).
        count_per_torque: inverse of `torque_per_count`, shape (n motors, n joints).
        offset: position of the joints where all counts are `zero`, shape (n,).
        zero: counts of the motors at that position; whole numbers, any size.
        limit: most counts of torque that each motor may be asked for, either way.
        groups: motors that share joints, and the joints they share, by number.
    """

    joint_per_count: Matrix
    torque_per_count: Matrix
    count_per_torque: Matrix
    offset: Vector
    zero: tuple[int, ...]
    limit: tuple[int, ...]
    groups: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...]

    @property
    def motors_of(self) -> list[tuple[int, ...]]:
        """Return the motors that each joint's position is computed from, by number."""
        return [next(motors for motors, joints in self.groups if j in joints) for j in range(len(self.offset))]

    @property
    def torque_limit(self) -> Vector:
        """Return the most each joint can be given while the others are given nothing [N m or N], shape (n,)."""
        with np.errstate(divide="ignore"):
            alone = np.array(self.limit)[:, None] / np.abs(self.count_per_torque)
        return np.asarray(alone.min(axis=0))

    @property
    def torque_resolution(self) -> Vector:
        """Return the largest change of each joint's torque by one count of one motor [N m or N], shape (n,)."""
        return np.asarray(np.abs(self.torque_per_count).max(axis=1))

    @property
    def position_resolution(self) -> Vector:
        """Return the largest change of each joint's position by one count of one motor [rad or m], shape (n,)."""
        return np.asarray(np.abs(self.joint_per_count).max(axis=1))

    def positions(self, counts: Sequence[int]) -> Vector:
        """Return the joint positions [rad or m], shape (n,), of motors at these counts, unwrapped (`unwrapped`)."""
        return self.joint_per_count @ [float(n - zero) for n, zero in zip(counts, self.zero, strict=True)] + self.offset

    def counts_at(self, position: Vector) -> list[int]:
        """Return the nearest counts of the motors when the joints are at this position [rad or m], shape (n,)."""
        motors = np.linalg.solve(self.joint_per_count, position - self.offset)
        return [round(turn) + zero for turn, zero in zip(motors.tolist(), self.zero, strict=True)]

    def count_limits(self, lowest: Vector, highest: Vector) -> list[tuple[int, int] | None]:
        """Return each motor's lowest and highest counts, rounded, between joint positions; None without limits.

        Args:
            lowest: [rad or m], shape (n,); not finite where a joint has no limit.
            highest: the other end, likewise.

        Returns:
            Lowest and highest counts of each motor; None for one that moves a joint without limits.
        """
        found: list[tuple[int, int] | None] = []
        for row, zero in zip(np.linalg.inv(self.joint_per_count), self.zero, strict=True):
            moved = row != 0.0
            ends = row[moved] * (np.array([lowest, highest]) - self.offset)[:, moved]
            if not np.isfinite(ends).all():
                found.append(None)
                continue
            found.append((round(zero + ends.min(axis=0).sum()), round(zero + ends.max(axis=0).sum())))
        return found

    def zeroed(self, counts: Sequence[int], home_position: Vector) -> Coordinates:
        """Return coordinates for an arm whose motors are at these counts while its joints are at this position.

        Args:
            counts: counts of the motors, one each.
            home_position: of the joints [rad or m], shape (n,).
        """
        return replace(self, zero=tuple(counts), offset=np.array(home_position, dtype=float))

    def torque_counts(self, torque: Vector) -> tuple[list[int], bool]:
        """Return each motor's counts for joint torques, scaled down by group to the limits, and whether any group was.

        Args:
            torque: of the joints [N m or N], shape (n,).

        Returns:
            Counts of torque of each motor, clipped (see above) and rounded; whether it was clipped.

        Raises:
            DriverError: a torque that is not finite (or absurd), or not of this shape.
        """
        wanted = np.asarray(torque, dtype=float)
        if wanted.shape != self.offset.shape or not all(abs(one) < _ABSURD for one in wanted.tolist()):
            raise DriverError(f"{len(self.limit)} finite joint torques are needed, not {torque}")
        exact = (self.count_per_torque @ wanted).tolist()
        counts, clipped = [0] * len(exact), False
        for motors, _ in self.groups:
            share = 1.0
            for k in motors:
                asked = abs(exact[k])
                if asked * share > self.limit[k]:
                    share = self.limit[k] / asked
                    clipped = True
            for k in motors:
                limit = self.limit[k]
                counts[k] = min(max(round(exact[k] * share), -limit), limit)
        return counts, clipped

    def joint_torque(self, counts: Sequence[float]) -> Vector:
        """Return the joint torque [N m or N], shape (n,), that motors really give at these counts of torque."""
        return np.asarray(self.torque_per_count @ [float(n) for n in counts])


def motor_coordinates(
    transmission: Transmission,
    counts_per_turn: Sequence[int],
    torque_per_count: Sequence[float],
    max_torque_counts: Sequence[int],
) -> Coordinates:
    """Return the coordinates of an arm, with counts of 0 where the transmission has its zero.

    Args:
        transmission: the arm's.
        counts_per_turn: of each motor's encoder.
        torque_per_count: torque that each motor really gives for one count of torque [N m].
        max_torque_counts: largest counts of torque that each motor may be asked for, either way.

    Raises:
        DriverError: not as many motors as ratios.
    """
    size = len(counts_per_turn)
    if size != len(transmission.ratios):
        raise DriverError(f"{size} drives but {len(transmission.ratios)} ratios in the transmission")
    coupling = transmission.coupling_matrix
    motor_per_joint = np.array(transmission.ratios)[:, None] * coupling
    joint_per_motor = np.linalg.inv(motor_per_joint)
    # An inverse that is only nearly zero where it should be zero would couple joints that are not coupled.
    groups = _groups(coupling)
    inside = np.zeros((size, size), dtype=bool)
    for motors, joints in groups:
        inside[np.ix_(joints, motors)] = True
    joint_per_motor[~inside] = 0.0
    radians, per_count = 2.0 * pi / np.array(counts_per_turn), np.array(torque_per_count)
    return Coordinates(
        joint_per_motor * radians,
        motor_per_joint.T * per_count,
        joint_per_motor.T / per_count[:, None],
        np.array(transmission.offsets or np.zeros(size)),
        (0,) * size,
        tuple(max_torque_counts),
        groups,
    )


def unwrapped(counts_before: int, counts: int, bits: int = 32) -> int:
    """Return a position without wrap-around: the value nearest to the one before.

    Args:
        counts_before: the last position, unwrapped [counts].
        counts: present position of the drive [counts], a signed number of so many bits.
        bits: number of bits of the drive's counter.
    """
    turn = 1 << bits
    return counts_before + (counts - counts_before + turn // 2) % turn - turn // 2


def _groups(coupling: Matrix) -> tuple[tuple[tuple[int, ...], tuple[int, ...]], ...]:
    """Return motors (rows) and joints (columns) connected through elements that are not zero."""
    size, left = len(coupling), set(range(len(coupling)))
    found = []
    while left:
        motors, joints = {min(left)}, set[int]()
        while True:
            more = {j for m in motors for j in range(size) if coupling[m, j] != 0.0}
            others = {m for j in more for m in range(size) if coupling[m, j] != 0.0}
            if more == joints and others == motors:
                break
            joints, motors = more, others | motors
        left -= motors
        found.append((tuple(sorted(motors)), tuple(sorted(joints))))
    return tuple(found)
