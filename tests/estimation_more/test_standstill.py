"""Weigh rows near standstill by their own residuals, and choose Huber's weights where they predict better."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from estimation.synthetic import SampledRecording, Waves, recorded, serial_chain, waves, with_options
from helpers.plain import plain_friction, plain_options, plain_smoothing
from helpers.random_arms import model_around, random_delta

from ident_service.config.arm import Identification, Reversal
from ident_service.errors import RecordingError
from ident_service.estimation.equations import Equations, equations
from ident_service.estimation.identify import identify
from ident_service.estimation.least_squares import weighted_least_squares
from ident_service.estimation.robust_regression import standstill_weights
from ident_service.model.arm_model import ArmModel
from ident_service.model.base_parameters import base_parameters

RATE = 250.0
NOISE = np.array([0.3, 0.1])


def arm() -> tuple[ArmModel, np.ndarray]:
    options = plain_options(smoothing=plain_smoothing(cutoff=30.0), reversal=Reversal(speed=0.1, window=0.1))
    model = with_options(model_around(serial_chain(21, 2)), options)
    return model, random_delta(np.random.default_rng(3), model.layout)


def measured(model: ArmModel, delta: np.ndarray, near: float) -> SampledRecording:
    """Record with noise that is `near` times larger where a joint hardly moves, and of one sign there."""
    exact = recorded(model, delta, waves(4, 2), rate=RATE, seconds=40.0)
    rng = np.random.default_rng(1)
    slow = np.abs(np.gradient(exact.position, 1.0 / RATE, axis=0)) < 0.1
    noise = NOISE * rng.normal(size=exact.torque.shape)
    return replace(exact, torque=exact.torque + np.where(slow, near * np.abs(noise), noise))


def off(model: ArmModel, delta: np.ndarray, gathered: Equations) -> float:
    fit = weighted_least_squares(gathered.total)
    base = base_parameters(model.chain, model.layout)
    return float(np.linalg.norm(fit.R1 @ (fit.beta - base.K @ delta)))


def test_rows_that_the_model_explains_count_in_full_and_others_as_they_deserve() -> None:
    model, delta = arm()
    base = base_parameters(model.chain, model.layout)
    good = standstill_weights(equations(measured(model, delta, 1.0), model, base))
    assert np.all(good > 0.8)
    assert np.all(good <= 1.0)
    gathered = equations(measured(model, delta, 30.0), model, base)
    shares = standstill_weights(gathered)
    # Rows near standstill are also those within 0.1 s of slow ones, whose noise is small.
    assert np.all(shares > 1.0 / 40.0)
    assert np.all(shares < 1.0 / 10.0)
    weighed, full = gathered.with_standstill_rows(shares), gathered.with_standstill_rows(np.ones(2))
    assert off(model, delta, weighed) < 0.2 * off(model, delta, full)
    np.testing.assert_array_equal(weighed.total.rows, gathered.everything.rows)
    assert not weighed.near


def fast(amplitude: float) -> Waves:
    """Swing the joints at 2 and 2.7 Hz."""
    return Waves(np.array([[2.0], [2.7]]), np.array([[0.1], [0.5]]), np.full((2, 1), amplitude))


def test_two_hertz_are_identified_by_default_and_refused_only_for_being_slow() -> None:
    model, delta = arm()
    default = with_options(model, Identification())
    recording = recorded(default, delta, fast(0.3), rate=RATE, seconds=20.0)
    estimate = identify(default, [recording])
    assert estimate.candidates[estimate.chosen].identification.relative_percent < 3.0
    # At 2 mrad and 2.7 Hz a joint moves with 0.034 rad/s: that is the reason, and no window around reversals is.
    small = recorded(default, delta, fast(0.002), rate=RATE, seconds=20.0)
    with pytest.raises(
        RecordingError, match=r"never faster than identification\.reversal\.speed \(0\.05 rad/s"
    ) as caught:
        identify(default, [small])
    assert "window" not in str(caught.value)


def test_a_motion_that_turns_round_all_the_time_is_identified() -> None:
    # 2 Hz: no row is further than the window from a reversal.
    model, delta = arm()
    busy = with_options(model, plain_options(smoothing=plain_smoothing(cutoff=60.0), reversal=Reversal(window=0.3)))
    base = base_parameters(model.chain, model.layout)
    recording = recorded(busy, delta, fast(0.3), rate=RATE, seconds=20.0)
    gathered = equations(recording, busy, base)
    assert gathered.total.rows.max() == 0
    np.testing.assert_array_equal(standstill_weights(gathered), 1.0)
    estimate = identify(busy, [recording], method="wls")
    torque = np.sqrt(gathered.everything.squared_torques().sum())
    errors = gathered.everything.squared_residuals(estimate.fit.beta)
    assert np.sqrt(errors.sum()) < 0.2 * torque


def test_a_joint_that_never_moves_is_named() -> None:
    model, delta = arm()
    recording = measured(model, delta, 1.0)
    still = recording.position.copy()
    still[:, 1] = 0.3
    held, base = replace(recording, position=still, sha256="1" * 64), base_parameters(model.chain, model.layout)
    name = model.chain.names[1]
    with pytest.raises(
        RecordingError, match=rf"{name}: never faster than .* in it, .* kinematics\.lock: {{{name}: POSITI"
    ):
        equations(held, model, base)
    nowhere = replace(recording, position=np.full_like(still, 0.3), sha256="2" * 64)
    with pytest.raises(RecordingError, match=r"are positions in the unit that recording\.columns names"):
        equations(nowhere, model, base)
    # Radians that are read as degrees move, but hardly.
    small = recording.position * np.where(np.arange(2) == 1, np.pi / 180.0, 1.0)
    words = rf"the positions of {name} span 0\.0\d+ rad: are they in rad, and read as deg\? Then correct their unit in"
    with pytest.raises(RecordingError, match=rf"{words} recording\.columns; else record a motion of it, .*kinematics"):
        equations(replace(recording, position=small, sha256="3" * 64), model, base)
    with pytest.raises(RecordingError, match="shows; record a motion of it"):
        equations(held, model, base)
    # Another recording may move it, and whoever only judges needs no motion of it.
    assert equations([held, recording], model, base).samples > equations(recording, model, base).samples
    assert equations(held, model, base, allow_still_joints=True).samples > 0


def test_a_joint_whose_torque_is_always_zero_is_weighed() -> None:
    model, delta = arm()
    recording = measured(model, delta, 1.0)
    torque = recording.torque * [1.0, 0.0]
    found = equations(replace(recording, torque=torque), model, base_parameters(model.chain, model.layout))
    assert np.isfinite(weighted_least_squares(found.everything).weights).all()
    nothing = equations(replace(recording, torque=0.0 * torque), model, base_parameters(model.chain, model.layout))
    assert np.isfinite(weighted_least_squares(nothing.everything).weights).all()


@pytest.mark.parametrize(("outliers", "method"), [(0.0, "wls"), (0.03, "huber")])
def test_the_estimator_is_the_one_that_predicts_what_was_held_out(outliers: float, method: str) -> None:
    model, delta = arm()
    chosen = with_options(model, model.config.identification.model_copy(update={"method": "choose"}))
    recording = measured(model, delta, 1.0)
    rng = np.random.default_rng(7)
    # Half a second at a time somebody leans on the arm.
    gross = np.repeat(rng.random((len(recording.torque) // 125 + 1, 2)) < outliers, 125, axis=0)[
        : len(recording.torque)
    ]
    leaned = replace(recording, torque=recording.torque + 100.0 * NOISE * gross)
    estimate = identify(chosen, [leaned])
    (choice,) = estimate.choices
    assert (choice.option, choice.value, estimate.method) == ("method", method, method)
    assert set(choice.held_out) == {"wls", "huber"}
    if method == "huber":
        assert choice.held_out["huber"] < 0.99 * choice.held_out["wls"]
    assert str(choice).startswith(f"method {method}; torque error on held-out thirds of the recordings: wls ")


def test_friction_that_a_joint_cannot_have_is_not_searched_for() -> None:
    model, delta = arm()
    fit = plain_friction(presliding="fit", stribeck_velocity="fit")
    options = model.config.identification.model_copy(update={"friction": fit})
    smooth = replace(model, layout=replace(model.layout, terms=("drive_inertia", "viscous", "offset")))
    estimate = identify(with_options(smooth, options), [measured(model, delta, 1.0)], method="ols")
    np.testing.assert_array_equal(estimate.model.config.identification.friction.presliding, 0.0)
