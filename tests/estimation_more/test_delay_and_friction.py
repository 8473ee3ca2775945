"""What has to be found before the equations are linear: delay between the channels, shape of the friction."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from estimation.synthetic import SampledRecording, Waves, exact_torque, serial_chain, stamps, waves, with_options
from helpers.plain import plain_friction, plain_options, plain_smoothing
from helpers.random_arms import model_around, random_delta

from ident_service.config.arm import FrictionShape, Reversal
from ident_service.errors import RecordingError
from ident_service.estimation.choices import significant_choice
from ident_service.estimation.equations import equations
from ident_service.estimation.feasible.feasible_set import feasible_set
from ident_service.estimation.fit import prepare, unconstrained
from ident_service.estimation.friction_fit import at_search_bounds, fit_friction, friction_trials, with_friction
from ident_service.estimation.identify import identify
from ident_service.estimation.least_squares import torque_error, weighted_least_squares
from ident_service.estimation.shape_uncertainty import ShapeUncertainty, shape_uncertainty
from ident_service.estimation.torque_delay import Delay, estimate_delay, with_delay
from ident_service.estimation.uncertainty import student_factors
from ident_service.model.arm_model import ArmModel
from ident_service.model.base_parameters import BaseParameters, base_parameters
from ident_service.model.friction_state import friction_direction
from ident_service.model.parameter_layout import NO_STRIBECK, Layout
from ident_service.model.regressor import joint_regressor

RATE = 250.0
SMOOTH = plain_smoothing(cutoff=12.0, filter_torque=True)


@cache
def two_links() -> tuple[ArmModel, BaseParameters, np.ndarray]:
    model = with_options(model_around(serial_chain(21, 2)), plain_options(smoothing=plain_smoothing(cutoff=20.0)))
    return model, base_parameters(model.chain, model.layout), random_delta(np.random.default_rng(5), model.layout)


def late(seconds: float, noise: float = 0.1, seed: int = 1) -> SampledRecording:
    """A recording whose torque at each stamp is what acted so long before."""
    model, _, delta = two_links()
    time = np.arange(7500) / RATE
    motion, rng = waves(seed, 2), np.random.default_rng(seed)
    torque = exact_torque(model, delta, *(motion.derivative(time - seconds, order) for order in range(3)))
    return SampledRecording(
        stamps(len(time), RATE), motion.derivative(time, 0), torque + noise * rng.normal(size=torque.shape)
    )


# Delay.


@pytest.mark.parametrize("seconds", [0.0, 0.0013, 0.0092, -0.0057, 0.041])
def test_a_delay_is_found_to_a_fraction_of_a_sample(seconds: float) -> None:
    model, base, _ = two_links()
    found = estimate_delay([late(seconds)], model, base)
    # The filter makes neighbours alike, so that the white deviation is too small by a few times.
    assert abs(found.seconds - seconds) < 0.1 / RATE
    assert abs(found.seconds - seconds) < 12.0 * found.deviation
    assert 0.0 < found.deviation < 0.05 / RATE


@pytest.mark.slow
def test_the_deviation_is_that_of_many_recordings() -> None:
    model, base, _ = two_links()
    found = [estimate_delay([late(0.003, noise=0.5, seed=seed)], model, base) for seed in range(6)]
    off = np.array([one.seconds - 0.003 for one in found])
    size = np.sqrt(np.mean(off**2)) / np.mean([one.deviation for one in found])
    assert 0.3 < size < 10.0


def test_two_recordings_share_one_delay() -> None:
    model, base, _ = two_links()
    both = estimate_delay([late(0.006), late(0.006, seed=2)], model, base)
    alone = estimate_delay([late(0.006)], model, base)
    assert both.seconds == pytest.approx(0.006, abs=4e-4)
    assert both.deviation < alone.deviation


def test_a_delay_applied_improves_the_residual() -> None:
    model, base, delta = two_links()
    recording = late(0.01)
    found = estimate_delay([recording], model, base)

    def left(arm: ArmModel) -> float:
        total = equations(recording, arm, base).total
        return torque_error(total, weighted_least_squares(total).beta).rms

    without, with_it = left(model), left(with_delay(model, found.seconds))
    # Reading the torque between its samples smooths its noise a little.
    assert 0.08 < with_it < 0.102
    assert without > 1.3 * with_it
    assert left(with_delay(model, -found.seconds)) > without
    total = equations(recording, with_delay(model, found.seconds), base).total
    fit = weighted_least_squares(total)
    truth = base.K @ delta
    assert np.linalg.norm(fit.R1 @ (fit.beta - truth)) < 0.01 * np.linalg.norm(fit.R1 @ truth)


def test_with_delay_changes_nothing_else() -> None:
    model, _, _ = two_links()
    shifted = with_delay(model, 0.004)
    assert shifted.config.identification.delay == 0.004
    assert with_delay(shifted, 0.0).config == model.config
    assert model.config.identification.delay == 0.0


@pytest.mark.slow
def test_torque_of_another_motion_has_no_delay() -> None:
    model, base, _ = two_links()
    foreign = replace(late(0.0), torque=late(0.0, seed=9).torque[::-1].copy())

    def outcome() -> Delay | str:
        try:
            return estimate_delay([foreign], model, base)
        except RecordingError as error:
            return str(error)

    found = outcome()
    assert isinstance(found, str)
    assert "no delay between position and torque explains the torques" in found


def test_a_delay_beyond_reason_is_refused() -> None:
    model, base, _ = two_links()
    with pytest.raises(RecordingError, match="no delay between position and torque"):
        estimate_delay([late(0.35)], model, base)


@pytest.mark.parametrize(
    ("seconds", "taken"), [(0.0, False), (0.003, True), (0.006, True), (-0.01, True), (0.06, True)]
)
def test_a_delay_is_chosen_where_there_is_one(seconds: float, taken: bool) -> None:
    model, _, _ = two_links()
    estimate = identify(with_options(model, plain_options(smoothing=SMOOTH, delay="choose")), [late(seconds)])
    (choice,) = estimate.choices
    found = estimate.model.config.identification.delay
    assert choice.option == "delay"
    assert (choice.value != "0 ms") is taken
    assert found == pytest.approx(seconds, abs=0.5e-3)
    errors = list(choice.held_out.values())
    assert (errors[1] < 0.9 * errors[0]) is taken


@pytest.mark.campaign
def test_channels_that_do_not_belong_together_have_no_delay() -> None:
    model, _, _ = two_links()
    estimate = identify(with_options(model, plain_options(smoothing=SMOOTH, delay="choose")), [late(0.35)])
    assert estimate.choices[0].value == "0 ms"
    assert estimate.model.config.identification.delay == 0.0


def test_a_delay_of_one_third_is_not_taken() -> None:
    """A part of a recording that a delay explains is no delay of the arm."""
    model, _, _ = two_links()
    there, here = late(0.008), late(0.0)
    third = np.arange(len(here.torque)) < len(here.torque) // 3
    mixed = replace(here, torque=np.where(third[:, None], there.torque, here.torque))
    estimate = identify(with_options(model, plain_options(smoothing=SMOOTH, delay="choose")), [mixed])
    assert estimate.choices[0].value == "0 ms"
    assert estimate.model.config.identification.delay == 0.0


@pytest.mark.parametrize(
    ("errors", "value"),
    [
        ([2.0, 2.1, 1.9], "other"),
        ([2.0, 2.1, 3.1], "usual"),  # not every third
        ([2.99, 2.99, 2.98], "usual"),  # less than a hundredth
        ([1.0, 2.9, 2.9], "usual"),  # mostly one third
        ([np.inf, np.inf, np.inf], "usual"),
    ],
)
def test_what_is_not_clearly_better_is_not_taken(errors: list[float], value: str) -> None:
    choice = significant_choice("delay", {"usual": np.full(3, 3.0), "other": np.array(errors)})
    assert choice.value == value
    assert significant_choice("delay", {"usual": np.full(3, np.inf), "other": np.array(errors)}).value == "usual"


# Friction.

TERMS = ("drive_inertia", "viscous", "coulomb", "offset", "stribeck")
PRESLIDING, STRIBECK = np.array([0.006, 0.03]), np.array([0.06, 0.25])
FIT = plain_friction(presliding="fit", stribeck_velocity="fit")
NOISE = 0.05


def rubbing(shape: FrictionShape, terms: tuple[str, ...] = TERMS) -> tuple[ArmModel, BaseParameters, np.ndarray]:
    """An arm whose friction is known, and what is to be fitted of it."""
    plain = model_around(serial_chain(21, 2))
    velocities = STRIBECK if isinstance(shape.stribeck_velocity, str) else shape.stribeck_velocity
    velocities = tuple(np.broadcast_to(velocities, 2).tolist()) if "stribeck" in terms else ()
    layout = Layout(plain.chain.revolute, terms, velocities)  # type: ignore[arg-type]
    options = plain_options(
        smoothing=plain_smoothing(cutoff=20.0), reversal=Reversal(speed=0.0, window=0.0), friction=shape
    )
    model = with_options(replace(plain, layout=layout), options)
    delta = random_delta(np.random.default_rng(6), layout)
    delta[layout.term_columns("coulomb")] = (1.0, 0.7)
    if "stribeck" in terms:
        delta[layout.term_columns("stribeck")] = (0.8, 0.6)
    return model, base_parameters(model.chain, layout), delta


def slow_waves() -> Waves:
    """Two joints that turn round often and not fast."""
    rng = np.random.default_rng(12)
    return Waves(rng.uniform(0.05, 0.4, (2, 4)), rng.uniform(0.0, 6.3, (2, 4)), rng.uniform(0.05, 0.3, (2, 4)))


def rubbed(
    model: ArmModel,
    delta: np.ndarray,
    presliding: np.ndarray,
    seconds: float = 40.0,
    noise: float = NOISE,
    seed: int = 2,
    motion: Waves | None = None,
) -> SampledRecording:
    time = np.arange(round(seconds * RATE)) / RATE
    q, dq, ddq = ((motion or slow_waves()).derivative(time, order) for order in range(3))
    s = friction_direction(dq, 1.0 / RATE, presliding)
    torque = np.einsum("jps,p->sj", joint_regressor(model.chain, model.layout, q, dq, ddq, direction=s), delta)
    return SampledRecording(
        stamps(len(time), RATE), q, torque + noise * np.random.default_rng(seed).normal(size=torque.shape)
    )


def fitted_friction(recordings: list[SampledRecording], model: ArmModel, base: BaseParameters) -> ArmModel:
    return fit_friction(friction_trials(recordings, model, base), model, base)[0]


@pytest.mark.slow
def test_presliding_and_stribeck_velocity_are_found() -> None:
    model, base, delta = rubbing(FIT)
    recording = rubbed(model, delta, PRESLIDING)
    fitted = fitted_friction([recording], model, base)
    shape = fitted.config.identification.friction
    assert isinstance(shape.presliding, tuple)
    for found, true in ((np.array(shape.presliding), PRESLIDING), (np.array(shape.stribeck_velocity), STRIBECK)):
        assert np.all(np.abs(np.log(found / true)) < np.log(1.35))
    assert fitted.layout.stribeck_velocity == shape.stribeck_velocity

    def left(arm: ArmModel) -> np.ndarray:
        total = equations(recording, arm, base).total
        return torque_error(total, weighted_least_squares(total).beta).joint_rms

    np.testing.assert_allclose(left(fitted), NOISE, rtol=0.1)
    worse = left(with_friction(model, plain_friction(presliding=0.0, stribeck_velocity=0.1)))
    assert np.all(worse > 1.2 * left(fitted))


def test_friction_that_is_not_there_is_left_out_and_stated() -> None:
    bare, _, delta = rubbing(plain_friction(presliding=0.0), TERMS[:4])
    recording = rubbed(bare, delta, np.zeros(2))
    left_out = rubbing(plain_friction(presliding=0.0, stribeck_velocity=NO_STRIBECK))[0]
    without, with_none = identify(bare, [recording]), identify(left_out, [recording])
    assert sum(name.startswith("fs") for name in with_none.base.expressions) == 2
    for number, name in enumerate(with_none.base.expressions):
        if name.startswith("fs"):
            assert with_none.beta[number] == 0.0
            assert np.isinf(with_none.standard_deviations[number])
        else:
            same = without.base.expressions.index(name)
            assert with_none.beta[number] == pytest.approx(without.beta[same], rel=1e-4, abs=1e-6)
    assert at_search_bounds(with_none.model.config.identification.friction, ("a", "b"), ("coulomb", "stribeck")) == ()


def test_no_row_has_stribeck_friction_that_is_left_out() -> None:
    model, base, _ = rubbing(plain_friction(presliding=0.0, stribeck_velocity=NO_STRIBECK))
    # At rest, where the curve of any velocity is one, and at 10 microradians a second.
    velocity = np.array([[0.0, 0.0], [1e-5, -1e-5], [1.0, 1.0]])
    states = (np.zeros((3, 2)), velocity, np.zeros((3, 2)))
    H = joint_regressor(model.chain, model.layout, *states, base.base, direction=np.ones((3, 2)))
    friction = {name[:2]: k for k, name in enumerate(base.expressions) if name[:2] in ("fc", "fs")}
    assert not H[:, friction["fs"]].any()
    assert H[:, friction["fc"]].any(axis=0).all()


@pytest.mark.slow
def test_pre_sliding_and_stribeck_friction_that_are_there_are_kept() -> None:
    model, base, delta = rubbing(FIT)
    conditions = feasible_set("pseudo_inertia", base.names, model.config)
    trials = friction_trials([rubbed(model, delta, PRESLIDING)], model, base)
    _, choices = fit_friction(trials, model, base, conditions)
    assert [(one.option, one.value) for one in choices] == [
        ("friction.presliding", "fit"),
        ("friction.stribeck_velocity", "fit"),
    ]
    assert all(one.held_out["none"] > 1.1 * one.held_out["fit"] for one in choices)


@pytest.mark.slow
def test_a_given_number_is_kept() -> None:
    given = plain_friction(presliding="fit", stribeck_velocity=tuple(STRIBECK))
    model, base, delta = rubbing(given)
    fitted = fitted_friction([rubbed(model, delta, PRESLIDING)], model, base)
    shape = fitted.config.identification.friction
    assert shape.stribeck_velocity == tuple(STRIBECK)
    np.testing.assert_allclose(np.log(np.array(shape.presliding) / PRESLIDING), 0.0, atol=np.log(1.3))


@pytest.mark.slow
def test_a_drive_without_presliding_is_given_little_or_none() -> None:
    model, base, delta = rubbing(plain_friction(presliding="fit"), TERMS[:4])
    fitted = fitted_friction([rubbed(model, delta, np.array([0.0, 0.03]))], model, base)
    first, second = fitted.config.identification.friction.presliding  # type: ignore[misc]
    assert first < 1e-3
    assert second == pytest.approx(0.03, rel=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("terms", [TERMS, TERMS[:4]])
def test_nothing_to_fit_leaves_the_numbers(terms: tuple[str, ...]) -> None:
    shape = plain_friction(presliding=0.01, stribeck_velocity=tuple(STRIBECK))
    model, base, delta = rubbing(shape, terms)
    recording = rubbed(model, delta, PRESLIDING)
    fitted = fitted_friction([recording], model, base)
    one, other = (equations(recording, arm, base).total for arm in (model, fitted))
    for a, b in zip(one.factors, other.factors, strict=True):
        np.testing.assert_array_equal(a, b)
    assert fitted.config.identification.friction.presliding == (0.01, 0.01)


@pytest.mark.slow
def test_the_rate_and_other_options_come_back_untouched() -> None:
    model, base, delta = rubbing(plain_friction(presliding="fit"), TERMS[:4])
    before = model.config.identification
    after = fitted_friction([rubbed(model, delta, PRESLIDING)], model, base).config.identification
    assert after.model_copy(update={"friction": before.friction}) == before
    assert model.config.identification is before


@pytest.mark.campaign
@pytest.mark.slow
@pytest.mark.parametrize("noise", [NOISE, 0.3])
def test_deviations_of_friction_hold_where_its_shape_was_fitted(noise: float) -> None:
    model, base, delta = rubbing(FIT)
    conditions = feasible_set("pseudo_inertia", base.names, model.config)
    shares, ratios = [], []
    for seed in range(10):
        recording = rubbed(model, delta, PRESLIDING, noise=noise, seed=seed)
        prepared = prepare([recording], model, base, conditions)
        found = unconstrained("wls", [recording], prepared, base, conditions)
        known = unconstrained("wls", [recording], replace(prepared, shapes=()), base, conditions)
        np.testing.assert_array_equal(found.fit.beta, known.fit.beta)
        shares.append((found.fit.beta - base.K @ delta) / found.deviations)
        ratios.append(found.deviations / known.deviations)
        assert np.linalg.eigvalsh(found.covariance - known.covariance).min() > -1e-9 * np.trace(found.covariance)
    size, wider = np.sqrt(np.mean(np.square(shares), axis=0)), np.mean(ratios, axis=0)
    names = [base.names[column] for column in base.base]
    for name in ("fv1", "fc1", "fs1", "fv2", "fc2", "fs2"):
        assert 0.2 < size[names.index(name)] < 1.5, name
    # Where the shape is not known well, Coulomb friction is not; gravity does not mind.
    assert wider[names.index("fc2")] > 1.1
    assert np.all(wider >= 1.0)
    assert wider[names.index("lx1")] < 1.02


def test_degrees_of_freedom_of_both_parts_are_joined() -> None:
    shape = ShapeUncertainty(np.diag([3.0, 0.0, 1.0]), np.array([2.0, np.inf, 5.0]), np.array([8.0, 8.0, 8.0]))
    degrees = np.array([30.0, 5.0, 30.0])
    deviations, joined = shape.joined(np.array([1.0, 2.0, np.inf]) * student_factors(degrees), degrees)
    # Student's t has 97.5 % below 4.302653, 2.306004 and 2.570582 with 2, 8 and 5 degrees of freedom.
    both = np.sqrt(2.306004**2 + 3.0 * 4.302653**2) / 1.959964
    np.testing.assert_allclose(deviations, [both, 2.0 * 2.570582 / 1.959964, np.inf], rtol=1e-6)
    np.testing.assert_allclose(joined, [16.0 / (1.0 / 8.0 + 9.0 / 2.0), 5.0, 8.0])


@pytest.mark.campaign
@pytest.mark.slow
@pytest.mark.parametrize(
    ("slower", "noise", "seconds"), [(1.0, 0.3, 12.0), pytest.param(0.5, 0.05, 24.0, marks=pytest.mark.campaign)]
)
def test_two_deviations_are_95_percent_where_few_reversals_tell_the_shape(
    slower: float, noise: float, seconds: float
) -> None:
    """The second drive turns round five times."""
    model, base, delta = rubbing(FIT)
    conditions = feasible_set("pseudo_inertia", base.names, model.config)
    motion = slow_waves()
    motion = replace(motion, frequency=motion.frequency * np.array([[1.0], [slower]]))
    names = [base.names[column] for column in base.base]
    friction = [names.index(name) for name in ("fv1", "fc1", "fs1", "fv2", "fc2", "fs2")]
    within = []
    for seed in range(25):
        recording = rubbed(model, delta, PRESLIDING, seconds=seconds, noise=noise, seed=seed, motion=motion)
        prepared = prepare([recording], model, base, conditions)
        found = unconstrained("wls", [recording], prepared, base, conditions)
        known = unconstrained("wls", [recording], replace(prepared, shapes=()), base, conditions)
        assert np.all(found.deviations >= known.deviations)
        assert np.all(found.degrees <= known.degrees)
        within.append(np.abs(found.fit.beta - base.K @ delta)[friction] < 1.96 * found.deviations[friction])
    assert np.mean(within) > 0.95
    assert np.mean(within, axis=0).min() > 0.9


@pytest.mark.slow
def test_a_shape_shown_by_few_reversals_has_few_degrees_of_freedom() -> None:
    model, base, delta = rubbing(FIT)
    conditions = feasible_set("pseudo_inertia", base.names, model.config)
    names = [base.names[column] for column in base.base]
    degrees = {}
    often = slow_waves()
    rarely = replace(often, frequency=often.frequency * np.array([[1.0], [0.35]]))
    for name, motion in (("often", often), ("rarely", rarely)):
        recording = rubbed(model, delta, PRESLIDING, seconds=16.0, motion=motion)
        prepared = prepare([recording], model, base, conditions)
        known = unconstrained("wls", [recording], replace(prepared, shapes=()), base, conditions)
        shape = shape_uncertainty(
            *([recording], prepared.model, base, prepared.shapes, known.fit.beta, known.fit.weights),
            *(prepared.torque_scales, known.shares),
        )
        degrees[name] = shape.degrees[names.index("fc2")]
    assert 1.0 <= degrees["rarely"] < 4.0 < degrees["often"]


@pytest.mark.slow
def test_friction_that_is_not_there_adds_no_doubt_of_its_shape() -> None:
    model, base, delta = rubbing(FIT)
    conditions = feasible_set("pseudo_inertia", base.names, model.config)
    recording = rubbed(model, delta, PRESLIDING)
    prepared = prepare([recording], model, base, conditions)
    found = unconstrained("wls", [recording], prepared, base, conditions)
    beta = np.where([name in ("fc", "fs") for name in (base.names[c][:2] for c in base.base)], 0.0, found.fit.beta)
    added = shape_uncertainty(
        [recording],
        prepared.model,
        base,
        prepared.shapes,
        beta,
        found.fit.weights,
        prepared.torque_scales,
        found.shares,
    )
    np.testing.assert_array_equal(added.covariance, 0.0)
    assert np.isinf(added.degrees).all()


def test_a_number_at_the_end_of_its_search_is_stated() -> None:
    shape = plain_friction(presliding=(0.05, 0.01), stribeck_velocity=(0.8, 0.02))
    assert at_search_bounds(shape, ("shoulder", "elbow"), ("coulomb", "stribeck")) == (
        "shoulder: its pre-sliding distance of 0.05 is the largest that is searched",
        "shoulder: its Stribeck velocity of 0.8 is the largest that is searched",
        "elbow: its Stribeck velocity of 0.02 is the smallest that is searched",
    )
    assert len(at_search_bounds(shape, ("shoulder", "elbow"), ("coulomb",))) == 1


@pytest.mark.slow
def test_the_edge_is_a_remark_of_the_estimate() -> None:
    model, _, delta = rubbing(FIT)
    estimate = identify(model, [rubbed(model, delta, np.array([0.2, 0.01]))])
    assert estimate.remarks[0].startswith(f"{model.chain.names[0]}: its ")
    assert estimate.remarks[0].endswith(" is the largest that is searched")
    given = rubbing(plain_friction(presliding=0.05, stribeck_velocity=0.8))[0]
    assert identify(given, [rubbed(model, delta, PRESLIDING)]).remarks == ()
