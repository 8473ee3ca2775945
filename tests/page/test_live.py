"""What is read of a run while it is recorded, held against what was written."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import pytest

from ident_service.config.load import load_arm, shipped_arms
from ident_service.daemon.live import BIN_NS, LiveRun
from ident_service.errors import RecordingError
from ident_service.estimation.online import SequentialLeastSquares
from ident_service.model.arm_model import arm_model
from ident_service.model.regressor import joint_regressor
from ident_service.recordings.cycle import Cycle
from ident_service.recordings.mcap_follower import RecordingFollower
from ident_service.recordings.mcap_writer import RecordingWriter
from ident_service.recordings.recording import Block

NAMES = ("shoulder", "elbow")
STEP_NS = 2_000_000
START_NS = 5_000_000_000


def cycle(k: int) -> Cycle:
    """One whose values say which it is."""
    ones = np.ones(2)
    return Cycle(
        cycle=k,
        stamp_ns=START_NS + k * STEP_NS,
        position=np.array([k, -k]) * 1e-3,
        velocity=None,
        torque=np.array([k, 2.0 * k]),
        valid=ones.astype(bool),
        age=ones.astype(np.uint32) * 0,
        reference_position=np.array([k, -k]) * 1e-3 + (0.5 if k == 333 else 0.01) * np.array([1.0, -1.0]),
        reference_velocity=0.0 * ones,
        lateness_ns=0,
        compute_ns=0,
        lost=0,
    )


def everything(tail: RecordingFollower, most: int = 1 << 20) -> list[float]:
    """Torque of the first joint of all samples that can be had now."""
    found = list[float]()
    while (samples := tail.read(most)) is not None:
        assert samples.position.shape == samples.reference.shape == (len(samples.stamp_ns), 2)
        np.testing.assert_array_equal(samples.stamp_ns, START_NS + np.rint(samples.torque[:, 0]) * STEP_NS)
        np.testing.assert_array_equal(samples.torque[:, 1], 2.0 * samples.torque[:, 0])
        found += samples.torque[:, 0].tolist()
    return found


@pytest.mark.parametrize("most", [1 << 20, 4096, 16])
def test_a_tail_gives_each_flushed_sample_once(tmp_path: Path, most: int) -> None:
    with RecordingWriter(tmp_path / "run.mcap", NAMES, "<robot/>", 0) as writer:
        tail = RecordingFollower(writer.partial)
        assert tail.read(most) is None
        writer.event(START_NS, 20, "approaching")
        seen, counts = list[float](), []
        for k in range(1000):
            writer.sample(cycle(k))
            if k in (500, 700):
                writer.event(START_NS + k * STEP_NS, 20, "exciting")
            assert tail.exciting_ns is None or k > 500
            if k % 100 == 99:
                seen += everything(tail, most)
                counts.append(len(seen))
                # A chunk of 0.1 s at most is not flushed yet.
                assert k - len(seen) <= 51
        assert counts == sorted(set(counts))
    # The file has another name now; the tail reads on.
    seen += everything(tail, most)
    assert seen == list(range(1000))
    assert tail.joint_names == NAMES
    assert tail.exciting_ns == START_NS + 500 * STEP_NS
    assert tail.ended
    tail.close()


def test_a_torn_end_waits_and_damage_is_reported(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "run.mcap", NAMES, "<robot/>", 0) as writer:
        for k in range(500):
            writer.sample(cycle(k))
    whole = (tmp_path / "run.mcap").read_bytes()
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(whole[: len(whole) // 2])
    tail = RecordingFollower(torn)
    first = everything(tail)
    assert 0 < len(first) < 500
    torn.write_bytes(whole)
    assert first + everything(tail) == list(range(500))
    tail.close()
    damaged = bytearray(whole)
    damaged[len(whole) // 2] ^= 0xFF
    torn.write_bytes(damaged)
    tail = RecordingFollower(torn)
    with pytest.raises(RecordingError):
        everything(tail)
    tail.close()
    torn.write_bytes(whole[:8] + b"\x06" + (1 << 40).to_bytes(8, "little") + b"x")
    tail = RecordingFollower(torn)
    with pytest.raises(RecordingError, match="above the limit"):
        tail.read()
    tail.close()


def test_watching_thins_samples_and_keeps_the_largest_error(tmp_path: Path) -> None:
    clock = [0.0]
    live = LiveRun(tmp_path, lambda: clock[0])
    assert live.since(0) == []
    with RecordingWriter(tmp_path / "run.mcap", NAMES, "<robot/>", 0) as writer:
        for k in range(1000):
            writer.sample(cycle(k))
        times, errors, last = list[float](), list[float](), 0
        for _ in range(20):
            clock[0] += 1.0
            frames = live.since(last)
            for frame in frames:
                assert frame.number == last + 1
                last = frame.number
                piece = json.loads(frame.data)
                assert piece["joints"] == list(NAMES)
                times += piece["time"]
                errors += piece["error"][0]
                assert piece["torque"][1] == [2.0 * one for one in piece["torque"][0]]
        number = live.since(0)[-1].number
        clock[0] += 0.01
        writer.sample(cycle(1000))
        assert live.since(0)[-1].number == number  # nobody looks twice within a moment
    assert len(times) == pytest.approx(1000 * STEP_NS / BIN_NS, rel=0.1)
    assert sorted(set(times)) == times
    assert max(errors) == pytest.approx(0.5)  # of one sample in ten that a point stands for
    assert min(errors) == pytest.approx(0.01)
    live.close()
    assert live.since(0)[-1].number == number


def test_watching_tells_what_was_commanded_and_what_drives_measured(tmp_path: Path) -> None:
    live = LiveRun(tmp_path)
    with RecordingWriter(tmp_path / "run.mcap", NAMES, "<robot/>", 0) as writer:
        for k in range(500):
            writer.sample(cycle(k)._replace(measured_torque=np.array([k + 0.25, np.nan])))
    (frame,) = [one for one in live.since(0) if one.kind == "samples"]
    live.close()
    piece = json.loads(frame.data)
    assert piece["measured"][0] == [torque + 0.25 for torque in piece["torque"][0]]
    assert set(piece["measured"][1]) == {None}
    expected = np.add(piece["position"][0], [0.5 if torque == 333 else 0.01 for torque in piece["torque"][0]])
    np.testing.assert_allclose(piece["reference"][0], expected, atol=1e-5)
    # A recording without measured torques says so instead of leaving them out one by one.
    with RecordingWriter(tmp_path / "other.mcap", NAMES, "<robot/>", 0) as writer:
        writer.sample(cycle(1))
    tail = RecordingFollower(tmp_path / "other.mcap")
    samples = tail.read()
    assert samples is not None
    assert samples.measured is None
    tail.close()


def test_a_run_that_cannot_be_read_says_so_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "run.mcap.partial").write_bytes(b"\x89MCAP0\r\n" + b"\x06" + (1 << 40).to_bytes(8, "little") + b"x" * 9)
    clock = [0.0]
    live = LiveRun(tmp_path, lambda: clock[0])
    for _ in range(3):
        clock[0] += 1.0
        assert live.since(0) == []
    assert "above the limit" in live.broken
    assert len(caplog.records) == 1
    live.close()


def growing_run(
    seconds: float, noise: float, *, in_blocks: bool = False, period: float | None = None, error: float = 0.0
) -> tuple[SequentialLeastSquares, np.ndarray, list[np.ndarray]]:
    """Doubt of a motion of the planar arm that comes in pieces; the true base parameters; deviations on the way.

    With a period [s] the motion repeats itself; `error` [N m] is of the model, along the position.
    """
    model = arm_model(load_arm(shipped_arms()["planar2"]))
    growing = SequentialLeastSquares(model, in_blocks=in_blocks, period=period)
    rng, step = np.random.default_rng(3), 0.002
    time_s = np.arange(0.0, seconds, step)
    w = 2 * np.pi * (np.array([[0.31], [0.47]]) if period is None else np.array([[2.0], [3.0]]) / period)
    q = np.stack([0.9 * np.sin(w[0] * time_s), 1.1 * np.sin(w[1] * time_s + 1.0)], axis=1)
    dq = np.stack([0.9 * w[0] * np.cos(w[0] * time_s), 1.1 * w[1] * np.cos(w[1] * time_s + 1.0)], axis=1)
    ddq = -q * (w.T**2)
    beta = rng.uniform(0.3, 1.0, growing.base.size)
    H = joint_regressor(model.chain, model.layout, q, dq, ddq, growing.base.base)
    torque = np.stack([rows.T @ beta for rows in H], axis=1) + error * np.sin(5.0 * q + 1.0)
    # What is held from stamp to stamp acts half a step later than a sample would.
    held = torque + 0.5 * step * np.gradient(torque, step, axis=0)
    held += noise * rng.standard_normal(torque.shape)
    stamp = np.rint(time_s * 1e9).astype(np.int64)
    told = []
    for start in range(0, len(stamp), 400):
        part = slice(start, start + 400)
        growing.add(Block(stamp[part], q[part], held[part]))
        if growing.step():
            doubt = growing.uncertainty()
            assert doubt is not None
            told.append(doubt.deviations)
    return growing, beta, told


def test_doubt_shrinks_as_the_arm_moves_and_is_honest() -> None:
    growing, beta, told = growing_run(40.0, 0.2)
    doubt = growing.uncertainty()
    assert doubt is not None
    assert len(told) >= 5
    assert doubt.seconds > 30.0
    known = [np.isfinite(one).all() for one in told]
    assert known[-1]
    assert known == sorted(known)
    assert (told[-1] < 0.6 * told[known.index(True)]).all()
    for earlier, later in zip(told[known.index(True) :], told[known.index(True) + 1 :], strict=False):
        assert (later < 1.15 * earlier).all()
    assert (np.abs(doubt.beta - beta) < 6.0 * doubt.deviations + 0.02).all()
    assert set(doubt.verdicts) <= {"identified", "weak", "unidentified"}


def test_deviations_from_blocks_are_those_that_blocks_of_the_whole_give() -> None:
    plain, careful = growing_run(40.0, 0.2)[0].uncertainty(), growing_run(40.0, 0.2, in_blocks=True)[0].uncertainty()
    assert plain is not None
    assert careful is not None
    np.testing.assert_allclose(careful.beta, plain.beta, rtol=1e-9)
    assert plain.blocks == 0
    assert 35 <= careful.blocks <= 41  # of a second
    assert (careful.deviations >= plain.deviations).all()
    # The noise is white, so that both know the same; blocks are few, err, and are widened for that (decision 0063).
    assert (careful.deviations < 4.0 * plain.deviations).all()
    assert (careful.deviations > plain.deviations).any()
    assert 38_000_000_000 < careful.until_ns < 40_000_000_000


def test_a_run_with_a_target_does_not_end_on_repetitions_alone() -> None:
    """Show that repeating a motion does not reach a target: an error of the model is the same in every period."""
    once, often = (
        growing_run(seconds, 0.002, in_blocks=True, period=10.0, error=0.2)[2][-1] for seconds in (11.0, 101.0)
    )
    known = np.isfinite(once) & np.isfinite(often)
    assert known.sum() > 5
    assert np.median(often[known] / once[known]) > 0.85


def test_what_is_remembered_stays_bounded() -> None:
    growing, _, _ = growing_run(60.0, 0.1)
    assert sum(len(block.stamp_ns) for block in growing._waiting) < 5.0 / 0.002


def test_nothing_is_known_before_the_arm_has_moved() -> None:
    growing = SequentialLeastSquares(arm_model(load_arm(shipped_arms()["planar2"])))
    assert not growing.step()
    assert growing.uncertainty() is None
    stamp = np.arange(0, 10_000_000_000, 2_000_000)
    growing.add(Block(stamp, np.zeros((len(stamp), 2)), np.zeros((len(stamp), 2))))
    growing.step()
    doubt = growing.uncertainty()
    assert doubt is None or not np.isfinite(doubt.deviations).any()


@pytest.mark.slow
def test_a_watched_run_tells_its_doubt(tmp_path: Path) -> None:
    config = load_arm(shipped_arms()["planar2"])
    (tmp_path / "arm.json").write_text(config.model_dump_json())
    live = LiveRun(tmp_path)
    rng = np.random.default_rng(1)
    with RecordingWriter(tmp_path / "run.mcap", NAMES, "<robot/>", 0) as writer:
        for k in range(5000):
            at = k * STEP_NS * 1e-9
            q = np.array([np.sin(1.9 * at), np.sin(2.9 * at)])
            writer.sample(cycle(k)._replace(position=q, torque=rng.standard_normal(2) + q))
        until = time.monotonic() + 60.0
        while not (found := [frame for frame in live.since(0) if frame.kind == "doubt"]):
            assert time.monotonic() < until
            time.sleep(0.1)
    told = json.loads(found[0].data)
    assert len(told["parameters"]) == 13
    assert all(one["deviation"] is None or one["deviation"] > 0 for one in told["parameters"])
    live.close()
