"""Check the arm against its model: the torque that holds it, and a small jerk-limited motion of one joint at a time.

The torque that holds the arm where it stands is compared with the model's gravity torque.

Two numbers tell direction and scale of a joint. How it follows: the displacement measured from dwell to dwell against
the one asked for. And how it answers torque: measured acceleration against the one that the model expects of the
torque that acted, `M^-1 (tau - g)`, friction and offset taken out. A loop closes over a wrong encoder scale as if
nothing were wrong; only the answer to torque shows it, as it shows a wrong gear ratio, squared. A joint whose sign is
wrong runs away from its reference, until the guard ends that at twice the amplitude; what it did on the way says
whether the sign was why.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident_service.config.motion_limits import MotionLimits, Vector, motion_limits
from ident_service.errors import ArmFault, MotionRefused
from ident_service.model.arm_model import ArmModel
from ident_service.model.collision import CollisionModel
from ident_service.model.expected_friction import ExpectedFriction, expected_friction
from ident_service.model.zero_phase import local_polynomial
from ident_service.motion.clearance import trajectory_clearance
from ident_service.motion.encoder_observer import STANDING
from ident_service.motion.safety_monitor import TORQUE_RATE, TORQUE_RATE_SHARE
from ident_service.motion.ticket import (
    Check,
    Measure,
    Verdict,
    check_from_measures,
    failed_check,
    joint_units,
    measures,
)
from ident_service.motion.trajectory import Reference, RuckigReference, Setpoint, plan_trajectory, rest
from ident_service.preflight.delay import CALM, FREQUENCY, Delay, delay_measures, dither_amplitude
from ident_service.preflight.session import BAND, CREEP, Rows, Session, Trace, remedy_of
from ident_service.preflight.stability import INERTIA, drive_matrix, known_drive_inertia
from ident_service.preflight.static_checks import HOLDABLE

AMPLITUDES = (0.04, -0.04, 0.02, -0.02)  # rad or m, the first that is free
SPEED, ACCELERATION = 0.2, 1.2  # rad/s and rad/s^2, or m: at one metre 0.2 m/s, below the 0.25 of ISO 10218
DWELL, _SETTLED = 0.25, 0.1  # s at each end, and of it what displacements are measured in
LEARNING = (6.0, 3.0)  # 1/s, in turn: dry friction is learned at this rate, and taken as known the last time
FOLLOWS = (0.8, 1.25)  # measured against commanded displacement
# Where the model lacks the drive's inertia the loop's gain is too low for it, and it overshoots.
FOLLOWS_LOOSELY = (0.5, 2.0)
MOST_ANSWER = 1.0 / INERTIA[0]  # how much more a joint may answer to torque than the model says, at most
# And times the answer of the lightest arm that the description allows: torque constants by data sheet are off by that.
MORE_TORQUE = 1.25
LEAST_ANSWER = 1.0 / (2.0 * INERTIA[1])  # and how much less, where the model knows the drive's inertia
# Rotors by data sheet are the least that is there: of the shipped WAM's wrist, a fifth of what is.
LEAST_DESCRIBED = 0.1
# A prior that has a joint's dry friction, too, which no CAD model knows, is identified: sound arms respond 0.8 to 1.15
# times as expected, 0.66 times with half a kilogram that nobody described.
IDENTIFIED_ANSWER = (0.4, 1.5)
# Below which an answer is reported, although a joint with an unknown inertia may give it; and of an identified prior.
ODD_ANSWER, ODD_IDENTIFIED = 0.5, 0.6
_NEAREST = "response to torque, closest value within its uncertainty"
# Behind an inertia that is missing in the model even a healthy joint answers with next to nothing.
_NEAREST_LOOSELY = (
    "response to torque (a scale that is too low cannot be detected until the prior has the drive inertia)"
)
_DOUBT = 3.0  # standard deviations
_EXPLAINS = 0.5  # of what is unexplained must remain at most when a wrong sign is put right
_LEAST_CYCLES = 8
_BEGUN = 0.95  # of the way that ended at the guard is still to come when a joint has begun to move
_SWINGS = 0.3  # of the largest error, as an error on the other side
_SEEN = 2e-3  # rad or m that a joint must have moved before its sign can be judged
_WINDOW = 0.06  # s, of the filter that differentiates
_MOVING = 0.2  # of the largest speed
SIGN_REMEDY = (
    "Check the sign of this joint's transmission, of its encoder and of its torque in the driver's configuration."
)


@dataclass(frozen=True)
class TestMotion:
    """Represent a small test motion of one joint from where it stands and back.

    Attributes:
        joint: index of the joint.
        amplitude: signed amplitude [rad or m].
        duration: [s].
    """

    joint: int
    amplitude: float
    there: RuckigReference
    back: RuckigReference

    @property
    def duration(self) -> float:
        """Return the duration of both ways and the dwells [s]."""
        return self.there.duration + self.back.duration + 3.0 * DWELL

    def at(self, time: float) -> Setpoint:
        """Return the setpoint at `time` [s], counted from the beginning of the first dwell."""
        time -= DWELL
        if time < self.there.duration + DWELL:
            return self.there.at(max(time, 0.0))
        return self.back.at(time - self.there.duration - DWELL)


@dataclass(frozen=True)
class JointResponse:
    """Represent the response of one joint to its test motion.

    Attributes:
        follows: ratio of the measured to the commanded displacement; NaN where the joint was not moved.
        answers: ratio of the measured to the expected acceleration; NaN where the joint was not moved.
        doubt: standard deviation of `answers`.
    """

    follows: float
    answers: float
    doubt: float


def plan_strokes(
    session: Session, model: ArmModel, limits: MotionLimits, only_joint: int | None = None
) -> list[TestMotion]:
    """Plan a small test motion there and back for each joint, or for index `only_joint`; MotionRefused without room.

    Raises:
        MotionRefused: a joint has no room within its position limits or its surroundings.
    """
    collision = CollisionModel(model)
    own = np.diag(session.mass)
    friction = expected_friction(model, limits, model.config.design.friction_guess).at_joints(model.chain).coulomb
    # The torque against friction rises while the joint sets off, from none to all of it at the speed `CREEP`.
    calm = CALM * np.minimum(TORQUE_RATE, TORQUE_RATE_SHARE * limits.torque) * CREEP
    acceleration = np.minimum(np.minimum(limits.acceleration, ACCELERATION), 0.5 * BAND * limits.torque / own)
    slow = replace(
        limits,
        velocity=np.minimum(limits.velocity, SPEED),
        acceleration=np.minimum(acceleration, calm / np.maximum(friction, calm / ACCELERATION)),
    )
    found = []
    for joint, name in enumerate(model.chain.names):
        if only_joint not in (None, joint):
            continue
        if (free := _clear_test_motion(session.home, joint, collision, slow, model.config.workspace.clearance)) is None:
            raise MotionRefused(f"{name}: no room to move by at least {min(np.abs(AMPLITUDES)):g} either way")
        found.append(free)
    return found


def follow_stroke(session: Session, stroke: TestMotion) -> tuple[Rows, Rows]:
    """Move one joint there and back three times; return the cycles of the third time, and of the second, shaken one.

    Returns:
        The cycles of the last time, and of the time before, when the joint was shaken on its way (`delay.py`).

    Raises:
        ArmFault, DriverError: from the loop.
    """
    reference: Reference = stroke
    first, second = LEARNING
    session.follow(reference, stroke.duration, first)
    amplitude = dither_amplitude(session, session.torque_limit, stroke.joint)
    shaken = session.follow(reference, stroke.duration, second, (amplitude, FREQUENCY))
    return session.follow(reference, stroke.duration), shaken


def judge_response(trace: Trace, stroke: TestMotion, session: Session) -> JointResponse:
    """Return what a complete test motion shows: displacement / expected, response / expected with its deviation."""
    answers, doubt = _response_to_torque(trace, stroke.joint, session)
    return JointResponse(_displaced(trace, stroke) / stroke.amplitude, answers, doubt)


def _response_to_torque(trace: Trace, joint: int, session: Session) -> tuple[float, float]:
    """Return measured over expected acceleration and its standard deviation; NaN where the joint hardly moved."""
    nothing = float("nan"), float("nan")
    rate = trace.rate[:, joint]
    window = max(5, 2 * round(0.5 * _WINDOW / trace.period) + 1)
    if len(rate) < 2 * window:
        return nothing
    largest = np.abs(rate).max()
    measured = local_polynomial(trace.position[:, joint], window, 2, 2, trace.period)
    speed = local_polynomial(trace.position[:, joint], window, 2, 1, trace.period)
    # The same filter on the way that the model expects, so that what it distorts it distorts on both sides.
    expected = local_polynomial(_expected_displacement(trace, session, joint), window, 2, 2, trace.period)
    sliding = (np.minimum(np.abs(rate), np.abs(speed)) > _MOVING * largest) & (np.sign(speed) == np.sign(rate))
    if int(sliding.sum()) < 2 * window:
        return nothing
    ones = np.ones(int(sliding.sum()))
    columns = np.column_stack([expected[sliding], np.sign(rate[sliding]), speed[sliding], ones])
    return _fitted(columns, measured[sliding], window)


def _displaced(trace: Trace, stroke: TestMotion) -> float:
    """Return the mean displacement there and back, from dwell to dwell [rad or m]."""
    ends = (DWELL, stroke.there.duration + 2.0 * DWELL, stroke.duration)
    last = max(1, round(_SETTLED / trace.period))
    rows = [round(end / trace.period) for end in ends]
    start, far, back = (float(trace.position[row - last : row, stroke.joint].mean()) for row in rows)
    return far - 0.5 * (start + back)


def moved_against_torque(trace: Trace, joint: int, session: Session) -> bool:
    """Return whether the joint that left its reference accelerated against its own torque, since it last stood.

    Friction holds it until the torque is large enough, and is constant afterwards, so that only what comes after it has
    begun to move counts, with a constant torque taken out.
    """
    position = trace.position[:, joint]
    away = np.abs(position - position[-1])
    begin = int(np.flatnonzero(away > _BEGUN * away.max())[-1]) if away.max() > _SEEN else len(position)
    rows = slice(max(begin - _LEAST_CYCLES, 0), None)
    moved, push = position[rows], (trace.torque[rows, joint] - session.gravity[joint]) / session.inertia[joint, joint]
    if len(moved) < _LEAST_CYCLES or not np.isfinite(moved).all():
        return False
    speed = np.concatenate([[0.0], np.cumsum(push)[:-1]]) * trace.period
    expected = np.concatenate([[0.0], np.cumsum(speed)[:-1]]) * trace.period
    time = np.linspace(0.0, 1.0, len(moved))
    gain, _ = _fitted(np.column_stack([expected, time**2, time, np.ones_like(time)]), moved, 1.0)
    return gain < 0.0


def swings_to_both_sides(trace: Trace, joint: int) -> bool:
    """Return whether the error's smaller side is over 0.3 of its largest, however small: so swings a loop.

    A loop that is not stable swings, and by its delay seems to move against its torque.
    """
    error = trace.position[:, joint] - trace.reference[:, joint]
    return bool(min(error.max(), -error.min()) > _SWINGS * np.abs(error).max())


def wrong_signs(trace: Trace, session: Session) -> list[int]:
    """Return the indices of the joints whose wrong sign of torque or position explains how the arm moved.

    Measured displacements against the twice integrated accelerations that the model expects, constant torques that the
    model does not know (gravity's for example) taken out on both sides. Joints are coupled, so that one wrong sign
    makes others go the wrong way too: a sign of torque or of position is wrong when turning it round explains at least
    half of what is otherwise unexplained.

    Returns:
        Indices; empty where no sign explains it, or nothing has moved far enough to say.
    """
    moved = trace.position - trace.position[0]
    cycles, joints = moved.shape
    if cycles < _LEAST_CYCLES or np.abs(moved).max() < _SEEN or not np.isfinite(moved).all():
        return []
    time = np.linspace(0.0, 1.0, cycles)
    basis = np.linalg.qr(np.column_stack([np.ones(cycles), time, time**2]))[0]

    def varying(values: Vector) -> Vector:
        return np.asarray(values - basis @ (basis.T @ values))

    seen = varying(moved)
    size = np.maximum(np.linalg.norm(seen, axis=0), 1e-9)

    def unexplained(torque_sign: Vector, position_sign: Vector) -> float:
        expected = varying(expected_displacement(trace, session, torque_sign)) * position_sign
        # How much more or less inertia there is than the model knows is not the question, but no less than none.
        gain = (seen * expected).sum(axis=0) / np.maximum((expected**2).sum(axis=0), 1e-30)
        return float((((seen - np.maximum(gain, 0.0) * expected) / size) ** 2).sum())

    signs = [np.ones(joints), np.ones(joints)]
    left = unexplained(*signs)
    found: list[int] = []
    while len(found) < joints:
        tried = []
        for kind in (0, 1):
            for joint in range(joints):
                other = [one.copy() for one in signs]
                other[kind][joint] *= -1.0
                tried.append((unexplained(*other), joint, other))
        best, joint, other = min(tried, key=lambda one: one[0])
        if best > _EXPLAINS * left or joint in found:
            break
        left, signs = best, other
        found.append(joint)
    return sorted(found)


def sign_failure(joints: Sequence[int], model: ArmModel, reason: str) -> Check:
    """Return the failed direction check of an arm with joints that went the wrong way."""
    names = ", ".join(model.chain.names[joint] for joint in joints)
    return failed_check("direction", f"{names}: seems to move against its torque ({reason})", SIGN_REMEDY)


def direction_check(
    responses: Sequence[JointResponse], model: ArmModel, session: Session, delays: Sequence[Delay] = ()
) -> Check:
    """Return the check `direction`: joints follow, answer torque as predicted, and hide no unknown delay."""
    names, ones = model.chain.names, ("",) * model.chain.joints
    nothing = np.zeros(len(names))
    follows = np.array([one.follows for one in responses])
    # What the drives are known to have does not get lighter with the links: doubled torque shows the sooner.
    most = np.minimum(MOST_ANSWER, MORE_TORQUE * np.diag(session.inertia) / session.lightest)
    known = nothing if model.prior is None else np.diag(drive_matrix(model, model.prior))
    said = known_drive_inertia(model)
    least = np.where(known > 0.0, LEAST_ANSWER, np.where(said > 0.0, LEAST_DESCRIBED, 0.0))
    identified = (known > 0.0) & (_dry_friction(model) > 0.0)
    least = np.where(identified, IDENTIFIED_ANSWER[0], least)
    most = np.where(identified, np.minimum(IDENTIFIED_ANSWER[1], most), most)
    response = np.array([one.answers for one in responses])
    doubt = np.array([one.doubt for one in responses])
    # The doubt is on the arm's side: only an answer that is certainly out of bounds is.
    nearest = np.clip(response, least, most)
    judged_at = np.where(np.abs(response - nearest) <= _DOUBT * doubt, nearest, response)
    found: list[Measure] = [
        *measures("displacement, measured against commanded", follows, ones, names,
                  least=np.where(known > 0.0, FOLLOWS[0], FOLLOWS_LOOSELY[0]),
                  most=np.where(known > 0.0, FOLLOWS[1], FOLLOWS_LOOSELY[1])),
        *measures("response to torque, measured over predicted", response, ones, names),
        *(replace(one, what=_NEAREST if drive > 0.0 else _NEAREST_LOOSELY) for one, drive in zip(
            measures(_NEAREST, judged_at, ones, names, least=least, most=most), known + said, strict=True)),
    ]  # fmt: skip
    # Where the response to torque cannot be told from friction, only following can be judged.
    found = [one for one in found if one.value is not None or one.what.startswith("displacement")]
    found += delay_measures(delays, model, session.period)
    odd = [
        (name, f"{value:.2g}")
        for name, value, sure, known_well in zip(
            names, response, np.abs(response) + _DOUBT * doubt, identified, strict=True
        )
        if sure < (ODD_IDENTIFIED if known_well else ODD_ANSWER)
    ]
    check = check_from_measures(
        "direction",
        found,
        "Check this joint's gear ratio, encoder steps per turn and torque constant in the driver's configuration, and "
        "that no brake and nothing else holds it; a joint that responds too little may lack drive inertia in the prior."
        " One that only falls short of its displacement, and answers torque as expected, is held back by its dry "
        "friction: a larger kp brings it closer. A hidden delay is in the drive's filters or its interpolation, or "
        "belongs into identification.delay.",
    )
    if check.verdict is not Verdict.PASSED:
        return check
    remarks = [*([_of_odd_answers(odd, model)] if odd else []), *_of_friction(model, session.dry_friction)]
    return replace(check, reason=". ".join(remarks)) if remarks else check


def _dry_friction(model: ArmModel) -> Vector:
    """Return the dry friction that the prior has at each joint [N m or N], shape (joints,)."""
    if model.prior is None:
        return np.zeros(model.chain.joints)
    return np.asarray(np.abs(model.layout.term_values("coulomb", model.prior)) @ np.abs(model.chain.coupling))


def _of_odd_answers(odd: Sequence[tuple[str, str]], model: ArmModel) -> str:
    """Say of joints, with their answers to torque, whether a person has to do anything, and what."""
    names, values = (", ".join(column) for column in zip(*odd, strict=True))
    respond = "responds" if len(odd) == 1 else "respond"
    found = (
        f"{names} {respond} to torque {values} times as the model expects. Drives with more inertia than described do"
        " so, and identification finds it. "
    )
    driver = model.config.driver
    if driver is not None and driver.kind == "simulated":
        return f"{found}Nothing to do: the arm is simulated"
    return (
        f"{found}Nothing to do where gear ratios and torque constants of this arm have been checked. Where they have"
        " not, do `ident preflight ARM --scale` before the motion: with a gear ratio configured twice too large a joint"
        " responds 0.25 times as much, with half of the torque 0.5 times"
    )


def _of_friction(model: ArmModel, felt: Vector) -> Iterator[str]:
    """Yield a sentence where drives have so much more dry friction than expected that they may seem frozen in a run."""
    limits, guess = motion_limits(model.config), model.config.design.friction_guess
    expected = expected_friction(model, limits, guess)
    most = 0.5 * STANDING * np.maximum(expected.coulomb, guess[0] * limits.torque) + expected.viscous * 0.5 * SPEED
    dry = [k for k in range(len(felt)) if felt[k] > most[k]]
    if not dry:
        return
    names = ", ".join(model.chain.names[k] for k in dry)
    values = ", ".join(f"{felt[k]:.2g} {'N m' if model.chain.revolute[k] else 'N'}" for k in dry)
    share = max(math.ceil(100.0 * felt[k] / limits.torque[k]) for k in dry) / 100.0
    yield (
        f"{names}: friction takes {values}, more than is expected. Where such a joint reverses it may stand so"
        " long that a run takes its encoder for frozen, and ends. Set design.friction_guess to"
        f" [{share:g}, {guess[1]:g}], and design the motion again: `ident design ARM`"
    )


def _clear_test_motion(
    home: Vector, joint: int, collision: CollisionModel, slow: MotionLimits, clearance: float
) -> TestMotion | None:
    for amplitude in AMPLITUDES:
        target = home.copy()
        target[joint] += amplitude
        if not slow.lower[joint] <= target[joint] <= slow.upper[joint]:
            continue
        try:
            there, back = (
                plan_trajectory(rest(home), rest(target), slow),
                plan_trajectory(rest(target), rest(home), slow),
            )
        except MotionRefused:
            continue
        if not collision.pairs or trajectory_clearance(collision, there, slow, clearance).proven:
            return TestMotion(joint, amplitude, there, back)
    return None


def expected_displacement(trace: Trace, session: Session, torque_sign: Vector | float = 1.0) -> Vector:
    """Return the displacement that the model expects of torque minus gravity [rad or m], (cycles, joints)."""
    acceleration = np.linalg.solve(session.inertia, (torque_sign * (trace.torque - session.gravity)).T).T
    return _integrated_twice(np.asarray(acceleration, dtype=np.float64), trace.period)


def _expected_displacement(trace: Trace, session: Session, joint: int) -> Vector:
    """Return how far the model expects a joint's own torque to have moved it while the others stand, shape (cycles,).

    Others are held by friction and by torques that move nothing.
    """
    # Gravity of where the joint is: over the way it changes by as much as a slow motion takes to accelerate.
    push = (trace.torque - session.gravity_at(trace.position))[:, [joint]] / session.inertia[joint, joint]
    return _integrated_twice(push, trace.period)[:, 0]


def _integrated_twice(acceleration: Vector, period: float) -> Vector:
    """Return the way [rad or m] of accelerations held for a period each, both of shape (cycles, joints)."""
    start = np.zeros((1, acceleration.shape[1]))
    speed = np.vstack([start, np.cumsum(acceleration, axis=0)[:-1]]) * period
    steps = period * (speed + 0.5 * period * acceleration)
    return np.vstack([start, np.cumsum(steps, axis=0)[:-1]])


def _fitted(columns: Vector, values: Vector, correlated: float) -> tuple[float, float]:
    """Return the first coefficient of a least-squares fit and its standard deviation.

    Args:
        columns: shape (samples, unknowns).
        values: shape (samples,).
        correlated: number of samples over which residuals are not independent.
    """
    size = np.linalg.norm(columns, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    solution, _, rank, _ = np.linalg.lstsq(columns / size, values, rcond=None)
    if rank < columns.shape[1]:
        return float("nan"), float("nan")
    left = values - (columns / size) @ solution
    variance = float(left @ left) / max(len(values) - columns.shape[1], 1) * correlated
    inverse = np.linalg.inv((columns / size).T @ (columns / size))
    return float(solution[0] / size[0]), float(np.sqrt(variance * inverse[0, 0]) / size[0])


SETTLE, HOLD = 0.3, 1.0  # s before the mean is taken, and over which
_SUNK = 1e-3  # rad or m that a joint must have moved down before a load is reported
GRAVITY_ERROR = 0.1  # of the torque limit, beside Coulomb friction, which may carry as much of the weight
_SIGNS = "Check the signs of encoders and torques too."
REMEDY = (
    "Compare tool and load on the arm with the description, check that it does not lean on anything, and check "
    "torque constants and the zero positions of the joints."
)


def too_heavy_check(gravity_torque: Vector, model: ArmModel, limits: MotionLimits) -> Check | None:
    """Return a failed check `gravity` if the model's gravity torque exceeds 80 % of a torque limit; else None.

    Args:
        gravity_torque: the model's torque where the arm stands [N m or N], shape (joints,).
        model: of the arm.
        limits: of the arm.
    """
    found = measures(
        "gravity torque of the model",
        np.abs(gravity_torque),
        joint_units(model.chain.revolute, "N m", "N"),
        model.chain.names,
        most=HOLDABLE * limits.torque,
    )
    if all(one.within_limits for one in found):
        return None
    return failed_check(
        "gravity",
        "holding the arm takes too much of the torque limits: "
        + "; ".join(str(one) for one in found if not one.within_limits),
        "Support the arm in a posture that takes less torque, then check again.",
        found,
    )


def holding_torque(rows: Rows, period: float) -> Vector:
    """Return the mean torque that held the arm, after it had settled [N m or N], shape (joints,).

    Args:
        rows: cycles of holding still for `SETTLE + HOLD` seconds.
        period: [s].
    """
    return np.asarray(np.mean([sample.torque for sample, _ in rows[round(SETTLE / period) :]], axis=0))


def gravity_differences(
    held_torque: Vector, gravity_torque: Vector, limits: MotionLimits, friction: ExpectedFriction
) -> tuple[Vector, Vector]:
    """Return |held - gravity|, and the most that it may be by torque limit and friction [N m or N], (joints,) each."""
    return np.abs(held_torque - gravity_torque), GRAVITY_ERROR * limits.torque + friction.coulomb


def gravity_check(
    held_torque: Vector, gravity_torque: Vector, model: ArmModel, limits: MotionLimits, friction: ExpectedFriction
) -> Check:
    """Return the check `gravity`: failed where the torque that held the arm differs too much from the model's.

    Args:
        held_torque: `holding_torque` [N m or N], shape (joints,).
        gravity_torque: the model's torque there, likewise.
        model: of the arm.
        limits: of the arm.
        friction: Coulomb friction may hold the arm instead of torque, either way.
    """
    names = model.chain.names
    force = joint_units(model.chain.revolute, "N m", "N")
    difference, most = gravity_differences(held_torque, gravity_torque, limits, friction)
    found = [
        *measures("holding torque", held_torque, force, names),
        *measures("gravity torque of the model", gravity_torque, force, names),
        *measures("difference", difference, force, names, most=most),
    ]
    check = check_from_measures("gravity", found, REMEDY)
    if check.verdict is Verdict.FAILED and (weight := _weight(held_torque - gravity_torque, gravity_torque, most)):
        return replace(check, reason=f"{weight}: {check.reason}")
    return check


def holding_fault_check(
    session: Session, model: ArmModel, limits: MotionLimits, friction: ExpectedFriction, fault: ArmFault
) -> Check:
    """Return the failed check on a fault that ended the holding: `direction` for a wrong sign, else `gravity`.

    Causes: a wrong sign that explains how the arm moved; what the fault itself says; or a load: an arm that sinks,
    although the torque that holds it is above the model's. Its joints stick on the way, like a frozen encoder.

    Args:
        session: session that held the arm.
        model: of the arm.
        limits: of the arm.
        friction: expected friction.
        fault: the fault.
    """
    remedy, trace = remedy_of(fault), session.trace()
    stands_still = fault.code == "frozen_encoder"
    if remedy is not None and not stands_still:
        return failed_check("gravity", str(fault), remedy)
    if not stands_still and (wrong := wrong_signs(trace, session)):
        return sign_failure(wrong, model, str(fault))
    moved = trace.position[-1] - trace.position[0]
    sunk = (moved * session.gravity < 0.0) & (np.abs(moved) > _SUNK)
    extra = np.where(sunk, trace.torque[-1] - session.gravity, 0.0)
    _, most = gravity_differences(trace.torque[-1], session.gravity, limits, friction)
    if weight := _weight(extra, session.gravity, most):
        joints = ", ".join(
            f"{name} sank by {abs(way):.3g} {unit} against {abs(more):.3g} {force} more than the model's"
            for name, way, more, most_more, unit, force in zip(
                model.chain.names,
                moved,
                extra,
                most,
                joint_units(model.chain.revolute, "rad", "m"),
                joint_units(model.chain.revolute, "N m", "N"),
                strict=True,
            )
            if abs(more) > most_more
        )
        return failed_check("gravity", f"{weight}: {joints}; the safety monitor released it ({fault.code})", REMEDY)
    if remedy is not None:
        return failed_check("gravity", str(fault), remedy)
    return failed_check("gravity", f"the arm could not be held where it stands: {fault}", f"{REMEDY} {_SIGNS}")


def _weight(extra: Vector, gravity: Vector, most: Vector) -> str:
    """Describe whether the arm is heavier or lighter than described, where all joints that differ agree; else empty."""
    sides = np.sign(extra * gravity)[np.abs(extra) > most]
    if not len(sides) or (sides != sides[0]).any() or sides[0] == 0.0:
        return ""
    if sides[0] > 0.0:
        return "the arm is heavier than described, or its drives give less torque than they are asked for"
    return "the arm is lighter than described, or its drives give more torque than they are asked for"
