"""Add to covariances how far base parameters may be off because the shape of the friction was fitted, too.

The pre-sliding distance and the Stribeck velocity are found by search (`friction_fit.py`), and the estimate is linear
once they are numbers. An error of such a number moves the parameters along with it: viscous and Coulomb friction most.
To first order it is a further column of the equations, the derivative of the predicted torque by the number's
logarithm. Its covariance C comes from the equations with these columns, blocks as everywhere, and how the parameters
follow, A, from the same columns by least squares: A C A^T is added to their covariance. Under white noise the two parts
are independent. No logarithm is less certain than any value of the search would be.

A shape is often told by a few reversals alone, so by few blocks, and its covariance is then as uncertain as those few
make it: the degrees of freedom of both parts are those of the equations with the further columns.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ident_service.estimation.equations import Rows, equation_rows, equations_of
from ident_service.estimation.friction_fit import log_deviation_of_search_range, with_friction
from ident_service.estimation.least_squares import ordinary_least_squares, unit_columns
from ident_service.estimation.uncertainty import jackknife, student_factors
from ident_service.model.arm_model import ArmModel
from ident_service.model.base_parameters import BaseParameters
from ident_service.model.chain import Array
from ident_service.model.information import sparsity
from ident_service.recordings.recording import Recording

_STEP = 1e-3  # of a number's logarithm
_RANK_TOLERANCE = 1e-10


@dataclass(frozen=True)
class ShapeUncertainty:
    """Uncertainty of base parameters by the doubt about the friction's shape, or about torque constants.

    Attributes:
        covariance: covariance to be added to that of the base parameters, SI units, shape (base, base).
        degrees: degrees of freedom of its variances, shape (base,); infinite where a bound of the search is all that is
            known.
        known_degrees: degrees of freedom of the variances that take the shape for known, the fitted numbers counted
            among the parameters, shape (base,).
    """

    covariance: Array
    degrees: Array
    known_degrees: Array

    def joined(self, deviations: Array, degrees_of_freedom: Array) -> tuple[Array, Array]:
        """Return deviations widened by the friction shape's uncertainty, and the degrees of freedom of both together.

        Each part is widened for its own degrees of freedom, none of which is more than the deviations have: beyond
        first order, and over longer blocks, a shape is not known better than what it goes with. Together they have
        Satterthwaite's (1946), or as many as before.

        Args:
            deviations: standard deviations that take the shape for known, widened, shape (base,); may be infinite.
            degrees_of_freedom: degrees of freedom of the deviations, shape (base,).
        """
        own, added = np.minimum(degrees_of_freedom, self.known_degrees), np.minimum(degrees_of_freedom, self.degrees)
        variances = (deviations / student_factors(degrees_of_freedom)) ** 2, np.diag(self.covariance)
        both = variances[0] + variances[1]
        share = np.divide(variances[1], both, out=np.zeros_like(both), where=np.isfinite(both) & (both > 0.0))
        wider = np.sqrt(variances[0] * student_factors(own) ** 2 + variances[1] * student_factors(added) ** 2)
        # What no equation sees has no degrees of freedom at all.
        own, added = (np.maximum(one, np.finfo(float).tiny) for one in (own, added))
        return wider, np.minimum(degrees_of_freedom, 1.0 / ((1.0 - share) ** 2 / own + share**2 / added))


def shape_uncertainty(
    recordings: Sequence[Recording],
    model: ArmModel,
    base: BaseParameters,
    fitted: Sequence[str],
    beta: Array,
    weights: Array,
    torque_scales: Array,
    standstill_factors: Array,
) -> ShapeUncertainty:
    """Return the covariance that the uncertainty of the fitted friction shape adds to that of base parameters.

    Args:
        recordings: recordings that shape and base parameters were fitted to.
        model: the arm, the shape of its friction as numbers.
        base: grouping of its parameters.
        fitted: names of the fitted numbers, as of `fitted_friction_parameters`.
        beta: base parameters, shape (base,).
        weights: per joint, what its equations are multiplied by, shape (joints,).
        torque_scales: factor of each joint's measured torque, shape (joints,).
        standstill_factors: factors of the rows near standstill, shape (joints,).

    Raises:
        RecordingError: a recording cannot be used.
    """
    size, drives = base.size, model.chain.joints
    none = ShapeUncertainty(np.zeros((size, size)), np.full(size, np.inf), np.full(size, np.inf))
    columns = _friction_columns(model, base)
    if not fitted or not len(columns):
        return none
    others = [_moved(model, key) for key in fitted]
    own = replace(base, base=base.base[columns])

    def rows_of(recording: Recording) -> Iterator[Rows]:
        moved = [equation_rows(recording, other, own) for other in others]
        for rows, *shifted in zip(equation_rows(recording, model, base), *moved, strict=True):
            derivatives = [
                _per_drive((other.H_b - rows.H_b[:, columns]) * beta[columns, None] / _STEP, base.base[columns], model)
                for other in shifted
            ]
            yield replace(rows, H_b=np.concatenate([rows.H_b, *derivatives], axis=1))

    further = np.arange(len(fitted) * drives)
    felt = tuple(
        np.concatenate([support, size + further[np.tile(model.chain.coupling[:, joint] != 0.0, len(fitted))]])
        for joint, support in enumerate(sparsity(model.chain, model.layout, base.base))
    )
    gathered = (
        equations_of(recordings, model, felt, rows_of)
        .with_torques_times(torque_scales)
        .with_standstill_rows(standstill_factors)
    )
    fit = ordinary_least_squares(gathered.total, weights)
    W, D = fit.R1[:, :size], fit.R1[:, size:]
    # A number that was left out, or belongs to friction that is not there, moves nothing.
    _, seen = unit_columns(fit.R1)
    used = seen[size:]
    if not used.any():
        return none
    scale, _ = unit_columns(W)
    follow = -np.linalg.lstsq(W / scale, D[:, used], rcond=_RANK_TOLERANCE)[0] / scale[:, None]
    most = np.repeat([log_deviation_of_search_range(key) for key in fitted], drives)[used]
    numbers = np.eye(len(seen))[:, size:][:, used]
    found, _, blind = jackknife(gathered.clusters, fit, numbers)
    told, white = np.sqrt(np.diag(found)), np.where(blind, 0.0, fit.standard_deviations[size:][used])
    wider = np.maximum(white / np.where(told > 0.0, told, 1.0), 1.0)
    found = found * np.outer(wider, wider)
    found[blind, blind] = np.inf
    bounded = _bounded_deviations(found, most)
    added = follow @ bounded @ follow.T
    # A bound of the search is certain; what data say of the other numbers is not.
    by_data = np.sqrt(np.diag(found)) < most
    through = numbers[:, by_data] @ follow[:, by_data].T
    shape_known = np.eye(len(seen), size) - numbers @ follow.T
    _, degrees, _ = jackknife(gathered.clusters, fit, np.column_stack([shape_known, through]))
    part = np.diag(follow[:, by_data] @ bounded[np.ix_(by_data, by_data)] @ follow[:, by_data].T)
    share = np.divide(part, np.diag(added), out=np.zeros(size), where=part > 0.0)
    own = np.divide(np.maximum(degrees[size:], 1.0), share**2, out=np.full(size, np.inf), where=share > 0.0)
    return ShapeUncertainty(np.asarray(0.5 * (added + added.T)), own, np.maximum(degrees[:size], 1.0))


def _friction_columns(model: ArmModel, base: BaseParameters) -> NDArray[np.intp]:
    """Give the places of Coulomb and Stribeck friction among the base parameters."""
    terms = [term for term in ("coulomb", "stribeck") if term in model.layout.terms]
    wanted = [column for term in terms for column in model.layout.term_columns(term)]
    return np.flatnonzero(np.isin(base.base, wanted))


def _per_drive(changes: Array, columns: NDArray[np.intp], model: ArmModel) -> Array:
    """Sum torques of friction's columns, shape (joints, columns, samples), for each drive."""
    links = columns // model.layout.per_link
    return np.stack([changes[:, links == drive].sum(axis=1) for drive in range(model.chain.joints)], axis=1)


def _moved(model: ArmModel, key: str) -> ArmModel:
    """Give the arm with one kind of number larger by the step, of all drives at once."""
    shape = model.config.identification.friction
    value = np.broadcast_to(np.asarray(getattr(shape, key), dtype=float), (model.chain.joints,))
    larger = tuple((value * np.exp(_STEP)).tolist())
    return with_friction(model, shape.model_copy(update={key: larger}))


def _bounded_deviations(covariance: Array, most: Array) -> Array:
    """Bound deviations; what the data do not see, or one block alone, has the bound and no correlation."""
    variances = np.diag(covariance)
    known = np.isfinite(variances)
    inner = np.where(np.outer(known, known), covariance, 0.0)
    factor = np.minimum(1.0, most / np.sqrt(np.where(known & (variances > 0.0), variances, most**2)))
    return np.asarray(inner * np.outer(factor, factor) + np.diag(np.where(known, 0.0, most**2)))
