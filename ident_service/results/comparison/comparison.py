"""Compare two or more parameter sets: the first is the reference that the others are compared with.

Parameters are the same where their expressions are: two runs of one arm, or two arms of one kind. What only one side
has is listed and left out. Whether anything has changed is `estimation/drift.py`'s to say; where a side has no
covariance, as tables in papers, there are differences and no verdict.

The shape of friction (pre-sliding distance, Stribeck velocity) may be fitted to each recording. With another shape the
same parameter is another quantity, and no covariance knows of it: friction of such a joint is not compared, and without
it nothing is called unchanged.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ident_service.errors import ParameterError, UsageError
from ident_service.estimation.drift import Drift, Identified, drift
from ident_service.estimation.drift_causes import Cause, causes
from ident_service.estimation.least_squares import TorqueError, torque_error
from ident_service.model.chain import Array
from ident_service.results.comparison.in_use import InUse, values_in_use
from ident_service.results.comparison.sides import Side
from ident_service.results.run_folder import ARM

UNSAID = "-"
Verdict = Literal["unchanged", "changed", "impossible"]


@dataclass(frozen=True)
class Crossed:
    """Torque errors of both sides' parameters on the data that the second side was identified from."""

    reference: TorqueError
    own: TorqueError


@dataclass(frozen=True)
class Pair:
    """Comparison of one side with the reference.

    Attributes:
        side: the one that is compared.
        places: of the shared parameters in the reference's and in this side's table, each of shape (shared,).
        only_reference: expressions that the reference alone has.
        only_side: expressions that this side alone has.
        difference: of the values that are compared, this side less reference, shape (shared,).
        compared: reference and this side as they are tested; None without covariances.
        drift: the tests; None likewise.
        reason: why there is no verdict; empty otherwise.
        causes: single explanations, the best first; none where no motion is known.
        crossed: the reference's parameters on this side's torques; None where these are not kept.
        provenance: what differs in how the two came about: key to both values.
        notes: what a reader must know.
        in_use: the values that the sides are used with, which need not be those that are tested.
        free: whether values from before any constraint are tested.
        other_shape: joints, from 1, whose friction has another shape on each side, and so is not compared.
    """

    side: Side
    places: tuple[NDArray[np.intp], NDArray[np.intp]]
    only_reference: tuple[str, ...]
    only_side: tuple[str, ...]
    difference: Array
    compared: tuple[Identified, Identified] | None
    drift: Drift | None
    reason: str
    causes: tuple[Cause, ...]
    crossed: Crossed | None
    provenance: Mapping[str, tuple[str, str]]
    notes: tuple[str, ...]
    in_use: InUse
    free: bool
    other_shape: tuple[int, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """Return the verdict in one word; `impossible` also where friction of another shape was left out."""
        if self.drift is None or (self.drift.verdict == "unchanged" and self.other_shape):
            return "impossible"
        return self.drift.verdict

    @property
    def contradicted(self) -> bool:
        """Return whether the test finds no change, though the values in use predict other torques."""
        return self.verdict == "unchanged" and self.in_use.matters


@dataclass(frozen=True)
class Comparison:
    """Reference and the sides that were compared with it."""

    reference: Side
    pairs: tuple[Pair, ...]

    @property
    def verdict(self) -> Verdict:
        """Return `changed` where any side has changed, else `impossible` where any cannot be tested."""
        words = [pair.verdict for pair in self.pairs]
        return "changed" if "changed" in words else "impossible" if "impossible" in words else "unchanged"


def compare(sides: Sequence[Side]) -> Comparison:
    """Compare parameter sets with the first of them.

    Args:
        sides: two or more; the first is the reference.

    Raises:
        UsageError: fewer than two.
        ParameterError: two sides have nothing in common, or a file contradicts itself.
    """
    if len(sides) < 2:
        raise UsageError("give two or more folders of results or parameter files; the first is the reference")
    reference, *others = sides
    return Comparison(reference, tuple(_pair(reference, side) for side in others))


def _pair(reference: Side, side: Side) -> Pair:
    if reference.joints and side.joints and len(reference.joints) != len(side.joints):
        raise ParameterError(
            f"{side.path}: an arm of {len(side.joints)} joints, but {reference.path} has {len(reference.joints)}; "
            "only arms of one kind can be compared"
        )
    index = {key: place for place, key in enumerate(side.keys)}
    shared = [(place, index[key]) for place, key in enumerate(reference.keys) if key in index]
    if not shared:
        raise ParameterError(f"{side.path}: no base parameter in common with {reference.path}; nothing to compare")
    differing = _other_shape(reference, side)
    shared = [pair for pair in shared if not _shaped(reference.leading[pair[0]], differing)]
    if not shared:
        raise ParameterError(f"{side.path}: has only friction of another shape in common with {reference.path}")
    places = tuple(np.array(column, dtype=np.intp) for column in zip(*shared, strict=True))
    free = reference.unconstrained is not None and side.unconstrained is not None
    first, second = (one.identified(at, free=free) for one, at in zip((reference, side), places, strict=True))
    found, compared, explained, reason = None, None, tuple[Cause, ...](), ""
    if first is None or second is None:
        without = [str(one.path) for one, known in ((reference, first), (side, second)) if known is None]
        reason = f"no covariance in {' and '.join(without)}; differences are listed, nothing can be tested"
        difference = side.file.values[places[1]] - reference.file.values[places[0]]
    else:
        compared, found = (first, second), drift(first, second)
        difference = found.difference
        if differing and found.verdict == "unchanged":
            reason = (
                f"friction of joint {', '.join(_names(side, differing))} was fitted with another shape and is not "
                f"compared; all else is unchanged. Identify again with the reference's shape: {_remedy(reference)}"
            )
        motion = second.motion or first.motion
        if motion is not None:
            K = reference.file.base.K[places[0]]
            explained = tuple(
                causes(np.where(np.isfinite(found.deviations), difference, 0.0), K, reference.file.base.names, motion)
            )
    in_use = values_in_use((reference, side), places, compared)
    return Pair(
        side=side,
        places=(places[0], places[1]),
        only_reference=_others(reference, side),
        only_side=_others(side, reference),
        difference=difference,
        compared=compared,
        drift=found,
        reason=reason,
        causes=explained,
        crossed=_crossed(reference, side, (places[0], places[1])),
        provenance=_provenance(reference, side),
        notes=tuple(_notes(reference, side, free, differing, in_use)),
        in_use=in_use,
        free=free,
        other_shape=differing,
    )


def _others(side: Side, other: Side) -> tuple[str, ...]:
    expressions = side.content["base_parameters"]["expressions"]
    return tuple(expression for expression, key in zip(expressions, side.keys, strict=True) if key not in other.keys)


# Pre-sliding distances [rad or m] that differ by less change Coulomb friction over a motion by a thousandth; a Stribeck
# velocity changes what the other friction terms mean.
_SAME_SHAPE = {"presliding": 5e-4, "stribeck_velocity": 0.0}


def _other_shape(reference: Side, side: Side) -> tuple[int, ...]:
    found: set[int] = set()
    for key, symbol in (("presliding", "fc"), ("stribeck_velocity", "fs")):
        here, there = (one.content.get("friction", {}).get(key, []) for one in (reference, side))
        for joint, (a, b) in enumerate(zip(here, there, strict=False), 1):
            if abs(a - b) > _SAME_SHAPE[key] and f"{symbol}{joint}" in reference.leading:
                found.add(joint)
    return tuple(sorted(found))


def _shaped(name: str, joints: Sequence[int]) -> bool:
    """Return whether a parameter's meaning depends on the shape of the friction of these joints."""
    return (
        name.startswith("f") and not name.startswith("fo") and int(name.lstrip("abcdefghijklmnopqrstuvwxyz")) in joints
    )


def _remedy(reference: Side) -> str:
    arm = reference.path / ARM
    return f"ident identify ... --arm {arm}" if reference.config is not None else "identification.friction as numbers"


def _names(side: Side, joints: Sequence[int]) -> list[str]:
    return [side.joints[joint - 1] if side.joints is not None else str(joint) for joint in joints]


def _crossed(reference: Side, side: Side, places: tuple[NDArray[np.intp], NDArray[np.intp]]) -> Crossed | None:
    """Return torque errors with the values in use, held in a feasible set or not; None where tables differ."""
    size = side.file.base.size
    if side.information is None or len(places[0]) != size or size != reference.file.base.size:
        return None
    beta = np.empty(size)
    beta[places[1]] = reference.file.values[places[0]]
    return Crossed(torque_error(side.information, beta), torque_error(side.information, side.file.values))


def _provenance(reference: Side, side: Side) -> dict[str, tuple[str, str]]:
    known = [_flat(one) for one in (reference, side)]
    keys = list(dict.fromkeys([*known[0], *known[1]]))
    both = {key: (known[0].get(key, UNSAID), known[1].get(key, UNSAID)) for key in keys}
    return {key: pair for key, pair in both.items() if pair[0] != pair[1]}


def _flat(side: Side) -> dict[str, str]:
    content = side.content
    source = content.get("provenance", {})
    facts: dict[str, Any] = {
        "arm": content.get("arm", {}).get("name"),
        "arm sha256": content.get("arm", {}).get("sha256"),
        "method": content.get("method"),
        "feasible set": content.get("feasible_set"),
        "torque delay": content.get("torque_delay", {}).get("seconds"),
        "torque scales": content.get("torque_scales"),
        "friction": content.get("friction"),
        "software": source.get("software"),
        "git": source.get("git"),
        "created": source.get("created"),
        "recordings": ", ".join(f"{one['name']} {one['sha256'][:12]}" for one in source.get("recordings", [])) or None,
    }
    if side.config is not None:
        facts |= {f"identification.{key}": value for key, value in side.config.identification.model_dump().items()}
    return {key: str(value) for key, value in facts.items() if value is not None}


def _notes(reference: Side, side: Side, free: bool, differing: Sequence[int], in_use: InUse) -> list[str]:
    notes = []
    both = (reference.content, side.content)
    names = [content.get("arm", {}).get("name") for content in both]
    if names[0] != names[1] and all(names):
        notes.append(f"different arms: {names[0]} and {names[1]}")
    if reference.joints and side.joints and reference.joints != side.joints:
        notes.append(f"joints are called {', '.join(reference.joints)} and {', '.join(side.joints)}; compared in order")
    tested = reference.covariance is not None and side.covariance is not None
    if tested and not free and any(content.get("feasible_set") in ("inertia", "pseudo_inertia") for content in both):
        notes.append("constrained values are compared, in the covariance of unconstrained ones: on the careful side")
    made = [f"{content.get('method', '?')}, {content.get('feasible_set', '?')}" for content in both]
    if made[0] != made[1] and (worst := in_use.worst()) is not None:
        notes.append(
            f"values in use come about in two ways ({made[0]}; {made[1]}) and change the torque of joint "
            f"{', '.join(_names(side, [worst[0] + 1]))} by {worst[1]:.2%}, the most of all joints"
        )
    recordings = [{one["sha256"] for one in content.get("provenance", {}).get("recordings", [])} for content in both]
    if reference.sha256 != side.sha256 and recordings[0] & recordings[1]:
        notes.append("both were fitted to the same recording: their doubts are not independent")
    if differing:
        joints = ", ".join(_names(side, differing))
        notes.append(
            f"friction of joint {joints} has another shape (pre-sliding, Stribeck): not compared but for offsets"
        )
    notes += [
        f"{one.path} does not say what its covariance was estimated from: taken for exactly known"
        for one in (reference, side)
        if one.covariance is not None and "blocks" not in one.content.get("fit", {})
    ]
    scales = [content.get("torque_scales") for content in both]
    if scales[0] != scales[1] and all(scales):
        notes.append("torques were multiplied by different factors")
    return notes
