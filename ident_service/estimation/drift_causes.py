"""Find the single cause that explains most of a change of parameters, and describe it for a person at the arm.

Base parameters group the parameters of neighbouring links, so a tool on the last link moves the base parameters of all
links before it. A cause is a few link parameters (friction of a joint, drive inertia of a joint, the body of a link)
with their columns C of K. How much of a difference d it explains is said in torque on the recorded motion, each joint
in units of its residual:

    1 - min_x |R (d - C x)|^2 / |R d|^2

It describes, it does not test: whether anything has changed is for `drift.py` to say.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ident_service.estimation.drift import Drift, Effect, Identified, Motion
from ident_service.model.chain import Array
from ident_service.model.layout import INERTIAL, TERM_SYMBOLS

CauseKind = Literal["friction", "drive inertia", "body"]

_AS_GOOD = 0.02  # causes that explain as much within this share; the one with fewer parameters is preferred
_FRICTION = frozenset(TERM_SYMBOLS.values()) - {TERM_SYMBOLS["drive_inertia"]}
_MEANINGS: Mapping[str, str] = {
    "higher": "lubrication that ages or is cold, worn seals or bearings, a brake that drags",
    "lower": "a warmer or freshly lubricated gear, one that has run in, a looser belt or seal",
    "offset": "zero of the torque sensor or current, a cable package that pulls, a counterbalance",
    "drive inertia": "another motor or gear, or a torque constant that is not what it was",
    "last": "another tool or payload",
    "body": "a part mounted on or taken off, or a cable package moved",
    "first moments": "a part mounted on or taken off, another zero position of the joint, or the torque constant",
    "inertia": "a part mounted on or taken off, or a torque constant that is not what it was",
}


@dataclass(frozen=True)
class Cause:
    """One possible cause of a difference.

    Attributes:
        kind: what has changed.
        number: of the joint or link, from 1.
        explained: share of the change of torque, squared and in units of residuals, from 0 to 1.
        changes: of the link parameters, those that the difference shows, in SI units.
    """

    kind: CauseKind
    number: int
    explained: float
    changes: Mapping[str, float]


def causes(difference: Array, K: Array, names: Sequence[str], motion: Motion) -> list[Cause]:
    """Return every possible single cause of a difference, the best explanation first.

    Args:
        difference: of base parameters, SI units, shape (base,).
        K: of eq. 38, shape (base, link parameters).
        names: of the link parameters.
        motion: on which torques are compared.
    """
    units = np.maximum(motion.residual, np.finfo(float).tiny)
    R = np.vstack([response / unit for response, unit in zip(motion.responses, units, strict=True)])
    change = R @ difference
    total = float(change @ change)
    found = []
    for (kind, number), columns in _columns(names).items():
        A = R @ K[:, columns]
        if total == 0.0 or not np.any(A):
            continue
        # Columns differ by orders of magnitude in SI units.
        size = np.linalg.norm(A, axis=0)
        size[size == 0.0] = 1.0
        x = np.linalg.lstsq(A / size, change, rcond=1e-9)[0]
        rest = change - (A / size) @ x
        changes = {names[column]: float(value) for column, value in zip(columns, x / size, strict=True)}
        found.append((len(columns), Cause(kind, number, 1.0 - float(rest @ rest) / total, changes)))
    if not found:
        return []
    best = max(cause.explained for _, cause in found)
    found.sort(key=lambda pair: (pair[1].explained < best - _AS_GOOD, pair[0], -pair[1].explained))
    simple = found[0][1]
    return [simple, *sorted((cause for _, cause in found[1:]), key=lambda cause: -cause.explained)]


def meaning_of_cause(cause: Cause, links: int) -> str:
    """Return the possible meaning of a cause, in words for a person at the arm.

    Args:
        cause: to explain.
        links: of the arm; the last one carries tools.
    """
    if cause.kind == "body":
        return _MEANINGS["last" if cause.number == links else "body"]
    return _MEANINGS["drive inertia"] if cause.kind == "drive inertia" else _MEANINGS[_direction(cause.changes)]


def meaning_of_effect(effect: Effect, found: Drift, leading: Sequence[str], links: int) -> str:
    """Return the possible meaning of an effect that no single cause explains, in words for a person at the arm."""
    if effect.kind == "friction":
        return _MEANINGS[_direction({leading[place]: float(found.difference[place]) for place in effect.places})]
    return _MEANINGS["last" if effect.number == links and effect.kind != "drive inertia" else effect.kind]


def friction_ratio(first: Identified, second: Identified, joint: int) -> tuple[float, float] | None:
    """Return the friction of a joint, second over first, at the root mean square of its speed.

    Args:
        first: the reference.
        second: the later one; the speed is that of its motion.
        joint: from 1.

    Returns:
        The ratio, and the speed [rad/s or m/s]; None where no motion is known, or the first has no such friction.
    """
    motion, place = second.motion or first.motion, {name: k for k, name in enumerate(first.leading)}
    viscous, coulomb = place.get(f"fv{joint}"), place.get(f"fc{joint}")
    if motion is None or viscous is None or joint > len(motion.responses):
        return None
    speed = float(np.linalg.norm(motion.responses[joint - 1][:, viscous]))
    before, after = (
        one.values[viscous] * speed + (0.0 if coulomb is None else one.values[coulomb]) for one in (first, second)
    )
    return None if before <= 0.0 or speed == 0.0 else (float(after / before), speed)


def _direction(changes: Mapping[str, float]) -> str:
    dissipating = {name: value for name, value in changes.items() if not name.startswith("fo")}
    offset = sum(abs(value) for name, value in changes.items() if name.startswith("fo"))
    if offset > sum(abs(value) for value in dissipating.values()):
        return "offset"
    return "higher" if sum(dissipating.values()) > 0.0 else "lower"


def _columns(names: Sequence[str]) -> dict[tuple[CauseKind, int], list[int]]:
    columns: dict[tuple[CauseKind, int], list[int]] = {}
    for column, name in enumerate(names):
        symbol = name.rstrip("0123456789")
        kind: CauseKind
        kind = "body" if symbol in INERTIAL else "friction" if symbol in _FRICTION else "drive inertia"
        columns.setdefault((kind, int(name[len(symbol) :])), []).append(column)
    return columns
