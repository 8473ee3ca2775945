"""Decode sensor_msgs/msg/JointState payloads many at a time.

Messages of one publisher differ in the stamp and the numbers only, so one is parsed field by field and the rest are
read as columns, after a check that their names and counts are byte for byte the same.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from ident_service.recordings.recording import Block, Matrix, Stamps

_LITTLE_ENDIAN_CDR: Final = b"\x00\x01"
_BODY: Final = 4  # bytes of the encapsulation header, from behind which alignment counts
_UINT32: Final = struct.Struct("<I")
_STAMP: Final = slice(4, 12)
_MAX_LAYOUTS: Final = 16


class PayloadError(ValueError):
    """Report a payload that is no JointState, or not the expected one; `index` counts within the call."""

    def __init__(self, message: str, index: int = 0) -> None:
        self.index = index
        super().__init__(message)


@dataclass(frozen=True)
class Layout:
    """Describe where the numbers stand in a payload of a given length and given joint names.

    Attributes:
        names: of the joints, in the payload's order.
        position: offset of the first value [bytes], None where the sequence is empty; velocity and effort likewise.
        fixed: offsets of all bytes that make it this layout, shape (bytes,).
        expected: their values, shape (bytes,).
    """

    names: tuple[str, ...]
    position: int | None
    velocity: int | None
    effort: int | None
    fixed: NDArray[np.intp]
    expected: NDArray[np.uint8]

    @classmethod
    def parse(cls, payload: bytes) -> Self:
        """Find the layout of one payload.

        Raises:
            PayloadError: not a JointState in little-endian CDR, or its sequences differ in length.
        """
        if payload[:2] != _LITTLE_ENDIAN_CDR:
            raise PayloadError(f"encapsulation {payload[:2].hex()} is not little-endian CDR (0001)")
        fixed = [np.arange(2)]
        position = _STAMP.stop

        def count() -> int:
            nonlocal position
            position += (_BODY - position) % 4
            if position + 4 > len(payload):
                raise PayloadError("the message ends too early")
            fixed.append(np.arange(position, position + 4))
            value: int = _UINT32.unpack_from(payload, position)[0]
            position += 4
            if value > len(payload):
                raise PayloadError("the message ends too early")
            return value

        # The frame's length moves everything behind it; its content is not used.
        frame = count()
        position += frame
        names = []
        for _ in range(count()):
            start, length = position, count()
            start, position = position, position + length
            fixed.append(np.arange(start, position))
            names.append(payload[start : position - 1].decode("utf-8", errors="replace"))
        starts: dict[str, int | None] = {}
        for what in ("position", "velocity", "effort"):
            values = count()
            if values == 0:
                starts[what] = None
                continue
            if values != len(names):
                raise PayloadError(f"{len(names)} joint names but {values} values of {what}")
            position += (_BODY - position) % 8
            starts[what] = position
            position += 8 * values
        if position > len(payload):
            raise PayloadError("the message ends too early")
        if len(set(names)) != len(names):
            raise PayloadError(f"a joint name appears twice in {names}")
        where = np.concatenate(fixed)
        return cls(tuple(names), **starts, fixed=where, expected=np.frombuffer(payload, np.uint8)[where])

    def matches(self, rows: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Return which payloads, one a row, have this layout."""
        same: NDArray[np.bool_] = (rows[:, self.fixed] == self.expected).all(axis=1)
        return same

    def columns(self, rows: NDArray[np.uint8], start: int, order: NDArray[np.intp]) -> Matrix:
        """Return one value sequence of all payloads, shape (payloads, len(order))."""
        values = rows[:, start : start + 8 * len(self.names)]
        return np.ascontiguousarray(values).view("<f8")[:, order].astype(np.float64, copy=False)


class JointStateDecoder:
    """Decode payloads into columns of chosen joints.

    Args:
        names: joints wanted, in the order of the columns.
        others: whether payloads may hold more joints than these, or none of them (another publisher on the same
            topic; such payloads are left out).
        velocity: whether velocity is wanted; it must then be in every payload.
    """

    def __init__(self, names: Sequence[str], *, others: bool, velocity: bool) -> None:
        self._names = tuple(names)
        self._others = others
        self._velocity = velocity

    def decode(self, payloads: Sequence[bytes], log_times: Sequence[int]) -> Block:
        """Decode payloads in order.

        Args:
            payloads: JointState messages.
            log_times: [ns], for those whose header has no stamp.

        Raises:
            PayloadError: a payload that cannot be used; `index` says which.
        """
        n, joints = len(payloads), len(self._names)
        stamp: Stamps = np.zeros(n, np.int64)
        position: Matrix = np.empty((n, joints))
        velocity: Matrix = np.empty((n, joints))
        effort: Matrix = np.empty((n, joints))
        used = np.zeros(n, np.bool_)
        lengths = np.fromiter(map(len, payloads), np.int64, n)
        for length in np.unique(lengths):
            left = np.flatnonzero(lengths == length)
            rows = np.frombuffer(b"".join([payloads[int(i)] for i in left]), np.uint8).reshape(len(left), length)
            for _ in range(_MAX_LAYOUTS):
                try:
                    layout = Layout.parse(payloads[left[0]])
                    order = self._order(layout)
                except PayloadError as error:
                    raise PayloadError(str(error), int(left[0])) from error
                same = layout.matches(rows)
                if order is not None:
                    here, part = left[same], rows[same]
                    used[here] = True
                    seconds, nanoseconds = np.ascontiguousarray(part[:, _STAMP]).view("<u4").T
                    stamp[here] = seconds.view(np.int32).astype(np.int64) * 1_000_000_000 + nanoseconds
                    for start, values in (
                        (layout.position, position),
                        (layout.velocity if self._velocity else None, velocity),
                        (layout.effort, effort),
                    ):
                        if start is not None:
                            values[here] = layout.columns(part, start, order)
                left, rows = left[~same], rows[~same]
                if not len(left):
                    break
            else:
                raise PayloadError("the joint names change from message to message", int(left[0]))
        stamp = np.where(stamp == 0, np.asarray(log_times, np.int64), stamp)
        return Block(stamp[used], position[used], effort[used], velocity[used] if self._velocity else None)

    def _order(self, layout: Layout) -> NDArray[np.intp] | None:
        """Return the indices in the payload of the wanted joints, None for a payload to leave out."""
        present = set(layout.names)
        missing = [name for name in self._names if name not in present]
        if self._others and len(missing) == len(self._names):
            return None
        if missing:
            raise PayloadError(f"lacks joints {missing}; it has {list(layout.names)}")
        if not self._others and len(present) != len(self._names):
            raise PayloadError(f"has joints {list(layout.names)} where the first has {list(self._names)}")
        if layout.position is None or layout.effort is None:
            raise PayloadError(f"has no {'position' if layout.position is None else 'effort (torque)'}")
        if self._velocity and layout.velocity is None:
            raise PayloadError("has no velocity where the first has one")
        return np.array([layout.names.index(name) for name in self._names], np.intp)
