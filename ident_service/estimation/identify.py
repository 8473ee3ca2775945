"""Identify one estimate with its uncertainty from recordings, and the paper's other estimates (tables 6 and 8)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from ident_service.config.arm import FeasibleSetName, Method
from ident_service.errors import UsageError
from ident_service.estimation.bootstrap import constrained_intervals
from ident_service.estimation.choices import Choice
from ident_service.estimation.custom import CustomFunction
from ident_service.estimation.equations import Equations, equations
from ident_service.estimation.feasible.convex import (
    SOLVER,
    SecondOpinion,
    convex_least_squares,
    require_solver,
    second_opinion,
)
from ident_service.estimation.feasible.feasible_set import FeasibleSet, SetName, feasible_set
from ident_service.estimation.feasible.priors import Prior, choose_weight, move_off_boundary
from ident_service.estimation.feasible.problems import (
    FeasibilityTest,
    FeasibleEstimate,
    constrained_least_squares,
    feasibility_correction,
    feasibility_test,
)
from ident_service.estimation.fit import Fit, Prepared, allowed_change, prepare, unconstrained
from ident_service.estimation.friction_fit import at_search_bounds
from ident_service.estimation.least_squares import (
    LeastSquares,
    TorqueError,
    ordinary_least_squares,
    torque_error,
)
from ident_service.estimation.spectra import remarks_on_noise
from ident_service.estimation.torque_constants import require_known_load
from ident_service.estimation.uncertainty import Verdict, negligible, verdicts
from ident_service.model.arm_model import ArmModel
from ident_service.model.base_parameters import BaseParameters, base_parameters, remarks_on_angles
from ident_service.model.blas_threads import one_blas_thread
from ident_service.model.chain import Array
from ident_service.model.information import Information
from ident_service.model.likely_bodies import Source, likely_bodies
from ident_service.recordings.adapters import overlap
from ident_service.recordings.recording import Recording

_HELD_OUT = 1.0 / 3.0
_WEIGHTS = (0.0, *(10.0**k for k in range(-3, 5)))
_SETS: tuple[FeasibleSetName, ...] = ("inertia", "pseudo_inertia")
METHODS: tuple[Method, ...] = get_args(Method)


@dataclass(frozen=True)
class Scored:
    """Torque errors on one recording: on all its rows, and on those of joints that move."""

    recording: str
    sha256: str
    error: TorqueError
    moving: TorqueError


@dataclass(frozen=True)
class Candidate:
    """One of the paper's estimates, with its torque errors.

    Attributes:
        name: name for tables.
        beta: base parameters, shape (base,).
        margin: margin of the feasibility test under the arm's conditions; its sign is the verdict.
        identification: error on all rows of the recordings it was fitted to.
        moving: error on the rows that were fitted to, those near a velocity reversal left out.
        validation: errors on the validation recordings.
    """

    name: str
    beta: Array
    margin: float
    identification: TorqueError
    moving: TorqueError
    validation: tuple[Scored, ...]


@dataclass(frozen=True)
class CustomKnowledge:
    """Function of `constraints.custom`, and the torque errors with and without it.

    Attributes:
        function: the called function.
        solver: name of the solver that found the constrained estimates.
        error: relative torque error [percent] (eq. 84) of the estimate, on the rows that were fitted to.
        error_without: the same of the estimate that knows the rest of the description alone.
    """

    function: CustomFunction
    solver: str
    error: float
    error_without: float


@dataclass(frozen=True)
class Estimate:
    """Identified parameter set with the evidence to judge it by.

    Attributes:
        model: the arm, with what the recordings said of its friction's shape.
        base: grouping of the parameters.
        method: estimator of the unconstrained fit.
        conditions: the feasible set it was held against.
        constrained: whether it was forced into that set.
        beta: base parameters in SI units, shape (base,).
        delta: link parameters with K delta = beta inside the set, shape (parameters,); None where none exist.
        margin: margin of delta inside the set, or of the feasibility test when infeasible.
        tight: blocks of the set that the estimate presses against or violates.
        covariance: of the unconstrained estimate, see `Fit`, shape (base, base).
        standard_deviations: standard deviations on the careful side, at least the square roots of the covariance's
            diagonal, see `uncertainty.py`, shape (base,).
        white_standard_deviations: standard deviations of the paper (eq. 81), shape (base,).
        degrees: degrees of freedom of the standard deviations, shape (base,).
        negligible: sizes below which parameters are as good as zero on this motion, shape (base,).
        noise_deviations: standard deviations from the differences between repetitions of the motion alone, shape
            (base,); None where it is not repeated.
        constrained_intervals: 95 % intervals of the constrained estimate, shape (base, 2); None where no condition
            bends it, or further knowledge does.
        verdicts: one per base parameter.
        fit: the unconstrained least squares.
        samples: smoothed samples used.
        prepared: the equations, and what had to be found before them: friction's shape, delay, torque constants.
        fitted: the equations that the fit solves, for what else is to be asked of them (bootstrap, essential ones).
        information: the rows, in motion and near standstill, without a robust method's weights; what is kept of them.
        prior: prior that the constrained estimates were drawn to; None for none.
        nearest_to: bodies that the link values were chosen near to; None where they were not chosen.
        recordings: name and hash of what it was fitted to.
        candidates: the estimates of table 8, this one's among them.
        chosen: index of this estimate among the candidates.
        standstill_shares: factors of the rows near standstill in the fit, shape (joints,).
        choices: choices among what the configuration left open, with the errors of the alternatives.
        remarks: remarks on how the estimate was found, for people.
        custom: further knowledge in the estimate, where the description names some and it is constrained; neither
            `margin` nor a certificate is about it.
        second: another solution of the constrained problem, where it was asked for.
    """

    model: ArmModel
    base: BaseParameters
    method: Method
    conditions: FeasibleSet
    constrained: bool
    beta: Array
    delta: Array | None
    margin: float
    tight: tuple[str, ...]
    covariance: Array
    standard_deviations: Array
    white_standard_deviations: Array
    degrees: Array
    negligible: Array
    noise_deviations: Array | None
    constrained_intervals: Array | None
    verdicts: tuple[Verdict, ...]
    fit: LeastSquares
    samples: int
    prepared: Prepared
    fitted: Equations
    information: Information
    prior: Prior | None
    nearest_to: Source | None
    recordings: tuple[tuple[str, str], ...]
    candidates: tuple[Candidate, ...]
    chosen: int
    standstill_shares: Array
    choices: tuple[Choice, ...] = ()
    remarks: tuple[str, ...] = ()
    custom: CustomKnowledge | None = None
    second: SecondOpinion | None = None

    @property
    def feasible(self) -> bool:
        """Return whether a real body could have these parameters: the margin in the feasible set is positive."""
        return self.margin > 0.0


@one_blas_thread()
def identify(
    model: ArmModel,
    recordings: Sequence[Recording],
    validation: Sequence[Recording] = (),
    *,
    method: Method | None = None,
    set_name: SetName | None = None,
    custom: CustomFunction | None = None,
    solver: str | None = None,
    ask_second_solver: bool = False,
    step: Callable[[str, float], None] = lambda words, share: None,
    torque_constants: bool = False,
) -> Estimate:
    """Identify an arm from recordings: fit, constrain to the feasible set, validate; return it with uncertainty.

    Args:
        model: the arm; its configuration says how to smooth, and what else to fit (delay, shape of the friction).
        recordings: to fit to; at least one.
        validation: to judge on; never used for the fit.
        method: estimator, the configuration's when None.
        set_name: feasible set to hold the estimate in, `none` for none; the configuration's when None.
        custom: the function that the configuration's `constraints.custom` names, loaded by `load_custom`.
        solver: name of the solver for the problems posed in cvxpy: those with `custom`, and the second opinion.
        ask_second_solver: whether to solve the constrained problem a second time.
        step: called with what is being done and the share of the time that is over, from 0 to 1, as a rule.
        torque_constants: whether to identify those of the motors with the parameters; needs a known payload.

    Raises:
        UsageError: unknown method, no recordings, the same recording twice, no prior where one is asked for, a solver
            that is not installed or has nothing to solve, or torque constants without a known payload.
        CustomError: `custom` raises, returns what is not convex, or contradicts the conditions.
        RecordingError: a recording does not fit the arm or cannot be used.
        SolverError: the solver stopped without an optimum.
    """
    wanted = method or model.config.identification.method
    _check(wanted, recordings, validation)
    _check_convex(model, set_name, custom, solver, again=ask_second_solver)
    if torque_constants:
        require_known_load(recordings, model)
    base = base_parameters(model.chain, model.layout)
    sets = {name: feasible_set(name, base.names, model.config) for name in _SETS}
    kind: FeasibleSetName = model.config.feasible_set if set_name is None or set_name == "none" else set_name
    conditions = sets[kind]

    constants: Literal["described", "unconstrained", "feasible"] = "described"
    if torque_constants:
        constants = "unconstrained" if set_name == "none" else "feasible"
    step("choosing filter, delay and friction", 0.01)
    prepared = prepare(recordings, model, base, conditions, validation, torque_constants=constants)
    step("estimating without conditions", 0.45)
    found = unconstrained(wanted, recordings, prepared, base, conditions)
    step("estimating inside the feasible set", 0.85)
    unseen = [(recording, _validation_equations(recording, prepared, base)) for recording in validation]
    prior = _prior(prepared.model, found, base, conditions)
    test = feasibility_test(found.fit.beta, base, conditions)
    corrected = feasibility_correction(found.fit.beta, base, conditions)
    knowledge: CustomKnowledge | None = None
    if custom is None:
        held = {name: constrained_least_squares(found.fit, base, one, prior) for name, one in sets.items()}
    else:
        by = solver or SOLVER
        held = {
            name: convex_least_squares(found.fit, base, one, prior=prior, custom=custom, solver=by).estimate
            for name, one in sets.items()
        }
        without = constrained_least_squares(found.fit, base, conditions, prior)
        errors = (torque_error(found.weighed.total, one.beta) for one in (held[kind], without))
        knowledge = CustomKnowledge(custom, by.lower(), *(error.relative_percent for error in errors))
    deviations, as_zero = found.deviations, negligible(prepared.equations.everything)
    second = None
    if ask_second_solver:
        second = second_opinion(
            held[kind], found.fit, base, conditions, deviations, prior=prior, custom=custom, solver=solver
        )
    # Link values are centred only without custom knowledge or prior: `custom` may forbid the central body.
    nearest_to: Source | None = None
    if prior is None and custom is None:
        likely = likely_bodies(prepared.model)
        nearest_to = likely.source
        near = allowed_change(found.fit, base, deviations, held[kind].beta) if held[kind].tight else None
        begin = held[kind] if near is None else move_off_boundary(held[kind], base, conditions, likely, near)
        held[kind] = begin.centred(base, conditions, likely, near)

    everything, moving = prepared.equations.everything, prepared.equations.moving
    label = found.method.upper()

    def candidate(name: str, beta: Array, margin: float) -> Candidate:
        scores = tuple(
            Scored(one.path.name, one.sha256, torque_error(rows.everything, beta), torque_error(rows.moving, beta))
            for one, rows in unseen
        )
        return Candidate(name, beta, margin, torque_error(everything, beta), torque_error(moving, beta), scores)

    def tested(name: FeasibleSetName, estimate: FeasibleEstimate) -> float:
        return estimate.margin if name == kind else feasibility_test(estimate.beta, base, conditions).margin

    candidates = [
        candidate(label, found.fit.beta, test.margin),
        candidate("BPFC", corrected.beta, corrected.margin),
        *(candidate(f"FBPE-{label} {name}", held[name].beta, tested(name, held[name])) for name in _SETS),
    ]
    free = set_name == "none"
    chosen = 0 if free else 2 + _SETS.index(kind)
    beta = candidates[chosen].beta
    intervals = None
    if not free and held[kind].tight and custom is None:
        variances = np.diag(found.covariance)
        told = np.isfinite(deviations) & np.isfinite(variances) & (variances > 0.0)
        care = np.where(told, deviations, 1.0) / np.sqrt(np.where(told, variances, 1.0))
        careful = found.covariance * np.outer(care, care)
        intervals = constrained_intervals(found.fit, careful, held[kind].beta, base, conditions, prior)
    delta, margin, tight = _of_test(test) if free else (held[kind].delta, held[kind].margin, held[kind].tight)
    return Estimate(
        model=prepared.model,
        base=base,
        method=found.method,
        conditions=conditions,
        constrained=not free,
        beta=beta,
        delta=delta,
        margin=margin,
        tight=tight,
        covariance=found.covariance,
        standard_deviations=deviations,
        white_standard_deviations=found.fit.standard_deviations,
        degrees=found.degrees,
        negligible=as_zero,
        noise_deviations=None if found.noise is None else np.sqrt(found.noise),
        constrained_intervals=intervals,
        verdicts=verdicts(beta, deviations, as_zero),
        fit=found.fit,
        samples=prepared.equations.samples,
        prepared=prepared,
        fitted=found.equations,
        information=found.weighed.total,
        prior=prior,
        nearest_to=None if free else nearest_to,
        recordings=tuple((recording.path.name, recording.sha256) for recording in recordings),
        candidates=tuple(candidates),
        chosen=chosen,
        standstill_shares=found.shares,
        choices=(*prepared.choices, *found.choices),
        remarks=(
            *found.remarks,
            *_remarks_on_friction(model, prepared.model),
            *remarks_on_angles(base),
            *(() if found.method == "iv" else remarks_on_noise(recordings, prepared.model)),
        ),
        custom=None if free else knowledge,
        second=second,
    )


def _remarks_on_friction(described: ArmModel, fitted: ArmModel) -> tuple[str, ...]:
    wanted, shape = described.config.identification.friction, fitted.config.identification.friction
    asked = {key: getattr(shape, key) for key in type(shape).model_fields if getattr(wanted, key) == "fit"}
    given = {key: 0.0 if key == "presliding" else 0.1 for key in type(shape).model_fields}
    return at_search_bounds(type(shape)(**(given | asked)), fitted.chain.names, fitted.layout.terms)


def _check(method: str, recordings: Sequence[Recording], validation: Sequence[Recording]) -> None:
    if method not in (*METHODS, "choose"):
        raise UsageError(f"method {method!r} is not one of {', '.join(METHODS)}")
    if not recordings:
        raise UsageError("give at least one recording to identify from")
    for index, recording in enumerate(recordings):
        if any(overlap(recording, other) for other in recordings[:index]):
            raise UsageError(
                f"{recording.path}: the same recording twice would make the uncertainty too small; leave one out, or "
                "give ranges that do not overlap"
            )
    if seen := [str(one.path) for one in validation if any(overlap(one, other) for other in recordings)]:
        raise UsageError(
            f"{', '.join(seen)}: a recording that is fitted to cannot validate the fit; give another, or ranges that do"
            " not overlap"
        )


def _check_convex(
    model: ArmModel, set_name: SetName | None, custom: CustomFunction | None, solver: str | None, *, again: bool
) -> None:
    wanted = model.config.constraints.custom
    if wanted != (None if custom is None else custom.name):
        raise UsageError(
            f"{model.config.name} names {wanted} as constraints.custom; give that function, see load_custom"
        )
    if again and set_name == "none":
        raise UsageError("a second opinion is about the constrained estimate; leave out the feasible set none")
    if solver is None:
        return
    if custom is None and not again:
        raise UsageError("a solver is for constraints.custom and the second opinion; add --second-opinion")
    require_solver(solver)


def _validation_equations(recording: Recording, prepared: Prepared, base: BaseParameters) -> Equations:
    return equations(recording, prepared.model, base, allow_still_joints=True).with_torques_times(
        prepared.torque_scales
    )


def _prior(model: ArmModel, found: Fit, base: BaseParameters, conditions: FeasibleSet) -> Prior | None:
    """Return the prior that the configuration asks constrained estimates to be drawn to; None for none."""
    pull = model.config.identification.prior
    if pull.kind == "none":
        return None
    if model.prior is None:
        raise UsageError(f"{model.config.name}: identification.prior asks for prior parameters, but the arm has none")
    if pull.weight != "held_out":
        return Prior(pull.kind, base.names, model.prior, pull.weight)
    blocks = found.equations.blocks
    count = len(blocks) - max(1, round(_HELD_OUT * len(blocks)))
    if count < 1:
        raise UsageError("a prior's weight cannot be chosen from so short a recording; give it a number")
    told, kept_back = (Information.sum(part) for part in (blocks[:count], blocks[count:]))
    fit = ordinary_least_squares(told, found.fit.weights)
    given = Prior(pull.kind, base.names, model.prior, 1.0)

    def estimate(weight: float) -> Array:
        return constrained_least_squares(fit, base, conditions, replace(given, weight=weight)).beta

    def error(beta: Array) -> float:
        return float(np.sum(found.fit.weights**2 * kept_back.squared_residuals(beta)))

    return replace(given, weight=choose_weight(estimate, error, _WEIGHTS).weight)


def _of_test(test: FeasibilityTest) -> tuple[Array | None, float, tuple[str, ...]]:
    return (test.delta, test.margin, ()) if test.feasible else (None, test.margin, test.tight)
