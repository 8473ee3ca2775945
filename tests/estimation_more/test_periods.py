"""Averaging over periods: less noise by the square root, an honest estimate of it, refusal of what does not repeat."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from estimation.synthetic import SampledRecording, exact_torque, serial_chain, stamps, with_options
from helpers.plain import plain_friction, plain_options, plain_smoothing
from helpers.random_arms import model_around, random_delta

from ident_service.config.arm import Reversal
from ident_service.config.recording import RecordingFormat
from ident_service.errors import RecordingError
from ident_service.estimation.identify import identify
from ident_service.estimation.signal_processing import averaged
from ident_service.model.arm_model import ArmModel
from ident_service.model.friction_state import friction_direction

RATE, PERIOD = 200.0, 5.0
LENGTH = round(RATE * PERIOD)
OPTIONS = plain_options(smoothing=plain_smoothing(cutoff=10.0), reversal=Reversal(window=0.05), period=PERIOD)


def periodic(time: np.ndarray, order: int, joints: int = 2) -> np.ndarray:
    """Derivatives of a motion of five harmonics."""
    rng = np.random.default_rng(8)
    harmonics = np.arange(1, 6) * 2.0 * np.pi / PERIOD
    amplitude, phase = rng.uniform(0.1, 0.4, (joints, 5)), rng.uniform(0.0, 6.3, (joints, 5))
    angle = harmonics * time[:, None, None] + phase + order * np.pi / 2.0
    return np.sum(amplitude * harmonics**order * np.sin(angle), axis=-1)


def arm() -> tuple[ArmModel, np.ndarray]:
    model = with_options(model_around(serial_chain(21, 2)), OPTIONS)
    return model, random_delta(np.random.default_rng(5), model.layout)


def run(samples: int, noise: float = 0.0, seed: int = 1, late: float = 0.0) -> SampledRecording:
    """The arm on its periodic motion: noise on torque and a hundredth of it on position, torque stamped late."""
    model, delta = arm()
    time = np.arange(samples) / RATE
    q = periodic(time, 0)
    torque = exact_torque(model, delta, *(periodic(time - late, order) for order in range(3)))
    rng = np.random.default_rng(seed)
    torque = torque + noise * rng.normal(size=q.shape)
    return SampledRecording(stamps(samples, RATE), q + 0.01 * noise * rng.normal(size=q.shape), torque)


@pytest.mark.parametrize("more", [0, 1, LENGTH - 1])
def test_whole_periods_are_counted(more: int) -> None:
    # n periods of samples end one step before the next period would begin.
    assert averaged(run(3 * LENGTH + more), OPTIONS, PERIOD).periods == 3
    assert averaged(run(3 * LENGTH + LENGTH), OPTIONS, PERIOD).periods == 4


def test_two_periods_are_enough_and_one_sample_less_is_not() -> None:
    assert averaged(run(2 * LENGTH), OPTIONS, PERIOD).periods == 2
    with pytest.raises(RecordingError, match="holds 1 whole periods of 5 s; averaging needs two"):
        averaged(run(2 * LENGTH - 1), OPTIONS, PERIOD)


def test_derivatives_of_a_period_are_exact() -> None:
    got = averaged(run(3 * LENGTH), OPTIONS, PERIOD).motion
    assert len(got.time) == LENGTH
    for order, values in enumerate((got.position, got.velocity, got.acceleration)):
        wanted = periodic(got.time, order)
        np.testing.assert_allclose(values, wanted, rtol=0, atol=1e-9 * np.abs(wanted).max())
    np.testing.assert_allclose(got.torque, run(LENGTH).torque, rtol=0, atol=1e-9)


def test_the_mean_is_better_by_the_square_root_of_the_periods() -> None:
    periods = 16
    got = averaged(run(periods * LENGTH, 0.2), OPTIONS, PERIOD).motion
    errors = got.torque - run(LENGTH).torque
    single = run(LENGTH, 0.2).torque - run(LENGTH).torque
    assert np.std(errors) == pytest.approx(np.std(single) / 4.0, rel=0.08)


@pytest.mark.parametrize("periods", [2, 3, 12])
def test_noise_is_estimated_from_what_differs(periods: int) -> None:
    got = averaged(run(periods * LENGTH, 0.2, seed=3), OPTIONS, PERIOD)
    np.testing.assert_allclose(got.torque_noise, 0.2, rtol=0.1)


def test_a_held_torque_stands_between_its_samples() -> None:
    held = replace(run(2 * LENGTH), torque_zero_order_hold=True)
    torque = run(LENGTH).torque
    got = averaged(held, OPTIONS, PERIOD).motion
    np.testing.assert_allclose(got.torque, 0.5 * (torque + np.roll(torque, 1, axis=0)), rtol=0, atol=1e-9)


def test_rows_near_a_reversal_are_left_out_round_the_corner() -> None:
    C = np.array([[1.0, 0.0], [0.8, 1.0]])
    got = averaged(run(2 * LENGTH), OPTIONS, PERIOD, C).motion
    rate = np.tile(periodic(np.arange(LENGTH) / RATE, 1) @ C.T, (3, 1))
    reach = round(OPTIONS.reversal.window * RATE)
    near = np.abs(rate) <= OPTIONS.reversal.speed
    near[1:] |= np.signbit(rate[1:]) != np.signbit(rate[:-1])
    wide = np.array([near[max(k - reach, 0) : k + reach + 1].any(axis=0) for k in range(len(near))])
    middle = wide[LENGTH : 2 * LENGTH]
    np.testing.assert_array_equal(got.keep[:, 1], ~middle[:, 1])
    np.testing.assert_array_equal(got.keep[:, 0], ~(middle[:, 0] | middle[:, 1]))


def test_direction_begins_as_the_period_ends() -> None:
    options = OPTIONS.model_copy(update={"friction": plain_friction(presliding=(0.2, 0.05))})
    got = averaged(run(2 * LENGTH), options, PERIOD).motion
    rate = np.tile(periodic(np.arange(LENGTH) / RATE, 1), (6, 1))
    wanted = friction_direction(rate, 1.0 / RATE, np.array([0.2, 0.05]))[-LENGTH:]
    assert got.direction is not None
    np.testing.assert_allclose(got.direction, wanted, rtol=0, atol=1e-6)


@pytest.mark.parametrize("seconds", [0.003, -0.0071])
def test_a_delay_shifts_the_torque_of_a_period(seconds: float) -> None:
    # A smooth torque, so that shifting it back is exact.
    time = np.arange(2 * LENGTH) / RATE
    late = replace(run(2 * LENGTH), torque=periodic(time - seconds, 0))
    got = averaged(late, OPTIONS.model_copy(update={"delay": seconds}), PERIOD).motion
    np.testing.assert_allclose(got.torque, periodic(got.time, 0), rtol=0, atol=1e-9)


def test_a_motion_that_does_not_repeat_is_refused() -> None:
    with pytest.raises(RecordingError, match=r"joint \d differs by .* between periods of 3 s"):
        averaged(run(4 * LENGTH), OPTIONS, 3.0)


def test_an_approach_must_be_trimmed() -> None:
    good = run(3 * LENGTH)
    position = np.concatenate([np.tile(good.position[:1] + 0.9, (200, 1)), good.position])
    torque = np.concatenate([np.tile(good.torque[:1], (200, 1)), good.torque])
    approached = SampledRecording(stamps(len(position), RATE), position, torque)
    with pytest.raises(RecordingError, match="trim approach and return"):
        averaged(approached, OPTIONS, PERIOD)
    trimmed = averaged(approached, OPTIONS, PERIOD, fmt=RecordingFormat(trim=(1.0, 0.0)))
    assert trimmed.periods == 3
    np.testing.assert_allclose(trimmed.motion.torque, good.torque[:LENGTH], rtol=0, atol=1e-9)


def test_a_period_that_is_no_number_of_samples_is_refused() -> None:
    with pytest.raises(RecordingError, match=r"a period of 5\.002 s is 1000\.400 samples"):
        averaged(run(4 * LENGTH), OPTIONS, 5.002)


@pytest.mark.parametrize("period", [1e-6, 0.001, 0.005])
def test_a_period_of_a_sample_is_refused(period: float) -> None:
    with pytest.raises(RecordingError, match="period"):
        averaged(run(4 * LENGTH), OPTIONS, period)


def test_a_gap_in_every_period_is_refused() -> None:
    whole = run(3 * LENGTH)
    keep = np.arange(3 * LENGTH) % LENGTH
    keep = (keep < 300) | (keep > 340)
    keep[:LENGTH] = True
    gappy = SampledRecording(whole.stamp_ns[keep], whole.position[keep], whole.torque[keep])
    with pytest.raises(RecordingError, match="gaps leave parts of the period"):
        averaged(gappy, OPTIONS, PERIOD)


def test_a_gap_in_one_period_costs_only_that() -> None:
    whole = run(4 * LENGTH, 0.1)
    keep = np.ones(4 * LENGTH, dtype=bool)
    keep[LENGTH + 300 : LENGTH + 340] = False
    gappy = SampledRecording(whole.stamp_ns[keep], whole.position[keep], whole.torque[keep])
    got, without = averaged(gappy, OPTIONS, PERIOD).motion, averaged(whole, OPTIONS, PERIOD).motion
    same = np.ones(LENGTH, dtype=bool)
    same[300:340] = False
    np.testing.assert_allclose(got.torque[same], without.torque[same], rtol=0, atol=1e-12)
    others = whole.torque.reshape(4, LENGTH, 2)[[0, 2, 3]].mean(axis=0)
    np.testing.assert_allclose(got.torque[~same], others[~same], rtol=0, atol=1e-12)


@pytest.mark.parametrize("late", [0.0, 0.0043])
def test_identify_from_periods(late: float) -> None:
    model, delta = arm()
    if late:
        model = with_options(model, OPTIONS.model_copy(update={"delay": "estimate"}))
    estimate = identify(model, [run(20 * LENGTH, 0.05, late=late)])
    assert estimate.samples == LENGTH
    truth = estimate.base.K @ delta
    predicted = estimate.fit.R1 @ (estimate.beta - truth)
    assert np.linalg.norm(predicted) < 0.003 * np.linalg.norm(estimate.fit.R1 @ truth)
    assert estimate.feasible
    if late:
        assert estimate.prepared.delay is not None
        assert estimate.prepared.delay.seconds == pytest.approx(
            late, abs=max(5 * estimate.prepared.delay.deviation, 2e-4)
        )
