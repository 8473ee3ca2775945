"""The set of parameters that a real body could have, as a list of named blocks (3.1 to 3.3).

Each block is an affine map of delta into symmetric matrices or numbers that must be positive:

- `inertia`, the paper's: D_k(delta_k) of eq. 17, equivalent to m > 0 and I > 0 about the centre of mass;
- `pseudo_inertia`, stricter: the 4x4 matrix [[tr(L)/2 1 - L, l], [l^T, m]] > 0, equivalent to a mass distribution
  that has these moments (Wensing, Kim and Slotine 2018); it adds the triangle inequalities;
- bounds of masses and centres of mass (eqs. 25, 26) and positive joint terms (eq. 28), from the arm's configuration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ident_service.config.schema import ArmConfig, FeasibleSetName
from ident_service.estimation.conic import triangle_entries
from ident_service.model.chain import Array
from ident_service.model.layout import INERTIAL, TERM_SYMBOLS

SetName = FeasibleSetName | Literal["none"]


@dataclass(frozen=True)
class Block:
    """One condition on delta.

    Attributes:
        name: what it says, for people.
        size: rows of the symmetric matrix; 0 for a list of numbers.
        F: affine map, shape (entries, parameters); entries of a matrix are its upper triangle, column by column.
        f: constant part, shape (entries,).
    """

    name: str
    size: int
    F: Array
    f: Array

    def smallest(self, delta: Array) -> float:
        """Smallest eigenvalue, or smallest number, of the block at `delta`."""
        entries = self.F @ delta + self.f
        if self.size == 0:
            return float(entries.min())
        return float(np.linalg.eigvalsh(symmetric(entries, self.size))[0])

    def identity(self) -> Array:
        """Entries of the identity matrix (or of ones), shape (entries,)."""
        if self.size == 0:
            return np.ones(len(self.f))
        return np.array([1.0 if i == j else 0.0 for i, j in triangle_entries(self.size)])


@dataclass(frozen=True)
class FeasibleSet:
    """All conditions on delta, in the order of `names`."""

    kind: FeasibleSetName
    names: tuple[str, ...]
    blocks: tuple[Block, ...]

    def margin(self, delta: Array) -> tuple[float, str]:
        """The smallest eigenvalue of all blocks and the block it belongs to; positive inside the set."""
        return min((block.smallest(delta), block.name) for block in self.blocks)


def symmetric(entries: Array, size: int) -> Array:
    """The symmetric matrix with this upper triangle."""
    matrix = np.zeros((size, size))
    for value, (i, j) in zip(entries, triangle_entries(size), strict=True):
        matrix[i, j] = matrix[j, i] = value
    return matrix


def feasible_set(kind: FeasibleSetName, names: Sequence[str], config: ArmConfig | None = None) -> FeasibleSet:
    """The feasible set of an arm, or of a bare table of parameters.

    Args:
        kind: which condition on inertias.
        names: link parameters in the order of delta; every link has all ten of eq. 13.
        config: where mass, centre-of-mass and sign conditions come from; none of them without it.
    """
    index = {name: column for column, name in enumerate(names)}
    links = sorted({int(name[1:]) for name in names if name.startswith("m") and name[1:].isdigit()})
    build = _inertia if kind == "inertia" else _pseudo_inertia
    blocks = [build(link, index) for link in links]
    if config is not None:
        blocks += _masses(config, links, index)
        blocks += _centers_of_mass(config, links, index)
        blocks += _signs(config, links, index)
    return FeasibleSet(kind, tuple(names), tuple(blocks))


def _matrix_block(name: str, rows: list[list[dict[str, float]]], index: dict[str, int]) -> Block:
    size = len(rows)
    F = np.zeros((size * (size + 1) // 2, len(index)))
    for entry, (i, j) in enumerate(triangle_entries(size)):
        for parameter, coefficient in rows[i][j].items():
            F[entry, index[parameter]] += coefficient
    return Block(name, size, F, np.zeros(len(F)))


def _inertia(link: int, index: dict[str, int]) -> Block:
    xx, xy, xz, yy, yz, zz, lx, ly, lz, m = ({f"{symbol}{link}": 1.0} for symbol in INERTIAL)
    neg = {key: dict.fromkeys(value, -1.0) for key, value in (("x", lx), ("y", ly), ("z", lz))}
    o: dict[str, float] = {}
    rows = [
        [xx, xy, xz, o, neg["z"], ly],
        [xy, yy, yz, lz, o, neg["x"]],
        [xz, yz, zz, neg["y"], lx, o],
        [o, lz, neg["y"], m, o, o],
        [neg["z"], o, lx, o, m, o],
        [ly, neg["x"], o, o, o, m],
    ]
    return _matrix_block(f"link {link}: mass and inertia positive", rows, index)


def _pseudo_inertia(link: int, index: dict[str, int]) -> Block:
    def half(plus: tuple[str, str], minus: str) -> dict[str, float]:
        return {f"L{plus[0]}{link}": 0.5, f"L{plus[1]}{link}": 0.5, f"L{minus}{link}": -0.5}

    def off(axes: str) -> dict[str, float]:
        return {f"L{axes}{link}": -1.0}

    lx, ly, lz, m = ({f"{symbol}{link}": 1.0} for symbol in ("lx", "ly", "lz", "m"))
    rows = [
        [half(("yy", "zz"), "xx"), off("xy"), off("xz"), lx],
        [off("xy"), half(("xx", "zz"), "yy"), off("yz"), ly],
        [off("xz"), off("yz"), half(("xx", "yy"), "zz"), lz],
        [lx, ly, lz, m],
    ]
    return _matrix_block(f"link {link}: a mass distribution exists", rows, index)


def _linear(name: str, rows: Sequence[tuple[dict[str, float], float]], index: dict[str, int]) -> Block:
    F = np.zeros((len(rows), len(index)))
    for entry, (row, _) in enumerate(rows):
        for parameter, coefficient in row.items():
            F[entry, index[parameter]] = coefficient
    return Block(name, 0, F, np.array([constant for _, constant in rows]))


def _masses(config: ArmConfig, links: Sequence[int], index: dict[str, int]) -> list[Block]:
    blocks = []
    for link, joint in zip(links, config.joints.values(), strict=False):
        if joint.body.mass is not None:
            lower, upper = joint.body.mass
            rows = [({f"m{link}": 1.0}, -lower), ({f"m{link}": -1.0}, upper)]
            blocks.append(_linear(f"link {link}: mass within {lower:g}..{upper:g} kg", rows, index))
    total = config.constraints.total_mass
    if total.lower > 0.0:
        blocks.append(
            _linear(f"total mass at least {total.lower:g} kg", [({f"m{k}": 1.0 for k in links}, -total.lower)], index)
        )
    if total.upper is not None:
        blocks.append(
            _linear(f"total mass at most {total.upper:g} kg", [({f"m{k}": -1.0 for k in links}, total.upper)], index)
        )
    return blocks


def _centers_of_mass(config: ArmConfig, links: Sequence[int], index: dict[str, int]) -> list[Block]:
    blocks = []
    for link, joint in zip(links, config.joints.values(), strict=False):
        box = joint.body.center_of_mass
        if box is None:
            continue
        rows: list[tuple[dict[str, float], float]] = []
        for axis, lower, upper in zip("xyz", box.lower, box.upper, strict=True):
            rows.append(({f"l{axis}{link}": 1.0, f"m{link}": -lower}, 0.0))
            rows.append(({f"l{axis}{link}": -1.0, f"m{link}": upper}, 0.0))
        blocks.append(_linear(f"link {link}: centre of mass inside its box", rows, index))
    return blocks


def _signs(config: ArmConfig, links: Sequence[int], index: dict[str, int]) -> list[Block]:
    blocks = []
    for term in config.constraints.positive:
        for link in links:
            name = f"{TERM_SYMBOLS[term]}{link}"
            if name in index:
                blocks.append(_linear(f"joint {link}: {term.replace('_', ' ')} positive", [({name: 1.0}, 0.0)], index))
    return blocks
