"""Define names, order and units of the link parameters delta (eqs. 12, 13, 27, 28).

Per link k: `Lxx Lxy Lxz Lyy Lyz Lzz lx ly lz m`, then the joint terms the model has, in the order `Ia fv fc fo` and,
beyond eq. 27, `fs` (Stribeck), `fq` (quadratic) and `fa` (viscous asymmetry; an asymmetric Coulomb friction is `fo`):

    f = fv dq + fc s + fo + fs s exp(-(dq / v_s)^2) + fq dq |dq| + fa |dq|

with s the direction of motion, sign(dq) or what smoothing makes of it near standstill.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ident_service.certificate_verifier import INERTIAL as INERTIAL
from ident_service.config.quantities import ParameterTable
from ident_service.config.schema import JointTerm
from ident_service.errors import ParameterError

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
# [rad/s or m/s] At any speed that is ever recorded nothing is left of Stribeck friction with this velocity.
NO_STRIBECK = 1e-6
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
        """Return the number of parameters of the arm, n in the paper."""
        return self.per_link * self.joints

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Return all names, `Lxx1 ... foN`."""
        symbols = INERTIAL + tuple(TERM_SYMBOLS[term] for term in self.terms)
        return tuple(f"{symbol}{link}" for link in range(1, self.joints + 1) for symbol in symbols)

    @cached_property
    def units(self) -> tuple[str, ...]:
        """Return the unit of each parameter."""
        inertial = ("kg m^2",) * 6 + ("kg m",) * 3 + ("kg",)
        units: list[str] = []
        for revolute in self.revolute:
            table = _REVOLUTE_UNITS if revolute else _PRISMATIC_UNITS
            units += [*inertial, *(table[TERM_SYMBOLS[term]] for term in self.terms)]
        return tuple(units)

    def inertial(self, link: int) -> slice:
        """Return the columns of the ten inertial parameters of `link` (counted from 0)."""
        start = link * self.per_link
        return slice(start, start + len(INERTIAL))

    def term_columns(self, term: JointTerm) -> NDArray[np.intp]:
        """Return the columns of one joint term, shape (joints,), or empty where the model has no such term."""
        if term not in self.terms:
            return np.zeros(0, dtype=np.intp)
        return np.arange(self.joints) * self.per_link + len(INERTIAL) + self.terms.index(term)

    def term_values(self, term: JointTerm, delta: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the values of one joint term in `delta`, shape (joints,), zero where the model has no such term."""
        columns = self.term_columns(term)
        return delta[columns] if len(columns) else np.zeros(self.joints)

    def vector(self, table: ParameterTable) -> NDArray[np.float64]:
        """Return delta from named values, shape (size,); names that are not given are zero.

        Raises:
            ParameterError: names that this arm does not have.
        """
        index = {name: column for column, name in enumerate(self.names)}
        if unknown := [name for name in table.names if name not in index]:
            raise ParameterError(
                f"parameters this arm does not have: {', '.join(unknown)}; it has {self.names[0]} ... {self.names[-1]}"
            )
        delta = np.zeros(self.size)
        for name, value in zip(table.names, table.values, strict=True):
            delta[index[name]] = value
        return delta
