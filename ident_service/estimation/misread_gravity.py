"""Find torques that were recorded without gravity, or gravity in another direction, by fitting each such reading.

Without gravity in its torques an arm seems to be balanced: first moments near zero predict a part of what the links'
motion alone asks for, so that the error does not tell it from a poor model. The right gravity leaves far less of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident_service.errors import RecordingError, SolverError
from ident_service.estimation.equations import equations
from ident_service.estimation.feasible.problems import ENOUGH, constrained_least_squares
from ident_service.estimation.identify import Estimate
from ident_service.estimation.least_squares import TorqueError, ordinary_least_squares, torque_error
from ident_service.estimation.misread_columns import (
    BETTER,
    EXPLAINED,
    LIKELIER,
    NONE_WORSE,
    SUSPECTED_FROM,
    WHOLE_CONCERNED,
    error_reductions,
    weights_of_joints,
)
from ident_service.model.base_parameters import base_parameters
from ident_service.model.blas_threads import one_blas_thread
from ident_service.model.chain import Array
from ident_service.recordings.adapters import RangeRecording, time_range
from ident_service.recordings.recording import Recording

STANDARD = 9.81  # m/s^2, where a description has no gravity
_LONGEST = 60.0  # s of recordings that are fitted
_MOST = 6  # of them, the first ones
_SAME = 0.02  # cosine short of 1 of directions that are the same


@dataclass(frozen=True)
class MisreadGravity:
    """Another gravity that explains the recordings far better.

    Attributes:
        gravity: the other gravity in the base frame [m/s^2], shape (3,); zero where the torques lack it.
        before: torque error in motion with the gravity that is described.
        after: the same with that gravity.
    """

    gravity: Array
    before: TorqueError
    after: TorqueError

    @property
    def error_reduction(self) -> float:
        """Return the sum over joints of the logarithm of the torque error before over after; positive is better."""
        return float(error_reductions(self.before, self.after).sum())

    def sentence(self, joint_names: Sequence[str]) -> str:
        """Return a sentence for people: which gravity seems right, the errors before and after, and what to correct.

        Args:
            joint_names: of the joints.
        """
        pairs = zip(joint_names, self.before.joint_relative_percent, self.after.joint_relative_percent, strict=True)
        each = ", ".join(f"of {name} {before:.2g} % and {after:.2g} %" for name, before, after in pairs)
        errors = f"the torque error in motion is {self.before.relative_percent:.1f} %, and"
        left = f"{self.after.relative_percent:.2g} %"
        if not self.gravity.any():
            return (
                f"the torques seem to lack gravity, as where it is compensated apart: {errors} {left} without gravity"
                f" ({each}): record the whole torque of the drives, add what compensates gravity, or correct gravity in"
                " the description"
            )
        written = ", ".join(f"{value:g}" for value in self.gravity)
        return (
            f"gravity seems to point in another direction than described: {errors} {left} with gravity [{written}]"
            f" ({each}): correct gravity in the description, or the order of its joints and their axes"
        )


@one_blas_thread()
def misread_gravity(estimate: Estimate, recordings: Sequence[Recording]) -> MisreadGravity | None:
    """Return the gravity, none or along a base axis, that predicts torques far better than described; else None.

    Directions are those of the base frame's axes. Nothing is tried where all torques are predicted to 4 %. Of the
    recordings at most a minute is fitted.

    Args:
        estimate: identified estimate.
        recordings: recordings that the estimate was fitted to.
    """
    own = estimate.candidates[estimate.chosen].moving
    worst = own.joint_relative_percent.max(initial=0.0)
    if not recordings or own.relative_percent < WHOLE_CONCERNED:
        return None
    described = estimate.prepared.model.chain.gravity
    size = float(np.linalg.norm(described))
    tried = [np.zeros(3)] if size else []
    if worst >= SUSPECTED_FROM:
        along = [sign * (size or STANDARD) * axis for axis in np.eye(3) for sign in (1.0, -1.0)]
        tried += [one for one in along if one @ described < (1.0 - _SAME) * size**2 or not size]
    parts = [_beginning(one, _LONGEST / min(len(recordings), _MOST)) for one in recordings[:_MOST]]
    weights = weights_of_joints(own)
    try:
        before = _error(estimate, parts, described, weights)
    except (RecordingError, SolverError):  # nothing can be compared with it
        return None
    best: MisreadGravity | None = None
    for gravity in tried:
        try:
            found = MisreadGravity(gravity, before, _error(estimate, parts, gravity, weights))
        except SolverError:  # it explains nothing, and must not end what has been identified
            continue
        enough = np.log(BETTER) + (np.log(LIKELIER) if gravity.any() else 0.0)
        none_worse = error_reductions(before, found.after).min() >= -np.log(NONE_WORSE)
        explains = found.error_reduction >= enough and none_worse and found.after.relative_percent < EXPLAINED
        if explains and (best is None or found.error_reduction > best.error_reduction):
            best = found
    return best


def _beginning(recording: Recording, seconds: float) -> RangeRecording:
    start = max(time_range(recording)[0], 0.0)
    return RangeRecording(recording, start, start + seconds)


def _error(estimate: Estimate, parts: Sequence[Recording], gravity: Array, weights: Array) -> TorqueError:
    """Return the torque error in motion that a fit with some gravity leaves."""
    prepared = estimate.prepared
    model = replace(prepared.model, chain=replace(prepared.model.chain, gravity=gravity))
    base = base_parameters(model.chain, model.layout)
    moving = equations(parts, model, base, allow_still_joints=True).with_torques_times(prepared.torque_scales).moving
    fit = ordinary_least_squares(moving, weights)
    found = constrained_least_squares(fit, base, estimate.conditions, first_tolerance=ENOUGH)
    return torque_error(moving, found.beta)
