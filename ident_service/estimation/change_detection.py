"""Detect whether an arm has changed between two identifications, and find the single cause that explains most of it.

With d the difference of the base parameters and S = S_1 + S_2 the sum of their covariances,

    T^2 = d^T S^-1 d

is chi-square distributed over rank(S) directions when nothing has changed and S is known. S comes from the blocks of
two recordings, of which there are not many more than parameters, and T^2 then is larger than chi-square. It follows

    (nu - r + 1) / (nu r) T^2  ~  F(r, nu - r + 1)

with r directions and nu the degrees of freedom of a sum of two estimated covariances (Krishnamoorthy and Yu 2004, eq.
"modified Nel and van der Merwe"; Welch's for r = 1). Directions of the correlation matrix are left out where nothing
was seen, where no variance was estimated because blocks are fewer than parameters, and, the best known first, until
nu - r + 1 >= r: beyond, the inverse of S is noise.

The same test is made of every effect: friction of a joint, drive inertia of a joint, first moments of a link, inertia
of a link. The joint test and all effects together are one family, controlled by Holm's method.

Constrained estimates: their covariance here is that of the unconstrained fit. Projection into a convex set moves two
estimates closer together, not apart, so such a test is on the careful side. Where a file has its unconstrained values,
those are compared, to which the covariance belongs.

A cause only describes a change; whether there is one, the tests say. Base parameters group the parameters of
neighbouring links, so a tool on the last link moves the base parameters of all links before it. A cause is a few link
parameters (friction of a joint, drive inertia of a joint, the body of a link) with their columns C of K. How much of a
difference d it explains is said in torque on the recorded motion, each joint in units of its residual:

    1 - min_x |R (d - C x)|^2 / |R d|^2
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import scipy.special

from ident_service.errors import ParameterError
from ident_service.model.chain import Array
from ident_service.model.information import Information
from ident_service.model.parameter_layout import INERTIAL, TERM_SYMBOLS

Kind = Literal["friction", "drive inertia", "first moments", "inertia"]
Word = Literal["unchanged", "changed", "impossible"]

# One false alarm in a hundred comparisons, over all tests of a comparison together: an arm that is compared every week
# cries wolf once in two years. Changes that matter lie ten and more deviations away.
ALPHA = 0.01
# Of a joint's torque on the motion (root mean square). Drives' torque constants are seldom known to better than 1 %.
RELEVANT_TORQUE = 0.01
# Of what the parameters leave unexplained (root mean square). Noise averages out of parameters, and their covariance
# says how well; model error does neither, and shows in the residual alone.
RELEVANT_RESIDUAL = 0.25

_NO_VARIANCE = 1e-10  # smallest eigenvalue of the correlation matrix, as a share of the largest
_ROUNDING = 8.0 * np.finfo(float).eps
_KINDS: dict[str, Kind] = {
    **dict.fromkeys(INERTIAL[:6], "inertia"),
    **dict.fromkeys(INERTIAL[6:], "first moments"),
    **dict.fromkeys(TERM_SYMBOLS.values(), "friction"),
    TERM_SYMBOLS["drive_inertia"]: "drive inertia",
}


@dataclass(frozen=True)
class Motion:
    """Torque response of a recorded motion to changes of the base parameters.

    Attributes:
        responses: per joint a matrix whose product with a difference of parameters has as its length the root mean
            square of the change of torque [N m or N], shape (rows, base).
        torque: root mean square of each joint's measured torque [N m or N], shape (joints,).
        residual: root mean square of the torque that the identified parameters leave unexplained [N m or N], shape
            (joints,).
    """

    responses: tuple[Array, ...]
    torque: Array
    residual: Array

    @classmethod
    def of(cls, information: Information, beta: Array, base_indices: Sequence[int] | None = None) -> Motion:
        """Build torque responses to base parameters, and RMS of torque and residual, from a recording's equations.

        Args:
            information: the equations.
            beta: all base parameters that were identified from them, SI units, shape (base,).
            base_indices: indices of the base parameters that the responses are about, in that order; all when None.
        """
        wanted = np.arange(information.base) if base_indices is None else np.array(base_indices, dtype=np.intp)
        rows = np.sqrt(np.maximum(information.rows, 1))
        responses = []
        for count, support, factor in zip(rows, information.supports, information.factors, strict=True):
            full = np.zeros((len(factor), information.base))
            full[:, support] = factor[:, :-1] / count
            responses.append(full[:, wanted])
        torque, residual = information.squared_torques(), information.squared_residuals(beta)
        return cls(tuple(responses), np.sqrt(torque) / rows, np.sqrt(residual) / rows)

    def torque_change(self, difference: Array) -> Array:
        """Return the RMS torque change of each joint [N m or N] for a difference of base parameters."""
        return np.array([float(np.linalg.norm(response @ difference)) for response in self.responses])


@dataclass(frozen=True)
class ComparedEstimate:
    """Values and covariance, from one identification, of the base parameters that two identifications share.

    Attributes:
        leading: the link parameter that each base parameter is named after, `fv2` for example.
        values: values of the base parameters, unconstrained where known, SI units, shape (base,).
        covariance: covariance of the values, infinite on the diagonal where nothing was seen, shape (base, base).
        blocks: number of time blocks that the covariance was estimated from; None where it is known exactly.
        motion: torque response of the fitted recordings; None where it was not kept.
    """

    leading: tuple[str, ...]
    values: Array
    covariance: Array
    blocks: int | None = None
    motion: Motion | None = None

    def __post_init__(self) -> None:
        size = len(self.leading)
        if self.values.shape != (size,) or self.covariance.shape != (size, size):
            raise ParameterError(f"{self.values.shape=} and {self.covariance.shape=} but {size} parameters")
        if self.blocks is not None and self.blocks < 2:
            raise ParameterError(f"a covariance from {self.blocks} blocks says nothing")


@dataclass(frozen=True)
class Test:
    """Result of a test that some parameters have not changed.

    Attributes:
        statistic: T^2, the squared length of the difference in deviations.
        directions: r, number of independent directions of the difference.
        degrees: nu of the covariances; infinite where they are known.
        p: probability of a larger statistic by chance when nothing has changed.
        left_out: number of directions in which nothing could be tested.
    """

    statistic: float
    directions: int
    degrees: float
    p: float
    left_out: int

    @property
    def sigma(self) -> float:
        """Return the length of the difference in standard deviations, sqrt(T^2); |z| for a single parameter."""
        return float(np.sqrt(self.statistic))


@dataclass(frozen=True)
class Effect:
    """Test result of one physical effect: friction or drive inertia of a joint, first moments or inertia of a link.

    Attributes:
        kind: of effect.
        number: of the joint or link, from 1.
        places: indices of its parameters.
        test: test of the hypothesis that these parameters have not changed.
        p: p-value of the test, after Holm's correction.
        joint: index of the joint whose torque changes most for its size, from 0; None where no motion is known.
        torque_share: change of that joint's predicted torque, as a share of its torque (root mean squares); None where
            no motion is known.
        residual_share: the same change as a share of that joint's residual; None where no motion is known.
        changed: whether it is significant, and large enough to matter where that can be said.
    """

    kind: Kind
    number: int
    places: tuple[int, ...]
    test: Test
    p: float
    joint: int | None
    torque_share: float | None
    residual_share: float | None
    changed: bool


@dataclass(frozen=True)
class ParameterChange:
    """Difference of two identifications, tested per parameter, per effect and as a whole.

    Attributes:
        difference: second less first, shape (base,).
        deviations: standard deviations of the difference, infinite where either estimate saw nothing, shape (base,).
        z: difference in deviations, 0 where nothing was seen, shape (base,).
        p: p-value of each parameter's own test, after Holm's correction over the parameters, shape (base,).
        joint: the test of all parameters together.
        joint_p: p-value of the joint test, after Holm's correction over it and the effects.
        torque_share: change of each joint's predicted torque, as a share of its torque, shape (joints,); None without a
            motion.
        residual_share: the same change as a share of each joint's residual, shape (joints,); None without a motion.
        effects: all of them, in the order of the parameters.
        verdict: verdict in one word.
    """

    difference: Array
    deviations: Array
    z: Array
    p: Array
    joint: Test
    joint_p: float
    torque_share: Array | None
    residual_share: Array | None
    effects: tuple[Effect, ...]
    verdict: Literal["unchanged", "changed"]

    @property
    def shares(self) -> tuple[Array, Array] | None:
        """Return (`torque_share`, `residual_share`), each of shape (joints,); None where no motion is known."""
        if self.torque_share is None or self.residual_share is None:
            return None
        return self.torque_share, self.residual_share

    @cached_property
    def changes(self) -> tuple[Effect, ...]:
        """Return the effects that have changed, sorted by change of torque over residual, the largest first."""
        found = [effect for effect in self.effects if effect.changed]
        return tuple(sorted(found, key=lambda effect: (-(effect.residual_share or 0.0), effect.p)))


def detect_change(first: ComparedEstimate, second: ComparedEstimate) -> ParameterChange:
    """Test whether base parameters differ between identifications: each, per physical effect, and all together.

    Args:
        first: the reference, the accepted one for example.
        second: the later one; torques are those of its motion, or of the first one's where it has none.

    Raises:
        ParameterError: the two are about different parameters, or one has other shapes than its parameters.
    """
    if first.leading != second.leading:
        raise ParameterError("the two sets are about different base parameters")
    difference = second.values - first.values
    total = np.diag(first.covariance) + np.diag(second.covariance)
    seen = np.isfinite(total)
    # Values are printed with rounding, so even exactly known values are known to that rounding only.
    rounding = _ROUNDING * (np.abs(first.values) + np.abs(second.values)) + np.finfo(float).tiny
    deviations = np.where(seen, np.maximum(np.sqrt(np.where(seen, total, 0.0)), rounding), np.inf)
    singles = [difference_test(first, second, (place,)) for place in range(len(difference))]
    joint = difference_test(first, second, tuple(range(len(difference))))
    groups = parameter_groups(first.leading)
    tests = [difference_test(first, second, places) for places in groups.values()]
    corrected = holm([joint.p, *(test.p for test in tests)])
    effects = []
    for ((kind, number), places), test, p in zip(groups.items(), tests, corrected[1:], strict=True):
        only = np.zeros(len(difference))
        only[list(places)] = difference[list(places)]
        shares = torque_shares(first, second, np.where(seen, only, 0.0))
        worst = None if shares is None else int(np.argmax(shares[0]))
        torque, residual = (None, None) if shares is None else (float(shares[0][worst]), float(shares[1][worst]))
        changed = p < ALPHA and relevant(shares)
        effects.append(Effect(kind, number, places, test, p, worst, torque, residual, changed))
    whole = torque_shares(first, second, np.where(seen, difference, 0.0))
    drifted = any(effect.changed for effect in effects) or (corrected[0] < ALPHA and relevant(whole))
    return ParameterChange(
        difference=difference,
        deviations=deviations,
        z=np.where(seen, difference / deviations, 0.0),
        p=np.array(holm([test.p for test in singles])),
        joint=joint,
        joint_p=corrected[0],
        torque_share=None if whole is None else whole[0],
        residual_share=None if whole is None else whole[1],
        effects=tuple(effects),
        verdict="changed" if drifted else "unchanged",
    )


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values adjusted for multiple tests (Holm 1979), in the order given, at most 1."""
    order = np.argsort(p_values, kind="stable")
    adjusted = np.empty(len(p_values))
    adjusted[order] = np.maximum.accumulate(np.arange(len(p_values), 0, -1) * np.asarray(p_values, dtype=float)[order])
    return [float(value) for value in np.minimum(adjusted, 1.0)]


def torque_shares(first: ComparedEstimate, second: ComparedEstimate, difference: Array) -> tuple[Array, Array] | None:
    """Return RMS torque changes by a difference, in second's (else first's) motion, over torque and residual; or None.

    Returns:
        Per joint, root mean square of the change over that of the torque, and over that of what the parameters
        identified from it leave unexplained; each of shape (joints,). None where no motion is known.
    """
    motion = second.motion or first.motion
    if motion is None:
        return None
    change, tiny = motion.torque_change(difference), np.finfo(float).tiny
    return change / np.maximum(motion.torque, tiny), change / np.maximum(motion.residual, tiny)


def relevant(shares: tuple[Array, Array] | None) -> bool:
    """Return whether some joint's torque changes by at least 1 % of it and 25 % of its residual; True for None."""
    if shares is None:
        return True
    return bool(np.any((shares[0] >= RELEVANT_TORQUE) & (shares[1] >= RELEVANT_RESIDUAL)))


def parameter_groups(leading_names: Sequence[str]) -> dict[tuple[Kind, int], tuple[int, ...]]:
    """Group base parameters by the (kind, joint or link number from 1) of their `leading_names`; return their indices.

    Args:
        leading_names: the link parameter that each base parameter is named after.
    """
    groups: dict[tuple[Kind, int], list[int]] = {}
    for place, name in enumerate(leading_names):
        symbol = name.rstrip("0123456789")
        groups.setdefault((_KINDS.get(symbol, "friction"), int(name[len(symbol) :])), []).append(place)
    return {key: tuple(places) for key, places in groups.items()}


def difference_test(first: ComparedEstimate, second: ComparedEstimate, base_indices: Sequence[int]) -> Test:
    """Test (T^2) whether base parameters at `base_indices` differ between two identifications; p is 1 if none is known.

    Args:
        first: one set.
        second: the other.
        base_indices: indices of the tested parameters, from 0.
    """
    chosen = np.array(base_indices, dtype=np.intp)
    seen = chosen[[np.isfinite(first.covariance[k, k] + second.covariance[k, k]) for k in base_indices]]
    d = second.values[seen] - first.values[seen]
    parts = [one.covariance[np.ix_(seen, seen)] for one in (first, second)]
    blocks = [one.blocks for one in (first, second)]
    rounding = _ROUNDING * (np.abs(first.values[seen]) + np.abs(second.values[seen])) + np.finfo(float).tiny
    if len(seen) == 0:
        return Test(0.0, 0, np.inf, 1.0, len(base_indices))
    S = parts[0] + parts[1]
    scale = np.maximum(np.sqrt(np.diag(S)), rounding)
    exact = np.diag(S) <= rounding**2
    correlation = S / np.outer(scale, scale)
    correlation[exact, exact] = 1.0
    values, vectors = np.linalg.eigh(correlation)
    # Largest variance first: directions left out are the best known, whose variances blocks cannot tell from zero.
    values, vectors = values[::-1], vectors[:, ::-1]
    rank = int(np.sum(values > _NO_VARIANCE * values[0]))
    whitening = (vectors[:, :rank] / np.sqrt(values[:rank])).T / scale
    z = whitening @ d
    for r in range(rank, 0, -1):
        degrees = _degrees([whitening[:r] @ part @ whitening[:r].T for part in parts], blocks)
        if degrees - r + 1.0 >= r or r == 1:
            break
    statistic = float(z[:r] @ z[:r])
    return Test(statistic, r, degrees, p_value(statistic, r, degrees), len(base_indices) - r)


def p_value(statistic: float, directions: int, degrees_of_freedom: float) -> float:
    """Return the p-value of a T^2 (Hotelling): F distribution for finite `degrees_of_freedom`, else chi-squared."""
    if np.isinf(degrees_of_freedom):
        return float(scipy.special.chdtrc(directions, statistic))
    below = max(degrees_of_freedom - directions + 1.0, 1.0)
    return float(scipy.special.fdtrc(directions, below, statistic * below / (degrees_of_freedom * directions)))


def _degrees(parts: Sequence[Array], blocks: Sequence[int | None]) -> float:
    """Return the degrees of freedom of a sum of covariances, each in the coordinates in which the sum is 1."""
    below = 0.0
    for part, count in zip(parts, blocks, strict=True):
        if count is not None:
            below += float(np.sum(part * part.T) + np.trace(part) ** 2) / (count - 1)
    r = len(parts[0])
    return (r + r**2) / below if below > 0.0 else float("inf")


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
        kind: kind of thing that has changed.
        number: of the joint or link, from 1.
        explained: share of the change of torque, squared and in units of residuals, from 0 to 1.
        changes: changes of the link parameters that the difference shows, by name, in SI units.
    """

    kind: CauseKind
    number: int
    explained: float
    changes: Mapping[str, float]


def causes(difference: Array, K: Array, names: Sequence[str], motion: Motion) -> list[Cause]:
    """Return how much of a torque difference each body, friction or drive inertia alone explains, likeliest first.

    The first is the simplest of those that explain nearly the most, the others follow by what they explain. What has no
    torque on this motion is left out.

    Args:
        difference: difference of base parameters, SI units, shape (base,).
        K: matrix K of eq. 38, shape (base, link parameters).
        names: of the link parameters.
        motion: motion whose torques are compared.
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


def meaning_of_cause(cause: Cause, link_count: int) -> str:
    """Return a lower-case phrase on what a cause may mean, from a table: by kind, friction's sign, last link.

    Args:
        cause: to explain.
        link_count: number of links of the arm; the last one carries tools.
    """
    if cause.kind == "body":
        return _MEANINGS["last" if cause.number == link_count else "body"]
    return _MEANINGS["drive inertia"] if cause.kind == "drive inertia" else _MEANINGS[_direction(cause.changes)]


def meaning_of_effect(effect: Effect, change: ParameterChange, leading_names: Sequence[str], link_count: int) -> str:
    """Return a lower-case phrase on what an effect may mean, from a table: by kind, friction's sign, last link."""
    if effect.kind == "friction":
        return _MEANINGS[_direction({leading_names[place]: float(change.difference[place]) for place in effect.places})]
    return _MEANINGS["last" if effect.number == link_count and effect.kind != "drive inertia" else effect.kind]


def friction_ratio(first: ComparedEstimate, second: ComparedEstimate, joint_number: int) -> tuple[float, float] | None:
    """Return (viscous plus Coulomb friction, second over first, at the motion's RMS speed; that speed), or None.

    The speed is the root mean square of the motion's.

    Args:
        first: the reference.
        second: the later one; the speed is that of its motion.
        joint_number: index of the joint, from 1.

    Returns:
        The ratio, and the speed [rad/s or m/s]; None where no motion is known, or the first has no such friction.
    """
    motion, place = second.motion or first.motion, {name: k for k, name in enumerate(first.leading)}
    viscous, coulomb = place.get(f"fv{joint_number}"), place.get(f"fc{joint_number}")
    if motion is None or viscous is None or joint_number > len(motion.responses):
        return None
    speed = float(np.linalg.norm(motion.responses[joint_number - 1][:, viscous]))
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
