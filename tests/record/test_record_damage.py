"""What becomes of a recording whose writer was killed, or that was cut off, damaged or made to do harm."""

from __future__ import annotations

import os
import signal
import struct
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer
from record_samples import (
    START_NS,
    STEP_NS,
    URDF,
    position,
    read_all,
    write_recording,
)

from ident_service.errors import RecordingError
from ident_service.recordings import mcap_records
from ident_service.recordings.mcap_reader import JointStateDecoder, McapRecording, PayloadError
from ident_service.recordings.mcap_writer import JOINT_STATE, JointStateEncoder

ROOT = Path(__file__).parents[2]


KILLED = """
import os, signal, sys
sys.path[:0] = [{here!r}]
from ident_service.recordings.mcap_writer import RecordingWriter
from record_samples import JOINTS, URDF, OFFSET_NS, write_samples
writer = RecordingWriter({path!r}, JOINTS, URDF, OFFSET_NS)
writer.__enter__()
write_samples(writer, {count})
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_process_loses_less_than_200_ms(tmp_path: Path) -> None:
    path, count = tmp_path / "run.mcap", 1237
    code = KILLED.format(here=str(Path(__file__).parent), path=str(path), count=count)
    killed = subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False, env={**os.environ})
    assert killed.returncode == -signal.SIGKILL
    assert not path.exists()
    recording = McapRecording(tmp_path / "run.mcap.partial")
    block = read_all(recording)
    assert recording.torn
    assert recording.torque_zero_order_hold
    assert recording.metadata["complete"] == "false"
    assert np.array_equal(block.position, [position(k, 3) for k in range(len(block.stamp_ns))])
    assert START_NS + (count - 1) * STEP_NS - block.stamp_ns[-1] <= 200_000_000
    assert recording.read_extras().robot_description == URDF


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recording(tmp_path_factory.mktemp("whole") / "run.mcap", 300)


def test_torn_at_any_place_a_prefix_is_read(whole: Path, tmp_path: Path) -> None:
    content = whole.read_bytes()
    complete = read_all(McapRecording(whole))
    places = np.random.default_rng(1).integers(0, len(content), 150).tolist()
    lengths = []
    for cut in [*places, 0, 8, 9, len(content) - 1, len(content) - 8]:
        torn = tmp_path / "torn.mcap"
        torn.write_bytes(content[:cut])
        try:
            recording = McapRecording(torn)
            block = read_all(recording)
        except RecordingError:
            continue
        n = len(block.stamp_ns)
        assert recording.torn
        assert np.array_equal(block.stamp_ns, complete.stamp_ns[:n])
        assert np.array_equal(block.torque, complete.torque[:n])
        recording.read_extras()
        lengths.append(n)
    assert max(lengths) == 300
    assert min(lengths) < 150


@pytest.mark.slow
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_damage_never_passes_for_samples(whole: Path, tmp_path: Path, data: st.DataObject) -> None:
    content = bytearray(whole.read_bytes())
    place = data.draw(st.integers(0, len(content) - 1))
    content[place] ^= data.draw(st.integers(1, 255))
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(content)
    try:
        recording = McapRecording(damaged)
        block = read_all(recording)
        recording.read_extras()
    except RecordingError:
        return
    complete = read_all(McapRecording(whole))
    n = len(block.stamp_ns)
    # A flipped digit in the metadata may move the clock, as nothing protects it; the samples themselves are covered.
    assert np.array_equal(np.diff(block.stamp_ns), np.diff(complete.stamp_ns[:n]))
    assert np.array_equal(block.position, complete.position[:n])


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.parametrize("declared", [1000, 1 << 40])
def test_bombs_are_not_expanded(tmp_path: Path, compression: str, declared: int) -> None:
    from mcap.data_stream import RecordBuilder
    from mcap.records import Chunk

    data = zstandard.compress(bytes(1 << 24)) if compression == "zstd" else lz4.frame.compress(bytes(1 << 24))
    builder = RecordBuilder()
    Chunk(compression, data, 0, 0, 0, declared).write(builder)
    path = tmp_path / "bomb.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + builder.end())
    with pytest.raises(RecordingError, match=r"no message|above the limit"):
        McapRecording(path)


@pytest.mark.slow
@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_damage_without_checksums_is_a_recording_error_at_worst(tmp_path: Path, data: st.DataObject) -> None:
    path = tmp_path / "bag.mcap"
    encoder = JointStateEncoder(["a", "bc"])
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE, enable_crcs=False)
        writer.start(profile="ros2")
        schema = writer.register_schema(JOINT_STATE, "ros2msg", b"")
        channel = writer.register_channel("/joint_states", "cdr", schema)
        for k in range(1, 4):
            writer.add_message(channel, k, encoder.encode(k, [k, 1], [k, 2], [k, 3]), k)
        writer.add_metadata("ident", {"utc_offset_ns": "1"})
        writer.finish()
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content)
    try:
        recording = McapRecording(path)
        recording.read_extras()
        read_all(recording, 2)
    except RecordingError:
        pass


@given(st.binary(max_size=120))
def test_any_payload_is_a_joint_state_or_refused(noise: bytes) -> None:
    decoder = JointStateDecoder(["a"], others=True, velocity=False)
    good = JointStateEncoder(["a"]).encode(1, [1.0], None, [2.0])
    for payload in (noise, b"\x00\x01\x00\x00" + noise, good[: len(noise)], good[:24] + noise):
        try:
            block = decoder.decode([good, payload, good], [1, 2, 3])
        except PayloadError:
            continue
        assert len(block.stamp_ns) in (2, 3)


def _record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def _message(channel: int, time: int, payload: bytes) -> bytes:
    return _record(5, struct.pack("<HIQQ", channel, time % 2**32, time, time) + payload)


@st.composite
def runs_of_records(draw: st.DrawFn) -> tuple[bytes, list[tuple[int, int, bytes]]]:
    """A loop's messages, again and again, between single ones; and what a reader must find of channels 1 and 2."""
    run, messages, time = b"", [], 0
    for _ in range(draw(st.integers(1, 4))):
        period = draw(st.lists(st.tuples(st.integers(1, 4), st.integers(0, 20)), min_size=1, max_size=5))
        for _ in range(draw(st.sampled_from([1, 2, 9, 30]))):
            for channel, length in period:
                payload = bytes((time + k) % 256 for k in range(length))
                messages.append((channel, time, payload))
                run += _message(channel, time, payload)
                time += 2**61 // 1000
        if draw(st.booleans()):
            run += _record(draw(st.sampled_from([7, 200])), b"\x00" * draw(st.integers(0, 3)))
    return run, [one for one in messages if one[0] < 3]


@given(made=runs_of_records(), cut=st.integers(0, 2000))
@settings(deadline=None)
def test_records_that_repeat_are_the_same_messages_as_one_by_one(
    made: tuple[bytes, list[tuple[int, int, bytes]]], cut: int
) -> None:
    run, messages = made
    chosen = lambda channel: channel < 3  # noqa: E731
    directory = mcap_records.Directory()
    assert list(mcap_records.messages(run, directory, chosen)) == messages
    # What was learnt of a run's period changes nothing of the next one.
    assert list(mcap_records.messages(run, directory, chosen)) == messages
    # Of a run that ends too early, all that came before.
    short, found = run[: max(len(run) - cut, 0)], []
    with suppress(mcap_records.TornError):
        found.extend(mcap_records.messages(short, mcap_records.Directory(), chosen))
    assert found == messages[: len(found)]


def test_runs_of_whole_cycles_are_read_at_once_unless_one_is_another() -> None:
    cycle = [(1, 16), (2, 8), (3, 4)]

    def run(first: int, count: int, odd: int | None = None) -> bytes:
        return b"".join(
            _message(4 if (n, channel) == (odd, 3) else channel, n, bytes([n]) * length)
            for n in range(first, first + count)
            for channel, length in cycle
        )

    directory, choose = mcap_records.Directory(), lambda channel: channel == 2
    assert len(list(mcap_records.series(run(0, 20), directory, choose))) == 2
    (whole,) = mcap_records.series(run(20, 5), directory, choose)
    assert isinstance(whole, mcap_records.Series)
    assert whole.log_times.tolist() == list(range(20, 25))
    assert whole.payloads.tolist() == [[n] * 8 for n in range(20, 25)]
    # As long as whole cycles, but one message is of another channel; and a run that ends within a message.
    found = list(mcap_records.messages(run(25, 12, odd=30), directory, choose))
    assert [time for _, time, _ in found] == list(range(25, 37))
    with pytest.raises(mcap_records.TornError):
        list(mcap_records.messages(run(37, 12)[:-1], directory, choose))


def test_many_at_once_are_found_in_a_loops_records() -> None:
    cycle = [(1, 16), (2, 8), (3, 4)]
    run = b"".join(_message(channel, n, bytes([n]) * length) for n in range(50) for channel, length in cycle)
    first, many = mcap_records.series(run, mcap_records.Directory(), lambda channel: channel == 2)
    assert first == (2, 0, bytes(8))
    assert isinstance(many, mcap_records.Series)
    assert many.channel == 2
    assert many.log_times.tolist() == list(range(1, 50))
    assert many.payloads.tolist() == [[n] * 8 for n in range(1, 50)]
    assert not list(mcap_records.series(run, mcap_records.Directory(), lambda channel: channel == 9))
