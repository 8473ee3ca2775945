"""Weigh rows near standstill by how well their friction is modelled.

Where a joint turns round or hardly moves, dry friction takes any value up to its limit, and a model of it errs in
another way than where the joint moves. So each joint's equations are of two kinds with a deviation each, and rows near
standstill are multiplied by the ratio of the two: an arm whose pre-sliding friction the model describes keeps them, one
whose drives stick does without. Rows in motion never count less than they.
"""

from __future__ import annotations

import numpy as np

from ident_service.estimation.equations import Equations
from ident_service.estimation.least_squares import ordinary_least_squares, weighted_least_squares
from ident_service.model.chain import Array
from ident_service.model.information import Information

_SETTLED = 1e-3  # change of a share that counts as settled
_MOST_ROUNDS = 100


def standstill_shares(gathered: Equations) -> Array:
    """Return the factors of the rows near standstill, shape (joints,), at most one.

    Args:
        gathered: equations with their rows near standstill apart.

    Raises:
        ModelError: the joints' weights do not settle.
    """
    moving, near = gathered.total, gathered.left_out
    shares = np.ones(moving.joints)
    if near is None or not near.rows.any():
        return shares
    beta = weighted_least_squares(gathered.everything).beta
    floor = 1e-9 * np.sqrt(gathered.everything.squared_torques() / np.maximum(gathered.everything.rows, 1))
    for _ in range(_MOST_ROUNDS):
        fast, slow = (np.maximum(_deviations(part, beta), floor) for part in (moving, near))
        # A joint whose rows are all of one kind has nothing to compare.
        wanted = np.where((moving.rows > 0) & (near.rows > 0), np.minimum(1.0, fast / slow), 1.0)
        settled = bool(np.all(np.abs(wanted - shares) <= _SETTLED * shares))
        shares = wanted
        if settled:
            break
        each = np.where(moving.rows > 0, 1.0 / fast, 1.0 / slow)
        beta = ordinary_least_squares(moving.merged(near.times(shares)), each).beta
    return shares


def _deviations(information: Information, beta: Array) -> Array:
    return np.asarray(np.sqrt(information.squared_residuals(beta) / np.maximum(information.rows, 1)))
