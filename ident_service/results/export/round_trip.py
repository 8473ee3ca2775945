"""Check that an export, read back, predicts the torques of the parameters on random states."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident_service.config.arm import JointTerm
from ident_service.errors import ModelError
from ident_service.model.arm_model import ArmModel
from ident_service.model.base_parameters import BaseParameters
from ident_service.model.chain import Array
from ident_service.model.friction_state import presliding_distances
from ident_service.model.information import Information
from ident_service.model.parameter_layout import JOINT_TERMS, TERM_SYMBOLS, Layout, WrittenArm, joint_drives
from ident_service.model.regressor import joint_regressor

AGREEMENT = 1e-9
"""Largest difference of two torques that are the same, relative to the largest torque of all states."""
_STATES = 40
_SEED = 19990101

Carried = Mapping[JointTerm, NDArray[np.bool_]]
"""By joint term, the joints whose values a file carries, shape (joints,)."""
States = tuple[Array, Array, Array]


def random_states(joints: int) -> States:
    """Return position, velocity and acceleration, always the same ones, each of shape (states, joints)."""
    rng = np.random.default_rng(_SEED)
    position, velocity, acceleration = rng.uniform(-3.0, 3.0, size=(3, _STATES, joints))
    velocity[::4] *= 0.02  # where the friction of slow motion differs from that of fast
    return position, velocity, acceleration


def gravity_of(model: ArmModel) -> tuple[float, float, float]:
    """Return gravity in the base frame [m/s^2]."""
    x, y, z = (float(component) for component in model.chain.gravity)
    return x, y, z


def disagreement(computed: Array, expected: Array) -> float:
    """Return the largest |computed - expected| over the largest |expected|; infinite unless all computed are finite."""
    if not np.all(np.isfinite(computed)):
        return np.inf
    return float(np.abs(computed - expected).max() / max(np.abs(expected).max(), np.finfo(float).tiny))


def torque(model: ArmModel, delta: Array, states: States) -> Array:
    """Return the torque of link parameters `delta` at some states [N m or N], shape (samples, joints) as the states."""
    return np.asarray(np.einsum("jps,p->sj", joint_regressor(model.chain, model.layout, *states), delta))


def with_terms(model: ArmModel, delta: Array, kept_terms: Collection[JointTerm]) -> Array:
    """Return a copy of the link parameters in which the joint terms outside `kept_terms` are zero."""
    kept, layout = np.array(delta, dtype=float), model.layout
    for term in layout.terms:
        if term not in kept_terms:
            kept[layout.term_columns(term)] = 0.0
    return kept


def supported_terms(model: ArmModel, delta: Array, format_terms: Collection[JointTerm]) -> Carried:
    """Map each joint term of a format to a mask of the joints whose value it can hold: not negative, with own drive."""
    drives = joint_drives(model.chain, model.layout, delta)
    known = [term for term in JOINT_TERMS if term in format_terms and term in model.layout.terms]
    return {term: drives.own & (drives.of(term) >= 0.0) for term in known}


def require_same_torques(
    model: ArmModel, delta: Array, read_back: WrittenArm, carried: Carried, file_name: str
) -> None:
    """Raise ModelError unless an arm read from a file predicts the parameters' torques, in the terms that it carries.

    Args:
        model: the arm.
        delta: link parameters, shape (layout.size,).
        read_back: arm that was read back.
        carried: terms that the file carries.
        file_name: name of the file.

    Raises:
        ModelError: other joints, or other torques.
    """
    refused = f"{file_name}: what is read back differs from the parameters"
    if sorted(read_back.chain.names) != sorted(model.chain.names):
        raise ModelError(f"{refused}: its joints are {', '.join(read_back.chain.names)}; it was not written")
    order = [read_back.chain.names.index(joint) for joint in model.chain.names]
    layout = Layout(read_back.chain.revolute, JOINT_TERMS)
    values = np.zeros((layout.joints, layout.per_link))
    values[:, :10] = read_back.bodies
    states = position, velocity, acceleration = random_states(model.chain.joints)
    shape: dict[JointTerm, Array] = {"drive_inertia": acceleration, "viscous": velocity, "coulomb": np.sign(velocity)}
    found = dict(zip(JOINT_TERMS, (read_back.armature, read_back.damping, read_back.friction), strict=True))
    drives = joint_drives(model.chain, model.layout, delta)
    meant = torque(model, with_terms(model, delta, ()), states)
    for place, term in enumerate(JOINT_TERMS):
        if term in carried:
            values[order, 10 + place] = np.where(carried[term], found[term][order], 0.0)
            meant = meant + np.where(carried[term], drives.of(term), 0.0) * shape[term]
    back = np.argsort(order)  # from our order to the file's
    H = joint_regressor(read_back.chain, layout, position[:, back], velocity[:, back], acceleration[:, back])
    predicted = np.einsum("jps,p->sj", H, values.ravel())[:, order]
    if not (apart := disagreement(predicted, meant)) <= AGREEMENT:
        raise ModelError(f"{refused}: torques are up to {apart:.1e} of the largest apart; it was not written")


_WORDS: dict[JointTerm, str] = {
    "drive_inertia": "drive inertia",
    "viscous": "viscous friction",
    "coulomb": "Coulomb friction",
    "offset": "torque offset",
    "stribeck": "Stribeck friction",
    "quadratic": "quadratic friction",
    "viscous_asymmetry": "viscous asymmetry",
}


_TOLD = 1e-3  # share of the joint's own torque below which nothing is told


@dataclass(frozen=True)
class RecordedMotion:
    """Motion that an arm was identified from, by which the torque of what a file does not carry is measured.

    Attributes:
        base: the grouping of the parameters.
        information: information of the equations on the base parameters.
        rows: sum of the squared weights of each joint's rows, shape (joints,).
    """

    base: BaseParameters
    information: Information
    rows: Array

    def torque(self, delta: Array) -> Array:
        """Return the torque of link parameters over the motion, root mean square per joint [N m or N], (joints,).

        Args:
            delta: link parameters, zero where they do not count, shape (layout.size,).
        """
        beta, known = self.base.K @ delta, self.information
        sums = [
            float(np.linalg.norm(factor[:, :-1] @ beta[support])) ** 2
            for support, factor in zip(known.supports, known.factors, strict=True)
        ]
        return np.asarray(np.sqrt(np.array(sums) / np.maximum(self.rows, 1.0)))

    def in_words(self, model: ArmModel, lost_delta: Array) -> str:
        """Describe the torque of link parameters that are lost, at each joint where it counts, the largest first."""
        torques = self.torque(lost_delta)
        own = np.sqrt(self.information.squared_torques() / np.maximum(self.rows, 1.0))
        told = torques > _TOLD * own
        units = ["N m" if turns else "N" for turns in model.chain.revolute]
        largest = [k for k in np.argsort(-torques, kind="stable") if told[k]]
        shown = ", ".join(f"{torques[k]:.2g} {units[k]} at {model.chain.names[k]}" for k in largest)
        less = ", less elsewhere" if (torques[~told] > 0.0).any() else ""
        return f"{shown or 'no torque'}{less}; rms over the recorded motion, weighted as in the fit"


def unsupported_terms(
    model: ArmModel, delta: Array, carried: Carried, motion: RecordedMotion | None = None
) -> tuple[str, ...]:
    """Return, in words, pre-sliding and the joint terms with a value that a file does not carry, with torque if known.

    Args:
        model: the arm.
        delta: link parameters, shape (layout.size,).
        carried: terms that the file carries.
        motion: motion that the arm was identified from; None where it is not known.
    """
    found = []
    for term in model.layout.terms:
        values = model.layout.term_values(term, delta)
        missing = (values != 0.0) & ~carried.get(term, np.zeros(model.chain.joints, dtype=bool))
        if missing.any():
            joints = "every joint" if missing.all() else ", ".join(np.array(model.chain.names)[missing])
            lost = np.zeros(model.layout.size)
            lost[model.layout.term_columns(term)] = np.where(missing, values, 0.0)
            size = "" if motion is None else f": {motion.in_words(model, lost)}"
            found.append(f"{_WORDS[term]} ({TERM_SYMBOLS[term]}) of {joints}{size}")
    return (*found, *presliding_left_out(model, delta))


def presliding_left_out(model: ArmModel, delta: Array) -> tuple[str, ...]:
    """Describe in one sentence the pre-sliding that a format without friction state leaves out; empty without any.

    Args:
        model: the arm.
        delta: link parameters, shape (layout.size,).
    """
    layout, ways = model.layout, presliding_distances(model)
    dry = [layout.term_values(term, delta) for term in ("coulomb", "stribeck") if term in layout.terms]
    slides = [
        (name, way, turns, 2.0 * abs(sum(values)))
        for name, way, turns, *values in zip(model.chain.names, ways, model.chain.revolute, *dry, strict=True)
        if way > 0.0 and any(values)
    ]
    if not slides:
        return ()
    said = ", ".join(f"{name} {way:.3g} {'rad' if turns else 'm'}" for name, way, turns, _ in slides)
    # Torques of drives: with a differential, several joints feel them.
    sizes = ", ".join(f"{twice:.2g} {'N m' if turns else 'N'} at {name}" for name, _, turns, twice in slides)
    return (
        f"pre-sliding of dry friction (distance: {said}): here it reverses at once, and torques after a "
        f"reversal differ by up to twice the dry friction ({sizes}); the torque errors of the report are with "
        "pre-sliding",
    )
