"""Compare parameter sets with a reference: sides, the values in use, differences, findings.

Tests are made of unconstrained values, to which the covariances belong. Exports, models and torque errors are made of
the values held in a feasible set, so these may differ where the arm has not changed: by another set, another method, or
an edited file. Pure computation, no I/O.

Parameters are the same where their expressions are: two runs of one arm, or two arms of one kind. What only one side
has is listed and left out. Whether anything has changed is `estimation/change_detection.py`'s to say; where a side has
no covariance, as tables in papers, there are differences and no verdict.

The shape of friction (pre-sliding distance, Stribeck velocity) may be fitted to each recording. With another shape the
same parameter is another quantity, and no covariance knows of it: friction of such a joint is not compared, and without
it nothing is called unchanged.

A body that explains the change stands for the effects on all links that it has in the base parameters; friction and
drive inertia are base parameters of their own joint, and are findings beside it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ident_service.config.arm import ArmConfig
from ident_service.errors import ParameterError, UsageError
from ident_service.estimation.change_detection import (
    Cause,
    ComparedEstimate,
    Effect,
    Motion,
    ParameterChange,
    causes,
    detect_change,
    friction_ratio,
    meaning_of_cause,
    meaning_of_effect,
    relevant,
    torque_shares,
)
from ident_service.estimation.least_squares import TorqueError, torque_error
from ident_service.model.base_parameters import parse_expression
from ident_service.model.chain import Array
from ident_service.model.information import Information
from ident_service.results.parameter_file import ParameterFile, information_from, read_parameters, require_consistent
from ident_service.results.run_folder import ARM, PARAMETERS, read_results

_DECIMALS = 9  # of coefficients; expressions that agree to these are the same parameter
Key = tuple[tuple[str, float], ...]


@dataclass(frozen=True)
class ComparedSet:
    """Parameter set that takes part in a comparison.

    Attributes:
        path: folder or file as it was given.
        sha256: hash of the parameter file.
        file: content of the parameter file.
        config: the arm it was identified for; None for a file alone.
    """

    path: Path
    sha256: str
    file: ParameterFile
    config: ArmConfig | None = None

    @property
    def name(self) -> str:
        """Return a short name: the folder's, or the file's where that is not called `parameters.json`."""
        path = self.path.absolute()
        return path.parent.name if path.name == PARAMETERS else path.name

    @property
    def content(self) -> Mapping[str, Any]:
        """Return everything in the parameter file."""
        return self.file.content

    @cached_property
    def keys(self) -> tuple[Key, ...]:
        """Return each base parameter as sorted pairs (link parameter, rounded coefficient), however it is written."""
        expressions = self.content["base_parameters"]["expressions"]
        return tuple(
            tuple(sorted((name, round(value, _DECIMALS)) for name, value in parse_expression(expression).items()))
            for expression in expressions
        )

    @cached_property
    def leading(self) -> tuple[str, ...]:
        """Return the link parameter that each base parameter is named after."""
        return tuple(self.file.base.names[column] for column in self.file.base.base)

    @cached_property
    def joints(self) -> tuple[str, ...] | None:
        """Return the names of the arm's joints; None where the file does not say."""
        arm = self.content.get("arm")
        return None if arm is None else tuple(arm["joints"])

    @cached_property
    def covariance(self) -> Array | None:
        """Return the covariance of the unconstrained estimate, shape (base, base), infinite where unseen; None without.

        Raises:
            ParameterError: it is none.
        """
        rows = self.content["base_parameters"].get("covariance")
        if rows is None:
            return None
        size = self.file.base.size
        if len(rows) != size or any(len(row) != size for row in rows):
            raise ParameterError(f"{self.path}: covariance is not {size} by {size}")
        # Covariances with an unseen parameter are null in the file, too.
        unseen = np.array([rows[k][k] is None for k in range(size)])
        matrix = np.array([[0.0 if value is None else value for value in row] for row in rows], dtype=float)
        matrix[unseen, :] = matrix[:, unseen] = 0.0
        largest = np.sqrt(np.outer(np.diag(matrix).clip(0.0), np.diag(matrix).clip(0.0)))
        slack = 1e-9 * np.max(largest, initial=0.0)
        if np.any(np.diag(matrix) < 0.0) or np.any(np.abs(matrix - matrix.T) > 1e-6 * largest + slack):
            raise ParameterError(f"{self.path}: covariance is not symmetric, or has negative variances")
        matrix = np.asarray(0.5 * (matrix + matrix.T))
        matrix[unseen, unseen] = np.inf
        return matrix

    @property
    def unconstrained(self) -> Array | None:
        """Return the values before a feasible set changed them (those in use if none did), (base,); None: unknown."""
        values = self.content["base_parameters"].get("unconstrained_values")
        if values is None and self.content.get("feasible_set") == "none":
            return self.file.values
        return None if values is None else np.array(values, dtype=float)

    @cached_property
    def information(self) -> Information | None:
        """Return the information of the recordings that were fitted to; None where the file has none.

        Raises:
            ParameterError: it does not fit the parameters.
        """
        joints = self.content.get("information")
        if joints is None:
            return None
        try:
            return information_from(joints, self.file.base.size)
        except ParameterError as error:
            raise ParameterError(f"{self.path}: {error}") from None

    def identified(self, base_indices: NDArray[np.intp], *, use_unconstrained: bool) -> ComparedEstimate | None:
        """Return values (unconstrained if asked and known), covariance, motion of some parameters; None: no covariance.

        Args:
            base_indices: indices of the parameters, in the order of the comparison.
            use_unconstrained: whether values are those before they were held in a feasible set.
        """
        covariance = self.covariance
        if covariance is None:
            return None
        values = self.unconstrained if use_unconstrained else None
        values = self.file.values if values is None else values
        fit = self.content.get("fit", {})
        motion = None if self.information is None else Motion.of(self.information, values, base_indices.tolist())
        return ComparedEstimate(
            tuple(self.leading[place] for place in base_indices),
            values[base_indices],
            covariance[np.ix_(base_indices, base_indices)],
            fit.get("blocks"),
            motion,
        )


def read_side(results_path: Path) -> ComparedSet:
    """Read and check a folder of results or a parameter file, to be compared.

    Raises:
        UsageError: neither is there.
        ParameterError: torn, changed or foreign, or values that contradict each other.
        ConfigError: the folder's arm is not one that this version reads.
    """
    if results_path.is_dir():
        results = read_results(results_path)
        require_consistent(results.parameters, results_path / PARAMETERS)
        return ComparedSet(results_path, results.sha256[PARAMETERS], results.parameters, results.config)
    file = read_parameters(results_path)
    require_consistent(file, results_path)
    return ComparedSet(results_path, hashlib.sha256(results_path.read_bytes()).hexdigest(), file)


@dataclass(frozen=True)
class AppliedValues:
    """Values in use of the parameters that both sides have.

    Attributes:
        reference: values [SI], shape (shared,).
        side: values of the other side [SI], shape (shared,).
        apart: whether they are other values than the tested ones, on either side.
        shares: per joint, the root mean square by which their difference changes its torque, over that of the torque
            and over that of the residual, each of shape (joints,); None where no motion is known.
    """

    reference: Array
    side: Array
    apart: bool
    shares: tuple[Array, Array] | None

    @property
    def matters(self) -> bool:
        """Return whether the difference of the values in use changes some joint's torque by a relevant amount."""
        return self.shares is not None and relevant(self.shares)

    def worst(self) -> tuple[int, float] | None:
        """Return (joint from 0, share) where the difference changes torque by the largest share; None if not known."""
        if self.shares is None:
            return None
        joint = int(np.argmax(self.shares[0]))
        return joint, float(self.shares[0][joint])


def values_in_use(
    sides: tuple[ComparedSet, ComparedSet],
    shared_indices: Sequence[NDArray[np.intp]],
    compared: tuple[ComparedEstimate, ComparedEstimate] | None,
) -> AppliedValues:
    """Return both sides' values in use, whether the tests used others, and what share of torque they differ by.

    Args:
        sides: the reference and the other.
        shared_indices: indices of the shared parameters in each side.
        compared: both as they are tested; None where they are not.
    """
    reference, side = (one.file.values[at] for one, at in zip(sides, shared_indices, strict=True))
    if compared is None:
        return AppliedValues(reference, side, False, None)
    first, second = compared
    seen = np.isfinite(np.diag(first.covariance) + np.diag(second.covariance))
    apart = not (np.array_equal(first.values, reference) and np.array_equal(second.values, side))
    return AppliedValues(reference, side, apart, torque_shares(first, second, np.where(seen, side - reference, 0.0)))


UNSAID = "-"
Verdict = Literal["unchanged", "changed", "impossible"]


@dataclass(frozen=True)
class CrossErrors:
    """Torque errors of both sides' parameters on the data that the second side was identified from."""

    reference: TorqueError
    own: TorqueError


@dataclass(frozen=True)
class Pair:
    """Comparison of one side with the reference.

    Attributes:
        side: the one that is compared.
        places: indices of the shared parameters in the reference's and in this side's table, each of shape (shared,).
        only_reference: expressions that the reference alone has.
        only_side: expressions that this side alone has.
        difference: difference of the compared values, this side less reference, shape (shared,).
        compared: reference and this side as they are tested; None without covariances.
        drift: the tests; None likewise.
        reason: reason why there is no verdict; empty otherwise.
        causes: single explanations, the best first; none where no motion is known.
        crossed: the reference's parameters on this side's torques; None where these are not kept.
        provenance: differences in how the two came about: key to both values.
        notes: notes for the reader.
        in_use: the values that the sides are used with, which need not be those that are tested.
        free: whether values from before any constraint are tested.
        other_shape: joints, from 1, whose friction has another shape on each side, and so is not compared.
    """

    side: ComparedSet
    places: tuple[NDArray[np.intp], NDArray[np.intp]]
    only_reference: tuple[str, ...]
    only_side: tuple[str, ...]
    difference: Array
    compared: tuple[ComparedEstimate, ComparedEstimate] | None
    drift: ParameterChange | None
    reason: str
    causes: tuple[Cause, ...]
    crossed: CrossErrors | None
    provenance: Mapping[str, tuple[str, str]]
    notes: tuple[str, ...]
    in_use: AppliedValues
    free: bool
    other_shape: tuple[int, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """Return `changed`, `unchanged` or `impossible`: nothing tested, or no change but some friction not tested."""
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

    reference: ComparedSet
    pairs: tuple[Pair, ...]

    @property
    def verdict(self) -> Verdict:
        """Return `changed` if any side has changed, else `impossible` if any cannot be tested, else `unchanged`."""
        words = [pair.verdict for pair in self.pairs]
        return "changed" if "changed" in words else "impossible" if "impossible" in words else "unchanged"


def compare(sides: Sequence[ComparedSet]) -> Comparison:
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


def _pair(reference: ComparedSet, side: ComparedSet) -> Pair:
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
    first, second = (
        one.identified(at, use_unconstrained=free) for one, at in zip((reference, side), places, strict=True)
    )
    found, compared, explained, reason = None, None, tuple[Cause, ...](), ""
    if first is None or second is None:
        without = [str(one.path) for one, known in ((reference, first), (side, second)) if known is None]
        reason = f"no covariance in {' and '.join(without)}; differences are listed, nothing can be tested"
        difference = side.file.values[places[1]] - reference.file.values[places[0]]
    else:
        compared, found = (first, second), detect_change(first, second)
        difference = found.difference
        if differing and found.verdict == "unchanged":
            reason = (
                f"friction of joint {', '.join(_names(side, differing))} was fitted with another shape and is not "
                f"compared; everything else is unchanged. Identify again with the reference's shape:"
                f" {_remedy(reference)}"
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


def _others(side: ComparedSet, other: ComparedSet) -> tuple[str, ...]:
    expressions = side.content["base_parameters"]["expressions"]
    return tuple(expression for expression, key in zip(expressions, side.keys, strict=True) if key not in other.keys)


# Pre-sliding distances [rad or m] that differ by less change Coulomb friction over a motion by a thousandth; a Stribeck
# velocity changes what the other friction terms mean.
_SAME_SHAPE = {"presliding": 5e-4, "stribeck_velocity": 0.0}


def _other_shape(reference: ComparedSet, side: ComparedSet) -> tuple[int, ...]:
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


def _remedy(reference: ComparedSet) -> str:
    arm = reference.path / ARM
    return f"ident identify ... --arm {arm}" if reference.config is not None else "identification.friction as numbers"


def _names(side: ComparedSet, joints: Sequence[int]) -> list[str]:
    return [side.joints[joint - 1] if side.joints is not None else str(joint) for joint in joints]


def _crossed(
    reference: ComparedSet, side: ComparedSet, places: tuple[NDArray[np.intp], NDArray[np.intp]]
) -> CrossErrors | None:
    """Return torque errors with the values in use, held in a feasible set or not; None where tables differ."""
    size = side.file.base.size
    if side.information is None or len(places[0]) != size or size != reference.file.base.size:
        return None
    beta = np.empty(size)
    beta[places[1]] = reference.file.values[places[0]]
    return CrossErrors(torque_error(side.information, beta), torque_error(side.information, side.file.values))


def _provenance(reference: ComparedSet, side: ComparedSet) -> dict[str, tuple[str, str]]:
    known = [_flat(one) for one in (reference, side)]
    keys = list(dict.fromkeys([*known[0], *known[1]]))
    both = {key: (known[0].get(key, UNSAID), known[1].get(key, UNSAID)) for key in keys}
    return {key: pair for key, pair in both.items() if pair[0] != pair[1]}


def _flat(side: ComparedSet) -> dict[str, str]:
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


def _notes(
    reference: ComparedSet, side: ComparedSet, free: bool, differing: Sequence[int], in_use: AppliedValues
) -> list[str]:
    notes = []
    both = (reference.content, side.content)
    names = [content.get("arm", {}).get("name") for content in both]
    if names[0] != names[1] and all(names):
        notes.append(f"different arms: {names[0]} and {names[1]}")
    if reference.joints and side.joints and reference.joints != side.joints:
        notes.append(f"joints are called {', '.join(reference.joints)} and {', '.join(side.joints)}; compared in order")
    tested = reference.covariance is not None and side.covariance is not None
    if tested and not free and any(content.get("feasible_set") in ("inertia", "pseudo_inertia") for content in both):
        notes.append("constrained values are compared, with the covariance of unconstrained ones: conservative")
    made = [f"{content.get('method', '?')}, {content.get('feasible_set', '?')}" for content in both]
    if made[0] != made[1] and (worst := in_use.worst()) is not None:
        notes.append(
            f"values in use come about in two ways ({made[0]}; {made[1]}) and change the torque of joint "
            f"{', '.join(_names(side, [worst[0] + 1]))} by {worst[1]:.2%}, the most of all joints"
        )
    recordings = [{one["sha256"] for one in content.get("provenance", {}).get("recordings", [])} for content in both]
    if reference.sha256 != side.sha256 and recordings[0] & recordings[1]:
        notes.append("both were fitted to the same recording: their uncertainties are not independent")
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
    found = [[one["factor"] for one in content.get("torque_constants", [])] for content in both]
    if (scales[0] != scales[1] and all(scales)) or found[0] != found[1]:
        notes.append("torques were multiplied by different factors")
    return notes


_OF_JOINTS = ("friction", "drive inertia")
EXPLAINS = 0.9  # of the squared change of torque; a single cause that explains less is not the whole story


@dataclass(frozen=True)
class Finding:
    """Description of one change, for a person.

    Attributes:
        what: name of the changed quantity, and of its joint or link.
        sigma: length of the change in standard deviations.
        joint: name of the joint whose torque changes most for its size; empty where no motion is known.
        torque_share: change of that joint's predicted torque, as a share of its torque; None where no motion is known.
        residual_share: the same change as a share of that joint's residual; None where no motion is known.
        size: size of the change, in words; may be empty.
        meaning: possible meaning, in words.
    """

    what: str
    sigma: float
    joint: str
    torque_share: float | None
    residual_share: float | None
    size: str
    meaning: str


def findings(pair: Pair) -> tuple[Finding, ...]:
    """Describe what changed from the reference to a side: one finding at least if `changed`, else none."""
    found, compared = pair.drift, pair.compared
    if found is None or compared is None or found.verdict != "changed":
        return ()
    links = _links(pair)
    changes = found.changes
    best = pair.causes[0] if pair.causes and pair.causes[0].explained >= EXPLAINS else None
    whole: tuple[Finding, ...] = ()
    if best is not None and best.kind == "body":
        whole = (_whole(pair, found, best, links),)
        changes = tuple(effect for effect in changes if effect.kind in _OF_JOINTS)
    single = tuple(_single(pair, found, compared, effect, links) for effect in changes)
    return (*whole, *single) or (_whole(pair, found, best, links),)


def joint_name(pair: Pair, joint_number: int) -> str:
    """Return the name of a joint counted from 1, or its number where the side knows no name."""
    names = pair.side.joints
    return names[joint_number - 1] if names is not None and joint_number <= len(names) else str(joint_number)


def _links(pair: Pair) -> int:
    names = pair.side.file.base.names
    return max(int(name[1:]) for name in names if name.startswith("m") and name[1:].isdigit())


def _whole(pair: Pair, found: ParameterChange, cause: Cause | None, links: int) -> Finding:
    """Return the change of all parameters together, as a finding."""
    joint, torque, residual = "", None, None
    if found.torque_share is not None and found.residual_share is not None:
        worst = int(found.residual_share.argmax())
        joint = joint_name(pair, worst + 1)
        torque, residual = float(found.torque_share[worst]), float(found.residual_share[worst])
    if cause is None:
        what, size, meaning = (
            "all parameters together",
            "",
            "no single joint or link; check conditions common to all",
        )
    else:
        owner = f"link {cause.number}" if cause.kind == "body" else f"joint {joint_name(pair, cause.number)}"
        what, meaning = f"{cause.kind} of {owner}", meaning_of_cause(cause, links)
        size = f"explains {cause.explained:.1%} of the change"
        if (mass := cause.changes.get(f"m{cause.number}")) and cause.kind == "body" and cause.number == links:
            size += f"; about {mass:+.3g} kg"
    return Finding(what, found.joint.sigma, joint, torque, residual, size, meaning)


def _single(
    pair: Pair, found: ParameterChange, compared: tuple[ComparedEstimate, ComparedEstimate], effect: Effect, links: int
) -> Finding:
    owner = f"joint {joint_name(pair, effect.number)}" if effect.kind in _OF_JOINTS else f"link {effect.number}"
    return Finding(
        what=f"{effect.kind} of {owner}",
        sigma=effect.test.sigma,
        joint="" if effect.joint is None else joint_name(pair, effect.joint + 1),
        torque_share=effect.torque_share,
        residual_share=effect.residual_share,
        size=_ratio(compared, effect.number) if effect.kind == "friction" else "",
        meaning=meaning_of_effect(effect, found, compared[0].leading, links),
    )


def _ratio(compared: tuple[ComparedEstimate, ComparedEstimate], joint: int) -> str:
    found = friction_ratio(*compared, joint)
    return "" if found is None else f"{found[0] - 1.0:+.0%} at {found[1]:.2g} rad/s"
