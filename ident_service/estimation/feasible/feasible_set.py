"""Describe the set of parameters that a real body could have as named conditions: affine maps of delta into cones.

Margins in SI units mix kg, kg m^2 and N m. Dividing each row by the reference of its unit makes them comparable; the
references are those of a body of 1 kg and 0.1 m and of a small joint:

    | row                                  | reference    |
    |--------------------------------------|--------------|
    | second moments, inertias, `Ia`       | 0.01 kg m^2  |
    | first moments against a box or hull  | 0.1 kg m     |
    | masses, the bounding ellipsoid       | 1 kg         |
    | friction terms                       | 0.1 N m, 0.1 N m s/rad |

The off-diagonal entries of a matrix need none: with D the matrix and S the diagonal of references, D - t S >= 0.

Beyond the paper: a convex hull around the centre of mass; an ellipsoid (x - c)^T Q^-1 (x - c) <= 1 around all mass of
a link, which a density inside it can only satisfy if

    m - tr(Q^-1 (Sigma - l c^T - c l^T + m c c^T)) >= 0,    Sigma = tr(L)/2 1 - L

(Wensing, Kim and Slotine 2018); and symmetry about a coordinate plane of the link frame, whose odd moments are zero.

Each block is an affine map of delta into symmetric matrices or numbers that must be positive:

- `inertia`, the paper's: D_k(delta_k) of eq. 17, equivalent to m > 0 and I > 0 about the centre of mass;
- `pseudo_inertia`, stricter: the 4x4 matrix [[tr(L)/2 1 - L, l], [l^T, m]] > 0, equivalent to a mass distribution
  that has these moments (Wensing, Kim and Slotine 2018); it adds the triangle inequalities;
- what the arm's configuration knows besides (eqs. 25, 26, 28 and more).

Equalities (symmetry planes) stand beside the blocks: they have no inside, so they take no part in a margin.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ident_service.config.arm import ArmConfig, Body, Box, Ellipsoid, FeasibleSetName, JointTerm
from ident_service.config.payload import constraints_with_payload
from ident_service.config.quantities import Vector3
from ident_service.errors import ParameterError
from ident_service.estimation.feasible.conic import triangle_entries
from ident_service.model.chain import Array
from ident_service.model.parameter_layout import INERTIAL, TERM_SYMBOLS

SetName = FeasibleSetName | Literal["none"]
Row = dict[str, float]

REFERENCE_MASS = 1.0  # kg
REFERENCE_LENGTH = 0.1  # m
REFERENCE_MOMENT = REFERENCE_MASS * REFERENCE_LENGTH  # kg m
REFERENCE_INERTIA = REFERENCE_MASS * REFERENCE_LENGTH**2  # kg m^2
REFERENCE_FRICTION = 0.1  # N m, N m s/rad and what else friction is measured in


def reference_scale(parameter_name: str) -> float:
    """Return the order of magnitude [SI] that a link parameter is scaled by, chosen by its name's symbol."""
    symbol = parameter_name.rstrip("0123456789")
    if symbol == "m":
        return REFERENCE_MASS
    if symbol in ("lx", "ly", "lz"):
        return REFERENCE_MOMENT
    return REFERENCE_INERTIA if symbol.startswith("L") or symbol == "Ia" else REFERENCE_FRICTION


def link_number_of(parameter_name: str) -> str:
    """Return the digits that a parameter's name ends in: the number of its link, as text."""
    return parameter_name[len(parameter_name.rstrip("0123456789")) :]


@dataclass(frozen=True)
class Block:
    """Named condition on delta: an affine map into a symmetric matrix or into numbers that must be positive.

    Attributes:
        name: of the condition, for people.
        size: rows of the symmetric matrix; 0 for a list of numbers.
        F: affine map, shape (entries, parameters); entries of a matrix are its upper triangle, column by column.
        f: constant part, shape (entries,).
        scale: reference scale per row of the matrix or per number; ones when empty.
    """

    name: str
    size: int
    F: Array
    f: Array
    scale: tuple[float, ...] = ()

    def smallest(self, delta: Array) -> float:
        """Return the smallest eigenvalue of the block's matrix at link parameters `delta`, or its smallest number."""
        return self._smallest(delta, np.ones(self.size or len(self.f)))

    def smallest_scaled(self, delta: Array) -> float:
        """Return the largest t with block(link parameters) - t S positive semidefinite, S its reference scales."""
        return self._smallest(delta, self.references())

    def largest_scaled(self, delta: Array) -> float:
        """Return the largest magnitude of the block's numbers at link parameters `delta`, over reference scales."""
        return float(np.max(np.abs(self.F @ delta + self.f) / self.references()))

    def _smallest(self, delta: Array, scale: Array) -> float:
        entries = self.F @ delta + self.f
        if self.size == 0:
            return float((entries / scale).min())
        root = np.sqrt(scale)
        return float(np.linalg.eigvalsh(symmetric(entries, self.size) / np.outer(root, root))[0])

    def times(self, T: Array) -> Array:
        """Return F T, shape (entries, columns of T), from the nonzero columns of F."""
        return np.asarray(self.F[:, self.parameter_indices] @ T[self.parameter_indices])

    @cached_property
    def parameter_indices(self) -> NDArray[np.intp]:
        """Return the indices of the parameters that the block depends on: the columns of F that are not zero."""
        return np.flatnonzero(np.any(self.F != 0.0, axis=0))

    def identity(self) -> Array:
        """Return the upper triangle of the identity matrix, or ones for a block of numbers, shape (entries,)."""
        return self._diagonal(np.ones(self.size or len(self.f)))

    def references(self) -> Array:
        """Return the reference scale per matrix row or number, shape (size,) or (entries,); ones where none is set."""
        return np.array(self.scale) if self.scale else np.ones(self.size or len(self.f))

    def reference_identity(self) -> Array:
        """Return the upper triangle of the diagonal matrix of reference scales, shape (entries,)."""
        return self._diagonal(self.references())

    def _diagonal(self, values: Array) -> Array:
        if self.size == 0:
            return values
        return np.array([values[i] if i == j else 0.0 for i, j in triangle_entries(self.size)])


def symmetric(entries: Array, size: int) -> Array:
    """Build symmetric matrices of the entries of their upper triangles: shape (size, size, ...) from (entries, ...)."""
    matrix = np.zeros((size, size, *entries.shape[1:]))
    for value, (i, j) in zip(entries, triangle_entries(size), strict=True):
        matrix[i, j] = matrix[j, i] = value
    return matrix


def matrix_block(
    name: str, rows: list[list[Row]], reference_scales: tuple[float, ...], parameter_index: dict[str, int]
) -> Block:
    """Build the condition that a matrix, linear in link parameters (upper triangle read), is positive semidefinite."""
    size = len(rows)
    F = np.zeros((size * (size + 1) // 2, len(parameter_index)))
    for entry, (i, j) in enumerate(triangle_entries(size)):
        for parameter, coefficient in rows[i][j].items():
            F[entry, parameter_index[parameter]] += coefficient
    return Block(name, size, F, np.zeros(len(F)), reference_scales)


def linear_block(
    name: str, rows: Sequence[tuple[Row, float]], reference_scale: float, parameter_index: dict[str, int]
) -> Block:
    """Build the condition that sums of link parameters and a constant, all of one unit, are not negative."""
    F = np.zeros((len(rows), len(parameter_index)))
    for entry, (row, _) in enumerate(rows):
        for parameter, coefficient in row.items():
            F[entry, parameter_index[parameter]] = coefficient
    return Block(name, 0, F, np.array([constant for _, constant in rows]), (reference_scale,) * len(rows))


Index = dict[str, int]

_ODD = {"xy": ("lz", "Lxz", "Lyz"), "yz": ("lx", "Lxy", "Lxz"), "xz": ("ly", "Lxy", "Lyz")}


def configured_blocks(config: ArmConfig, link_numbers: Sequence[int], index: Index) -> list[Block]:
    """Return the inequality conditions of a description: bounds of mass and its center, hulls, ellipsoids, signs.

    Args:
        config: of the arm.
        link_numbers: numbers of the links, from 1, as in the parameters' names.
        index: column of each link parameter.

    Raises:
        ParameterError: a hull whose points lie in one plane.
    """
    config = constraints_with_payload(config)
    blocks = _masses(config, link_numbers, index)
    for link, body in _bodies(config, link_numbers):
        if body.center_of_mass is not None:
            blocks.append(_box(link, body.center_of_mass, index))
        if body.hull is not None:
            blocks.append(_hull(link, body.hull, index))
        if body.ellipsoid is not None:
            blocks.append(_ellipsoid(link, body.ellipsoid, index))
    return blocks + signs(config.constraints.positive, link_numbers, index)


def symmetries(config: ArmConfig, link_numbers: Sequence[int], index: Index) -> list[Block]:
    """Return, per symmetry plane of a link, the equalities that its odd moments are zero; none is repeated."""
    blocks = []
    for link, body in _bodies(constraints_with_payload(config), link_numbers):
        gone: set[str] = set()
        for plane in dict.fromkeys(body.symmetry):
            names = [f"{symbol}{link}" for symbol in _ODD[plane] if symbol not in gone]
            gone |= set(_ODD[plane])
            F = np.zeros((len(names), len(index)))
            F[np.arange(len(names)), [index[name] for name in names]] = 1.0
            scale = tuple(reference_scale(name) for name in names)
            blocks.append(Block(f"link {link}: symmetric about its {plane} plane", 0, F, np.zeros(len(names)), scale))
    return blocks


def _bodies(config: ArmConfig, links: Sequence[int]) -> Iterator[tuple[int, Body]]:
    for link, joint in zip(links, config.joints.values(), strict=False):
        yield link, joint.body


def _masses(config: ArmConfig, links: Sequence[int], index: Index) -> list[Block]:
    blocks = []
    for link, body in _bodies(config, links):
        if body.mass is not None:
            lower, upper = body.mass
            rows = [({f"m{link}": 1.0}, -lower), ({f"m{link}": -1.0}, upper)]
            name = f"link {link}: mass within {lower:g}..{upper:g} kg"
            blocks.append(linear_block(name, rows, REFERENCE_MASS, index))
    total = config.constraints.total_mass
    if total.lower > 0.0:
        rows = [({f"m{k}": 1.0 for k in links}, -total.lower)]
        blocks.append(linear_block(f"total mass at least {total.lower:g} kg", rows, REFERENCE_MASS, index))
    if total.upper is not None:
        rows = [({f"m{k}": -1.0 for k in links}, total.upper)]
        blocks.append(linear_block(f"total mass at most {total.upper:g} kg", rows, REFERENCE_MASS, index))
    return blocks


def _box(link: int, box: Box, index: Index) -> Block:
    rows: list[tuple[Row, float]] = []
    for axis, lower, upper in zip("xyz", box.lower, box.upper, strict=True):
        rows.append(({f"l{axis}{link}": 1.0, f"m{link}": -lower}, 0.0))
        rows.append(({f"l{axis}{link}": -1.0, f"m{link}": upper}, 0.0))
    return linear_block(f"link {link}: centre of mass inside its box", rows, REFERENCE_MOMENT, index)


def _hull(link: int, points: Sequence[Vector3], index: Index) -> Block:
    """Return the half-spaces n . r + d <= 0 of the hull, times the mass: -(n . l) - d m > 0."""
    from scipy.spatial import ConvexHull, QhullError  # loads for 0.1 s, and few arms have a hull

    try:
        planes = ConvexHull(np.array(points)).equations
    except QhullError as error:
        raise ParameterError(f"link {link}: the points of its hull enclose no volume") from error
    # Triangles of one face give the same half-space several times.
    planes = np.unique(np.round(planes, 12), axis=0)
    rows = [
        ({f"lx{link}": -x, f"ly{link}": -y, f"lz{link}": -z, f"m{link}": -d}, 0.0) for x, y, z, d in planes.tolist()
    ]
    return linear_block(f"link {link}: centre of mass inside its hull", rows, REFERENCE_MOMENT, index)


def _ellipsoid(link: int, body: Ellipsoid, index: Index) -> Block:
    # In fractions and rounded once, so that every machine has the same digits: files are compared with them.
    axes = [[Fraction(value) for value in row] for row in (np.eye(3).tolist() if body.axes is None else body.axes)]
    weights = [1 / Fraction(length) ** 2 for length in body.semi_axes]
    W = [
        [sum((w * row[i] * row[j] for w, row in zip(weights, axes, strict=True)), Fraction(0)) for j in range(3)]
        for i in range(3)
    ]
    c = [Fraction(value) for value in body.center]
    trace = W[0][0] + W[1][1] + W[2][2]
    Wc = [sum((W[i][j] * c[j] for j in range(3)), Fraction(0)) for i in range(3)]
    row = {f"l{axis}{link}": float(2 * Wc[i]) for i, axis in enumerate("xyz")}
    row[f"m{link}"] = float(1 - sum((c[i] * Wc[i] for i in range(3)), Fraction(0)))
    for i, a in enumerate("xyz"):
        row[f"L{a}{a}{link}"] = float(W[i][i] - trace / 2)
        for j in range(i + 1, 3):
            row[f"L{a}{'xyz'[j]}{link}"] = float(2 * W[i][j])
    return linear_block(f"link {link}: all mass inside its ellipsoid", [(row, 0.0)], REFERENCE_MASS, index)


def signs(positive_terms: Sequence[JointTerm], link_numbers: Sequence[int], index: Index) -> list[Block]:
    """Return the conditions that joint terms such as friction are positive (eq. 28), for terms that the model has.

    Args:
        positive_terms: the terms.
        link_numbers: numbers of the links, from 1.
        index: column of each link parameter.
    """
    blocks = []
    for term in positive_terms:
        for link in link_numbers:
            name = f"{TERM_SYMBOLS[term]}{link}"
            if name in index:
                title = f"joint {link}: {term.replace('_', ' ')} positive"
                blocks.append(linear_block(title, [({name: 1.0}, 0.0)], reference_scale(name), index))
    return blocks


__all__ = ["Block", "FeasibleSet", "SetName", "feasible_set", "symmetric"]


class _Group:
    """Blocks of one size, whose smallest eigenvalues or numbers are found together."""

    def __init__(self, size: int, places: tuple[int, ...], blocks: Sequence[Block]) -> None:
        self.places = places
        own = [blocks[place] for place in places]
        self._size, self._ends = size, np.cumsum([0, *(len(block.f) for block in own)])[:-1]
        self._F, self._f = np.vstack([block.F for block in own]), np.concatenate([block.f for block in own])

    def smallest(self, delta: Array) -> Array:
        """Return the smallest eigenvalue or number of each block, shape (blocks,)."""
        entries = self._F @ delta + self._f
        if self._size == 0:
            return np.asarray(np.minimum.reduceat(entries, self._ends))
        matrices = symmetric(entries.reshape(len(self.places), -1).T, self._size)
        return np.asarray(np.linalg.eigvalsh(np.moveaxis(matrices, -1, 0))[:, 0])


@dataclass(frozen=True)
class FeasibleSet:
    """All conditions on delta, whose entries are in the order of `names`.

    Attributes:
        kind: condition on the inertias.
        names: link parameters.
        blocks: matrices or lists of numbers that must be positive.
        equalities: lists of numbers that must be zero.
    """

    kind: FeasibleSetName
    names: tuple[str, ...]
    blocks: tuple[Block, ...]
    equalities: tuple[Block, ...] = field(default=())

    def margin(self, delta: Array) -> tuple[float, str]:
        """Return the blocks' smallest eigenvalue at link parameters, and whose; positive inside but for equalities."""
        return min(
            (float(value), self.blocks[place].name)
            for group in self._by_size
            for value, place in zip(group.smallest(delta), group.places, strict=True)
        )

    @cached_property
    def _by_size(self) -> tuple[_Group, ...]:
        sizes = dict.fromkeys(block.size for block in self.blocks)
        return tuple(
            _Group(size, tuple(place for place, block in enumerate(self.blocks) if block.size == size), self.blocks)
            for size in sizes
        )

    @cached_property
    def links(self) -> tuple[frozenset[str], ...]:
        """Return per block the numbers (as text) of the links whose parameters it depends on."""
        return tuple(
            frozenset(link_number_of(self.names[column]) for column in block.parameter_indices) for block in self.blocks
        )

    def scaled_margin(self, delta: Array) -> tuple[float, str]:
        """Return the largest t with D(link parameters) - t S >= 0, S reference scales, and the limiting block."""
        return min((block.smallest_scaled(delta), block.name) for block in self.blocks)

    def violation(self, delta: Array) -> tuple[float, str]:
        """Return link parameters' largest scaled equality error and which it is; (0, "") without equalities."""
        return max(((block.largest_scaled(delta), block.name) for block in self.equalities), default=(0.0, ""))

    def equality_rows(self) -> tuple[Array, Array]:
        """Return E, shape (rows, parameters), and e of all equalities E delta + e = 0, divided by reference scales."""
        E = [block.F / block.references()[:, None] for block in self.equalities]
        e = [block.f / block.references() for block in self.equalities]
        return np.vstack([np.zeros((0, len(self.names))), *E]), np.concatenate([np.zeros(0), *e])


def feasible_set(
    kind: FeasibleSetName,
    names: Sequence[str],
    config: ArmConfig | None = None,
    *,
    positive_terms: Sequence[JointTerm] = (),
) -> FeasibleSet:
    """Build the feasible set of named link parameters: each link's inertia, and the description's conditions.

    Args:
        kind: condition on the inertias.
        names: link parameters in the order of delta; every link has all ten of eq. 13.
        config: description with the mass, centre-of-mass and sign conditions; none of these when None.
        positive_terms: joint terms that must be positive where there is no configuration.

    Raises:
        ParameterError: a hull whose points lie in one plane.
    """
    index = {name: column for column, name in enumerate(names)}
    links = sorted({int(name[1:]) for name in names if name.startswith("m") and name[1:].isdigit()})
    build = _inertia if kind == "inertia" else _pseudo_inertia
    blocks = [build(link, index) for link in links]
    equalities: list[Block] = []
    if config is None:
        blocks += signs(positive_terms, links, index)
    else:
        blocks += configured_blocks(config, links, index)
        equalities += symmetries(config, links, index)
    return FeasibleSet(kind, tuple(names), tuple(blocks), tuple(equalities))


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
    scale = (REFERENCE_INERTIA,) * 3 + (REFERENCE_MASS,) * 3
    return matrix_block(f"link {link}: mass and inertia positive", rows, scale, index)


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
    scale = (REFERENCE_INERTIA,) * 3 + (REFERENCE_MASS,)
    return matrix_block(f"link {link}: a mass distribution exists", rows, scale, index)
