"""Fit unconstrained parameters to recordings: filter, delay, friction shape, torque constants, estimator, covariance.

Order: the filter, the delay between the channels, the shape of the friction, the equations, the factors of the torque
constants, the estimator. Each step looks at the recordings that are fitted to, never at those that validate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ident_service.config.arm import Method
from ident_service.errors import RecordingError
from ident_service.estimation import instrumental_variables as instruments
from ident_service.estimation import robust_regression
from ident_service.estimation.choices import Choice, best_choice, held_out_error
from ident_service.estimation.equations import Equations, equations
from ident_service.estimation.feasible.central import ChangeEllipsoid
from ident_service.estimation.feasible.feasible_set import FeasibleSet
from ident_service.estimation.feasible.priors import residual_deviation
from ident_service.estimation.feasible.problems import constrained_least_squares
from ident_service.estimation.feasible.torque_scales import constrained_least_squares_with_scales, scale_bounds
from ident_service.estimation.friction_fit import (
    FrictionTrials,
    fit_friction,
    fitted_friction_parameters,
    friction_trials,
)
from ident_service.estimation.instrumental_variables import instrumental_variables
from ident_service.estimation.least_squares import LeastSquares, ordinary_least_squares, weighted_least_squares
from ident_service.estimation.robust_regression import held_out_errors, huber, spread_rows, standstill_weights
from ident_service.estimation.shape_uncertainty import ShapeUncertainty, shape_uncertainty
from ident_service.estimation.spectra import with_chosen_cutoff
from ident_service.estimation.torque_constants import TorqueConstants, identify_torque_constants
from ident_service.estimation.torque_delay import Delay, choose_delay, estimate_delay, with_delay
from ident_service.estimation.uncertainty import student_factors, uncertainty
from ident_service.model.arm_model import ArmModel
from ident_service.model.base_parameters import BaseParameters
from ident_service.model.chain import Array
from ident_service.model.parameter_layout import INERTIAL
from ident_service.recordings.recording import Recording
from ident_service.recordings.resampling import grid

SAME = 0.01  # share of its deviation; a parameter that changes by less counts as unchanged


@dataclass(frozen=True)
class Prepared:
    """Equations of recordings, with the nonlinear quantities that were found first.

    Attributes:
        model: the arm, with the friction's shape and the delay as numbers.
        equations: equations of all recordings, torques multiplied by `torque_scales`.
        delay: between position and torque, where it was estimated.
        torque_scales: factor of each joint's measured torque, shape (joints,).
        choices: choices among what the configuration left open.
        shapes: names of the fitted numbers of the friction's shape.
        torque_constants: of the motors, where they were identified; `model` multiplies recorded torques by them.
    """

    model: ArmModel
    equations: Equations
    delay: Delay | None
    torque_scales: Array
    choices: tuple[Choice, ...] = ()
    shapes: tuple[str, ...] = ()
    torque_constants: TorqueConstants | None = None


@dataclass(frozen=True)
class Fit:
    """Unconstrained estimate with its uncertainty.

    Attributes:
        fit: the least squares whose factors constrained estimates use.
        equations: equations that `fit` solves, with row weights where the method has them.
        weighed: the same without row weights, rows near standstill multiplied by `shares`.
        covariance: covariance from blocks of scores, with the uncertainty of fitted friction shapes, shape (base,
            base).
        deviations: standard deviations on the careful side, shape (base,), see `uncertainty.py`.
        degrees: degrees of freedom of the deviations, shape (base,).
        noise: variances from the differences between repetitions of the motion, shape (base,); None where most is not
            repeated.
        shares: factors of the rows near standstill, shape (joints,).
        method: estimator.
        remarks: remarks on how the estimate was found, for people.
        choices: choice of the estimator, where there was one.
    """

    fit: LeastSquares
    equations: Equations
    weighed: Equations
    covariance: Array
    deviations: Array
    degrees: Array
    noise: Array | None
    shares: Array
    method: Method
    remarks: tuple[str, ...] = ()
    choices: tuple[Choice, ...] = ()


def prepare(
    recordings: Sequence[Recording],
    model: ArmModel,
    base: BaseParameters,
    conditions: FeasibleSet,
    validation: Sequence[Recording] = (),
    *,
    torque_constants: Literal["described", "unconstrained", "feasible"] = "described",
) -> Prepared:
    """Fit delay, friction shape and torque constants where these are asked for; return them and the linear equations.

    Args:
        recordings: recordings to fit to.
        model: the arm.
        base: grouping of the parameters.
        conditions: feasible set of the estimates that torque constants and choices are judged by.
        validation: recordings to validate on; only whether they have velocities is looked at.
        torque_constants: whether to identify those of the motors, with any parameters or with feasible ones.

    Raises:
        UsageError: torque constants without a known payload.
        RecordingError: a recording does not fit the arm or cannot be used.
        ParameterError: bounds of torque constants that mean nothing.
        SolverError: the solver stopped without an optimum.
    """
    model, choices = _with_velocity(recordings, validation, model, base)
    delay, wanted = None, model.config.identification.delay
    # The delay comes first: a friction fit would take a delay for a longer pre-sliding distance.
    if wanted == "estimate":
        delay = estimate_delay(recordings, model, base)
        model = with_delay(model, delay.seconds)
    trials = None
    if wanted == "choose":
        seconds = 0.0
        # For averaged periods (derivatives by harmonics, torque unfiltered) no delay is searched for.
        if model.config.identification.period is None:
            undelayed = trials = friction_trials(recordings, model, base)
            period = min(grid(recording, model.config.recording).period_s for recording in recordings)

            def trials_at(delay: float) -> FrictionTrials:
                return undelayed if delay == 0.0 else friction_trials(recordings, with_delay(model, delay), base)

            seconds, choice = choose_delay(trials_at, period, base, conditions)
            choices += () if choice is None else (choice,)
        model = with_delay(model, seconds)
        trials = trials if seconds == 0.0 else None
    if trials is None and fitted_friction_parameters(model):
        trials = friction_trials(recordings, model, base)
    fitted = fitted_friction_parameters(model)
    model, shapes = fit_friction(trials, model, base, conditions)
    choices += shapes
    # A number of friction that was left out moves nothing.
    left_out = {choice.option for choice in shapes if choice.value == "none"}
    fitted = tuple(key for key in fitted if f"friction.{key}" not in left_out)
    constants = None
    if torque_constants != "described":
        within = conditions if torque_constants == "feasible" else None
        constants = identify_torque_constants(recordings, model, base, within)
        model = constants.of(model)
    gathered = gather(recordings, model, base)
    scales = np.ones(model.chain.joints)
    if bounds := scale_bounds(model.config, model.chain.names):
        weights = weighted_least_squares(gathered.total).weights
        scales = constrained_least_squares_with_scales(gathered.total, base, conditions, bounds, weights).scales
        gathered = gathered.with_torques_times(scales)
    return Prepared(model, gathered, delay, scales, choices, fitted, constants)


def _with_velocity(
    recordings: Sequence[Recording], validation: Sequence[Recording], model: ArmModel, base: BaseParameters
) -> tuple[ArmModel, tuple[Choice, ...]]:
    """Choose between measured and differentiated velocities, and the filter with them.

    Our own recordings have the velocities of the loop, which lag behind the positions.
    """
    options = model.config.identification
    if options.smoothing.velocity != "choose":
        return with_chosen_cutoff(model, recordings), ()

    def of(velocity: str, **more: object) -> ArmModel:
        smoothing = options.smoothing.model_copy(update={"velocity": velocity, **more})
        update = {"identification": options.model_copy(update={"smoothing": smoothing})}
        return replace(model, config=model.config.model_copy(update=update))

    usual = with_chosen_cutoff(of("position"), recordings)
    there = all(
        not one.torque_zero_order_hold and all(block.velocity is not None for block in one.blocks())
        for one in (*recordings, *validation)
    )
    if not there or options.period is not None:
        return usual, ()
    # Through the same filter, so that the same torque is predicted.
    filtered = usual.config.identification.smoothing
    own = with_chosen_cutoff(of("measured", cutoff=filtered.cutoff, decimate=filtered.decimate), recordings)
    ways = {"position": gather(recordings, usual, base)}
    try:
        ways["measured"] = gather(recordings, own, base)
    except RecordingError as error:
        reason = (
            "its positions show a motion that its velocities do not: correct or leave out the columns dq1 ... dqN, or"
            " set identification.smoothing.velocity: position"
        )
        raise RecordingError(recordings[0].path, reason) from error
    weights = weighted_least_squares(ways["position"].total).weights
    errors = {name: held_out_error(found.blocks, weights) for name, found in ways.items()}
    choice = best_choice("smoothing.velocity", errors)
    return (usual if choice.value == "position" else with_chosen_cutoff(of("measured"), recordings)), (choice,)


def gather(recordings: Sequence[Recording], model: ArmModel, base: BaseParameters) -> Equations:
    """Read recordings into equations in base parameters, in blocks of time; raises if a joint never moves."""
    return equations(recordings, model, base)


def unconstrained(
    method: Method | Literal["choose"],
    recordings: Sequence[Recording],
    prepared: Prepared,
    base: BaseParameters,
    conditions: FeasibleSet,
) -> Fit:
    """Estimate base parameters without conditions; method `choose` takes `wls` or `huber` by error on held-out thirds.

    The covariance has the doubt about the friction's shape and the torque constants in it, where those were fitted.

    Raises:
        RecordingError: a recording cannot be used.
        ModelError: the joints' weights do not settle, or instruments say nothing.
        SolverError: the solver stopped without an optimum.
    """
    found = _with_known_shape(method, recordings, prepared, base, conditions)
    if prepared.torque_constants is not None:
        found = _joined(found, prepared.torque_constants.uncertainty())
    if not prepared.shapes:
        return found
    # The weights of Huber's rows are in his equations, not among those per joint.
    weights = weighted_least_squares(found.weighed.total).weights if found.method == "huber" else found.fit.weights
    shape = shape_uncertainty(
        recordings,
        prepared.model,
        base,
        prepared.shapes,
        found.fit.beta,
        weights,
        prepared.torque_scales,
        found.shares,
    )
    return _joined(found, shape)


def _joined(found: Fit, doubt: ShapeUncertainty) -> Fit:
    deviations, degrees = doubt.joined(found.deviations, found.degrees)
    return replace(found, covariance=found.covariance + doubt.covariance, deviations=deviations, degrees=degrees)


def _with_known_shape(
    method: Method | Literal["choose"],
    recordings: Sequence[Recording],
    prepared: Prepared,
    base: BaseParameters,
    conditions: FeasibleSet,
) -> Fit:
    model = prepared.model
    shares = standstill_weights(prepared.equations)
    gathered = prepared.equations.with_standstill_rows(shares)
    if method == "ols":
        return _fit_with_uncertainty("ols", ordinary_least_squares(gathered.total), gathered, shares)
    fit = weighted_least_squares(gathered.total)
    if method == "wls":
        return _fit_with_uncertainty("wls", fit, gathered, shares)
    choices: tuple[Choice, ...] = ()
    spread = None
    if method == "choose":
        spread = spread_rows(recordings, model, base, prepared.torque_scales, shares)
        choices = (best_choice("method", held_out_errors(spread, fit)),)
        if choices[0].value == "wls":
            return replace(_fit_with_uncertainty("wls", fit, gathered, shares), choices=choices)
    if method != "iv":
        fit, reweighted, change = huber(recordings, model, base, fit, prepared.torque_scales, shares, spread)
        found = replace(_fit_with_uncertainty("huber", fit, reweighted, shares), weighed=gathered)
        return replace(
            found, choices=choices, remarks=_convergence_warnings("Huber's weights", change, robust_regression.SETTLED)
        )
    delta = constrained_least_squares(fit, base, conditions).delta
    refined = instrumental_variables(recordings, model, base, conditions, fit, delta)
    moved = replace(fit, beta=refined.beta, rho1=fit.R1 @ refined.beta, standard_deviations=refined.standard_deviations)
    # The instrumental estimate's variances come from as many equally weighted blocks: same degrees of freedom.
    remarks = _convergence_warnings("the instrumental estimate", refined.change, instruments.SETTLED)
    degrees = uncertainty(gathered, fit).degrees
    deviations = np.sqrt(np.diag(refined.covariance)) * student_factors(degrees)
    return Fit(moved, gathered, gathered, refined.covariance, deviations, degrees, None, shares, "iv", remarks)


def _convergence_warnings(what: str, change: float, settled: float) -> tuple[str, ...]:
    if change < settled:
        return ()
    return (
        f"{what} did not converge: the round is used that changed parameters least, by {change:.2g} of its"
        " standard deviations",
    )


def _fit_with_uncertainty(method: Method, fit: LeastSquares, equations: Equations, shares: Array) -> Fit:
    found = uncertainty(equations, fit)
    return Fit(
        fit, equations, equations, found.covariance, found.deviations, found.degrees, found.noise, shares, method
    )


def allowed_change(fit: LeastSquares, base: BaseParameters, deviations: Array, beta: Array) -> ChangeEllipsoid | None:
    """Return the ellipsoid of changes within 1 % of the deviations, friction fixed; None where no deviation is known.

    In the metric of eq. 81 a change of length 1 moves each parameter by at most its white deviation, which is no
    larger than the one that is told; so no torque changes by what could be seen. Friction does not move.

    Args:
        fit: unconstrained least squares.
        base: grouping of the parameters.
        deviations: reported standard deviations, shape (base,).
        beta: base parameters before the change, shape (base,).

    Returns:
        None where no parameter was seen, or nothing is uncertain.
    """
    white = fit.standard_deviations
    seen = np.isfinite(white) & np.isfinite(deviations) & (white > 0.0)
    if not seen.any():
        return None
    moves = np.array([base.names[column].rstrip("0123456789") in (*INERTIAL, "Ia") for column in base.base])
    least = float(np.min(deviations[seen] / white[seen]))
    return ChangeEllipsoid(beta, fit.R1 / (SAME * least * residual_deviation(fit)), moves)
