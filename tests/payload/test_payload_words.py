"""Rounding is no value: what is printed of a body has zeros for it."""

from __future__ import annotations

import numpy as np

from ident_service.results.payload_file import without_rounding_errors


def test_rounding_beside_its_own_quantity_is_zero() -> None:
    body = np.array([1e-3, -9e-16, 2e-15, 1e-3, 0.0, 1e-3, 0.05, -4e-14, 6e-14, 1.2])
    np.testing.assert_array_equal(
        without_rounding_errors(body), [1e-3, 0.0, 2e-15, 1e-3, 0.0, 1e-3, 0.05, 0.0, 6e-14, 1.2]
    )


def test_nothing_stays_nothing() -> None:
    np.testing.assert_array_equal(without_rounding_errors(np.zeros(10)), np.zeros(10))
