"""Simulate dry friction that really sticks: one step's velocities as a box-constrained complementarity problem.

Find `v` with `A v + lambda = b` and `lambda_i` in `bound_i Sgn(v_i)`, where Sgn is set-valued: a sliding joint feels
its whole friction against its motion, and a joint at rest whatever keeps it at rest, up to its bound (Moreau 1988,
Stewart & Trinkle 1996). `A` is symmetric positive definite, so `v` is the one minimum of the strictly convex
`v^T A v / 2 - b^T v + sum bound_i |v_i|`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

# Rounding must not tell a joint at the very edge of its friction cone to creep.
_EDGE = 1e-14
_PIVOTS = 20
_SWEEPS = 20
_ROUNDS = 500


def stick_slip_velocity(A: Vector, b: Vector, bound: Vector, guess: Vector) -> Vector:
    """Solve for the velocities; joints that stick come back with exactly 0.

    Args:
        A: symmetric positive definite, shape (joints, joints).
        b: shape (joints,).
        bound: largest friction in the units of b, not negative, shape (joints,).
        guess: a velocity whose signs are probably right, 0 for joints that probably stick, shape (joints,).

    Returns:
        The velocities, shape (joints,).
    """
    slack = _EDGE * float((np.abs(b) + bound).max())
    v, consistent = _pivot(A, b, bound, np.sign(guess), slack)
    if consistent:
        return v
    # Pivoting several joints at once can go in circles; sweeping over them one by one only ever descends.
    for _ in range(_ROUNDS):
        v = _sweep(A, b, bound, v)
        exact, consistent = _pivot(A, b, bound, np.sign(v), slack, pivots=1)
        if consistent:
            return exact
    return v


def _pivot(
    A: Vector, b: Vector, bound: Vector, mode: Vector, slack: float, pivots: int = _PIVOTS
) -> tuple[Vector, bool]:
    """Solve with each joint's mode (-1, 0, 1) assumed, correct the modes, and repeat.

    Returns:
        The last solution, and whether its modes are the right ones.
    """
    dry, edge = bound > 0.0, bound + slack
    v = np.zeros_like(b)
    for _ in range(pivots):
        sliding = (mode != 0.0) | ~dry
        v = _with_modes(A, b - bound * mode, sliding)
        wrong_way = sliding & dry & (v * mode <= 0.0)
        holding = b - A @ v
        torn_loose = ~sliding & (np.abs(holding) > edge)
        if not (wrong_way | torn_loose).any():
            return v, True
        mode = np.where(torn_loose, np.sign(holding), mode * ~wrong_way)
    return v, False


def _with_modes(A: Vector, b: Vector, sliding: NDArray[np.bool_]) -> Vector:
    if not sliding.any():
        return np.zeros_like(b)
    # Unit rows in place of the sticking joints' are cheaper than cutting the others out.
    held = A * (sliding[:, None] & sliding)
    held.flat[:: len(b) + 1] += ~sliding
    v = np.asarray(np.linalg.solve(held, b * sliding))
    v[~sliding] = 0.0
    return v


def _sweep(A: Vector, b: Vector, bound: Vector, start: Vector) -> Vector:
    """Minimise by projected Gauss-Seidel: each joint in turn to its own minimum, the others held."""
    rows, v = A.tolist(), start.tolist()
    for _ in range(_SWEEPS):
        for i, (row, force, limit) in enumerate(zip(rows, b.tolist(), bound.tolist(), strict=True)):
            pull = force - sum(a * w for a, w in zip(row, v, strict=True)) + row[i] * v[i]
            v[i] = 0.0 if abs(pull) <= limit else (pull - (limit if pull > 0.0 else -limit)) / row[i]
    return np.array(v)
