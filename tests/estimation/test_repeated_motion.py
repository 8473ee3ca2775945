"""Repetitions of a motion are found, in one recording and from one to another, and nothing else is taken for one."""

from __future__ import annotations

import numpy as np
import pytest
from estimation.synthetic import SampledRecording, Waves, stamps, waves

from ident_service.estimation.repeats import Stretches, stretches

RATE = 200.0


def periodic(seed: int, period: float, joints: int = 3) -> Waves:
    rng = np.random.default_rng(seed)
    harmonics = np.arange(1, 6) / period
    shape = (joints, len(harmonics))
    return Waves(np.tile(harmonics, (joints, 1)), rng.uniform(0.0, 6.3, shape), rng.uniform(0.05, 0.4, shape))


def positions(motion: Waves, seconds: float, before: float = 0.0, start: float = 0.0) -> np.ndarray:
    """The motion from `start` on [s], after `before` seconds of a straight way to where it begins."""
    time = start + np.arange(round(seconds * RATE)) / RATE
    moved = motion.derivative(time, 0)
    way = np.linspace(0.0, 1.0, round(before * RATE), endpoint=False)[:, None]
    return np.concatenate([(1.0 - way) * -0.7 + way * moved[0], moved])


def recording(q: np.ndarray, noise: float = 0.0, seed: int = 0) -> SampledRecording:
    q = q + noise * np.random.default_rng(seed).normal(size=q.shape)
    return SampledRecording(stamps(len(q), RATE), q, np.zeros_like(q))


def label_at(cut: Stretches, time: float) -> tuple[int, int]:
    assert cut.origin is not None
    return cut.label(int(np.floor((time - cut.origin) / cut.length)))


@pytest.mark.parametrize("period", [7.3, 20.0])
@pytest.mark.parametrize("noise", [0.0, 2e-3])
def test_periods_have_the_same_labels(period: float, noise: float) -> None:
    q = positions(periodic(1, period), 3.4 * period, before=4.0)
    (cut,) = stretches([recording(q, noise)], [1.0])
    assert cut.length == pytest.approx(period / max(12, round(period)), rel=1e-3)
    for time in np.arange(4.5, 4.0 + period, 0.7):
        first = label_at(cut, time)
        assert first[0] == -1
        # A stretch's border may lie between two times that are a period apart.
        near = {label_at(cut, time + period + shift) for shift in (-0.03, 0.0, 0.03)}
        assert first in near
    assert label_at(cut, 1.0)[0] == 0
    assert len({label_at(cut, time) for time in np.arange(0.0, 3.5, cut.length)}) > 2


def test_half_a_period_more_is_enough() -> None:
    q = positions(periodic(2, 10.0), 15.0)
    (cut,) = stretches([recording(q)], [1.0])
    assert label_at(cut, 2.5) == label_at(cut, 12.5)
    assert label_at(cut, 7.5)[0] != -1 or label_at(cut, 7.5) != label_at(cut, 2.5)


@pytest.mark.parametrize("seed", range(6))
def test_motions_that_do_not_repeat_stay_as_they_are(seed: int) -> None:
    q = positions(waves(seed, 3), 40.0)
    assert stretches([recording(q)], [1.0]) == (Stretches(1.0),)


def test_a_rest_is_no_repetition() -> None:
    moved = positions(waves(3, 3), 15.0)
    q = np.concatenate([np.tile(moved[0], (4000, 1)), moved, np.tile(moved[-1], (4000, 1))])
    assert stretches([recording(q)], [1.0]) == (Stretches(1.0),)


def test_the_same_motion_again_in_another_recording() -> None:
    motion = waves(5, 3)
    first, second = positions(motion, 25.0), positions(motion, 18.0, before=3.0, start=4.0)
    other = positions(waves(6, 3), 25.0)
    one, again, apart = stretches([recording(q, 1e-3, k) for k, q in enumerate((first, second, other))], [1.0] * 3)
    assert one.length == again.length
    # Four seconds into the first is where the second arrives after three.
    assert label_at(one, 10.5) == label_at(again, 9.5)
    assert label_at(one, 21.5) == label_at(again, 20.5)
    assert label_at(again, 1.0)[0] == 1
    labels = [{label_at(cut, time) for time in np.arange(0.0, 21.0, 0.5)} for cut in (one, again, apart)]
    assert not labels[2] & (labels[0] | labels[1])


def test_one_period_in_a_recording_and_two_in_another() -> None:
    motion = periodic(8, 12.0)
    short, long = positions(motion, 11.0, start=30.0), positions(motion, 26.0)
    one, two = stretches([recording(short), recording(long)], [1.0, 1.0])
    assert label_at(one, 2.5) == label_at(two, 8.5) == label_at(two, 20.5)
