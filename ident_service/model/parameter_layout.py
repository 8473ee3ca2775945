"""Order, name and unit the link parameters delta (eqs. 12, 13, 27, 28) and the terms of drives.

Per link k: `Lxx Lxy Lxz Lyy Lyz Lzz lx ly lz m`, then the joint terms the model has, in the order `Ia fv fc fo` and,
beyond eq. 27, `fs` (Stribeck), `fq` (quadratic) and `fa` (viscous asymmetry; an asymmetric Coulomb friction is `fo`):

    f = fv dq + fc s + fo + fs s exp(-(dq / v_s)^2) + fq dq |dq| + fa |dq|

with s the direction of motion, sign(dq) or what smoothing makes of it near standstill.

A drive whose coordinate is `d = c q` of one joint alone, with inertia Ia, viscous fv and Coulomb friction fc on its own
side, adds to that joint the inertia `c^2 Ia`, the damping `c^2 fv` and the dry friction `|c| fc`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ident_service.certificate_verifier import INERTIAL as INERTIAL
from ident_service.config.arm import JointTerm
from ident_service.config.quantities import ParameterTable
from ident_service.errors import ParameterError
from ident_service.model.chain import Array, Chain

TERM_SYMBOLS: dict[JointTerm, str] = {
    "drive_inertia": "Ia",
    "viscous": "fv",
    "coulomb": "fc",
    "offset": "fo",
    "stribeck": "fs",
    "quadratic": "fq",
    "viscous_asymmetry": "fa",
}
_TERM_ORDER: tuple[JointTerm, ...] = tuple(TERM_SYMBOLS)
# [rad/s or m/s] With this velocity there is no Stribeck friction.
NO_STRIBECK = 1e-6
INERTIAL_UNITS = ("kg m^2",) * 6 + ("kg m",) * 3 + ("kg",)
"""Units of the ten inertial parameters of a link."""
_REVOLUTE_UNITS = {
    "Ia": "kg m^2",
    "fv": "N m s/rad",
    "fc": "N m",
    "fo": "N m",
    "fs": "N m",
    "fq": "N m s^2/rad^2",
    "fa": "N m s/rad",
}
_PRISMATIC_UNITS = {"Ia": "kg", "fv": "N s/m", "fc": "N", "fo": "N", "fs": "N", "fq": "N s^2/m^2", "fa": "N s/m"}


def inertia_matrix(parameters: Array) -> Array:
    """Return the inertia of a body about its frame's origin [kg m^2], shape (3, 3), of its parameters of eq. 13."""
    xx, xy, xz, yy, yz, zz, *_ = parameters
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def body_parameters(inertia: Array, first_moment: Array, mass: float) -> Array:
    """Return a body's ten parameters (eq. 13), shape (10,), from inertia about its origin, first moment m c and mass.

    Args:
        inertia: inertia about the frame's origin [kg m^2], shape (3, 3).
        first_moment: mass times centre of mass [kg m], shape (3,).
        mass: mass of the body [kg].
    """
    return np.array([*inertia[np.triu_indices(3)], *first_moment, mass])


def pseudo_inertia(parameters: Array) -> Array:
    """Return the pseudo-inertia matrix of a body, shape (4, 4); positive definite for real bodies.

    Args:
        parameters: of eq. 13, shape (10,).
    """
    L, J = inertia_matrix(parameters), np.zeros((4, 4))
    J[:3, :3] = 0.5 * np.trace(L) * np.eye(3) - L
    J[:3, 3] = J[3, :3] = parameters[6:9]
    J[3, 3] = parameters[9]
    return J


def from_pseudo_inertia(J: Array) -> Array:
    """Return a body's parameters (eq. 13), shape (10,), from its pseudo-inertia, shape (4, 4)."""
    return body_parameters(np.trace(J[:3, :3]) * np.eye(3) - J[:3, :3], J[:3, 3], J[3, 3])


def about_center(parameters: Array) -> tuple[float, Array, Array]:
    """Return mass [kg], centre of mass [m], (3,), and inertia about it [kg m^2], (3, 3), of a body.

    Args:
        parameters: of eq. 13, shape (10,), with a nonzero mass.
    """
    m = parameters[9]
    center = parameters[6:9] / m
    about_origin = inertia_matrix(parameters)
    return float(m), center, about_origin - m * (center @ center * np.eye(3) - np.outer(center, center))


@dataclass(frozen=True)
class Layout:
    """Order of the link parameters in delta.

    Attributes:
        revolute: per joint, True where it turns and False where it slides.
        terms: joint terms of the model, in the order of the conventions.
        stribeck_velocity: v_s per joint [rad/s or m/s]; needed where the model has the term.
    """

    revolute: tuple[bool, ...]
    terms: tuple[JointTerm, ...]
    stribeck_velocity: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "terms", tuple(term for term in _TERM_ORDER if term in self.terms))
        if "stribeck" in self.terms and len(self.stribeck_velocity) != len(self.revolute):
            raise ParameterError(f"{len(self.stribeck_velocity)} Stribeck velocities for {len(self.revolute)} joints")

    @property
    def joints(self) -> int:
        """Return the number of joints, which is the number of links."""
        return len(self.revolute)

    @property
    def per_link(self) -> int:
        """Return the number of parameters of one link."""
        return len(INERTIAL) + len(self.terms)

    @property
    def size(self) -> int:
        """Return the number of link parameters of the whole arm, n in the paper."""
        return self.per_link * self.joints

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Return the names of all link parameters, `Lxx1 ... foN`, in the order of delta."""
        symbols = INERTIAL + tuple(TERM_SYMBOLS[term] for term in self.terms)
        return tuple(f"{symbol}{link}" for link in range(1, self.joints + 1) for symbol in symbols)

    @cached_property
    def units(self) -> tuple[str, ...]:
        """Return the unit of each link parameter, in the order of delta."""
        units: list[str] = []
        for revolute in self.revolute:
            table = _REVOLUTE_UNITS if revolute else _PRISMATIC_UNITS
            units += [*INERTIAL_UNITS, *(table[TERM_SYMBOLS[term]] for term in self.terms)]
        return tuple(units)

    def inertial(self, link: int) -> slice:
        """Return the slice of the link parameters with the ten inertial ones of `link` (counted from 0)."""
        start = link * self.per_link
        return slice(start, start + len(INERTIAL))

    def term_columns(self, term: JointTerm) -> NDArray[np.intp]:
        """Return the indices in delta of one joint term, shape (joints,); empty where the model has no such term."""
        if term not in self.terms:
            return np.zeros(0, dtype=np.intp)
        return np.arange(self.joints) * self.per_link + len(INERTIAL) + self.terms.index(term)

    def term_values(self, term: JointTerm, delta: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return one joint term's values in link parameters `delta`, shape (joints,); zero if the model lacks it."""
        columns = self.term_columns(term)
        return delta[columns] if len(columns) else np.zeros(self.joints)

    def vector(self, named_values: ParameterTable) -> NDArray[np.float64]:
        """Return the link parameters delta from named values, shape (size,); names that are not given are zero.

        Raises:
            ParameterError: names that this arm does not have.
        """
        index = {name: column for column, name in enumerate(self.names)}
        if unknown := [name for name in named_values.names if name not in index]:
            raise ParameterError(
                f"parameters this arm does not have: {', '.join(unknown)}; it has {self.names[0]} ... {self.names[-1]}"
            )
        delta = np.zeros(self.size)
        for name, value in zip(named_values.names, named_values.values, strict=True):
            delta[index[name]] = value
        return delta


JOINT_TERMS: tuple[JointTerm, ...] = ("drive_inertia", "viscous", "coulomb")


@dataclass(frozen=True)
class JointDrives:
    """Effect of each joint's own drive; zero where a joint shares drives with other joints.

    Attributes:
        own: mask of the joints with a drive that moves no other joint, and no further drive, shape (joints,).
        armature: [kg m^2 or kg], shape (joints,).
        damping: [N m s/rad or N s/m], shape (joints,).
        friction: dry friction [N m or N], shape (joints,).
    """

    own: NDArray[np.bool_]
    armature: Array
    damping: Array
    friction: Array

    def of(self, term: JointTerm) -> Array:
        """Return `drive_inertia`, `viscous` or `coulomb` of each joint's own drive, zero if shared, shape (joints,)."""
        return {"drive_inertia": self.armature, "viscous": self.damping, "coulomb": self.friction}[term]


def own_drives(chain: Chain) -> NDArray[np.bool_]:
    """Return a mask of the joints moved by one drive alone that moves no other joint, shape (joints,)."""
    shared = (chain.coupling != 0.0) & ~np.eye(chain.joints, dtype=bool)
    return np.asarray(~(shared.any(axis=0) | shared.any(axis=1)))


def joint_drives(chain: Chain, layout: Layout, delta: Array) -> JointDrives:
    """Return inertia, damping and dry friction, of link parameters `delta`, of each joint's own drive; zero for shared.

    Args:
        chain: the mechanism.
        layout: order of the parameters.
        delta: link parameters, shape (layout.size,).
    """
    own = own_drives(chain)
    gear = np.where(own, np.diag(chain.coupling), 0.0)
    inertia, viscous, coulomb = (layout.term_values(term, delta) for term in JOINT_TERMS)
    return JointDrives(own, gear**2 * inertia, gear**2 * viscous, np.abs(gear) * coulomb)


@dataclass(frozen=True)
class WrittenArm:
    """Arm as read from a file, joints in the file's order.

    Attributes:
        chain: the mechanism; link frames are joint frames.
        bodies: the ten inertial parameters per link (eq. 13), shape (joints, 10).
        armature: [kg m^2 or kg], shape (joints,).
        damping: [N m s/rad or N s/m], shape (joints,).
        friction: dry friction [N m or N], shape (joints,).
    """

    chain: Chain
    bodies: Array
    armature: Array
    damping: Array
    friction: Array
