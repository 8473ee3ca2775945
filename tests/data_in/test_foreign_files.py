"""Files of others: CSV with any header, bags with other topics, names and orders, recordings of motors."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from made_recordings import MadeRecording, moving, whole, write_bag

from ident_service.config.recording import RecordingFormat, Transmission
from ident_service.errors import RecordingError, UsageError
from ident_service.recordings.adapters import JointSideRecording
from ident_service.recordings.cycle import Cycle
from ident_service.recordings.mcap_writer import RecordingWriter
from ident_service.recordings.open import open_recording
from ident_service.recordings.recording import Block

COUPLED = Transmission(ratios=(50.0, -40.0), coupling=((1.0, 0.0), (0.5, 1.0)), offsets=(0.1, -0.2))
COLUMNS = {"t": "zeit", "q1": "w 1", "q2": "w 2", "tau1": "m 1", "tau2": "m 2", "dq1": "v 1", "dq2": "v 2"}


@pytest.fixture
def samples() -> Block:
    return moving(np.arange(50, dtype=np.int64) * 4_000_000 + 10**9, velocity=True).block


def write_csv(path: Path, block: Block) -> Path:
    assert block.velocity is not None
    lines = ["m 2,zeit,extra,w 2,v 1,w 1,v 2,m 1"]
    for t, q, dq, tau in zip(
        block.stamp_ns.tolist(), block.position.tolist(), block.velocity.tolist(), block.torque.tolist(), strict=True
    ):
        fields = [tau[1], f"{t // 10**9}.{t % 10**9:09d}", "7", q[1], dq[0], q[0], dq[1], tau[0]]
        lines.append(",".join(map(str, fields)))
    path.write_bytes(gzip.compress("\n".join(lines).encode()))
    return path


def assert_same(found: Block, expected: Block) -> None:
    assert np.array_equal(found.stamp_ns, expected.stamp_ns)
    assert np.array_equal(found.position, expected.position)
    assert np.array_equal(found.torque, expected.torque)
    assert found.velocity is not None
    assert expected.velocity is not None
    assert np.array_equal(found.velocity, expected.velocity)


def test_csv_with_any_header(tmp_path: Path, samples: Block) -> None:
    path = write_csv(tmp_path / "run.csv.gz", samples)
    recording = open_recording(path, ["one", "two"], fmt=RecordingFormat(columns=COLUMNS))
    assert recording.joint_names == ("one", "two")
    assert_same(whole(recording), samples)
    with pytest.raises(RecordingError, match=r"unknown columns .*'zeit'"):
        open_recording(path)


@pytest.mark.parametrize("joints", [("one", "two"), ("two", "one"), ("two",)])
def test_a_bag_with_other_names_and_order(tmp_path: Path, samples: Block, joints: tuple[str, ...]) -> None:
    path = write_bag(tmp_path / "bag.mcap", "/arm/states", ["two", "axis_1"], samples)
    form = RecordingFormat(topic="/arm/states", joint_names={"one": "axis_1"})
    recording = open_recording(path, joints, fmt=form)
    order = [("two", "one").index(joint) for joint in joints]
    assert recording.joint_names == joints
    assert not recording.torque_zero_order_hold
    assert np.array_equal(whole(recording).position, samples.position[:, order])
    assert np.array_equal(whole(recording).torque, samples.torque[:, order])


def test_a_bag_names_the_arm_s_joints_when_none_are_requested(tmp_path: Path, samples: Block) -> None:
    path = write_bag(tmp_path / "bag.mcap", "/joint_states", ["two", "axis_1"], samples)
    recording = open_recording(path, fmt=RecordingFormat(joint_names={"one": "axis_1"}))
    assert recording.joint_names == ("two", "one")
    assert_same(whole(recording), samples)
    with pytest.raises(RecordingError, match=r"lacks joints \['one'\]; it has \['two', 'axis_1'\]"):
        open_recording(path, ["one", "two"])
    with pytest.raises(RecordingError, match=r"no message on /arm; topics with joint states: \['/joint_states'\]"):
        open_recording(path, fmt=RecordingFormat(topic="/arm"))


def test_own_recordings_need_no_format(tmp_path: Path) -> None:
    path, q = tmp_path / "run.mcap", np.array([1.0, 2.0])
    with RecordingWriter(path, ["one", "two"], "<robot/>", 0) as writer:
        for k in range(3):
            writer.sample(Cycle(k + 1, q, None, q + 2.0, q, q, k, 0, 0, np.ones(2, bool), np.zeros(2, int), 0))
    form = RecordingFormat(topic="/arm", joint_names={"one": "axis_1"}, side="motor")
    recording = open_recording(path, ["two", "one"], fmt=form, transmission=COUPLED)
    assert recording.joint_names == ("two", "one")
    assert whole(recording).position.tolist() == [[2.0, 1.0]] * 3
    assert whole(recording).torque.tolist() == [[4.0, 3.0]] * 3


def test_motor_side_is_brought_to_the_joints(tmp_path: Path, samples: Block) -> None:
    path = write_csv(tmp_path / "run.csv.gz", samples)
    form = RecordingFormat(columns=COLUMNS, side="motor")
    block = whole(open_recording(path, ["one", "two"], fmt=form, transmission=COUPLED))
    motor_1, motor_2 = samples.position.T
    assert np.allclose(block.position[:, 0], motor_1 / 50 + 0.1, rtol=1e-13, atol=1e-15)
    assert np.allclose(block.position[:, 1], motor_2 / -40 - 0.5 * motor_1 / 50 - 0.2, rtol=1e-13, atol=1e-15)
    assert np.allclose(block.torque[:, 0], 50 * samples.torque[:, 0] - 0.5 * 40 * samples.torque[:, 1], rtol=1e-13)
    assert np.allclose(block.torque[:, 1], -40 * samples.torque[:, 1], rtol=1e-13)
    with pytest.raises(ValueError, match="read-only"):
        block.torque[0, 0] = 1.0
    with pytest.raises(UsageError, match="no transmission"):
        open_recording(path, ["one", "two"], fmt=form)
    with pytest.raises(RecordingError, match="has 2 motors but the transmission has 1 ratios"):
        open_recording(path, fmt=form, transmission=Transmission(ratios=(3.0,)))


@pytest.mark.parametrize(("side", "torque_side"), [("joint", "motor"), ("motor", "joint")])
def test_torques_may_be_measured_on_the_other_side_than_positions(
    side: Literal["joint", "motor"], torque_side: Literal["joint", "motor"], tmp_path: Path, samples: Block
) -> None:
    path = write_csv(tmp_path / "run.csv.gz", samples)
    form = RecordingFormat.model_validate({"columns": COLUMNS, "side": side, "torque_side": torque_side})
    block = whole(open_recording(path, ["one", "two"], fmt=form, transmission=COUPLED))
    motors = form.model_copy(update={"side": "motor", "torque_side": None})
    brought = whole(open_recording(path, ["one", "two"], fmt=motors, transmission=COUPLED))
    positions, torques = (samples, brought) if side == "joint" else (brought, samples)
    assert np.array_equal(block.position, positions.position)
    assert block.velocity is not None
    assert positions.velocity is not None
    assert np.array_equal(block.velocity, positions.velocity)
    assert np.array_equal(block.torque, torques.torque)
    with pytest.raises(UsageError, match="no transmission"):
        open_recording(path, ["one", "two"], fmt=form)


def ratios() -> st.SearchStrategy[float]:
    return st.floats(0.5, 200.0).flatmap(lambda size: st.sampled_from([size, -size]))


@st.composite
def transmissions(draw: st.DrawFn, joints: int = 3) -> Transmission:
    lower = draw(arrays(np.float64, (joints, joints), elements=st.floats(-1, 1)))
    coupling = np.tril(lower, -1) + np.diag(draw(arrays(np.float64, joints, elements=st.floats(0.5, 2))))
    return Transmission(
        ratios=tuple(draw(st.lists(ratios(), min_size=joints, max_size=joints))),
        coupling=draw(st.sampled_from([None, tuple(map(tuple, coupling.tolist()))])),
        offsets=draw(st.sampled_from([None, tuple(np.linspace(-1.0, 2.0, joints).tolist())])),
    )


VALUES = arrays(np.float64, (5, 3), elements=st.integers(-(10**8), 10**8).map(lambda n: n * 1e-6))


@pytest.mark.slow
@given(transmissions(), VALUES, VALUES, VALUES)
def test_power_is_kept_and_motors_come_back(transmission: Transmission, q, dq, tau) -> None:
    motors = MadeRecording(np.arange(5), q, tau, dq)
    block = whole(JointSideRecording(motors, transmission))
    assert block.velocity is not None
    size = len(transmission.ratios)
    coupling = np.eye(size) if transmission.coupling is None else np.array(transmission.coupling)
    offsets = np.zeros(size) if transmission.offsets is None else np.array(transmission.offsets)
    to_motor = np.diag(transmission.ratios) @ coupling
    power = (block.torque * block.velocity).sum(axis=1)
    # The rounding is that of terms of the coupling that may cancel.
    scale = np.linalg.cond(to_motor) * np.linalg.norm(tau, axis=1) * np.linalg.norm(dq, axis=1)
    assert (np.abs(power - (tau * dq).sum(axis=1)) <= 1e-13 * scale).all()
    assert np.allclose((block.position - offsets) @ to_motor.T, q, rtol=1e-10, atol=1e-10)
    assert np.allclose(block.velocity @ to_motor.T, dq, rtol=1e-10, atol=1e-10)
    assert np.allclose(np.linalg.solve(to_motor.T, block.torque.T).T, tau, rtol=1e-9, atol=1e-9)
