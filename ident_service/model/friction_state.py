"""Model what dry friction is multiplied by: the sign of the velocity, or Dahl's pre-sliding state.

A drive that turns round does not change its friction at once: teeth and bearings give by some micrometres or
milliradians first. The simplest law for that is Dahl's (1968),

    ds/dx = (1 - s sign(v)) / x0

Where the drive moves by `step` without turning round, the direction s goes to

    s' = sign(step) + (s - sign(step)) exp(-|step| / x0)

exactly, however long the step is: an exponential in the distance travelled. With x0 = 0 it is the sign.
"""

from __future__ import annotations

import numpy as np

from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import Array


def presliding_distances(model: ArmModel) -> Array:
    """Return the pre-sliding distance x0 per drive [rad or m], shape (joints,); zero where none applies or was fitted.

    Zero where dry friction turns round at once: nothing was fitted, or the arm has no dry friction.
    """
    given = model.config.identification.friction.presliding
    if given == "fit" or not {"coulomb", "stribeck"} & set(model.layout.terms):
        return np.zeros(model.chain.joints)
    return np.array(np.broadcast_to(np.asarray(given, dtype=float), (model.chain.joints,)))


def advance_dahl_state(direction: Array, displacement: Array, presliding_lengths: Array) -> Array:
    """Return each drive's dry-friction direction, -1 to 1, after a displacement without reversal (Dahl 1968).

    Args:
        direction: direction before the step, between -1 and 1, shape (..., drives).
        displacement: displacement of the drives, none of which reverses meanwhile [rad or m], shape (..., drives).
        presliding_lengths: x0 [rad or m], shape (drives,).

    Returns:
        Shape (..., drives).
    """
    sign, distance = np.sign(displacement), np.abs(displacement)
    left = np.exp(-distance / np.where(presliding_lengths > 0.0, presliding_lengths, 1.0))
    return np.asarray(sign + np.where(presliding_lengths > 0.0, (direction - sign) * left, 0.0))


def friction_direction(
    drive_velocity: Array, period: float, presliding_lengths: Array, start_direction: Array | None = None
) -> Array:
    """Return the dry-friction direction of each drive at each sample, -1 to 1, shape (samples, drives).

    Args:
        drive_velocity: drive velocities [rad/s or m/s], shape (samples, drives).
        period: of the samples [s].
        presliding_lengths: x0 per drive [rad or m], shape (drives,); 0 for the sign itself.
        start_direction: direction before the first sample, shape (drives,); the first sign that follows when None.
    """
    result = np.empty_like(drive_velocity)
    for drive, x0 in enumerate(presliding_lengths):
        signs = np.sign(drive_velocity[:, drive])
        if x0 <= 0.0:
            result[:, drive] = signs
            continue
        # Where the velocity is exactly zero nothing is travelled, and the last sign may stand.
        moving = np.flatnonzero(signs)
        before = (
            signs[moving[0]]
            if start_direction is None and len(moving)
            else 0.0
            if start_direction is None
            else float(start_direction[drive])
        )
        travelled = np.cumsum(np.abs(drive_velocity[:, drive])) * (period / x0)
        last = np.maximum.accumulate(np.where(signs != 0.0, np.arange(len(signs)), -1))
        held = np.where(last >= 0, signs[np.maximum(last, 0)], np.sign(before) or 1.0)
        turns = np.flatnonzero(np.diff(held)) + 1
        state, reached = before, 0.0
        for begin, end in zip([0, *turns], [*turns, len(held)], strict=True):
            part = slice(begin, end)
            result[part, drive] = held[begin] + (state - held[begin]) * np.exp(reached - travelled[part])
            state, reached = result[end - 1, drive], travelled[end - 1]
    return result
