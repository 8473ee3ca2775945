"""Columns with a wrong sign, scale or time, or of another joint, are named; what is only poor data is not."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from estimation.synthetic import SampledRecording, Waves, recorded, waves, with_options

from ident_service.config.load import load_arm
from ident_service.errors import SolverError
from ident_service.estimation import misread_columns as misread_module
from ident_service.estimation import signal_processing
from ident_service.estimation.identify import Estimate, identify
from ident_service.estimation.misread_columns import Reading, misread_columns
from ident_service.estimation.plausibility import LARGEST_ERROR, reasons_against
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.recordings.adapters import RangeRecording
from ident_service.recordings.cached_recording import CachedRecording


@cache
def elbowed() -> tuple[ArmModel, SampledRecording]:
    """The shipped planar arm with friction, and what was recorded of it, with noise."""
    model = arm_model(load_arm("planar2"))
    return model, with_noise(model, waves(4, 2, highest=0.8))


def with_noise(model: ArmModel, motion: Waves) -> SampledRecording:
    assert model.prior is not None
    delta = model.prior.copy()
    for term, value in (("viscous", 0.4), ("coulomb", 0.5), ("offset", 0.05)):
        delta[model.layout.term_columns(term)] = value
    right = recorded(model, delta, motion, rate=100.0)
    noise = 0.02 * np.random.default_rng(1).normal(size=right.torque.shape)
    return replace(right, torque=right.torque + noise)


def misread(reading: Reading) -> SampledRecording:
    """The recording with columns as somebody would write them who errs like this."""
    _, right = elbowed()
    position, torque = reading.read(right.position, "position"), reading.read(right.torque, "torque")
    return replace(right, position=position, torque=torque)


def identified(recording: SampledRecording) -> Estimate:
    return identify(elbowed()[0], [recording], method="wls")


# Each column and each joint once for every change, and all of them together at night.
MISREAD = [
    pytest.param(which, joints, marks=() if number == place else pytest.mark.campaign)
    for number, joints in enumerate(((0,), (1,), (0, 1)))
    for place, which in enumerate(("torque", "position", "both"))
]


@pytest.mark.slow
@pytest.mark.parametrize(("which", "joints"), MISREAD)
def test_the_wrong_columns_are_named(which: str, joints: tuple[int, ...]) -> None:
    wrong = Reading(which, joints)  # type: ignore[arg-type]
    recording = misread(wrong)
    estimate = identified(recording)
    found = misread_columns(estimate, [recording])
    assert found is not None
    assert found.reading == wrong
    assert found.after.relative_percent < 0.25 * found.before.relative_percent
    (reason,) = reasons_against(estimate, [recording])
    names = ["shoulder", "elbow"]
    assert all(names[joint] in reason for joint in joints)
    assert ("exchanged" if len(joints) == 2 else "other direction" if which == "both" else "wrong sign") in reason
    assert "recording.columns" in reason


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.1, 0.5, 1.6])
def test_a_torque_of_another_scale_than_the_others_is_named(factor: float) -> None:
    recording = misread(Reading("torque", (1,), factor=factor))
    estimate = identified(recording)
    found = misread_columns(estimate, [recording])
    assert found is not None
    assert found.reading.joints == (1,)
    assert found.reading.factor == pytest.approx(1.0 / factor, rel=0.1)
    (reason,) = reasons_against(estimate, [recording])
    assert "the torque of elbow seems to have another unit or scale" in reason
    assert f"multiplied by about {found.reading.factor:.2g} " in reason


@pytest.mark.slow
@pytest.mark.parametrize(("samples", "words"), [(5, "0.049 s too late"), (-10, "0.099 s too early")])
def test_the_torque_of_one_joint_at_another_time_is_named(samples: int, words: str) -> None:
    _, right = elbowed()
    torque = right.torque.copy()
    torque[:, 1] = np.roll(torque[:, 1], samples)
    recording = replace(right, torque=torque)
    (reason,) = reasons_against(identified(recording), [recording])
    assert f"the torque of elbow seems to be stamped about {words}" in reason


@pytest.mark.slow
@pytest.mark.parametrize("which", ["position", "both"])
def test_the_scale_of_a_position_and_the_columns_of_a_motor_are_named(which: Any) -> None:
    recording = misread(Reading(which, (1,), factor=20.0))
    estimate = identified(recording)
    found = misread_columns(estimate, [recording])
    assert found is not None
    assert found.reading == Reading(which, (1,), factor=pytest.approx(0.05, rel=0.1))
    (reason,) = reasons_against(estimate, [recording])
    seen = (
        "the position of elbow seems to have another unit" if which == "position" else "seem to be those of its motor"
    )
    assert seen in reason


def unlike(right: SampledRecording) -> SampledRecording:
    """An elbow whose torque is that of something else, while the shoulder tells what it should be."""
    torque = right.torque.copy()
    torque[:, 1] = 0.05 * np.random.default_rng(5).normal(size=len(torque))
    return replace(right, torque=torque)


@pytest.mark.slow
@pytest.mark.parametrize("validated", [True, False])
def test_a_joint_whose_torque_is_predicted_worse_than_by_zero_is_a_reason(validated: bool) -> None:
    """The error of the whole arm is small; formerly nothing was said against it."""
    model, right = elbowed()
    other = replace(with_noise(model, waves(5, 2, highest=0.8)), sha256="5" * 64)
    recording, unseen = unlike(right), [unlike(other)] if validated else []
    estimate = identify(model, [recording], unseen, method="ols")
    own = estimate.candidates[estimate.chosen]
    judged = own.validation[0].moving if validated else own.moving
    assert judged.relative_percent < LARGEST_ERROR
    assert judged.joint_relative_percent[1] > 120.0
    reasons = reasons_against(estimate, [recording])
    assert any("the torque of elbow is off by" in one and "none at all" in one for one in reasons), reasons


def test_it_is_found_where_both_sides_of_the_equations_are_filtered() -> None:
    model = elbowed()[0]
    options = model.config.identification
    filtered = options.model_copy(update={"smoothing": options.smoothing.model_copy(update={"regressor_cutoff": 3.0})})
    recording = misread(Reading("position", (1,)))
    found = misread_columns(identify(with_options(model, filtered), [recording], method="wls"), [recording])
    assert found is not None
    assert found.reading == Reading("position", (1,))


@pytest.mark.slow
def test_torques_that_are_all_negated_are_named_as_such() -> None:
    recording = replace(elbowed()[1], torque=-elbowed()[1].torque)
    estimate = identified(recording)
    for recordings in ([recording], []):
        found = misread_columns(estimate, recordings)
        assert found is not None
        assert found.reading == Reading("torque", (0, 1), all_negated=True)
    assert "the torques of all joints" in reasons_against(estimate, [recording])[0]


def test_the_sign_of_a_torque_is_found_without_the_recordings() -> None:
    estimate = identified(misread(Reading("torque", (1,))))
    found = misread_columns(estimate, [])
    assert found is not None
    assert found.reading == Reading("torque", (1,))
    assert "wrong sign" in reasons_against(estimate)[0]


def test_right_columns_are_left_alone() -> None:
    recording = elbowed()[1]
    estimate = identified(recording)
    assert misread_columns(estimate, [recording]) is None
    assert reasons_against(estimate, [recording]) == ()


def test_a_torque_of_noise_is_no_misread_column() -> None:
    right = elbowed()[1]
    torque = right.torque.copy()
    torque[:, 1] = np.random.default_rng(5).normal(size=len(torque))
    poor = replace(right, torque=torque)
    estimate = identified(poor)
    assert estimate.candidates[estimate.chosen].moving.joint_relative_percent[1] > 50.0
    assert misread_columns(estimate, [poor]) is None


def test_a_sign_is_named_rather_than_an_exchange_that_is_as_good_but_for_a_poor_joint() -> None:
    # The elbow moves nearly as the shoulder does, so that the exchange turns the shoulder round, too; the elbow's
    # torque is mostly noise, of which a little follows the shoulder as it was recorded.
    model, motion = elbowed()[0], waves(4, 2, highest=0.8)
    own = motion.amplitude * [[0.0], [0.04]]
    frequency, phase = (np.concatenate([one, one[[0, 0]]], axis=1) for one in (motion.frequency, motion.phase))
    alike = Waves(frequency, phase, np.concatenate([own, motion.amplitude[[0, 0]]], axis=1))
    right = with_noise(model, alike)
    torque = right.torque.copy()
    little = np.tanh(-1e4 * np.gradient(right.position[:, 0]))
    torque[:, 1] = 0.15 * np.random.default_rng(5).normal(size=len(torque)) + 0.075 * little
    position = Reading("position", (0,)).read(right.position, "position")
    recording = replace(right, position=position, torque=torque)
    found = misread_columns(identified(recording), [recording])
    assert found is not None
    assert found.reading == Reading("position", (0,))


def test_a_reading_that_no_solver_can_fit_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    recording = misread(Reading("torque", (1,)))
    estimate = identified(recording)
    solve = misread_module.constrained_least_squares
    calls = []

    def fails_but_for_the_columns_as_they_are(*given: Any, **options: Any) -> Any:
        calls.append(given)
        if len(calls) > 1:
            raise SolverError("estimating", "stopped without an optimum")
        return solve(*given, **options)

    monkeypatch.setattr(misread_module, "constrained_least_squares", fails_but_for_the_columns_as_they_are)
    assert misread_columns(estimate, [recording]) is None
    assert len(calls) > 1


def test_the_first_minute_of_a_longer_recording_is_not_smoothed_again(monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = CachedRecording(misread(Reading("torque", (1,))))
    estimate = identify(elbowed()[0], [wrong], method="wls")
    monkeypatch.setattr(misread_module, "_LONGEST", 10.0)
    monkeypatch.setattr(signal_processing._Smoother, "__call__", lambda *_: pytest.fail("smoothed again"))
    found = misread_columns(estimate, [wrong])
    assert found is not None
    assert found.reading == Reading("torque", (1,))


@pytest.mark.slow
def test_many_short_recordings_are_not_cut_to_nothing() -> None:
    wrong = misread(Reading("torque", (1,)))
    parts = [RangeRecording(wrong, begin, begin + 3.0) for begin in np.arange(56) * 0.3]
    estimate = identified(wrong)
    found = misread_columns(estimate, parts)
    assert found is not None
    assert found.reading == Reading("torque", (1,))


def test_a_range_of_a_recording_is_read_within_its_range() -> None:
    wrong = misread(Reading("torque", (1,)))
    position = wrong.position.copy()
    position[wrong.stamp_ns < wrong.stamp_ns[0] + 5_000_000_000] = 0.0  # another arm's, say
    part = RangeRecording(replace(wrong, position=position), 5.0, 20.0)
    found = misread_columns(identify(elbowed()[0], [part], method="wls"), [part])
    assert found is not None
    assert found.reading == Reading("torque", (1,))
    assert found.after.relative_percent < 2.0
