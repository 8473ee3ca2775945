"""Build the conditions on bodies from an arm's configuration, as blocks linear in delta (eqs. 25, 26, 28 and beyond).

Beyond the paper: a convex hull around the centre of mass; an ellipsoid (x - c)^T Q^-1 (x - c) <= 1 around all mass of
a link, which a density inside it can only satisfy if

    m - tr(Q^-1 (Sigma - l c^T - c l^T + m c c^T)) >= 0,    Sigma = tr(L)/2 1 - L

(Wensing, Kim and Slotine 2018); and symmetry about a coordinate plane of the link frame, whose odd moments are zero.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from fractions import Fraction

import numpy as np

from ident_service.config.payload import knowledge_with_payload
from ident_service.config.quantities import Vector3
from ident_service.config.schema import ArmConfig, Body, Box, Ellipsoid, JointTerm
from ident_service.errors import ParameterError
from ident_service.estimation.feasible.blocks import (
    REFERENCE_MASS,
    REFERENCE_MOMENT,
    Block,
    Row,
    linear_block,
    reference,
)
from ident_service.model.layout import TERM_SYMBOLS

Index = dict[str, int]

_ODD = {"xy": ("lz", "Lxz", "Lyz"), "yz": ("lx", "Lxy", "Lxz"), "xz": ("ly", "Lxy", "Lyz")}


def configured(config: ArmConfig, links: Sequence[int], index: Index) -> list[Block]:
    """Return every block of the configuration that must be positive.

    Args:
        config: of the arm.
        links: numbers of the links, from 1, as in the parameters' names.
        index: column of each link parameter.

    Raises:
        ParameterError: a hull whose points lie in one plane.
    """
    config = knowledge_with_payload(config)
    blocks = _masses(config, links, index)
    for link, body in _bodies(config, links):
        if body.center_of_mass is not None:
            blocks.append(_box(link, body.center_of_mass, index))
        if body.hull is not None:
            blocks.append(_hull(link, body.hull, index))
        if body.ellipsoid is not None:
            blocks.append(_ellipsoid(link, body.ellipsoid, index))
    return blocks + signs(config.constraints.positive, links, index)


def symmetries(config: ArmConfig, links: Sequence[int], index: Index) -> list[Block]:
    """Return the odd moments that symmetry planes make zero, one block per plane; none stands twice."""
    blocks = []
    for link, body in _bodies(knowledge_with_payload(config), links):
        gone: set[str] = set()
        for plane in dict.fromkeys(body.symmetry):
            names = [f"{symbol}{link}" for symbol in _ODD[plane] if symbol not in gone]
            gone |= set(_ODD[plane])
            F = np.zeros((len(names), len(index)))
            F[np.arange(len(names)), [index[name] for name in names]] = 1.0
            scale = tuple(reference(name) for name in names)
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


def signs(positive: Sequence[JointTerm], links: Sequence[int], index: Index) -> list[Block]:
    """Return the blocks of joint terms that must be positive (eq. 28), where the model has them.

    Args:
        positive: the terms.
        links: numbers of the links, from 1.
        index: column of each link parameter.
    """
    blocks = []
    for term in positive:
        for link in links:
            name = f"{TERM_SYMBOLS[term]}{link}"
            if name in index:
                title = f"joint {link}: {term.replace('_', ' ')} positive"
                blocks.append(linear_block(title, [({name: 1.0}, 0.0)], reference(name), index))
    return blocks
