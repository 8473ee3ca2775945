"""Define the set of parameters that a real body could have, as a list of named blocks (3.1 to 3.3).

Each block is an affine map of delta into symmetric matrices or numbers that must be positive:

- `inertia`, the paper's: D_k(delta_k) of eq. 17, equivalent to m > 0 and I > 0 about the centre of mass;
- `pseudo_inertia`, stricter: the 4x4 matrix [[tr(L)/2 1 - L, l], [l^T, m]] > 0, equivalent to a mass distribution
  that has these moments (Wensing, Kim and Slotine 2018); it adds the triangle inequalities;
- what the arm's configuration knows besides (eqs. 25, 26, 28 and more), from `constraints.py`.

Equalities (symmetry planes) stand beside the blocks: they have no inside, so they take no part in a margin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ident_service.config.schema import ArmConfig, FeasibleSetName, JointTerm
from ident_service.estimation.feasible.blocks import (
    REFERENCE_INERTIA,
    REFERENCE_MASS,
    Block,
    SetName,
    link_of,
    matrix_block,
    symmetric,
)
from ident_service.estimation.feasible.constraints import configured, signs, symmetries
from ident_service.model.chain import Array
from ident_service.model.layout import INERTIAL

__all__ = ["Block", "FeasibleSet", "SetName", "feasible_set", "symmetric"]


class _Group:
    """Blocks of one size, whose smallest eigenvalues or numbers are found together."""

    def __init__(self, size: int, places: tuple[int, ...], blocks: Sequence[Block]) -> None:
        self.places = places
        own = [blocks[place] for place in places]
        self._size, self._ends = size, np.cumsum([0, *(len(block.f) for block in own)])[:-1]
        self._F, self._f = np.vstack([block.F for block in own]), np.concatenate([block.f for block in own])

    def smallest(self, delta: Array) -> Array:
        """Smallest eigenvalue or number of each block, shape (blocks,)."""
        entries = self._F @ delta + self._f
        if self._size == 0:
            return np.asarray(np.minimum.reduceat(entries, self._ends))
        matrices = symmetric(entries.reshape(len(self.places), -1).T, self._size)
        return np.asarray(np.linalg.eigvalsh(np.moveaxis(matrices, -1, 0))[:, 0])


@dataclass(frozen=True)
class FeasibleSet:
    """All conditions on delta, whose entries are in the order of `names`.

    Attributes:
        kind: which condition on inertias.
        names: link parameters.
        blocks: what must be positive.
        equalities: lists of numbers that must be zero.
    """

    kind: FeasibleSetName
    names: tuple[str, ...]
    blocks: tuple[Block, ...]
    equalities: tuple[Block, ...] = field(default=())

    def margin(self, delta: Array) -> tuple[float, str]:
        """Return the smallest eigenvalue of all blocks and the block it belongs to; positive inside the set."""
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
        """Numbers of the links that each block is about, as they end the names of its parameters."""
        return tuple(frozenset(link_of(self.names[column]) for column in block.felt) for block in self.blocks)

    def scaled_margin(self, delta: Array) -> tuple[float, str]:
        """Return the largest t with D(delta) - t S >= 0, S the reference scales, and the block that limits it."""
        return min((block.smallest_scaled(delta), block.name) for block in self.blocks)

    def violation(self, delta: Array) -> tuple[float, str]:
        """Return the largest deviation from an equality, over its reference scale, and its name; zero without any."""
        return max(((block.largest_scaled(delta), block.name) for block in self.equalities), default=(0.0, ""))

    def equality_rows(self) -> tuple[Array, Array]:
        """Return all equalities as E delta + e = 0, over their reference scales; (rows, parameters), (rows,)."""
        E = [block.F / block.references()[:, None] for block in self.equalities]
        e = [block.f / block.references() for block in self.equalities]
        return np.vstack([np.zeros((0, len(self.names))), *E]), np.concatenate([np.zeros(0), *e])


def feasible_set(
    kind: FeasibleSetName,
    names: Sequence[str],
    config: ArmConfig | None = None,
    *,
    positive: Sequence[JointTerm] = (),
) -> FeasibleSet:
    """Return the feasible set of an arm, or of a bare table of parameters.

    Args:
        kind: which condition on inertias.
        names: link parameters in the order of delta; every link has all ten of eq. 13.
        config: where mass, centre-of-mass and sign conditions come from; none of them without it.
        positive: joint terms that must be positive where there is no configuration.

    Raises:
        ParameterError: a hull whose points lie in one plane.
    """
    index = {name: column for column, name in enumerate(names)}
    links = sorted({int(name[1:]) for name in names if name.startswith("m") and name[1:].isdigit()})
    build = _inertia if kind == "inertia" else _pseudo_inertia
    blocks = [build(link, index) for link in links]
    equalities: list[Block] = []
    if config is None:
        blocks += signs(positive, links, index)
    else:
        blocks += configured(config, links, index)
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
