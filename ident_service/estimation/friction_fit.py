"""Fit the nonlinear friction numbers, pre-sliding distance and Stribeck velocity, outside the convex problem.

The pre-sliding distance x0 and the Stribeck velocity v_s belong to one drive each, and act on that drive's own rows. So
one value is tried for all drives at once, and each drive keeps the one that leaves it the smallest residual. Two
searches begin differently, the numbers in turn or all their pairs at once, because the residual has several minima.
Between their results decides what predicts better: the recordings are cut into thirds, and each third's torque is
predicted by friction fitted to the other two, inertias being those of the whole. A shape that only explains what it has
seen, such as a spike at a few reversals, loses there. Nothing but the recordings that are fitted to is looked at.

An arm without pre-sliding, or without Stribeck friction, is the alternative: it is taken where it predicts held-out
thirds clearly better (`choices.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ident_service.config.schema import FrictionShape
from ident_service.estimation.choices import Choice, clearly_chosen, held_out_thirds
from ident_service.estimation.equations import Equations
from ident_service.estimation.feasible.feasible_set import FeasibleSet
from ident_service.estimation.friction_trials import FrictionTrials
from ident_service.estimation.least_squares import weighted_least_squares
from ident_service.estimation.moments import Moments, ridge
from ident_service.estimation.standstill import standstill_shares
from ident_service.model.arm_model import ArmModel
from ident_service.model.base import BaseParameters
from ident_service.model.chain import Array
from ident_service.model.layout import INERTIAL, NO_STRIBECK
from ident_service.recordings.recording import Recording

# No gear gives by more than three degrees before it slips; a Stribeck velocity is a small share of full speed.
_GRIDS: dict[str, Array] = {
    "presliding": np.array([0.0, *np.geomspace(3e-4, 0.05, 8)]),
    "stribeck_velocity": np.geomspace(0.02, 0.8, 8),
}
# Values that stand for absence: Stribeck friction with this velocity vanishes at any recorded speed.
_NONE = {"presliding": 0.0, "stribeck_velocity": NO_STRIBECK}
_FINER = np.array([0.6, 0.8, 1.0, 1.25, 1.6])
_ROUNDS = 2
# So near that what is left of the grid moves no parameter by much beside its deviation.
_NEARER = (np.array([0.9, 0.95, 1.0, 1.05, 1.1]), np.array([0.975, 1.0, 1.025]), np.array([0.99, 1.0, 1.01]))
_RATE = 125.0  # Hz; friction changes slowly enough to be fitted on fewer rows


def with_friction(model: ArmModel, shape: FrictionShape) -> ArmModel:
    """Return the arm with these friction numbers; those still to be fitted stand at a middling value."""
    options = model.config.identification.model_copy(update={"friction": shape})
    config = model.config.model_copy(update={"identification": options})
    velocity = 0.1 if shape.stribeck_velocity == "fit" else shape.stribeck_velocity
    joints = model.chain.joints
    if "stribeck" not in model.layout.terms:
        return replace(model, config=config)
    velocities = tuple(float(v) for v in np.broadcast_to(np.asarray(velocity), (joints,)))
    return replace(model, config=config, layout=replace(model.layout, stribeck_velocity=velocities))


def friction_trials(recordings: Sequence[Recording], model: ArmModel, base: BaseParameters) -> FrictionTrials:
    """Read recordings for trials of friction, on fewer rows than the estimate has.

    Raises:
        RecordingError: a recording cannot be used.
    """
    return FrictionTrials(recordings, _thinned(model, recordings), base)


def to_be_fitted(model: ArmModel) -> tuple[str, ...]:
    """Return the names of the friction numbers that are left to be fitted and apply to this arm."""
    shape, terms = model.config.identification.friction, set(model.layout.terms)
    if not {"coulomb", "stribeck"} & terms:
        return ()
    return tuple(
        key for key in _GRIDS if getattr(shape, key) == "fit" and (key != "stribeck_velocity" or "stribeck" in terms)
    )


def searched(key: str) -> float:
    """Give the standard deviation of a number's logarithm if any value that is searched were as likely."""
    grid = _GRIDS[key][_GRIDS[key] > 0.0]
    return float(np.log(grid[-1] / grid[0]) / np.sqrt(12.0))


def fit_friction(
    trials: FrictionTrials | None, model: ArmModel, base: BaseParameters, conditions: FeasibleSet | None = None
) -> tuple[ArmModel, tuple[Choice, ...]]:
    """Fit every number that the configuration leaves to be fitted.

    Args:
        trials: of the recordings that are fitted to; None is for where nothing is to be fitted.
        model: the arm; `identification.friction` says what to fit.
        base: grouping of its parameters, which these numbers do not change.
        conditions: that choices are judged under; nothing is chosen when None.

    Returns:
        The arm with its numbers, and for each kind whether it was fitted or left out.
    """
    shape = model.config.identification.friction
    wanted = to_be_fitted(model)
    joints = model.chain.joints
    values = {
        key: np.full(joints, 0.1 if key == "stribeck_velocity" else 0.0)
        if getattr(shape, key) == "fit"
        else np.broadcast_to(np.asarray(getattr(shape, key), dtype=float), (joints,)).copy()
        for key in _GRIDS
    }
    choices: list[Choice] = []
    if wanted and trials is not None:
        search = _Search(trials, model, base)
        found = [
            search.finer(start, wanted) for start in (search.in_turn(values, wanted), search.pairs(values, wanted))
        ]
        start, values = values, search.nearer(search.best(values, found, predicting=True), wanted)
        if conditions is not None:
            values, choices = search.chosen(start, values, wanted, conditions)
    return with_friction(model, _shape(values)), tuple(choices)


def at_the_edge(shape: FrictionShape, joints: Sequence[str], terms: Sequence[str]) -> tuple[str, ...]:
    """Describe the fitted numbers that lie at an end of the search: the true value may lie beyond, or not exist.

    Args:
        shape: fitted.
        joints: their names.
        terms: of the model's joints; without Stribeck friction its velocity means nothing.
    """
    found = []
    for key, what in (("presliding", "pre-sliding distance"), ("stribeck_velocity", "Stribeck velocity")):
        if key == "stribeck_velocity" and "stribeck" not in terms:
            continue
        grid = _GRIDS[key]
        for name, value in zip(joints, np.broadcast_to(np.asarray(getattr(shape, key)), len(joints)), strict=True):
            if value >= grid[-1] or (_NONE[key] < value <= grid[0]):
                edge = "largest" if value >= grid[-1] else "smallest"
                found.append(f"{name}: its {what} of {value:g} is the {edge} that is searched")
    return tuple(found)


_Numbers = dict[str, Array]


@dataclass(frozen=True)
class _Search:
    trials: FrictionTrials
    model: ArmModel
    base: BaseParameters

    def in_turn(self, values: _Numbers, wanted: Sequence[str]) -> _Numbers:
        """Search one number after the other over its whole grid."""
        for key in wanted:
            trials = [{key: np.full(self.model.chain.joints, value)} for value in _GRIDS[key]]
            values = self.best(values, trials)
        return values

    def pairs(self, values: _Numbers, wanted: Sequence[str]) -> _Numbers:
        """Search every combination of the grids' values."""
        joints = self.model.chain.joints
        grids = product(*(_GRIDS[key].tolist() for key in wanted))
        return self.best(
            values,
            [{key: np.full(joints, value) for key, value in zip(wanted, pair, strict=True)} for pair in grids],
        )

    def finer(self, values: _Numbers, wanted: Sequence[str]) -> _Numbers:
        """Search around the values, inside the grids."""
        for key in [*wanted] * _ROUNDS:
            values = self._around(values, key, _FINER, np.ones_like(values[key], dtype=bool))
        return values

    def nearer(self, values: _Numbers, wanted: Sequence[str]) -> _Numbers:
        """Closer and closer around values that the finer steps have found; what is at the edge stays, and is said."""
        inside = {key: (values[key] > _GRIDS[key][0]) & (values[key] < _GRIDS[key][-1]) for key in wanted}
        for factors in _NEARER:
            for key in [*wanted] * _ROUNDS:
                values = self._around(values, key, factors, inside[key])
        return values

    def _around(self, values: _Numbers, key: str, factors: Array, moving: NDArray[np.bool_]) -> _Numbers:
        low, high = _GRIDS[key][0], _GRIDS[key][-1]
        trials = [np.where(moving, np.clip(values[key] * factor, low, high), values[key]) for factor in factors]
        return self.best(values, [{key: trial} for trial in trials])

    def best(self, values: _Numbers, trials: Sequence[_Numbers], *, predicting: bool = False) -> _Numbers:
        """Return, per drive, the trial that leaves its joint the smallest residual, or predicts its torque best."""
        # All trials use the joint weights of the best values so far.
        weights = self._moments(values)[0].weights()
        terms = _own_terms(self.model, self.base)
        left = []
        for trial in trials:
            (total,) = self._moments(values | trial)
            beta = total.solved(weights)
            left.append(
                _unpredicted(self._moments(values | trial, self.trials.thirds), beta, terms)
                if predicting
                else total.squared_residuals(beta)
            )
        choice = np.argmin(np.array(left), axis=0)
        return values | {
            key: np.array([trials[index][key][drive] for drive, index in enumerate(choice)]) for key in trials[0]
        }

    def chosen(
        self, start: _Numbers, fitted: _Numbers, wanted: Sequence[str], conditions: FeasibleSet
    ) -> tuple[_Numbers, list[Choice]]:
        """Leave out each kind, refit the others, and keep it out where held-out thirds are clearly better without."""
        values, choices = fitted, []
        gathered = self._equations(fitted)
        shares = standstill_shares(gathered)
        weights = weighted_least_squares(gathered.with_near(shares).total).weights
        for key in wanted:
            if np.all(values[key] <= _NONE[key]):
                continue
            without = start | {key: np.full_like(values[key], _NONE[key])}
            others = [other for other in wanted if other != key and not np.all(values[other] <= _NONE[other])]
            without = self.finer(self.in_turn(without, others), others)
            errors = {
                name: held_out_thirds(self._equations(way).with_near(shares).blocks, weights, self.base, conditions)
                for name, way in (("fit", values), ("none", without))
            }
            choices.append(clearly_chosen(f"friction.{key}", errors))
            values = values if choices[-1].value == "fit" else without
        return values, choices

    def _equations(self, values: _Numbers) -> Equations:
        return self.trials.equations(values["presliding"], values["stribeck_velocity"])

    def _moments(self, values: _Numbers, parts: Sequence[slice] | None = None) -> list[Moments]:
        return self.trials.moments(values["presliding"], values["stribeck_velocity"], parts)


def _own_terms(model: ArmModel, base: BaseParameters) -> NDArray[np.bool_]:
    """Return whether each base parameter is a joint term, shape (base,)."""
    return np.asarray(base.base % model.layout.per_link >= len(INERTIAL))


def _unpredicted(thirds: Sequence[Moments], beta: Array, terms: NDArray[np.bool_]) -> Array:
    """Return per joint the squared errors of each third as predicted from the other two, shape (joints,)."""
    total = np.zeros(len(thirds[0].products))
    for joint, support in enumerate(thirds[0].supports):
        own = np.flatnonzero(terms[support])
        # Columns: the joint's own terms, and the torque less the prediction of all other parameters.
        rest = np.zeros((len(support) + 1, len(own) + 1))
        rest[own, np.arange(len(own))] = 1.0
        rest[:-1, -1] = np.where(terms[support], 0.0, -beta[support])
        rest[-1, -1] = 1.0
        left = [rest.T @ third.products[joint] @ rest for third in thirds]
        for number, unseen in enumerate(left):
            told = np.sum([other for place, other in enumerate(left) if place != number], axis=0)
            error = np.append(-ridge(told[:-1, :-1], told[:-1, -1]), 1.0)
            total[joint] += max(float(error @ unseen @ error), 0.0)
    return total


def _shape(values: dict[str, Array]) -> FrictionShape:
    return FrictionShape(
        presliding=tuple(float(value) for value in values["presliding"]),
        stribeck_velocity=tuple(float(value) for value in values["stribeck_velocity"]),
    )


def _thinned(model: ArmModel, recordings: Sequence[Recording]) -> ArmModel:
    options = model.config.identification
    first = next(iter(recordings[0].blocks()), None)
    period = 1e-3 if first is None else float(np.median(np.diff(first.stamp_ns))) * 1e-9
    step = max(int(options.smoothing.decimate), int(1.0 / (_RATE * period)))
    smoothing = options.smoothing.model_copy(update={"decimate": step})
    config = model.config.model_copy(update={"identification": options.model_copy(update={"smoothing": smoothing})})
    return replace(model, config=config)
