"""Our MCAP recordings there and back, an independent reader on them, and the bags of others."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer as BagWriter
from record_samples import (
    JOINTS,
    OFFSET_NS,
    START_NS,
    STEP_NS,
    URDF,
    position,
    read_all,
    write_recording,
    write_samples,
)

from ident_service.errors import RecordingError, UsageError
from ident_service.recordings.cycle import Cycle
from ident_service.recordings.mcap_reader import McapRecording
from ident_service.recordings.mcap_writer import DEFINITIONS, JOINT_STATE, JointStateEncoder, RecordingWriter
from ident_service.recordings.open import open_recording

ROOT = Path(__file__).parents[2]


def decoded(path: Path, topic: str):
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return [(m.log_time, ros) for _, _, m, ros in reader.iter_decoded_messages(topics=[topic])]


@pytest.mark.parametrize("velocity", [False, True])
@pytest.mark.parametrize("samples", [1, 7, 100, 4096])
def test_round_trip(tmp_path: Path, velocity: bool, samples: int) -> None:
    path = write_recording(tmp_path / "run.mcap", 500, velocity=velocity)
    recording = open_recording(path)
    block = read_all(recording, samples)
    expected = np.array([position(k, 3) for k in range(500)])
    assert recording.joint_names == JOINTS
    assert recording.torque_zero_order_hold
    assert not recording.torn
    assert np.array_equal(block.stamp_ns, START_NS + STEP_NS * np.arange(500))
    assert np.array_equal(block.position, expected)
    assert np.array_equal(block.torque, expected + 20.0)
    assert block.velocity is None if not velocity else np.array_equal(block.velocity, expected + 10.0)


def test_blocks_are_read_only_and_can_be_read_again(tmp_path: Path) -> None:
    recording = open_recording(write_recording(tmp_path / "run.mcap", 10))
    first, second = read_all(recording), read_all(recording)
    assert np.array_equal(first.torque, second.torque)
    with pytest.raises(ValueError, match="read-only"):
        next(recording.blocks()).position[0, 0] = 1.0
    with pytest.raises(UsageError):
        next(recording.blocks(0))


def test_columns_follow_the_requested_joints(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "run.mcap", 20)
    block = read_all(open_recording(path, ["wrist_roll", "shoulder"]))
    assert np.array_equal(block.position, read_all(open_recording(path)).position[:, [2, 0]])


def test_missing_joints_are_named_with_what_is_there(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "run.mcap", 3)
    with pytest.raises(RecordingError, match=r"lacks joints \['hip'\]; it has \['shoulder', 'elbow', 'wrist_roll'\]"):
        open_recording(path, ["elbow", "hip"])
    with pytest.raises(RecordingError, match=r"but none of \['hip'\]"):
        open_recording(path, ["hip"])
    with pytest.raises(RecordingError, match=r"no message on /arm; topics with joint states: \['/joint_commands'"):
        McapRecording(path, topic="/arm")


def test_independent_reader_agrees_on_every_topic(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with RecordingWriter(path, JOINTS, URDF, OFFSET_NS) as writer:
        write_samples(writer, 3, velocity=True)
        writer.event(START_NS + 5, 30, "störung: axis 2")
    for k, (log_time, state) in enumerate(decoded(path, "/joint_states")):
        utc = OFFSET_NS + START_NS + k * STEP_NS
        assert log_time == utc == state.header.stamp.sec * 10**9 + state.header.stamp.nanosec
        assert tuple(state.name) == JOINTS
        assert list(state.position) == position(k, 3).tolist()
        assert list(state.velocity) == (position(k, 3) + 10.0).tolist()
        assert list(state.effort) == (position(k, 3) + 20.0).tolist()
    commands = decoded(path, "/joint_commands")
    assert len(commands) == 3
    assert list(commands[2][1].position) == (position(2, 3) + 30.0).tolist()
    assert list(commands[2][1].velocity) == (position(2, 3) + 40.0).tolist()
    assert list(commands[2][1].effort) == (position(2, 3) + 20.0).tolist()
    _, cycle = decoded(path, "/cycle")[2]
    assert (cycle.cycle, cycle.lateness_ns, cycle.compute_ns, cycle.lost) == (2, 102, 202, 1)
    assert list(cycle.valid) == [True, False, True]
    assert list(cycle.age) == [2, 3, 4]
    [(_, log)] = decoded(path, "/events")
    assert (log.level, log.name, log.msg) == (30, "ident", "störung: axis 2")
    [(log_time, description)] = decoded(path, "/robot_description")
    assert description.data == URDF
    assert log_time == OFFSET_NS + START_NS


@pytest.mark.parametrize("joints", range(1, 10))
@pytest.mark.parametrize("length", range(1, 10))
def test_alignment_for_all_names_and_joint_counts(tmp_path: Path, joints: int, length: int) -> None:
    names = [str(joint) + "x" * (length - 1) for joint in range(joints)]
    for velocity in (False, True):
        path = write_recording(tmp_path / f"{velocity}.mcap", 2, names, velocity=velocity)
        _, state = decoded(path, "/joint_states")[1]
        q = position(1, joints)
        assert list(state.name) == names
        assert list(state.effort) == (q + 20.0).tolist()
        _, cycle = decoded(path, "/cycle")[1]
        assert list(cycle.valid) == (np.arange(joints) != 1).tolist()
        assert list(cycle.age) == (np.arange(joints) + 1).tolist()
        assert cycle.lost == 0
        block = read_all(McapRecording(path))
        assert np.array_equal(block.position[1], q)
        assert np.array_equal(block.torque[1], q + 20.0)
        assert block.velocity is None if not velocity else np.array_equal(block.velocity[1], q + 10.0)


def test_extras(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with RecordingWriter(path, JOINTS, URDF, OFFSET_NS, {"excitation.json": b"{}"}, {"run": "7"}) as writer:
        write_samples(writer, 2)
        writer.event(START_NS + 7, 20, "started")
    extras = McapRecording(path).read_extras()
    assert extras.attachments == {"excitation.json": b"{}"}
    assert extras.robot_description == URDF
    assert [(event.stamp_ns, event.level, event.message) for event in extras.events] == [(START_NS + 7, 20, "started")]
    ident = extras.metadata["ident"]
    assert (ident["run"], ident["complete"], ident["torque_hold"]) == ("7", "true", "zero_order")
    assert ident["utc_offset_ns"] == str(OFFSET_NS)


def test_a_failed_motion_is_finished_and_says_so(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"

    def loop() -> None:
        with RecordingWriter(path, JOINTS, URDF, OFFSET_NS) as writer:
            write_samples(writer, 250)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        loop()
    recording = McapRecording(path)
    assert not recording.torn
    assert recording.metadata["complete"] == "false"
    assert len(read_all(recording).stamp_ns) == 250


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "run.mcap", 1)
    with pytest.raises(UsageError, match="never overwritten"), RecordingWriter(path, JOINTS, URDF, 0):
        pass
    (tmp_path / "other.mcap.partial").write_bytes(b"")
    with pytest.raises(UsageError, match="interrupted"), RecordingWriter(tmp_path / "other.mcap", JOINTS, URDF, 0):
        pass
    with pytest.raises(UsageError, match="not unique"):
        RecordingWriter(path, ["a", "a"], URDF, 0)
    with pytest.raises(UsageError, match="complete"):
        RecordingWriter(path, JOINTS, URDF, 0, {}, {"complete": "yes"})
    with pytest.raises(RecordingError, match="cannot be created"), RecordingWriter(tmp_path / "no" / "a", ["a"], "", 0):
        pass


def test_chunks_end_by_size_and_by_time(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "run.mcap", 1000)
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    for chunk in summary.chunk_indexes:
        assert chunk.uncompressed_size <= 66_000
        assert chunk.message_end_time - chunk.message_start_time < 100_000_000
    assert len(summary.chunk_indexes) >= 10


def test_bad_samples_are_named(tmp_path: Path) -> None:
    for name, change in {"nan": (np.nan, STEP_NS), "stamp": (1.0, 0)}.items():
        path = tmp_path / f"{name}.mcap"
        value, step = change
        with RecordingWriter(path, ["a", "b"], URDF, 0) as writer:
            for k in range(10):
                q = np.array([0.0, value if k == 5 else 0.0])
                stamp = START_NS + (k if k != 5 else 4) * STEP_NS + (step if k == 5 else 0)
                writer.sample(Cycle(stamp, q, None, q, q, q, k, 0, 0, np.ones(2, bool), np.zeros(2, int), 0))
        expected = "position of joint b is nan" if name == "nan" else "the stamp does not increase"
        for samples in (1, 3, 4096):
            with pytest.raises(RecordingError, match=rf"sample 5, 0\.00\d+ s after the first: {expected}"):
                list(McapRecording(path).blocks(samples))


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("chunk_size", [1, 4096, 1 << 20])
def test_bags_of_others(tmp_path: Path, compression: CompressionType, chunk_size: int) -> None:
    """Two publishers on one topic, a frame that changes its name, no metadata, one message without a stamp."""
    path = tmp_path / "bag.mcap"
    with path.open("wb") as stream:
        writer = BagWriter(stream, chunk_size, compression)
        schema = writer.register_msgdef(JOINT_STATE, DEFINITIONS[JOINT_STATE].decode())
        for k in range(1, 201):
            stamp = {"sec": 0, "nanosec": k * 10**6 if k != 9 else 0}
            finger = {"header": {"stamp": stamp, "frame_id": ""}, "name": ["finger"], "position": [0.0]}
            arm = {
                "header": {"stamp": stamp, "frame_id": "x" * (k % 3)},
                "name": ["b", "a"],
                "position": [float(k), 2.0 * k],
                "effort": [k + 1.0, 2.0 * k + 1.0],
            }
            for message in (finger, arm):
                writer.write_message("/joint_states", schema, {"velocity": [], "effort": [], **message}, k * 10**6)
        writer.finish()
    recording = open_recording(path, ["a", "b"])
    assert not recording.torque_zero_order_hold
    for samples in (7, 1000):
        block = read_all(recording, samples)
        assert np.array_equal(block.stamp_ns, np.arange(1, 201) * 10**6)
        assert np.array_equal(block.position, np.outer(np.arange(1, 201), [2, 1]))
        assert np.array_equal(block.torque, block.position + 1)
    with pytest.raises(RecordingError, match="no effort"):
        open_recording(path)
    with pytest.raises(RecordingError, match=r"lacks joints \['a'\]; it has \['finger'\]"):
        open_recording(path, ["a", "finger"])


def test_what_is_no_recording(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such file"):
        open_recording(tmp_path / "missing.mcap")
    with pytest.raises(UsageError, match="folder"):
        open_recording(tmp_path)
    empty = tmp_path / "empty"
    empty.write_bytes(b"")
    with pytest.raises(RecordingError, match="is empty"):
        open_recording(empty)
    empty.write_bytes(b"\x7fELF\x00\x00")
    with pytest.raises(RecordingError, match="neither MCAP nor CSV"):
        open_recording(empty)
    empty.write_text("t,q1,tau1\n0,1,2\n", encoding="utf-16")
    with pytest.raises(RecordingError, match="UTF-16; save it as UTF-8"):
        open_recording(empty)


def test_the_high_level_ros2_reader_takes_our_files(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        from mcap_ros2.reader import read_ros2_messages
    topics = {message.channel.topic for message in read_ros2_messages(write_recording(tmp_path / "run.mcap", 3))}
    assert topics == {"/joint_states", "/joint_commands", "/cycle", "/robot_description"}


def test_joints_that_change_are_refused_unless_requested(tmp_path: Path) -> None:
    path = tmp_path / "bag.mcap"
    with path.open("wb") as stream:
        writer = BagWriter(stream)
        schema = writer.register_msgdef(JOINT_STATE, DEFINITIONS[JOINT_STATE].decode())
        for k in range(1, 11):
            names = ["a", "b"] if k < 8 else ["a", "c"]
            header = {"stamp": {"sec": k, "nanosec": 0}, "frame_id": ""}
            values = {"position": [1.0, 2.0], "velocity": [float("nan")] * 2, "effort": [3.0, 4.0]}
            writer.write_message("/joint_states", schema, {"header": header, "name": names, **values}, k)
        writer.finish()
    with pytest.raises(RecordingError, match=r"message 7 on /joint_states lacks joints \['b'\]; it has \['a', 'c'\]"):
        read_all(open_recording(path))
    block = read_all(open_recording(path, ["a"]))
    assert block.velocity is None
    assert block.torque.tolist() == [[3.0]] * 10


def test_messages_outside_of_chunks(tmp_path: Path) -> None:
    path = tmp_path / "bag.mcap"
    encoder = JointStateEncoder(["a"])
    with path.open("wb") as stream:
        writer = Writer(stream, use_chunking=False)
        writer.start(profile="ros2")
        schema = writer.register_schema(JOINT_STATE, "ros2msg", DEFINITIONS[JOINT_STATE])
        channel = writer.register_channel("/joint_states", "cdr", schema)
        for k in range(1, 50):
            writer.add_message(channel, k, encoder.encode(k, [k], None, [-k]), k)
        writer.finish()
    assert read_all(open_recording(path)).torque[:, 0].tolist() == [-float(k) for k in range(1, 50)]
    path.write_bytes(path.read_bytes()[:1000])
    torn = open_recording(path)
    assert torn.torn
    assert 0 < len(read_all(torn).stamp_ns) < 49


def test_what_drives_measured_stands_beside_what_they_were_sent(tmp_path: Path) -> None:
    path, q = tmp_path / "run.mcap", np.array([0.1, 0.2, 0.3])
    with RecordingWriter(path, JOINTS, URDF, OFFSET_NS) as writer:
        for k in range(5):
            measured = None if k == 3 else np.where(np.arange(3) == 1, np.nan, q + k)
            timing = (k, 0, 0, np.ones(3, bool), np.zeros(3, int), 0)
            writer.sample(Cycle(START_NS + k * STEP_NS, q, None, q, q, q, *timing, measured))
    found = decoded(path, "/joint_torques")
    assert [stamp - OFFSET_NS - START_NS for stamp, _ in found] == [0, STEP_NS, 2 * STEP_NS, 4 * STEP_NS]
    for stamp, message in found:
        k = (stamp - OFFSET_NS - START_NS) // STEP_NS
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp
        assert list(message.name) == list(JOINTS)
        assert (list(message.position), list(message.velocity)) == ([], [])
        np.testing.assert_array_equal(message.effort, np.where(np.arange(3) == 1, np.nan, q + k))
    stamps, torques = McapRecording(path).measured("/joint_torques")
    np.testing.assert_array_equal(stamps, [stamp - OFFSET_NS for stamp, _ in found])
    np.testing.assert_array_equal(torques, [message.effort for _, message in found])
    reordered = McapRecording(path, order=JOINTS[::-1]).measured("/joint_torques")[1]
    np.testing.assert_array_equal(reordered, torques[:, ::-1])
