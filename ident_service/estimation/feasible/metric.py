"""Compute the metric of a covariance, which makes a correction independent of the base columns (3.4, eq. 52)."""

from __future__ import annotations

import numpy as np

from ident_service.errors import ParameterError
from ident_service.model.base import BaseParameters
from ident_service.model.chain import Array

_LARGEST_CONDITION = 1e13  # of the correlations, beyond which their inverse is rounding


def whitening(covariance: Array, base: BaseParameters) -> Array:
    """Return W with W^T W the inverse of a covariance, shape (base, base).

    Args:
        covariance: of the base parameters, SI units, shape (base, base).
        base: their grouping.

    Raises:
        ParameterError: the covariance has no inverse; the message says along which parameters.
    """
    refusal = "no correction in the metric of this covariance:"
    if covariance.shape != (base.size, base.size):
        raise ParameterError(f"{covariance.shape=} but there are {base.size} base parameters")
    variances = np.diag(covariance)
    if blind := [base.expressions[i] for i in np.flatnonzero(np.isinf(variances))]:
        raise ParameterError(
            f"{refusal} the data left directions unseen, the variance of {'; '.join(blind)} is infinite"
        )
    if not np.all(np.isfinite(covariance)) or not np.allclose(covariance, covariance.T, rtol=1e-6, atol=0.0):
        raise ParameterError(f"{refusal} it is not a symmetric matrix of numbers")
    if wrong := [base.expressions[i] for i in np.flatnonzero(variances <= 0.0)]:
        raise ParameterError(f"{refusal} the variance of {'; '.join(wrong)} is not positive")
    deviations = np.sqrt(variances)
    values, vectors = np.linalg.eigh(covariance / np.outer(deviations, deviations))
    if values[0] * _LARGEST_CONDITION <= values[-1]:
        worst = base.expressions[int(np.argmax(np.abs(vectors[:, 0])))]
        raise ParameterError(
            f"{refusal} it is singular, most of all along {worst}; fewer blocks or equations than parameters?"
        )
    return np.asarray((vectors / np.sqrt(values)).T / deviations)
