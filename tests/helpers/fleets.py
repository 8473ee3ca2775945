"""Recordings of many simulated arms of one kind, each with its own true parameters, computed without a control loop."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy  # its parts load for a second where they are used
from mcap.data_stream import RecordBuilder
from mcap.records import Message, MessageIndex
from numpy.typing import NDArray

from ident_service.config.load import load_arm
from ident_service.fleet.factor import Described, Merged
from ident_service.fleet.population import ArmFit, error_on, pooled_fit
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.base_parameters import BaseParameters, base_parameters
from ident_service.model.chain import Array
from ident_service.model.regressor import joint_regressor
from ident_service.operations.commissioning import true_parameters
from ident_service.recordings.cycle import Cycle
from ident_service.recordings.mcap_writer import (
    _LOW_PASS_S,
    CHUNK_BYTES,
    CHUNK_NS,
    ENCAPSULATION,
    RecordingWriter,
    stamp_bytes,
)
from ident_service.recordings.recording import BLOCK_SAMPLES, Block, assemble

WEEK = 7 * 86_400.0
BEGIN = 1_767_225_600.0  # 2026-01-01
_CHUNK = 4096


@dataclass(frozen=True)
class Kind:
    """Kind of arm, and how its recordings are made.

    Attributes:
        model: of the description.
        base: grouping.
        truth: link parameters of the usual arm, shape (parameters,).
        noise: standard deviation of the torque [N m], shape (joints,).
        rate: [Hz].
        seconds: length of a recording.
    """

    model: ArmModel
    base: BaseParameters
    truth: Array
    noise: Array
    rate: float = 100.0
    seconds: float = 20.0

    def stamps(self, count: int) -> NDArray[np.int64]:
        """Return the stamps of a recording of so many samples [ns], shape (samples,)."""
        return np.rint(np.arange(count) * (1e9 / self.rate)).astype(np.int64)

    def changed(self, factors: Mapping[str, float] | None = None, added: Mapping[str, float] | None = None) -> Array:
        """Return the usual arm's parameters with some multiplied and some added to."""
        names, delta = self.model.layout.names, self.truth.copy()
        for name, factor in (factors or {}).items():
            delta[names.index(name)] *= factor
        for name, value in (added or {}).items():
            delta[names.index(name)] += value
        return delta

    def individual(self, seed: int, spread: float = 0.03) -> Array:
        """Return the parameters of one arm of the kind: bodies and drives differ a little, as real bodies do.

        Args:
            seed: of the arm.
            spread: standard deviation of links' masses and of each drive's terms, as a share.
        """
        rng = np.random.default_rng(seed)
        layout, delta = self.model.layout, self.truth.copy()
        for link in range(layout.joints):
            delta[layout.inertial(link)] *= 1.0 + spread * rng.standard_normal()
        drives = np.setdiff1d(
            np.arange(layout.size), np.concatenate([np.r_[layout.inertial(k)] for k in range(layout.joints)])
        )
        delta[drives] *= 1.0 + spread * rng.standard_normal(len(drives))
        return delta


def kind(arm: str = "planar2", *, noise: float | None = None, rate: float = 100.0, seconds: float = 20.0) -> Kind:
    """Return the kind of a shipped simulated arm."""
    model = arm_model(load_arm(arm))
    truth = true_parameters(model.config, model)
    assert truth is not None
    torque = np.array([model.config.joints[name].torque or 1.0 for name in model.chain.names])
    deviations = np.full(len(torque), noise) if noise is not None else 0.005 * torque
    return Kind(model, base_parameters(model.chain, model.layout), truth, deviations, rate, seconds)


def motion(of: Kind, seed: int) -> Callable[[Array], tuple[Array, Array, Array]]:
    """Return a random sum of sines inside the arm's limits: times [s] to position, velocity and acceleration."""
    rng = np.random.default_rng(seed)
    names = of.model.chain.names
    limits = [of.model.config.joints[name] for name in names]
    middle = np.array([0.5 * (one.position[0] + one.position[1]) if one.position else 0.0 for one in limits])
    half = np.array([0.5 * (one.position[1] - one.position[0]) if one.position else 1.0 for one in limits])
    fast = np.array([one.velocity or 1.0 for one in limits])
    waves = 5
    frequency = 2.0 * np.pi * rng.uniform(0.1, 0.6, (len(names), waves))
    phase = rng.uniform(0.0, 2.0 * np.pi, frequency.shape)
    amplitude = rng.uniform(0.5, 1.0, frequency.shape)
    amplitude *= (0.8 * np.minimum(half / amplitude.sum(axis=1), fast / (amplitude * frequency).sum(axis=1)))[:, None]

    def at(time: Array) -> tuple[Array, Array, Array]:
        angle = time[:, None, None] * frequency + phase
        position = middle + np.sum(amplitude * np.sin(angle), axis=2)
        velocity = np.sum(amplitude * frequency * np.cos(angle), axis=2)
        return position, velocity, -np.sum(amplitude * frequency**2 * np.sin(angle), axis=2)

    return at


def samples(of: Kind, delta: Array, seed: int, seconds: float | None = None) -> tuple[Array, Array, Array]:
    """Return position, velocity and torque of an arm with these link parameters, shape (samples, joints) each.

    Args:
        of: kind of arm.
        delta: link parameters, shape (parameters,).
        seed: of its motion and noise.
        seconds: its length; the kind's when None.
    """
    count = round((of.seconds if seconds is None else seconds) * of.rate)
    time, move = np.arange(count) / of.rate, motion(of, seed)
    position, velocity, _ = move(time)
    torque, beta = np.empty_like(position), of.base.K @ delta
    for start in range(0, count, _CHUNK):
        part = slice(start, start + _CHUNK)
        H = joint_regressor(of.model.chain, of.model.layout, *move(time[part] + 0.5 / of.rate), of.base.base)
        torque[part] = np.einsum("jps,p->sj", H, beta)
    torque += of.noise * np.random.default_rng(seed + 1_000_003).standard_normal(torque.shape)
    return position, velocity, torque


class DrawnRecording:
    """Recording that is no file: the samples that `write_recording` would write, for campaigns over many fleets."""

    joint_names: tuple[str, ...]
    torque_zero_order_hold, torn = True, False

    def __init__(self, of: Kind, delta: Array, *, seed: int, seconds: float | None = None) -> None:
        self.path = Path(f"{seed}.drawn")
        self.joint_names, self.joints = of.model.chain.names, len(of.model.chain.names)
        position, _, torque = samples(of, delta, seed, seconds)
        self.block = Block(of.stamps(len(torque)), position, torque)
        self.sha256 = hashlib.sha256(position.tobytes() + torque.tobytes()).hexdigest()

    def blocks(self, samples: int = BLOCK_SAMPLES) -> Iterator[Block]:
        """Give the samples as a reader does."""
        return assemble([self.block], samples, self.path, self.joint_names)


def write_recording(
    of: Kind,
    path: Path,
    delta: Array,
    *,
    seed: int,
    at: float = BEGIN,
    metadata: Mapping[str, str] | None = None,
    seconds: float | None = None,
) -> Path:
    """Write a recording of an arm with these link parameters; torques act from stamp to stamp, as ident records them.

    Args:
        of: kind of arm.
        path: of the MCAP file.
        delta: link parameters, shape (parameters,).
        seed: of its motion and noise.
        at: when it begins [s since 1970].
        metadata: of the record `ident`.
        seconds: its length; the kind's when None.
    """
    position, velocity, torque = samples(of, delta, seed, seconds)
    path.parent.mkdir(parents=True, exist_ok=True)
    with RecordingWriter(path, of.model.chain.names, "", round(at * 1e9), metadata=metadata) as writer:
        write_samples(writer, round(at * 1e9), of.stamps(len(torque)), position, velocity, torque)
    return path


_HEAD, _SEQUENCE, _LOG_TIME, _PUBLISH_TIME = 31, 11, 15, 23  # of a message's record, and where these lie in it [bytes]
_SECONDS, _NANOSECONDS, _BEHIND = 4, 8, 12  # in a payload, behind its encapsulation header
_CYCLE_NUMBER = 20


def write_samples(
    writer: RecordingWriter,
    utc_offset_ns: int,
    stamps: NDArray[np.int64],
    position: Array,
    velocity: Array,
    torque: Array,
) -> None:
    """Write samples that all axes answered, without lateness, as `RecordingWriter.sample` does one by one.

    All cycles together take a tenth of the time. The first is written by the writer itself; of the others the messages
    are copies of the first one's with other numbers, which go into the MCAP library's chunks as they are.

    Args:
        writer: open, nothing written.
        utc_offset_ns: of the stamps from UTC [ns].
        stamps: evenly spaced [ns], shape (samples,).
        position: measured, and reference [rad or m], shape (samples, joints).
        velocity: reference [rad/s or m/s], shape (samples, joints).
        torque: [N m or N], shape (samples, joints).
    """
    joints, count = position.shape[1], len(stamps)
    ok, age, none = np.ones(joints, dtype=bool), np.zeros(joints, dtype=np.int64), np.zeros(joints)
    row = (position[0], None, torque[0], position[0], velocity[0])
    writer.sample(Cycle(int(stamps[0]), *row, 0, 0, 0, ok, age, 0))
    messages = [
        ("/joint_states", writer._states.encode(0, none, none, none)),
        ("/joint_commands", writer._states.encode(0, none, none, none)),
        ("/cycle", writer._cycles.encode(0, 0, 0, 0, ok, age, 0)),
    ]
    fields: dict[str, tuple[object, int]] = {}
    template, starts = b"", []
    floats = len(ENCAPSULATION) + len(stamp_bytes(0)) + len(writer._states._until_position)
    for number, (topic, data) in enumerate(messages):
        starts.append(len(template))
        payload = len(template) + _HEAD
        fields[f"sequence{number}"] = "<u4", len(template) + _SEQUENCE
        fields[f"log{number}"] = "<u8", len(template) + _LOG_TIME
        fields[f"published{number}"] = "<u8", len(template) + _PUBLISH_TIME
        fields[f"seconds{number}"] = "<i4", payload + _SECONDS
        fields[f"nanoseconds{number}"] = "<u4", payload + _NANOSECONDS
        if topic == "/cycle":
            fields["cycle"] = "<u8", payload + _CYCLE_NUMBER
        else:
            for k, name in enumerate(("position", "velocity", "torque")):
                fields[f"{name}{number}"] = ("<f8", joints), payload + floats + k * 8 * (joints + 1)
        record = RecordBuilder()
        Message(writer._channels[topic], 0, data, 0, 0).write(record)
        template += record.end()
    names = list(fields)
    rows = np.zeros(
        count - 1,
        np.dtype(
            {
                "names": names,
                "formats": [fields[name][0] for name in names],
                "offsets": [fields[name][1] for name in names],
                "itemsize": len(template),
            }
        ),
    )
    rows.view(np.uint8).reshape(count - 1, -1)[:] = np.frombuffer(template, np.uint8)
    utc = stamps + utc_offset_ns
    for number in range(len(messages)):
        rows[f"sequence{number}"] = np.arange(1, count)
        rows[f"log{number}"] = rows[f"published{number}"] = utc[1:]
        rows[f"seconds{number}"], rows[f"nanoseconds{number}"] = np.divmod(utc[1:], 1_000_000_000)
    rows["cycle"] = np.arange(1, count)
    period = float(stamps[1] - stamps[0]) * 1e-9
    share = period / (period + _LOW_PASS_S)
    for number, measured in enumerate(
        (scipy.signal.lfilter([share], [1.0, share - 1.0], np.diff(position, axis=0) / period, axis=0), velocity[1:])
    ):
        rows[f"position{number}"], rows[f"velocity{number}"], rows[f"torque{number}"] = (
            position[1:],
            measured,
            torque[1:],
        )
    _add_rows(writer, rows.tobytes(), utc, stamps, starts, [writer._channels[topic] for topic, _ in messages])


def _add_rows(
    writer: RecordingWriter,
    content: bytes,
    utc: NDArray[np.int64],
    stamps: NDArray[np.int64],
    starts: Sequence[int],
    channels: Sequence[int],
) -> None:
    """Append the records of all cycles but the first to the file, in chunks as the writer makes them."""
    library: Any = writer._mcap
    chunk, statistics = library._Writer__chunk_builder, library._Writer__statistics
    size, begin, count = len(content) // (len(stamps) - 1), 1, len(stamps)
    while begin < count:
        started = writer._chunk_start_ns
        assert started is not None
        room = (CHUNK_BYTES - writer._chunk_bytes) // size
        end = min(begin + room, int(np.searchsorted(stamps, started + CHUNK_NS)), count)
        if end > begin:
            offset = chunk.record_writer.count
            chunk.record_writer._buffer.write(content[(begin - 1) * size : (end - 1) * size])
            times = utc[begin:end].tolist()
            for channel, start in zip(channels, starts, strict=True):
                index = chunk.message_indices.setdefault(channel, MessageIndex(channel_id=channel, records=[]))
                index.records.extend((at, offset + start + k * size) for k, at in enumerate(times))
                statistics.channel_message_counts[channel] += end - begin
            if not chunk.num_messages:
                chunk.message_start_time = times[0]
            chunk.message_end_time = statistics.message_end_time = times[-1]
            chunk.num_messages += len(channels) * (end - begin)
            statistics.message_count += len(channels) * (end - begin)
            writer._chunk_bytes += size * (end - begin)
            begin = end
        if begin < count:
            library.flush()
            writer._chunk_start_ns, writer._chunk_bytes = int(stamps[begin]), 0


def held_out_errors(
    alone: ArmFit, unseen: Merged, prior: tuple[Array, Array, Array], scale: Array, described: Described
) -> tuple[float, float]:
    """Torque errors of an arm alone and pooled on recordings that it was not fitted to [percent]."""
    pooled = pooled_fit(alone, prior, scale)
    return error_on(unseen, alone.fit, described), error_on(unseen, pooled, described)
