"""Two or more parameter sets against each other: the first is the reference that the others are compared with.

Parameters are the same where their expressions are: two runs of one arm, or two arms of one kind. What only one side
has is listed and left out. Whether anything has changed is `estimation/drift.py`'s to say; where a side has no
covariance, as tables in papers, there are differences and no verdict.
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
from ident_service.results.comparison_sides import Side

Verdict = Literal["unchanged", "changed", "impossible"]


@dataclass(frozen=True)
class Crossed:
    """Both sides' parameters on the torques that the second side was identified from."""

    reference: TorqueError
    own: TorqueError


@dataclass(frozen=True)
class Pair:
    """One side against the reference.

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

    @property
    def verdict(self) -> Verdict:
        """In one word."""
        return "impossible" if self.drift is None else self.drift.verdict


@dataclass(frozen=True)
class Comparison:
    """A reference and what was compared with it."""

    reference: Side
    pairs: tuple[Pair, ...]

    @property
    def verdict(self) -> Verdict:
        """`changed` where any has changed, else `impossible` where any cannot be tested."""
        words = [pair.verdict for pair in self.pairs]
        return "changed" if "changed" in words else "impossible" if "impossible" in words else "unchanged"


def compare(sides: Sequence[Side]) -> Comparison:
    """Compare parameter sets.

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
    places = tuple(np.array(column, dtype=np.intp) for column in zip(*shared, strict=True))
    free = reference.unconstrained is not None and side.unconstrained is not None
    first, second = (one.identified(at, free=free) for one, at in zip((reference, side), places, strict=True))
    found, compared, explained, reason = None, None, tuple[Cause, ...](), ""
    if first is None or second is None:
        without = [str(one.path) for one, known in ((reference, first), (side, second)) if known is None]
        reason = f"no covariance in {' and '.join(without)}"
        difference = side.file.values[places[1]] - reference.file.values[places[0]]
    else:
        compared, found = (first, second), drift(first, second)
        difference = found.difference
        motion = second.motion or first.motion
        if motion is not None:
            K = reference.file.base.K[places[0]]
            explained = tuple(
                causes(np.where(np.isfinite(found.deviations), difference, 0.0), K, reference.file.base.names, motion)
            )
    return Pair(
        side=side,
        places=(places[0], places[1]),
        only_reference=_others(reference, places[0]),
        only_side=_others(side, places[1]),
        difference=difference,
        compared=compared,
        drift=found,
        reason=reason,
        causes=explained,
        crossed=_crossed(reference, side, (places[0], places[1])),
        provenance=_provenance(reference, side),
        notes=tuple(_notes(reference, side, free)),
    )


def _others(side: Side, places: NDArray[np.intp]) -> tuple[str, ...]:
    return tuple(
        expression
        for place, expression in enumerate(side.content["base_parameters"]["expressions"])
        if place not in set(places.tolist())
    )


def _crossed(reference: Side, side: Side, places: tuple[NDArray[np.intp], NDArray[np.intp]]) -> Crossed | None:
    """With the values as they are used, held in a feasible set or not."""
    size = side.file.base.size
    if side.information is None or len(places[0]) != size or size != reference.file.base.size:
        return None
    beta = np.empty(size)
    beta[places[1]] = reference.file.values[places[0]]
    return Crossed(torque_error(side.information, beta), torque_error(side.information, side.file.values))


def _provenance(reference: Side, side: Side) -> dict[str, tuple[str, str]]:
    known = [_flat(one) for one in (reference, side)]
    keys = list(dict.fromkeys([*known[0], *known[1]]))
    both = {key: (known[0].get(key, "-"), known[1].get(key, "-")) for key in keys}
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


def _notes(reference: Side, side: Side, free: bool) -> list[str]:
    notes = []
    both = (reference.content, side.content)
    names = [content.get("arm", {}).get("name") for content in both]
    if names[0] != names[1] and all(names):
        notes.append(f"different arms: {names[0]} and {names[1]}")
    if reference.joints and side.joints and reference.joints != side.joints:
        notes.append(f"joints are called {', '.join(reference.joints)} and {', '.join(side.joints)}; compared in order")
    if not free and any(content.get("feasible_set") in ("inertia", "pseudo_inertia") for content in both):
        notes.append("constrained values are compared, in the covariance of unconstrained ones: on the careful side")
    recordings = [{one["sha256"] for one in content.get("provenance", {}).get("recordings", [])} for content in both]
    if reference.sha256 != side.sha256 and recordings[0] & recordings[1]:
        notes.append("both were fitted to the same recording: their doubts are not independent")
    for key, words in (
        ("friction", "friction has another shape (pre-sliding, Stribeck): its parameters are not quite the same"),
        ("torque_scales", "torques were multiplied by different factors"),
    ):
        if all(key in content for content in both) and both[0][key] != both[1][key]:
            notes.append(words)
    return notes
