"""Exchanged columns of friction are the same equations as a new look at the recording."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from estimation.synthetic import SampledRecording, stamps, with_options
from estimation_more.test_delay_and_friction import FIT, RATE, rubbed, rubbing
from helpers.plain import plain_friction, plain_options, plain_smoothing

from ident_service.config.arm import Reversal
from ident_service.errors import RecordingError
from ident_service.estimation import friction_fit as friction_trials
from ident_service.estimation.equations import equations
from ident_service.estimation.friction_fit import FrictionTrials, with_friction
from ident_service.model.arm_model import ArmModel
from ident_service.model.base_parameters import base_parameters

X0, V_S = np.array([0.004, 0.02]), np.array([0.09, 0.3])


def with_gap(recording: SampledRecording) -> SampledRecording:
    """Leave out half a second in the middle: two stretches."""
    first, second = slice(None, len(recording.stamp_ns) // 2), slice(len(recording.stamp_ns) // 2 + 125, None)
    cut = {
        name: np.concatenate([getattr(recording, name)[part] for part in (first, second)])
        for name in ("stamp_ns", "position", "torque")
    }
    return replace(recording, **cut)


def both(model: ArmModel, recordings: list[SampledRecording], x0: np.ndarray, v_s: np.ndarray) -> list[np.ndarray]:
    """Give each joint's Gram matrix of all rows, by exchange and then by reading everything again."""
    base = base_parameters(model.chain, model.layout)
    shape = plain_friction(presliding=tuple(x0.tolist()), stribeck_velocity=tuple(v_s.tolist()))
    again = equations(recordings, with_friction(model, shape), base)
    trials = FrictionTrials(recordings, model, base).equations(x0, v_s)
    np.testing.assert_array_equal(trials.everything.rows, again.everything.rows)
    assert len(trials.blocks) == 3
    return [
        np.concatenate([(factor.T @ factor).ravel() for factor in found.everything.factors])
        for found in (trials, again)
    ]


@pytest.mark.parametrize("x0", [np.zeros(2), X0, np.array([0.0, 0.05])])
def test_the_same_equations(x0: np.ndarray) -> None:
    model, _, delta = rubbing(FIT)
    exchanged, read = both(model, [rubbed(model, delta, X0)], x0, V_S)
    np.testing.assert_allclose(exchanged, read, rtol=1e-9, atol=1e-9 * np.abs(read).max())


def test_several_recordings_with_gaps_and_thinned_rows() -> None:
    model, _, delta = rubbing(FIT)
    thinned = with_options(
        model,
        plain_options(smoothing=plain_smoothing(cutoff=20.0, decimate=3), reversal=Reversal(speed=0.02), friction=FIT),
    )
    whole = rubbed(model, delta, X0)
    exchanged, read = both(thinned, [with_gap(whole), whole], X0, V_S)
    np.testing.assert_allclose(exchanged, read, rtol=1e-4, atol=1e-4 * np.abs(read).max())


def test_a_period() -> None:
    model, _, _ = rubbing(FIT)
    seconds = 8.0
    time = np.arange(round(5 * seconds * RATE)) / RATE
    phase = 2.0 * np.pi * time / seconds
    position = np.column_stack([0.4 * np.sin(phase) + 0.2 * np.cos(3 * phase), 0.3 * np.cos(2 * phase)])
    torque = np.column_stack([np.sign(np.cos(phase)), np.cos(phase)])
    recording = SampledRecording(stamps(len(time), RATE), position, torque)
    options = plain_options(
        smoothing=plain_smoothing(cutoff=20.0), reversal=Reversal(speed=0.0, window=0.0), friction=FIT, period=seconds
    )
    exchanged, read = both(with_options(model, options), [recording], X0, V_S)
    np.testing.assert_allclose(exchanged, read, rtol=1e-6, atol=1e-6 * np.abs(read).max())


def test_a_filtered_regressor_is_filtered_there_too() -> None:
    model, _, delta = rubbing(FIT)
    smoothing = plain_smoothing(cutoff=40.0, regressor_cutoff=8.0)
    options = plain_options(smoothing=smoothing, reversal=Reversal(speed=0.0, window=0.0), friction=FIT)
    exchanged, read = both(with_options(model, options), [rubbed(model, delta, X0)], X0, V_S)
    np.testing.assert_allclose(exchanged, read, rtol=0.0, atol=2e-3 * np.abs(read).max())


def test_long_recordings_are_thinned_and_say_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    model, _, delta = rubbing(FIT)
    base = base_parameters(model.chain, model.layout)
    recording = rubbed(model, delta, X0)
    whole = FrictionTrials([recording], model, base).equations(X0, V_S).everything
    monkeypatch.setattr(friction_trials, "_MOST_ROWS", 1500)
    few = FrictionTrials([recording], model, base).equations(X0, V_S).everything
    assert few.rows.max() <= 3000
    for all_rows, some in zip(whole.factors, few.factors, strict=True):
        share = few.rows[0] / whole.rows[0]
        np.testing.assert_allclose(
            some.T @ some, share * (all_rows.T @ all_rows), atol=0.03 * np.abs(some.T @ some).max()
        )


def test_a_joint_that_stands_still_is_named() -> None:
    model, _, delta = rubbing(FIT)
    options = model.config.identification.model_copy(update={"reversal": Reversal(speed=50.0)})
    slow = with_options(model, options)
    with pytest.raises(RecordingError, match="never faster than"):
        FrictionTrials([rubbed(model, delta, X0)], slow, base_parameters(model.chain, model.layout))


def test_what_a_joint_has_tried_is_not_computed_again_and_stays_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    model, _, delta = rubbing(FIT)
    base = base_parameters(model.chain, model.layout)
    recording = rubbed(model, delta, X0)
    trials, fresh = FrictionTrials([recording], model, base), FrictionTrials([recording], model, base)
    trials.moments(X0, V_S)
    trials.moments(X0[::-1], V_S)
    mixed = (np.array([X0[0], X0[0]]), V_S)  # of the first joint as in the first trial, of the second as in the second
    expected = fresh.moments(*mixed, parts=None)[0]
    monkeypatch.setattr(FrictionTrials, "_new_columns", None)
    for found, wanted in zip(trials.moments(*mixed)[0].products, expected.products, strict=True):
        np.testing.assert_array_equal(found, wanted)
