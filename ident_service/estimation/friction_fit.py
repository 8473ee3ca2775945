"""The numbers in the friction that are not linear, fitted outside the convex problem.

The way of pre-sliding x0 and the Stribeck velocity v_s belong to one drive each, and act on that drive's own rows. So
one value is tried for all drives at once, each drive keeps the value that leaves it the smallest residual, and a finer
grid around the best follows. Nothing but the recordings that are fitted to is looked at.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import reduce

import numpy as np

from ident_service.config.schema import FrictionShape
from ident_service.estimation.equations import Equations, equations
from ident_service.estimation.least_squares import weighted_least_squares
from ident_service.model.arm_model import ArmModel
from ident_service.model.base import BaseParameters
from ident_service.model.chain import Array
from ident_service.record.recording import Recording

_GRIDS: dict[str, Array] = {
    "presliding": np.array([0.0, *np.geomspace(3e-4, 0.1, 8)]),
    "stribeck_velocity": np.geomspace(0.02, 0.8, 8),
}
_FINER = np.array([0.6, 0.8, 1.0, 1.25, 1.6])
_RATE = 125.0  # Hz; friction changes slowly enough to be fitted on fewer rows


def with_friction(model: ArmModel, shape: FrictionShape) -> ArmModel:
    """The same arm with these numbers in its friction; what is still to be fitted stands at a middling value."""
    options = model.config.identification.model_copy(update={"friction": shape})
    config = model.config.model_copy(update={"identification": options})
    velocity = 0.1 if shape.stribeck_velocity == "fit" else shape.stribeck_velocity
    joints = model.chain.joints
    layout = replace(
        model.layout, stribeck_velocity=tuple(float(v) for v in np.broadcast_to(np.asarray(velocity), (joints,)))
    )
    return replace(model, config=config, layout=layout)


def fit_friction(recordings: Sequence[Recording], model: ArmModel, base: BaseParameters) -> ArmModel:
    """The arm with every number that its configuration leaves to be fitted.

    Args:
        recordings: to fit to.
        model: the arm; `identification.friction` says what to fit.
        base: grouping of its parameters, which these numbers do not change.

    Raises:
        RecordingError: a recording cannot be used.
    """
    shape = model.config.identification.friction
    wanted = [key for key in _GRIDS if getattr(shape, key) == "fit"]
    if "stribeck" not in model.layout.terms:
        wanted = [key for key in wanted if key != "stribeck_velocity"]
    joints = model.chain.joints
    values = {
        key: np.full(joints, 0.1 if key == "stribeck_velocity" else 0.0)
        if getattr(shape, key) == "fit"
        else np.broadcast_to(np.asarray(getattr(shape, key), dtype=float), (joints,)).copy()
        for key in _GRIDS
    }
    if wanted:
        thinned = _thinned(model, recordings)
        for grids in (_GRIDS, None):
            for key in wanted:
                trials = (
                    [np.full(joints, value) for value in grids[key]]
                    if grids is not None
                    else [values[key] * factor for factor in _FINER]
                )
                values[key] = _best(recordings, thinned, base, values, key, trials)
    return with_friction(model, _shape(values))


def _best(
    recordings: Sequence[Recording],
    model: ArmModel,
    base: BaseParameters,
    values: dict[str, Array],
    key: str,
    trials: Sequence[Array],
) -> Array:
    """Per drive, the trial value that leaves its joint the smallest residual."""
    left = []
    for trial in trials:
        tried = with_friction(model, _shape({**values, key: trial}))
        gathered = reduce(Equations.joined, (equations(recording, tried, base) for recording in recordings))
        left.append(gathered.total.squared_residuals(weighted_least_squares(gathered.total).beta))
    choice = np.argmin(np.array(left), axis=0)
    return np.array([trials[index][drive] for drive, index in enumerate(choice)])


def _shape(values: dict[str, Array]) -> FrictionShape:
    return FrictionShape(
        presliding=tuple(float(value) for value in values["presliding"]),
        stribeck_velocity=tuple(float(value) for value in values["stribeck_velocity"]),
    )


def _thinned(model: ArmModel, recordings: Sequence[Recording]) -> ArmModel:
    options = model.config.identification
    first = next(iter(recordings[0].blocks()), None)
    period = 1e-3 if first is None else float(np.median(np.diff(first.stamp_ns))) * 1e-9
    step = max(options.smoothing.decimate, int(1.0 / (_RATE * period)))
    smoothing = options.smoothing.model_copy(update={"decimate": step})
    config = model.config.model_copy(update={"identification": options.model_copy(update={"smoothing": smoothing})})
    return replace(model, config=config)
