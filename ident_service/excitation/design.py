"""Design the most informative motion that an arm can safely make, and prove that it can.

Everything a search needs is settled here, contradictions refused with their reason before it begins; what it finds is
then proven for all time. A motion of which not everything can be proven is made smaller, which costs information of
every joint. Where it is the arm that does not follow, or comes too near, the search is told how much more to keep free
and goes on from there.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident_service.config.motion_design import Criterion, Design
from ident_service.config.motion_limits import MotionLimits, motion_limits
from ident_service.errors import MotionRefused, UsageError
from ident_service.excitation.active_limits import (
    ActiveLimit,
    active_limit_lines,
    active_limits,
    improvement_words,
    needed_stiffness,
    stiffer_gains,
)
from ident_service.excitation.limit_proof import Proof, peak_bounds, proof_of, scale_to_verified, tightened, violations
from ident_service.excitation.motion_file import LONGEST, Excitation
from ident_service.excitation.optimal_design import Task, condition_number, criterion, usable_limits
from ident_service.excitation.prediction import (
    USABLE,
    described_noise,
    dry_friction,
    information,
    seconds_of_information,
)
from ident_service.excitation.search import FIRST_LOOK, Budget, Candidate, Progress, SearchResult, polished, search
from ident_service.excitation.trajectory import Basis, FourierBasis, FourierPath, PostureBasis, PosturePath
from ident_service.model.arm_model import ArmModel, control_model
from ident_service.model.base_parameters import BaseParameters, base_parameters, static_base_parameters
from ident_service.model.capsule_distances import CapsuleModel
from ident_service.model.chain import Array
from ident_service.model.collision import CollisionModel
from ident_service.model.expected_friction import expected_friction
from ident_service.model.regressor import joint_regressor

_TRIED = 4000
_INSIDE = 0.01  # of a joint's range, at either end
_RESERVE = 0.9  # of the room between clearance and torque limits that the posture should leave to a motion about it


def safe_posture(model: ArmModel, limits: MotionLimits, seed: int = 0, extra_clearance: float = 0.0) -> Array:
    """Return the tried posture nearest to home that leaves room for a motion, shape (joints,); raises if none.

    Args:
        model: model whose prior gives the gravity torque.
        limits: limits of the motion, margins taken off.
        seed: of the postures that are tried.
        extra_clearance: distance kept free beyond the workspace's clearance [m].

    Raises:
        MotionRefused: no posture keeps the limits; the message says which of them stand in the way.
    """
    rng = np.random.default_rng(seed)
    # At the very end of a range there is no room for a motion, nor for the rounding of a proof.
    span = limits.upper - limits.lower
    lower, upper = limits.lower + _INSIDE * span, limits.upper - _INSIDE * span
    home = np.clip(limits.home, lower, upper)
    # Nearer and nearer to home: half of the postures are drawn from all of the range, the others from parts of it.
    share = np.where(np.arange(_TRIED) % 2, 1.0, rng.uniform(size=_TRIED))[:, None]
    drawn = rng.uniform(lower, upper, size=(_TRIED, len(home)))
    postures = np.vstack([home, 0.5 * (lower + upper), home + share * (drawn - home)])
    torque = _torque_used(model, limits, postures)
    capsules = CapsuleModel(model)
    clearance = model.config.workspace.clearance + extra_clearance
    room = np.full(len(postures), np.inf)
    if capsules.pairs:
        distances = capsules.distances(postures)
        room = distances.min(axis=0)
    stands = (torque.max(axis=1) < 1.0) & (room > clearance)
    if not stands.any():
        raise MotionRefused(_reason(model, torque, room, clearance, capsules, postures))
    roomy = stands & (torque.max(axis=1) < _RESERVE) & (room > clearance + 0.02)
    pick = np.flatnonzero(roomy if roomy.any() else stands)
    away = (((postures[pick] - home) / span) ** 2).sum(axis=1)
    return np.asarray(postures[pick[int(away.argmin())]])


def _torque_used(model: ArmModel, limits: MotionLimits, postures: Array) -> Array:
    """Return the share of the torque limits that standing takes, dry friction against it, shape (postures, joints)."""
    if model.prior is None:
        return np.zeros_like(postures)
    still = np.zeros_like(postures)
    rows = joint_regressor(model.chain, model.layout, postures, still, still)
    _, dry = dry_friction(model, model.prior)
    gravity = np.einsum("jps,p->sj", rows, model.prior)
    used = (np.abs(gravity) + dry) / limits.torque
    return np.asarray(
        used if limits.motors is None else np.maximum(used, limits.motors.torque_shares_of_joints(gravity))
    )


def _reason(
    model: ArmModel, torque: Array, room: Array, clearance: float, capsules: CapsuleModel, postures: Array
) -> str:
    name, tried = model.config.name, len(postures)
    strong, clear = torque.max(axis=1) < 1.0, room > clearance
    if not strong.any():
        joint = int(torque.min(axis=0).argmax())
        if torque[:, joint].min() >= 1.0:
            return (
                f"{name}: {model.chain.names[joint]} cannot hold the arm in any of {tried} postures: standing asks for "
                f"at least {torque[:, joint].min():.0%} of what the torque limit leaves after the margin"
            )
        return f"{name}: in each of {tried} postures some joint cannot hold the arm within its torque limit"
    if not clear.any():
        best = int(room.argmax())
        pair = capsules.pairs[int(capsules.distances(postures[best : best + 1])[:, 0].argmin())]
        return (
            f"{name}: no posture within the position limits keeps {clearance:g} m clear: of {tried} tried the best "
            f"leaves {room[best]:.3f} m at {pair}; check workspace, obstacles and position limits"
        )
    return f"{name}: of {tried} postures none keeps torque limits and clearance together"


_ROUNDS = 2
_NEARLY = 0.99  # of its size: a motion of which so much can be proven is not worth searching on
_ENOUGH = 0.05  # of the criterion, lost to a proof: below, what else was tried is not proven too


@dataclass(frozen=True)
class Attempt:
    """The proof of one motion.

    Attributes:
        task: of the search that found it.
        candidate: the motion at full size.
        proof: proof of the motion at full size.
        why: objection to the motion at full size, in words; empty for none.
        result: coefficients and proof of the largest motion that could be proven, None where none could.
        value: criterion of the largest proven motion; infinite where there is none.
        refused: objection to the last size that was tried, in words.
    """

    task: Task
    candidate: Candidate
    proof: Proof
    why: str
    result: tuple[Array, Proof] | None
    value: float
    refused: str


class Prover:
    """Prove motions that a search has found, and search on, or shrink them, where not everything can be proven."""

    def __init__(
        self,
        model: ArmModel,
        task: Task,
        safe: Array,
        torque_margin: float,
        value: Callable[[Array], float],
        veto: Callable[[FourierPath | PosturePath], str | None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Hold the arm and the search whose motions are to be proven.

        Args:
            model: of the arm.
            task: of the search.
            safe: a posture that keeps all limits, shape (joints,).
            torque_margin: share of the torque that motions keep free.
            value: the criterion of a motion's coefficients, to be made small.
            veto: function that returns a further objection to a motion of which everything is proven, in words; None
                for none.
            clock: clock of the search's budget [s].
        """
        self._model, self._task, self._safe, self._margin = model, task, safe, torque_margin
        self._value, self._veto, self._clock = value, veto, clock
        self._limits, self._collision = motion_limits(model.config), CollisionModel(model)

    def proof(self, coefficients: Array) -> tuple[Proof, str]:
        """Return the proof of a motion's bounds, and what speaks against the motion in words; "" where nothing does."""
        path, limits = self._task.basis.path(coefficients), self._task.limits
        proof = proof_of(path, self._model, limits, self._collision, self._margin)
        why = "; ".join(violations(proof, self._model, limits))
        return proof, why or self._veto(path) or ""

    def prove_best(
        self,
        candidates: Sequence[Candidate],
        samples_per_period: int,
        search_seconds: float | None,
        cancelled: Callable[[], bool],
        best: Attempt | None = None,
        task: Task | None = None,
    ) -> Attempt | None:
        """Prove candidates, best first, searching on or shrinking if it fails; return the best, if any, even unproven.

        Args:
            candidates: candidates of the search. Their values are of a smoothed criterion; the exact one, used here,
                may rank them otherwise.
            samples_per_period: samples per period with which the search goes on.
            search_seconds: time for searching on, proofs not counted [s]; no bound when None.
            cancelled: called at every evaluation; True ends searching on.
            best: an earlier attempt.
            task: task of the search that found the candidates; the task of all proofs when None.

        Returns:
            The attempt with the smallest value, whose result is None where nothing could be proven; None without
            candidates and without `best`.
        """
        task = task or self._task
        ranked = sorted((self._value(one.coefficients), place) for place, one in enumerate(candidates))
        for value, place in ranked:
            if best is not None and value >= best.value:
                break  # even without the loss that a proof may cost it is no better
            each = None if search_seconds is None else search_seconds / _ROUNDS
            tries = self._searched_on(task, candidates[place], samples_per_period, each, cancelled)
            search_seconds = 0.0  # for one candidate: the others are there to be made smaller
            for tried in reversed(tries):
                one = self._largest(tried)
                best = one if best is None or one.value < best.value else best
                if best.value - value < _ENOUGH:
                    break
        return best

    def harder_task(self, candidate: Candidate) -> Task:
        """Return the task made harder by what the candidate's proof lacks at full size; else the task itself."""
        first = self._at_full_size(self._task, candidate)
        return (self._harder(first) if first.why else None) or self._task

    def safe_posture(self, task: Task) -> Array:
        """Return a posture that keeps the task's limits and clearance, shape (joints,); raises if none is found."""
        if task.extra_clearance == self._task.extra_clearance:
            return self._safe
        return safe_posture(self._model, task.limits, extra_clearance=task.extra_clearance)

    def _harder(self, attempt: Attempt) -> Task | None:
        """Return the task that keeps free what was missing; None where no posture does."""
        task = tightened(attempt.task, attempt.proof, self._limits)
        try:
            if task is not None:
                self.safe_posture(task)
        except MotionRefused:
            return None
        return task

    def _searched_on(
        self,
        task: Task,
        candidate: Candidate,
        samples_per_period: int,
        seconds: float | None,
        cancelled: Callable[[], bool],
    ) -> list[Attempt]:
        """Return a candidate and what was found from it, each the answer to the proof of the one before."""
        tried = [self._at_full_size(task, candidate)]
        while tried[-1].why and len(tried) <= _ROUNDS and seconds != 0.0 and not cancelled():
            latest = tried[-1]
            harder, whole = self._harder(latest), latest.candidate.coefficients
            if harder is None or not self.proof(self._scaled(whole, _NEARLY))[1]:
                break  # there is nothing to search for, or hardly anything to gain by it
            until = None if seconds is None else self._clock() + seconds

            def over(until: float | None = until) -> bool:
                return cancelled() or (until is not None and self._clock() >= until)

            found = polished(harder, whole, self.safe_posture(harder), candidate.start, samples_per_period, over)
            tried.append(self._at_full_size(harder, found))
        return tried

    def _at_full_size(self, task: Task, candidate: Candidate) -> Attempt:
        whole = candidate.coefficients
        proof, why = self.proof(whole)
        if why:
            return Attempt(task, candidate, proof, why, None, np.inf, why)
        return Attempt(task, candidate, proof, why, (whole, proof), self._value(whole), "")

    def _largest(self, attempt: Attempt) -> Attempt:
        """Return an attempt with the largest motion that can be proven."""
        if not attempt.why:
            return attempt
        whole, basis = attempt.candidate.coefficients, self._task.basis
        refused = attempt.why

        def proven(coefficients: Array) -> Proof | None:
            nonlocal refused
            if coefficients is whole:
                return None
            proof, refused = self.proof(coefficients)
            return None if refused else proof

        result = scale_to_verified(basis, whole, basis.standing(self._safe), proven)
        value = np.inf if result is None else self._value(result[0])
        return replace(attempt, result=result, value=value, refused=refused)

    def _scaled(self, coefficients: Array, share: float) -> Array:
        middle = self._task.basis.standing_at_middle(coefficients)
        return middle + share * (coefficients - middle)


_PER_HARMONIC = 50  # samples of a search per period of its highest harmonic
_PER_WAY = 24  # samples of a search per segment between postures
_MOST_SAMPLES = 2000
_EXACT = 1e6  # exponent of power means that are as good as the extremes themselves
_MENDING = 0.2  # of the time of a search, for what the proof of its result objects to
_LOOKING = 0.2  # of the time, for a first motion and what its proof says about how the arm follows; FIRST_LOOK at most
_SOFT = 3.0  # times the stiffness that a joint lacks to follow at its velocity limit
_SHORTEST = 1.0  # s, below which it does not pay to begin another part of a search


@dataclass(frozen=True)
class Designed:
    """Designed motion, with its proof and the search that it came from.

    Attributes:
        excitation: the motion, ready to be written.
        proof: bounds that hold at every instant.
        condition_number: condition number of the stacked regressor over one pass, as in the paper.
        found: result of the search, to go on from.
        binding: what holds the motion back, and what it costs, in words.
    """

    excitation: Excitation
    proof: Proof
    condition_number: float
    found: SearchResult
    binding: tuple[str, ...] = ()


def motion_family(design: Design, model: ArmModel) -> tuple[Basis, BaseParameters]:
    """Return the motion family (Fourier or postures) of a design, and the base parameters that it can identify."""
    if design.motion == "fourier":
        basis = FourierBasis(design.base_frequency, design.harmonics, design.periods, design.ramp)
        return basis, base_parameters(model.chain, model.layout)
    ways = design.postures - 1
    times = (design.way,) * ways + (2.0 * design.way,) * ways
    return PostureBasis(design.postures, times, design.dwell), static_base_parameters(model.chain, model.layout)


def complete_task(
    model: ArmModel,
    design: Design,
    basis: Basis,
    base: BaseParameters,
    torque_deviations: Array | None = None,
    earlier_information: Array | None = None,
) -> Task:
    """Build the search task of a design, with limits less margins; raises where limits or parameters do not fit.

    Args:
        model: of the arm.
        design: criterion and margins.
        basis: family of motions.
        base: the parameters that the motion shall teach.
        torque_deviations: standard deviation of each joint's torque, shape (joints,); the description's when None.
        earlier_information: information from earlier recordings, plain rows for the condition number and else whitened
            by `torque_deviations`.

    Raises:
        MotionRefused: limits are missing or contradict each other.
        UsageError: `design.parameters` names what is no base parameter.
    """
    full = motion_limits(model.config)
    limits = usable_limits(model.chain.names, full, design)
    _require_torque(model, limits)
    places = {expression.replace(" ", ""): place for place, expression in enumerate(base.expressions)}
    if unknown := [name for name in design.parameters if name.replace(" ", "") not in places]:
        raise UsageError(
            f"{', '.join(unknown)}: not among the base parameters of {model.config.name}; "
            "`ident base-parameters` prints them"
        )
    chosen = np.array([places[name.replace(" ", "")] for name in design.parameters], dtype=np.intp)
    plain = design.criterion == "condition_number"
    own_noise = described_noise(model, full).deviation if torque_deviations is None else torque_deviations
    return Task(
        model=control_model(model),
        columns=base.base,
        basis=basis,
        limits=limits,
        criterion=design.criterion,
        chosen=chosen if len(chosen) else None,
        scale=_scale(model, base, design.criterion),
        noise=np.ones_like(own_noise) if plain else own_noise,
        friction=expected_friction(model, full, design.friction_guess),
        rate=model.config.control.rate,
        added=earlier_information,
    )


def _require_torque(model: ArmModel, limits: MotionLimits) -> None:
    if model.prior is None:
        raise MotionRefused(
            f"{model.config.name}: torque cannot be predicted without prior (CAD) parameters; give them under prior"
        )
    drives, needed = dry_friction(model, model.prior)
    weak = [
        f"{name}: friction {f:g} against {limit:g}"
        for name, f, limit in zip(model.chain.names, needed, limits.torque, strict=True)
        if f >= limit
    ]
    if limits.motors is not None:
        taken = np.abs(limits.motors.to_motors @ model.chain.coupling.T) @ drives
        weak += [
            f"{name}: friction {f:g} against {limit:g}"
            for name, f, limit in zip(limits.motors.names, taken, limits.motors.torque, strict=True)
            if f >= limit
        ]
    if weak:
        raise MotionRefused("dry friction alone exceeds the torque limit less the margin: " + "; ".join(weak))
    supply = model.config.supply
    if supply is not None and supply.standby >= supply.budget:
        raise MotionRefused(
            f"{model.config.name}: the supply's standby {supply.standby:g} W leaves nothing of {supply.budget:g} W"
        )


def _scale(model: ArmModel, base: BaseParameters, kind: Criterion) -> Array | None:
    """Return the scale of each parameter's deviation: the prior's value, at least 1 % of the largest of its unit."""
    if kind != "a_optimal" or model.prior is None:
        return None
    values = np.abs(base.K @ model.prior)
    units = np.array(base.units)
    least = np.array([values[units == unit].max() for unit in units])
    overall = np.where(least > 0.0, 0.01 * least, 0.1)
    return np.asarray(np.maximum(values, overall))


def design_motion(
    model: ArmModel,
    design: Design,
    *,
    seed: int = 0,
    budget: Budget | None = None,
    basis: Basis | None = None,
    base: BaseParameters | None = None,
    torque_deviations: Array | None = None,
    earlier_information: Array | None = None,
    earlier_search: SearchResult | None = None,
    veto: Callable[[FourierPath | PosturePath], str | None] = lambda _: None,
    stable: Callable[[Array, Array], bool] = lambda kp, kd: True,
    tell: Callable[[Progress], None] = lambda _: None,
    cancelled: Callable[[], bool] = lambda: False,
) -> Designed:
    """Return the most informative motion that a search finds, proven to keep all limits; raises MotionRefused if none.

    Args:
        model: of the arm, with prior parameters.
        design: criterion, margins and, unless `basis` is given, the family of motions.
        seed: of the random starts.
        budget: budget of the search; a minute on two cores when None.
        basis: another family of motions.
        base: the parameters that the motion shall teach; all that the family can when None.
        torque_deviations: standard deviation of each joint's torque, shape (joints,); from the description when None.
        earlier_information: information from earlier recordings (`settled`).
        earlier_search: earlier search for the same task, to go on from.
        veto: function that returns a further objection to a motion of which everything is proven, in words, or None; a
            motion with one is made smaller.
        stable: function that judges gains kp and kd, each of shape (joints,), before they are proposed.
        tell: called from time to time.
        cancelled: called from time to time; True ends the search with what it has.

    Raises:
        MotionRefused: limits are missing or contradict each other, home is in collision, or no posture keeps them.
        UsageError: parameters that are none.
    """
    asked = motion_family(design, model)
    require_storable(asked[0] if basis is None else basis)
    basis, base = asked[0] if basis is None else basis, asked[1] if base is None else base
    task = complete_task(model, design, basis, base, torque_deviations, earlier_information)
    collision = CollisionModel(model)
    _require_free_home(model, task.limits, collision)
    safe = safe_posture(model, task.limits, seed)
    _require_holdable_home(model, task.limits)
    require_known_inertia(model, task, safe)
    budget = budget or Budget()
    prover = Prover(
        model, task, safe, design.torque_margin, lambda X: criterion_of(task, basis.path(X), base), veto, budget.clock
    )
    found, best = _searched(task, prover, safe, seed, budget, tell, cancelled, earlier_search)
    limits = motion_limits(model.config)
    if best.result is None and best.candidate.start >= 0:
        gains = _gains(best, (), limits, stable)
        proposed = "".join(f"{model.chain.names[k]}: {words}. " for k, words in gains.items())
        raise MotionRefused(
            f"{model.config.name}: of {found.finished} motions found the arm is certain to follow none, "
            f"however small: {best.refused}. {proposed}Stiffer gains, a wider following_error, or friction and "
            "drive_inertia as they are would help"
        )
    if best.result is None:
        raise MotionRefused(f"not even the posture at rest keeps the limits: {best.refused}")
    coefficients, proof = best.result
    path = basis.path(coefficients)
    kappa = condition_number(information(path, model, base, np.ones(model.chain.joints)))
    excitation = Excitation(
        "designed", path, model.config.motion_sha256, _made(model, design, seed, found, kappa, best.value, proof)
    )
    held: tuple[str, ...] = ()
    if best.value < criterion_of(task, basis.path(basis.standing_at_middle(coefficients)), base):
        whole = best.candidate.coefficients
        bound = active_limits(best.task, whole, samples_per_period(basis))
        lengths = ["rad" if turns else "m" for turns in model.chain.revolute]
        gains = _gains(best, bound, limits, stable)
        held = (
            *(() if coefficients is whole else (_scaling_text(task, base, best),)),
            *active_limit_lines(bound, task, limits, proof.demands.velocity, lengths, gains),
        )
    return Designed(excitation, proof, kappa, found, held)


def _searched(
    task: Task,
    prover: Prover,
    safe: Array,
    seed: int,
    budget: Budget,
    tell: Callable[[Progress], None],
    cancelled: Callable[[], bool],
    earlier: SearchResult | None,
) -> tuple[SearchResult, Attempt]:
    """Search, prove, and spend what time is left on what the proof objects to, or else on searching on."""
    begun, per = budget.clock(), samples_per_period(task.basis)

    def left() -> float:
        return np.inf if budget.seconds is None else budget.seconds - (budget.clock() - begun)

    aimed, looked = task, earlier
    before: tuple[Candidate, ...] = ()
    seconds = kept_back = None
    if budget.seconds is not None:
        kept_back = _MENDING * budget.seconds
        seconds = budget.seconds - kept_back
        if budget.starts is None and earlier is None:
            # What the proof of a first motion finds to be missing is kept free from then on.
            look = min(FIRST_LOOK, _LOOKING * budget.seconds)
            looked = search(task, safe, seed, replace(budget, seconds=look), per, tell, cancelled)
            if looked.candidates[0].start >= 0 and not cancelled():
                aimed = prover.harder_task(looked.candidates[0])
            if aimed is not task:
                before, looked = looked.candidates, None
            seconds -= look
    found = search(
        aimed, prover.safe_posture(aimed), seed, replace(budget, seconds=seconds), per, tell, cancelled, looked
    )
    best = prover.prove_best(found.candidates, per, kept_back, cancelled, task=aimed)
    # What the first look came to may be better, made smaller, than what a short or cancelled search came to after it.
    best = prover.prove_best(before[:1], per, 0.0, cancelled, best)
    if best is None:
        raise AssertionError("a search has at least one candidate")
    # What the proof objected to has had its time.
    at_once = best.task is task and not best.why and best.candidate.start >= 0
    if at_once and budget.seconds is not None and budget.starts is None and not cancelled() and left() > _SHORTEST:
        found = search(task, safe, seed, replace(budget, seconds=left()), per, tell, cancelled, found)
        best = prover.prove_best(found.candidates, per, 0.0, cancelled, best) or best
    return found, best


def _gains(
    attempt: Attempt,
    bound: Sequence[ActiveLimit],
    limits: MotionLimits,
    stable: Callable[[Array, Array], bool],
) -> dict[int, str]:
    """Propose gains by joint, for a motion as it was found and what its proof came to."""
    task, tracking = attempt.task, attempt.proof.tracking
    late = np.zeros(len(limits.kp), dtype=bool)
    needed = needed_stiffness(task, attempt.candidate.coefficients, samples_per_period(task.basis))
    if tracking is not None:
        late = tracking.lagging_joints(limits)
        needed = np.maximum(needed, np.where(late, tracking.error / (USABLE * limits.following_error), 0.0))
    return stiffer_gains(bound, late, needed, limits, stable)


def _scaling_text(task: Task, base: BaseParameters, attempt: Attempt) -> str:
    """Say what it costs that a motion was made smaller until it could be proven."""
    lost = attempt.value - criterion_of(task, task.basis.path(attempt.candidate.coefficients), base)
    gain = improvement_words(task.criterion, float(np.exp(max(lost, 0.0))))
    return f"scaled down until all limits could be proven; at full size it would give about {gain}: {attempt.why}"


def require_known_inertia(model: ArmModel, task: Task, safe_posture: Array) -> None:
    """Given a prior, raise MotionRefused where a joint without drive inertia would lag far at its velocity limit.

    The law's stiffness is kp times the inertia that it knows, behind a wrist next to none; and the arm itself, which
    has more, is simulated with as little. What such a motion comes to is chance.

    Args:
        model: of the arm.
        task: of the search.
        safe_posture: a posture that keeps all limits, shape (joints,).

    Raises:
        MotionRefused: a joint without drive inertia would lag at its velocity limit by far more than it may.
    """
    used = control_model(model)
    if used.prior is None:
        return
    drives = (model.chain.coupling**2).T @ used.layout.term_values("drive_inertia", used.prior)
    times = needed_stiffness(task, task.basis.standing(safe_posture), samples_per_period(task.basis))
    soft = [k for k, name in enumerate(model.chain.names) if drives[k] <= 0.0 and times[k] > _SOFT]
    if soft:
        names = [model.chain.names[k] for k in soft]
        keys = ", ".join(f"joints.{name}.drive_inertia" for name in names)
        terms = "" if "drive_inertia" in model.config.terms else ", and add drive_inertia to terms"
        raise MotionRefused(
            f"{model.config.name}: {', '.join(names)} would lag at the velocity limit by "
            f"{', '.join(f'{times[k]:.2g}' for k in soft)} times what following_error allows: neither prior nor "
            f"description has the inertia of the drives, without which the controller is soft. Write {keys} (rotor "
            f"inertia times the gear ratio squared){terms}"
        )


def require_storable(basis: Basis) -> None:
    """Raise UsageError if a motion of this family is longer than a day.

    Raises:
        UsageError: longer than a day.
    """
    duration = basis.path(np.zeros((1, basis.size))).duration
    if duration > LONGEST:
        raise UsageError(
            f"a motion of {duration:g} s; the longest is {LONGEST:g} s: fewer periods or a higher frequency"
        )


def samples_per_period(basis: Basis) -> int:
    """Return the number of samples at which a search checks a motion, per period (Fourier) or whole motion."""
    if isinstance(basis, FourierBasis):
        return min(_MOST_SAMPLES, max(120, _PER_HARMONIC * basis.harmonics))
    return min(_MOST_SAMPLES, max(120, _PER_WAY * 2 * basis.size))


def criterion_of(task: Task, path: FourierPath | PosturePath, base: BaseParameters) -> float:
    """Return the criterion's value, smaller is better, of a whole motion plus the task's earlier information."""
    G = information(path, task.model, base, task.noise) * seconds_of_information(path) * task.rate
    if task.added is not None:
        G = G + task.added
    return criterion(task.criterion, G, _EXACT, task.chosen, task.scale).value


def _require_holdable_home(model: ArmModel, limits: MotionLimits) -> None:
    standing = PosturePath(np.array([limits.home, limits.home]), np.ones(1), 0.0)
    if weak := peak_bounds(standing, model).torque_and_power_violations(model.chain.names, limits, model.config.supply):
        raise MotionRefused(
            f"{model.config.name}: the arm cannot be held at home, where motions begin, within what the margins leave: "
            f"{'; '.join(weak)}"
        )


def _require_free_home(model: ArmModel, limits: MotionLimits, collision: CollisionModel) -> None:
    if not collision.pairs:
        return
    distances = collision.distances(limits.home[None])[0]
    nearest = int(distances.argmin())
    least = model.config.workspace.clearance
    if distances[nearest] < least:
        what = "in collision" if distances[nearest] < 0.0 else f"nearer than the clearance of {least:g} m"
        raise MotionRefused(
            f"{model.config.name}: home, where motions begin, is {what}: {distances[nearest]:.3f} m at "
            f"{collision.pairs[nearest]}; give another home, or correct geometry and workspace"
        )


def _made(
    model: ArmModel, design: Design, seed: int, found: SearchResult, kappa: float, value: float, proof: Proof
) -> dict[str, object]:
    """Return the provenance of a motion as JSON values: how it was found and what was proven of it."""
    asked = proof.demands
    bounds: dict[str, object] = {
        "position": np.column_stack([asked.lowest, asked.highest]).tolist(),
        **{kind: getattr(asked, kind).tolist() for kind in ("velocity", "acceleration", "jerk")},
    }
    if asked.torque is not None:
        bounds["torque"] = asked.torque.tolist()
    if asked.power is not None:
        bounds["power"] = asked.power
    for name, clearance in (("clearance", proof.clearance), ("approach_clearance", proof.approach)):
        if clearance is not None and clearance.pair is not None:
            bounds[name] = clearance.lower_bound
    return {
        "arm": model.config.name,
        "criterion": design.criterion,
        "criterion_value": value,
        "condition_number": kappa if np.isfinite(kappa) else None,
        "seed": seed,
        "starts": found.finished,
        "position_margin": np.asarray(design.position_margin).tolist(),
        "torque_margin": design.torque_margin,
        "bounds": bounds,
        "bounds_hold": "at every instant: enclosures of the motion and of the model's torque between samples",
        "slack": {name: np.max(values).item() for name, values in asked.slack.items()},
    }
