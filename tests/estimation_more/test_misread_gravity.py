"""Torques without gravity, and gravity in another direction, are named; what is only poor data is not."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from estimation.synthetic import SampledRecording, recorded, waves

from ident_service.config.load import load_arm
from ident_service.errors import SolverError
from ident_service.estimation import misread_gravity as gravity_module
from ident_service.estimation.identify import Estimate, identify
from ident_service.estimation.misread_gravity import misread_gravity
from ident_service.estimation.plausibility import reasons_against
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.recordings.adapters import RangeRecording


@cache
def arm() -> ArmModel:
    return arm_model(load_arm("threelink"))


def with_gravity(model: ArmModel, *gravity: float) -> ArmModel:
    return replace(model, chain=replace(model.chain, gravity=np.array(gravity)))


def moved(*gravity: float, model: ArmModel | None = None) -> SampledRecording:
    """The arm with friction, its torques as in this gravity, with noise."""
    model = model or arm()
    assert model.prior is not None
    delta = model.prior.copy()
    for term, value in (("viscous", 0.3), ("coulomb", 0.4)):
        delta[model.layout.term_columns(term)] = value
    right = recorded(with_gravity(model, *gravity), delta, waves(4, model.chain.joints, highest=0.8), rate=100.0)
    size = 0.005 * np.std(right.torque, axis=0)
    return replace(right, torque=right.torque + size * np.random.default_rng(1).normal(size=right.torque.shape))


@cache
def identified(*gravity: float) -> tuple[Estimate, SampledRecording]:
    recording = moved(*gravity)
    return identify(arm(), [recording], method="wls"), recording


def test_the_arm_of_these_tests_stands_upright() -> None:
    assert arm().chain.gravity.tolist() == [0.0, 0.0, -9.81]


@pytest.mark.slow
def test_torques_without_gravity_are_named() -> None:
    """Each joint was off by a few percent, and by all of its torque in gravity."""
    estimate, recording = identified(0.0, 0.0, 0.0)
    assert estimate.candidates[estimate.chosen].moving.relative_percent < 30.0
    (reason,) = reasons_against(estimate, [recording])
    assert reason.startswith("the torques seem to lack gravity")
    assert "add what compensates gravity" in reason


@pytest.mark.slow
@pytest.mark.parametrize(
    "gravity",
    [
        (9.81, 0.0, 0.0),
        *(pytest.param(one, marks=pytest.mark.campaign) for one in ((0.0, -9.81, 0.0), (0.0, 0.0, 9.81))),
    ],
)
def test_gravity_in_another_direction_is_named(gravity: tuple[float, ...]) -> None:
    estimate, recording = identified(*gravity)
    found = misread_gravity(estimate, [recording])
    assert found is not None
    assert found.gravity.tolist() == list(gravity)
    reason, *_ = reasons_against(estimate, [recording])
    assert f"with gravity [{', '.join(f'{value:g}' for value in gravity)}]" in reason


@pytest.mark.slow
def test_right_gravity_is_left_alone_whatever_else_is_poor() -> None:
    estimate, recording = identified(0.0, 0.0, -9.81)
    assert reasons_against(estimate, [recording]) == ()
    poor = recording.torque.copy()
    poor[:, 2] = np.random.default_rng(5).normal(size=len(poor))
    spoiled = replace(recording, torque=poor)
    noisy = identify(arm(), [spoiled], method="wls")
    assert noisy.candidates[noisy.chosen].moving.joint_relative_percent[2] > 50.0
    assert misread_gravity(noisy, [spoiled]) is None


@pytest.mark.slow
def test_of_an_arm_that_feels_no_gravity_none_is_missing() -> None:
    """The shipped planar arm, laid on its side: with and without gravity its torques are the same."""
    model = arm_model(load_arm("planar2").model_copy(update={"gravity": (0.0, 0.0, -9.81)}))
    recording = moved(0.0, 0.0, -9.81, model=model)
    poor = replace(recording, torque=recording.torque + 0.1 * np.sin(np.arange(len(recording.torque)))[:, None])
    estimate = identify(model, [poor], method="wls")
    found = misread_gravity(estimate, [poor])
    assert found is None


def test_the_beginning_of_a_range_is_looked_at_and_what_cannot_be_solved_explains_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    estimate, recording = identified(0.0, 0.0, 0.0)
    assert misread_gravity(estimate, []) is None
    assert misread_gravity(estimate, [RangeRecording(recording, 8.0, 20.0)]) is not None

    def unsolvable(*_: object, **__: object) -> None:
        raise SolverError("no optimum", "stopped")

    monkeypatch.setattr(gravity_module, "constrained_least_squares", unsolvable)
    assert misread_gravity(estimate, [recording]) is None
