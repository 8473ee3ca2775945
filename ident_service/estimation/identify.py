"""From recordings to one estimate with its doubt, and the other estimates of the paper beside it (tables 6 and 8)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np

from ident_service.errors import UsageError
from ident_service.estimation.doubt import Verdict, block_covariance, verdicts
from ident_service.estimation.equations import Equations, equations
from ident_service.estimation.feasibility import (
    FeasibilityTest,
    constrained_least_squares,
    feasibility_correction,
    feasibility_test,
)
from ident_service.estimation.feasible_set import FeasibleSet, SetName, feasible_set
from ident_service.estimation.least_squares import LeastSquares, TorqueError, ordinary_least_squares, torque_error
from ident_service.model.arm_model import ArmModel
from ident_service.model.base import BaseParameters, base_parameters
from ident_service.model.chain import Array
from ident_service.record.recording import Recording

METHODS = ("ols",)


@dataclass(frozen=True)
class Scored:
    """Torque errors on one recording."""

    recording: str
    sha256: str
    error: TorqueError


@dataclass(frozen=True)
class Candidate:
    """One of the paper's estimates.

    Attributes:
        name: for tables.
        beta: base parameters, shape (base,).
        margin: of the feasibility test under the arm's conditions; its sign is the verdict.
        identification: error on the equations it was fitted to.
        validation: errors on recordings that it never saw.
    """

    name: str
    beta: Array
    margin: float
    identification: TorqueError
    validation: tuple[Scored, ...]


@dataclass(frozen=True)
class Estimate:
    """An identified parameter set with everything needed to doubt it.

    Attributes:
        model: the arm.
        base: grouping of the parameters.
        method: estimator.
        conditions: the feasible set it was held against.
        constrained: whether it was forced into that set.
        beta: base parameters in SI units, shape (base,).
        delta: link parameters with K delta = beta inside the set, shape (parameters,); None where none exist.
        margin: of delta inside the set, or of the feasibility test when infeasible.
        tight: blocks of the set that the estimate presses against or violates.
        covariance: of the unconstrained estimate, from blocks of scores, shape (base, base).
        standard_deviations: its diagonal's square root, shape (base,).
        white_standard_deviations: the paper's (eq. 81), shape (base,).
        verdicts: one per base parameter.
        fit: the unconstrained least squares.
        samples: smoothed samples used.
        recordings: name and hash of what it was fitted to.
        candidates: the estimates of table 8, this one's among them.
        chosen: index of this estimate among the candidates.
    """

    model: ArmModel
    base: BaseParameters
    method: str
    conditions: FeasibleSet
    constrained: bool
    beta: Array
    delta: Array | None
    margin: float
    tight: tuple[str, ...]
    covariance: Array
    standard_deviations: Array
    white_standard_deviations: Array
    verdicts: tuple[Verdict, ...]
    fit: LeastSquares
    samples: int
    recordings: tuple[tuple[str, str], ...]
    candidates: tuple[Candidate, ...]
    chosen: int

    @property
    def feasible(self) -> bool:
        """Whether a real body could have these parameters."""
        return self.margin > 0.0


def identify(
    model: ArmModel,
    recordings: Sequence[Recording],
    validation: Sequence[Recording] = (),
    *,
    method: str = "ols",
    set_name: SetName | None = None,
) -> Estimate:
    """Identify an arm from recordings.

    Args:
        model: the arm.
        recordings: to fit to; at least one.
        validation: to judge on; never used for the fit.
        method: one of METHODS.
        set_name: feasible set to hold the estimate in, `none` for none; the configuration's when None.

    Raises:
        UsageError: unknown method, no recordings, or a validation recording that was also fitted to.
        RecordingError: a recording does not fit the arm or cannot be used.
        SolverError: the solver stopped without an optimum.
    """
    if method not in METHODS:
        raise UsageError(f"method {method!r} is not one of {', '.join(METHODS)}")
    if not recordings:
        raise UsageError("give at least one recording to identify from")
    fitted = {recording.sha256 for recording in recordings}
    if seen := [str(recording.path) for recording in validation if recording.sha256 in fitted]:
        raise UsageError(f"{', '.join(seen)}: a recording that is fitted to cannot validate the fit")
    base = base_parameters(model.chain, model.layout)
    gathered = reduce(Equations.joined, (equations(recording, model, base) for recording in recordings))
    unseen = [(recording, equations(recording, model, base)) for recording in validation]
    fit = ordinary_least_squares(gathered.total)
    covariance = block_covariance(gathered, fit)
    deviations = np.sqrt(np.diag(covariance))

    kind = model.config.feasible_set if set_name in (None, "none") else set_name
    sets = {name: feasible_set(name, base.names, model.config) for name in ("inertia", "pseudo_inertia")}
    conditions = sets[kind]
    test = feasibility_test(fit.beta, base, conditions)
    constrained = {name: constrained_least_squares(fit, base, conditions) for name, conditions in sets.items()}
    corrected = feasibility_correction(fit.beta, base, conditions)

    def candidate(name: str, beta: Array, margin: float) -> Candidate:
        scores = tuple(
            Scored(recording.path.name, recording.sha256, torque_error(eqs.total, beta)) for recording, eqs in unseen
        )
        return Candidate(name, beta, margin, torque_error(gathered.total, beta), scores)

    candidates = (
        candidate("OLS", fit.beta, test.margin),
        candidate("BPFC", corrected.beta, corrected.margin),
        candidate(
            "FBPE-OLS inertia", constrained["inertia"].beta, _margin(constrained["inertia"].beta, base, conditions)
        ),
        candidate("FBPE-OLS pseudo_inertia", constrained["pseudo_inertia"].beta, constrained["pseudo_inertia"].margin),
    )
    free = set_name == "none"
    chosen = 0 if free else ("inertia", "pseudo_inertia").index(kind) + 2
    beta = candidates[chosen].beta
    delta: Array | None = constrained[kind].delta
    margin, tight = constrained[kind].margin, constrained[kind].tight
    if free:
        delta, margin, tight = _of_test(test)
    return Estimate(
        model=model,
        base=base,
        method=method,
        conditions=conditions,
        constrained=not free,
        beta=beta,
        delta=delta,
        margin=margin,
        tight=tight,
        covariance=covariance,
        standard_deviations=deviations,
        white_standard_deviations=fit.standard_deviations,
        verdicts=verdicts(beta, deviations, base.units),
        fit=fit,
        samples=gathered.samples,
        recordings=tuple((recording.path.name, recording.sha256) for recording in recordings),
        candidates=candidates,
        chosen=chosen,
    )


def _margin(beta: Array, base: BaseParameters, conditions: FeasibleSet) -> float:
    return feasibility_test(beta, base, conditions).margin


def _of_test(test: FeasibilityTest) -> tuple[Array | None, float, tuple[str, ...]]:
    return (test.delta, test.margin, ()) if test.feasible else (None, test.margin, test.tight)
