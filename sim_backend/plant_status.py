"""Encode and decode the status of a plant process, readable while it runs and after it is gone.

One record of fixed layout at the beginning of a file (or of anonymous memory), written in place through a mapping, so
that not even `kill -9` of the plant takes it away. A checksum tells a record read while it was written.
"""

from __future__ import annotations

import struct
import time
import zlib
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

import numpy as np

from drivers.arm import Vector
from ident_service.errors import DriverError

_MAGIC = b"IDENTPS1"
_FIXED = struct.Struct("<8sHBxiiiqqd")  # magic, joints, state, -, pid, client, clients, ticks, silent ticks, period
_CRC = struct.Struct("<I")
_VECTORS = (
    "position",
    "velocity",
    "lowest",
    "highest",
    "peak_velocity",
    "peak_torque",
    "silent_peak_velocity",
    "silent_peak_torque",
)
_TRIES = 50


class PlantState(IntEnum):
    """Name the states of a plant process."""

    WAITING = 0  # for its first client
    SERVING = 1  # a client is connected
    SETTLING = 2  # no client is connected; idle drives brake what moves
    AT_REST = 3  # no client is connected, and nothing moves
    STILL_MOVING = 4  # no client is connected, and the arm moved until the plant's patience ended
    RAN_AWAY = 5  # no client is connected, and the state is no longer finite
    ENDED_AT_REST = 6  # as AT_REST, and the process has ended
    ENDED_MOVING = 7  # the process has ended while the arm moved


@dataclass(frozen=True)
class PlantStatus:
    """Describe the state and the extremes of a plant; arrays of shape (joints,), in rad or m, rad/s or m/s, N m or N.

    Attributes:
        state: of the process.
        pid: id of its process.
        client_pid: the process that drives the arm, 0 if none does.
        clients: number of clients so far.
        ticks: number of periods that the plant has been moved for, in its whole life.
        silent_ticks: number of these periods since the last frame.
        period: of the plant [s].
        position: now, or where it came to rest.
        velocity: now.
        lowest: position ever.
        highest: position ever.
        peak_velocity: largest speed ever.
        peak_torque: largest torque ever, without noise and braking.
        silent_peak_velocity: largest speed since the last frame.
        silent_peak_torque: largest torque since the last frame.
    """

    state: PlantState
    pid: int
    client_pid: int
    clients: int
    ticks: int
    silent_ticks: int
    period: float
    position: Vector
    velocity: Vector
    lowest: Vector
    highest: Vector
    peak_velocity: Vector
    peak_torque: Vector
    silent_peak_velocity: Vector
    silent_peak_torque: Vector

    @property
    def came_to_rest(self) -> bool:
        """Return whether the recorded state is at rest with no client, the process running or ended."""
        return self.state in (PlantState.AT_REST, PlantState.ENDED_AT_REST)

    @property
    def ended(self) -> bool:
        """Return whether the process has recorded its own end; False while it runs, and if it was killed."""
        return self.state >= PlantState.ENDED_AT_REST

    @property
    def silent_time(self) -> float:
        """Return the plant's time since the last frame [s]; once at rest, how long it took to come to rest."""
        return self.silent_ticks * self.period


def status_size(joints: int) -> int:
    """Return the size of the record of an arm of so many joints [bytes]."""
    return _FIXED.size + 8 * joints * len(_VECTORS) + _CRC.size


def encode_status(status: PlantStatus) -> bytes:
    """Encode the record as bytes."""
    s = status
    fixed = (_MAGIC, len(s.position), s.state, s.pid, s.client_pid, s.clients, s.ticks, s.silent_ticks, s.period)
    body = _FIXED.pack(*fixed) + b"".join(np.asarray(getattr(s, name), dtype="<f8").tobytes() for name in _VECTORS)
    return body + _CRC.pack(zlib.crc32(body))


def decode_status(data: bytes) -> PlantStatus | None:
    """Decode the record; None if it is half written or none was written yet; DriverError for bytes of something else.

    Raises:
        DriverError: bytes of something else.
    """
    if len(data) < _FIXED.size + _CRC.size or not any(data[:8]):
        return None
    magic, joints, state, *numbers = _FIXED.unpack_from(data)
    if magic != _MAGIC:
        raise DriverError(f"not a plant's status: begins with {magic!r}")
    size = status_size(joints)
    if len(data) < size or _CRC.unpack_from(data, size - _CRC.size)[0] != zlib.crc32(data[: size - _CRC.size]):
        return None
    vectors = np.frombuffer(data, dtype="<f8", count=joints * len(_VECTORS), offset=_FIXED.size)
    return PlantStatus(PlantState(state), *numbers, *vectors.reshape(len(_VECTORS), joints))


def read_status(path: Path | str) -> PlantStatus:
    """Read the present status of a plant from its file; DriverError if there is none, or none that is whole.

    Args:
        path: the file that `driver.status` names, or `/proc/self/fd/N` of anonymous memory.

    Raises:
        DriverError: no such file, or nothing whole in it.
    """
    for _ in range(_TRIES):
        try:
            found = decode_status(Path(path).read_bytes())
        except OSError as error:
            raise DriverError(f"{path}: {error.strerror}") from None
        if found is not None:
            return found
        time.sleep(0.002)
    raise DriverError(f"{path}: no plant has said anything here")
