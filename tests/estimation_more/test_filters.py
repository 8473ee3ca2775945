"""Other ways to smooth: polynomials, both sides filtered alike, fewer samples, drives that are not joints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy  # its parts load for a second where they are used
from estimation.synthetic import SampledRecording, recorded, serial_chain, smoothed_samples, stamps, waves, with_options
from helpers.plain import plain_friction, plain_options, plain_smoothing
from helpers.random_arms import model_around, random_delta

from ident_service.config.arm import Identification, Reversal
from ident_service.errors import RecordingError
from ident_service.estimation import signal_processing as smoothing
from ident_service.estimation.equations import equation_rows, equations
from ident_service.estimation.least_squares import ordinary_least_squares, weighted_least_squares
from ident_service.model.arm_model import ArmModel
from ident_service.model.base_parameters import base_parameters
from ident_service.model.friction_state import friction_direction
from ident_service.model.regressor import joint_regressor

RATE = 200.0
FIELDS = ("time", "position", "velocity", "acceleration", "torque", "keep", "direction")


def noisy(samples: int, *, noise: float = 1e-4, seed: int = 3) -> SampledRecording:
    rng = np.random.default_rng(seed)
    time = np.arange(samples) / RATE
    position = waves(seed, 3).derivative(time, 0) + noise * rng.normal(size=(samples, 3))
    return SampledRecording(stamps(samples, RATE), position, rng.normal(size=(samples, 3)))


def test_polynomials_recover_the_derivatives() -> None:
    recording = noisy(4000, noise=0.0)
    options = plain_options(smoothing=plain_smoothing(method="savitzky_golay", order=4, cutoff=25.0))
    got = smoothed_samples(recording, options)
    for order, values in enumerate((got.position, got.velocity, got.acceleration)):
        wanted = waves(3, 3).derivative(got.time, order)
        np.testing.assert_allclose(values, wanted, rtol=0, atol=2e-4 * np.abs(wanted).max())


def test_polynomials_are_exact_for_polynomials() -> None:
    time = np.arange(2400) / RATE
    p = np.polynomial.Polynomial([0.3, -0.2, 0.05, 0.004])
    recording = SampledRecording(stamps(2400, RATE), p(time)[:, None], np.zeros((2400, 1)))
    got = smoothed_samples(recording, plain_options(smoothing=plain_smoothing(method="savitzky_golay", order=3)))
    for order, values in enumerate((got.position, got.velocity, got.acceleration)):
        wanted = p.deriv(order)(got.time) if order else p(got.time)
        np.testing.assert_allclose(values[:, 0], wanted, rtol=0, atol=1e-8 * 100.0**order)


def test_polynomials_have_about_the_requested_cut_off() -> None:
    rng = np.random.default_rng(4)
    white = rng.normal(size=(40_000, 1))
    recording = SampledRecording(stamps(len(white), RATE), white, white)
    for method in ("butterworth", "savitzky_golay"):
        got = smoothed_samples(recording, plain_options(smoothing=plain_smoothing(method=method, order=3, cutoff=10.0)))
        # White noise of which a share of the band is left.
        assert float(np.var(got.position)) == pytest.approx(10.0 / (RATE / 2.0), rel=0.25)


@pytest.mark.parametrize("method", ["butterworth", "savitzky_golay"])
@pytest.mark.parametrize("window", [500, 997])
@pytest.mark.parametrize("decimate", [1, 3, 7])
def test_windows_and_decimation_change_nothing(
    monkeypatch: pytest.MonkeyPatch, method: str, window: int, decimate: int
) -> None:
    recording = noisy(4013)
    shape = plain_friction(presliding=(0.0, 0.01, 0.05))
    whole = smoothed_samples(
        recording,
        plain_options(smoothing=plain_smoothing(method=method, filter_torque=True), friction=shape),  # type: ignore[arg-type]
    )
    monkeypatch.setattr(smoothing, "_WINDOW", window)
    few = plain_smoothing(method=method, filter_torque=True, decimate=decimate)  # type: ignore[arg-type]
    got = smoothed_samples(recording, plain_options(smoothing=few, friction=shape))
    for name in FIELDS:
        wanted = getattr(whole, name)[::decimate]
        largest = max(1.0, float(np.abs(wanted).max()))
        np.testing.assert_allclose(getattr(got, name), wanted, rtol=0, atol=1e-8 * largest, err_msg=name)


def test_direction_follows_the_smoothed_velocity() -> None:
    options = plain_options(friction=plain_friction(presliding=0.02), edge=0.0)
    C = np.array([[1.0, 0.0, 0.0], [0.5, 1.0, 0.0], [0.0, 0.0, -2.0]])
    got = smoothed_samples(noisy(3000), options, C)
    assert got.direction is not None
    wanted = friction_direction(got.velocity @ C.T, 1.0 / RATE, np.full(3, 0.02))
    np.testing.assert_allclose(got.direction, wanted, rtol=0, atol=1e-9)


def test_a_joint_is_left_out_where_any_of_its_drives_stands_still() -> None:
    C = np.array([[1.0, 0.0, 0.0], [0.7, 1.0, 0.0], [0.0, 0.0, 1.0]])
    options = plain_options(reversal=Reversal(speed=0.1, window=0.0))
    got = smoothed_samples(noisy(4000, noise=0.0), options, C)
    plain = smoothed_samples(noisy(4000, noise=0.0), options)
    rate = got.velocity @ C.T
    slow = np.abs(rate) <= 0.1
    # Rows where a speed changes its sign between two samples are fast here and hence none of those that differ.
    np.testing.assert_array_equal(got.keep[:, 0], ~(slow[:, 0] | slow[:, 1]))
    np.testing.assert_array_equal(got.keep[:, 1], ~slow[:, 1])
    np.testing.assert_array_equal(got.keep[:, 2], plain.keep[:, 2])
    assert not np.array_equal(got.keep[:, 1], plain.keep[:, 1])


@pytest.mark.parametrize("seconds", [0.0063, -0.0117])
def test_a_delay_shifts_the_torque(seconds: float) -> None:
    time = np.arange(3000) / RATE
    torque = np.sin(2.0 * np.pi * 0.7 * (time - seconds))[:, None]
    recording = SampledRecording(stamps(3000, RATE), noisy(3000).position[:, :1], torque)
    got = smoothed_samples(recording, plain_options(delay=seconds))
    np.testing.assert_allclose(got.torque[:, 0], np.sin(2.0 * np.pi * 0.7 * got.time), rtol=0, atol=1e-6)


# Regressor and torque through the same filter.


def three_links(options: Identification) -> ArmModel:
    return with_options(model_around(serial_chain(31, 3)), options)


def both_sides(**rest: object) -> Identification:
    return Identification.model_validate(
        {"smoothing": {"cutoff": 30.0, "regressor_cutoff": 4.0, **rest}, "reversal": {"speed": 0.02}, "edge": 0.5}
    )


def test_filtered_rows_equal_those_of_one_piece(monkeypatch: pytest.MonkeyPatch) -> None:
    options = both_sides(decimate=3)
    model = three_links(options)
    base = base_parameters(model.chain, model.layout)
    delta = random_delta(np.random.default_rng(1), model.layout)
    recording = recorded(model, delta, waves(2, 3), rate=RATE, seconds=40.0)
    plain = options.smoothing.model_copy(update={"regressor_cutoff": None, "decimate": 1})
    wide = options.model_copy(update={"smoothing": plain, "edge": 0.0})
    motion = smoothed_samples(recording, wide)
    H = joint_regressor(
        model.chain,
        model.layout,
        motion.position,
        motion.velocity,
        motion.acceleration,
        base.base,
        None,
        motion.direction,
    )
    sos = scipy.signal.butter(options.smoothing.order, 4.0, fs=RATE, output="sos")
    H, torque = (scipy.signal.sosfiltfilt(sos, H, axis=-1), scipy.signal.sosfiltfilt(sos, motion.torque, axis=0))
    edge = int(np.ceil(options.edge * RATE))
    inner = slice(edge, len(motion.time) - edge, 3)
    monkeypatch.setattr(smoothing, "_WINDOW", 1500)
    parts = list(equation_rows(recording, model, base))
    assert len(parts) > 2
    np.testing.assert_allclose(np.concatenate([rows.time for rows in parts]), motion.time[inner], atol=1e-9)
    np.testing.assert_array_equal(np.concatenate([rows.keep for rows in parts]), motion.keep[inner])
    got_torque = np.concatenate([rows.torque for rows in parts])
    np.testing.assert_allclose(got_torque, torque[inner], rtol=0, atol=1e-7 * np.abs(torque).max())
    got = np.concatenate([rows.H_b for rows in parts], axis=2)
    np.testing.assert_allclose(got, H[:, :, inner], rtol=0, atol=1e-7 * np.abs(H).max())


def test_both_sides_filtered_recover_the_parameters() -> None:
    options = both_sides(decimate=5)
    model = three_links(options)
    base = base_parameters(model.chain, model.layout)
    delta = random_delta(np.random.default_rng(1), model.layout)
    exact = recorded(model, delta, waves(2, 3), rate=RATE, seconds=60.0)
    truth = base.K @ delta
    quiet = ordinary_least_squares(equations(exact, model, base).total).beta
    np.testing.assert_allclose(quiet, truth, rtol=0, atol=1e-2)
    rng = np.random.default_rng(5)
    noise = 1.0 * rng.normal(size=exact.torque.shape)
    loud = replace(exact, position=exact.position + 1e-5 * rng.normal(size=noise.shape), torque=exact.torque + noise)
    # Kept every fifth sample: without the filter each keeps its whole noise, with it they share their neighbours'.
    errors = {}
    for cutoff in (4.0, None):
        how = options.smoothing.model_copy(update={"regressor_cutoff": cutoff})
        arm = with_options(model, options.model_copy(update={"smoothing": how}))
        fit = weighted_least_squares(equations(loud, arm, base).total)
        errors[cutoff] = float(np.linalg.norm(fit.R1 @ (fit.beta - truth)) / np.linalg.norm(fit.R1 @ truth))
    assert errors[4.0] < 0.02
    assert errors[4.0] < 0.7 * errors[None]


def test_a_cut_off_above_the_samples_is_refused() -> None:
    with pytest.raises(RecordingError, match="too slow for a cut-off of 150 Hz"):
        smoothed_samples(noisy(3000), plain_options(smoothing=plain_smoothing(method="savitzky_golay", cutoff=150.0)))
