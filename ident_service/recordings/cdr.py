"""Encode messages in CDR (OMG CORBA 3.0 section 15.3, the plain XCDR version 1 of DDS), little endian.

A payload is the encapsulation header `00 01 00 00` and then the fields, each aligned to its own size counted from
behind that header. All that is equal from sample to sample is laid out once per recording.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

ENCAPSULATION: Final = b"\x00\x01\x00\x00"
_STAMP: Final = struct.Struct("<iI")
_NO_ELEMENTS: Final = struct.pack("<I", 0)


class CdrBuilder:
    """Append fields one after the other, each at its alignment."""

    def __init__(self) -> None:
        self._data = bytearray()

    def align(self, size: int) -> None:
        """Fill up to the next multiple of `size` [bytes]."""
        self._data.extend(bytes(-len(self._data) % size))

    def uint8(self, value: int) -> None:
        """Append one byte."""
        self._data.append(value)

    def uint32(self, value: int) -> None:
        """Append four bytes at a multiple of four."""
        self.align(4)
        self._data += struct.pack("<I", value)

    def stamp(self, utc_ns: int) -> None:
        """Append a builtin_interfaces/Time from nanoseconds since 1970."""
        self.align(4)
        self._data += stamp_bytes(utc_ns)

    def string(self, value: str) -> None:
        """Append a string: length with the closing zero, the bytes in UTF-8, and the zero."""
        encoded = value.encode()
        self.uint32(len(encoded) + 1)
        self._data += encoded + b"\x00"

    def body(self) -> bytes:
        """Return the bytes appended so far, without the encapsulation header."""
        return bytes(self._data)

    def payload(self) -> bytes:
        """Return the whole message."""
        return ENCAPSULATION + self._data


def stamp_bytes(utc_ns: int) -> bytes:
    """Encode a builtin_interfaces/Time: whole seconds rounded down, and the nanoseconds on top."""
    return _STAMP.pack(*divmod(utc_ns, 1_000_000_000))


def encode_string(data: str) -> bytes:
    """Encode a std_msgs/msg/String."""
    builder = CdrBuilder()
    builder.string(data)
    return builder.payload()


def encode_log(utc_ns: int, level: int, name: str, message: str) -> bytes:
    """Encode a rcl_interfaces/msg/Log without a source position; `level` is 10 (debug), 20, 30, 40 or 50 (fatal)."""
    builder = CdrBuilder()
    builder.stamp(utc_ns)
    builder.uint8(level)
    for text in (name, message, "", ""):
        builder.string(text)
    builder.uint32(0)
    return builder.payload()


class JointStateEncoder:
    """Encode sensor_msgs/msg/JointState of always the same joints, with an empty frame_id."""

    def __init__(self, joint_names: Sequence[str]) -> None:
        self._joints = len(joint_names)
        builder = CdrBuilder()
        builder.stamp(0)
        builder.string("")
        builder.uint32(self._joints)
        for name in joint_names:
            builder.string(name)
        builder.uint32(self._joints)
        builder.align(8)
        self._until_position = builder.body()[_STAMP.size :]
        # Behind 8-byte values a count needs four bytes more to the next ones; behind an empty sequence's count, none.
        self._count = struct.pack("<I", self._joints)
        self._count_aligned = struct.pack("<I4x", self._joints)
        effort = CdrBuilder()
        effort.stamp(0)
        effort.string("")
        effort.uint32(self._joints)
        for name in joint_names:
            effort.string(name)
        for count in (0, 0, self._joints):
            effort.uint32(count)
        effort.align(8)
        self._until_effort = effort.body()[_STAMP.size :]

    def encode_effort(self, utc_ns: int, effort: ArrayLike) -> bytes:
        """Encode one message without position and velocity.

        Args:
            utc_ns: stamp [ns since 1970].
            effort: [N m or N], shape (joints,).

        Raises:
            ValueError: an array of another shape.
        """
        return b"".join((ENCAPSULATION, stamp_bytes(utc_ns), self._until_effort, self._floats(effort)))

    def encode(self, utc_ns: int, position: ArrayLike, velocity: ArrayLike | None, effort: ArrayLike | None) -> bytes:
        """Encode one message.

        Args:
            utc_ns: stamp [ns since 1970].
            position: [rad or m], shape (joints,).
            velocity: [rad/s or m/s], shape (joints,), or None for an empty sequence.
            effort: [N m or N], shape (joints,), or None for an empty sequence.

        Raises:
            ValueError: an array of another shape.
        """
        parts = [ENCAPSULATION, stamp_bytes(utc_ns), self._until_position, self._floats(position)]
        if velocity is None:
            parts.append(_NO_ELEMENTS)
        else:
            parts += (self._count_aligned, self._floats(velocity))
        if effort is None:
            parts.append(_NO_ELEMENTS)
        else:
            parts += (self._count if velocity is None else self._count_aligned, self._floats(effort))
        return b"".join(parts)

    def _floats(self, values: ArrayLike) -> bytes:
        array: NDArray[np.float64] = np.asarray(values, dtype="<f8")
        if array.shape != (self._joints,):
            raise ValueError(f"{array.shape=} but the recording has {self._joints} joints")
        return array.tobytes()


class CycleEncoder:
    """Encode ident_msgs/msg/Cycle of a fixed number of axes, with an empty frame_id."""

    def __init__(self, axes: int) -> None:
        self._axes = axes
        self._struct = struct.Struct(f"<4s iI I1x 3x Qqq I{axes}s{-axes % 4}x I{4 * axes}s I")

    def encode(
        self,
        utc_ns: int,
        cycle: int,
        lateness_ns: int,
        compute_ns: int,
        valid: ArrayLike,
        age: ArrayLike,
        lost: int,
    ) -> bytes:
        """Encode one message.

        Args:
            utc_ns: stamp [ns since 1970].
            cycle: number of the cycle.
            lateness_ns: how late the cycle began [ns].
            compute_ns: how long it computed [ns].
            valid: which axes answered, shape (axes,).
            age: cycles since each answered, shape (axes,).
            lost: frames lost so far.

        Raises:
            ValueError: an array of another shape.
        """
        flags = np.asarray(valid, dtype=np.bool_)
        ages = np.asarray(age).astype("<u4")
        if flags.shape != (self._axes,) or ages.shape != (self._axes,):
            raise ValueError(f"{flags.shape=}, {ages.shape=} but the recording has {self._axes} axes")
        seconds, nanoseconds = divmod(utc_ns, 1_000_000_000)
        return self._struct.pack(
            *(ENCAPSULATION, seconds, nanoseconds, 1, cycle, lateness_ns, compute_ns),
            *(self._axes, flags.tobytes(), self._axes, ages.tobytes(), lost),
        )
