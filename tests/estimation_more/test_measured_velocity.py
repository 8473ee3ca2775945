"""Use a recording's own velocities where they predict better than those of its positions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from estimation.synthetic import SampledRecording, recorded, serial_chain, waves, with_options
from helpers.plain import plain_friction, plain_options, plain_smoothing
from helpers.random_arms import model_around, random_delta

from ident_service.config.arm import Identification
from ident_service.errors import RecordingError
from ident_service.estimation.identify import Estimate, identify
from ident_service.model.arm_model import ArmModel
from ident_service.model.base_parameters import base_parameters

RATE = 250.0
COARSE = 2e-3  # rad


def arm() -> tuple[ArmModel, np.ndarray]:
    model = model_around(serial_chain(21, 2))
    delta = random_delta(np.random.default_rng(3), model.layout)
    for term in ("coulomb", "offset"):
        delta[model.layout.term_columns(term)] = 0.0  # type: ignore[arg-type]
    return model, delta


def noisy(model: ArmModel, delta: np.ndarray, *, late: float = 0.0) -> SampledRecording:
    """Record with coarse positions and fine velocities, which may be stamped late [s]."""
    motion, rng = waves(4, 2), np.random.default_rng(1)
    exact = recorded(model, delta, motion, rate=RATE, seconds=40.0)
    time = np.arange(len(exact.stamp_ns)) / RATE
    return replace(
        exact,
        position=exact.position + COARSE * rng.normal(size=exact.position.shape),
        velocity=motion.derivative(time - late, 1) + 1e-3 * rng.normal(size=exact.position.shape),
        torque=exact.torque + 0.02 * rng.normal(size=exact.torque.shape),
    )


def off(estimate: Estimate, delta: np.ndarray) -> float:
    """Give the error [N m] of the predicted torques, root mean square over the rows."""
    fit = estimate.fit
    truth = base_parameters(estimate.model.chain, estimate.model.layout).K @ delta
    return float(np.linalg.norm(fit.R1 @ (fit.beta - truth)) / np.sqrt(estimate.information.rows.sum()))


def identified(velocity: str, recording: SampledRecording, **more: object) -> Estimate:
    model, _ = arm()
    options = Identification.model_validate(
        {
            "method": "wls",
            "delay": 0.0,
            "friction": plain_friction(),
            "smoothing": {"velocity": velocity, **more},
        }
    )
    return identify(with_options(model, options), [recording])


@pytest.mark.slow
@pytest.mark.parametrize("method", ["butterworth", "savitzky_golay"])
def test_fine_velocities_beside_coarse_positions_are_chosen(method: str) -> None:
    recording = noisy(*arm())
    chosen = identified("choose", recording, method=method)
    (choice,) = chosen.choices
    assert (choice.option, choice.value) == ("smoothing.velocity", "measured")
    assert choice.held_out["measured"] < 0.99 * choice.held_out["position"]
    errors = {way: off(identified(way, recording, method=method), arm()[1]) for way in ("position", "measured")}
    assert off(chosen, arm()[1]) == errors["measured"]
    assert errors["measured"] < 0.5 * errors["position"]


@pytest.mark.slow
def test_velocities_that_lag_are_not_chosen() -> None:
    recording = noisy(*arm(), late=0.15)
    fine = replace(recording, position=recorded(*arm(), waves(4, 2), rate=RATE, seconds=40.0).position)
    chosen = identified("choose", fine)
    assert chosen.choices[0].value == "position"
    assert off(chosen, arm()[1]) < 0.5 * off(identified("measured", fine), arm()[1])


def test_velocities_of_our_own_loop_are_not_required() -> None:
    assert identified("choose", replace(noisy(*arm()), torque_zero_order_hold=True)).choices == ()


def test_a_validation_without_velocities_is_judged_all_the_same() -> None:
    model, delta = arm()
    options = Identification.model_validate({"method": "wls", "delay": 0.0, "friction": plain_friction()})
    other = replace(recorded(model, delta, waves(6, 2), rate=RATE, seconds=30.0), sha256="1" * 64)
    estimate = identify(with_options(model, options), [noisy(model, delta)], [other])
    assert estimate.choices == ()
    assert estimate.candidates[0].validation[0].error.relative_percent < 20.0


def test_required_velocities_that_are_missing_are_reported() -> None:
    model, delta = arm()
    bare = replace(noisy(model, delta), velocity=None)
    assert identified("choose", bare).choices == ()
    options = plain_options(smoothing=plain_smoothing(velocity="measured"))
    with pytest.raises(RecordingError, match="has no velocities; leave out identification"):
        identify(with_options(model, options), [bare])


@pytest.mark.slow
def test_velocities_that_show_no_motion_are_named_and_not_the_positions() -> None:
    """Columns of zeros were taken for an arm at rest: "are positions in the unit that recording.columns names?"."""
    recording = noisy(*arm())
    assert recording.velocity is not None
    for velocity in (0.0 * recording.velocity, recording.velocity * [1.0, 0.0]):
        with pytest.raises(
            RecordingError, match="its positions show a motion that its velocities do not: correct or leave out"
        ):
            identified("choose", replace(recording, velocity=velocity))
