"""Find reasons why an estimate cannot be right: wrong units or signs, swapped columns, another arm's geometry.

A set of parameters can be physically feasible, and its regression well conditioned, and still describe nothing: the
recording may be in degrees, or of other joints. Each rule here compares with what any arm, or this arm by its
description, can do. Its limits are far from what sound recordings show, so that a reason is a verdict, not a hint.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident_service.config.arm import JointTerm
from ident_service.estimation.feasible.problems import constrained_least_squares
from ident_service.estimation.identify import Candidate, Estimate
from ident_service.estimation.least_squares import TorqueError, ordinary_least_squares, torque_error
from ident_service.estimation.misread_columns import error_reductions, misread_columns
from ident_service.estimation.misread_gravity import misread_gravity
from ident_service.estimation.uncertainty import jackknife, student_factors
from ident_service.model.arm_model import ArmModel
from ident_service.recordings.quality import JointQuality
from ident_service.recordings.recording import Recording

LARGEST_ERROR = 30.0  # percent of the torque (eq. 84): a controller is better off without such a model
# A joint that feels almost nothing has a torque of noise, which no model predicts: 86 % on the KUKA's last one.
WORSE_THAN_NOTHING, NOT_SMALL = 120.0, 0.5  # percent of a joint's torque, and of its torque on the fitted recordings
MUCH_WORSE, WORSE_FROM = 4.0, 10.0  # times the error on what was fitted to, and percent from which that counts
CONSTRAINED_WORSE, CONSTRAINED_FROM = 1.8, 2.0  # times the unconstrained error, and percent from which that counts
WRONG_SIGN = 8.0  # standard deviations by which friction must be negative
CONSTRAINED_WORSE_WITH_SIGN, PERHAPS_WRONG_SIGN = 1.3, 4.0  # error factor and deviations, only together
MIRRORED_FROM, MIRRORED_WORSE = 20.0, 1.4  # percent and error factor, to try a negated torque
MIRRORED = 1.3  # factor by which the error must shrink with the torque negated
ENOUGH_MOTION, UNKNOWN_OF_LITTLE_MOTION = 10.0, 0.2  # s, and share of the base parameters
_OUTSIDE = 0.1  # share of a joint's range by which a description's limits may be off
_NOISE = 1e-3  # share of a joint's range that encoder noise at a limit may reach
_TURNS = 100.0  # rad, for joints without limits
_TOO_FAST, _TOO_STRONG = 4.0, 4.0  # times the limit of the description
_JUMP = 20.0  # times the usual step between samples
_LEAST_JUMP = 0.02  # rad or m
_TURN, _ABOUT_A_TURN = 2.0 * np.pi, 0.5  # rad, and what a joint itself may move meanwhile
_USUAL_OF_A_TURN = 0.1  # share of it that the usual step may be, which other turns are part of
_DENSITY = 1000.0  # kg for an arm of one metre, growing with its volume
_SAMPLES_OF_A_JUMP = 100  # with fewer samples the usual step is unknown
# Gravity alone may hold a torque on one side of zero, but seldom of so many joints at almost nothing.
_JOINTS_WITH_SIGN, _NEARLY_NOTHING = 4, 0.01  # and share of a joint's largest torque
_CLIPPED, _CLIPPED_ERROR = 0.05, 10.0  # share of the samples, and percent of the joint's torque, only together
_WEAKEST = 0.005  # of its limit, that the torque of some joint reaches in every motion
_GOES_ON = 0.1  # of a joint's whole range of torque, in which it changes while a position is frozen
_AT_REST = 0.9  # share of the time at standstill from which a joint need not feel a changing torque


@dataclass(frozen=True)
class Objections:
    """Reasons why an estimate must not be used.

    Attributes:
        wrong: faults of the recordings or the description, in words.
        little_motion: reasons why the motion tells too little, which a longer or richer one mends.
    """

    wrong: tuple[str, ...]
    little_motion: tuple[str, ...] = ()

    @property
    def reasons(self) -> tuple[str, ...]:
        """Return all reasons against the estimate: those of `wrong`, then those of `little_motion`."""
        return (*self.wrong, *self.little_motion)

    @property
    def motion_mends(self) -> bool:
        """Return whether another motion is all that is needed: reasons of `little_motion`, and none of `wrong`."""
        return bool(self.little_motion) and not self.wrong


def reasons_against(estimate: Estimate, recordings: Sequence[Recording] = ()) -> tuple[str, ...]:
    """Return sentences on why an estimate cannot be right: misread columns or gravity, torque errors; () for none.

    The words name the most likely cause where the numbers tell one.

    Args:
        estimate: to judge.
        recordings: recordings that the estimate was fitted to, to find columns that were misread; without them only
            wrong signs of torques are found.
    """
    names = estimate.model.chain.names
    misread, gravity = misread_columns(estimate, recordings), misread_gravity(estimate, recordings)
    if gravity is not None and (
        misread is None or gravity.error_reduction > float(error_reductions(misread.before, misread.after).sum())
    ):
        return (gravity.sentence(names),)
    if misread is not None:
        return (misread.sentence(names),)
    own = estimate.candidates[estimate.chosen]
    return (
        *_errors(own),
        *_joints_worse_than_nothing(own, names),
        *_compare_with_unconstrained(estimate),
    )


def reasons_in_length(estimate: Estimate, motion_seconds: float) -> tuple[str, ...]:
    """Return a sentence if a motion is short and leaves too much unidentified; () if not, or if others validate it.

    A short motion that leaves much unidentified predicts itself and nothing else. Where other recordings validate the
    estimate, their errors judge it.

    Args:
        estimate: to judge.
        motion_seconds: total length of the fitted recordings [s].
    """
    rows = estimate.prepared.equations.moving.rows
    moved = motion_seconds * float(rows.max(initial=0)) / max(estimate.samples, 1)
    unknown, size = estimate.verdicts.count("unidentified"), estimate.base.size
    # Stribeck friction of a drive that is never slow has no effect.
    unseen = [
        expression
        for expression, deviation in zip(estimate.base.expressions, estimate.standard_deviations, strict=True)
        if not np.isfinite(deviation) and not expression.startswith("fs")
    ]
    if estimate.candidates[estimate.chosen].validation or moved >= ENOUGH_MOTION:
        return ()
    if unknown <= UNKNOWN_OF_LITTLE_MOTION * size and not unseen:
        return ()
    what = f"{unknown} of its {size} base parameters are unidentified" + (", some not excited at all" if unseen else "")
    return (
        f"it was fitted to {moved:.1f} s of motion, and {what}: it predicts that motion and perhaps no other; record at"
        f" least {ENOUGH_MOTION:g} s of motion, or validate it on another motion (--validate)",
    )


def reasons_in_recording(
    recording_name: str, joint_qualities: Sequence[JointQuality], model: ArmModel
) -> tuple[str, ...]:
    """Return sentences on why a recording cannot be of this arm in SI units; empty where nothing speaks against it.

    Args:
        recording_name: name of the recording, for the words.
        joint_qualities: quality of each joint's samples.
        model: the arm and its limits.
    """
    found = [
        f"{recording_name}: {reason}"
        for index, seen in enumerate(joint_qualities)
        for reason in _of_joint(model.chain.names[index], seen, model, revolute=model.chain.revolute[index])
    ]
    together = (
        *_weight(joint_qualities, model),
        *_without_sign(joint_qualities),
        *_nearly_none(joint_qualities, model),
    )
    return (*found, *(f"{recording_name}: {reason}" for reason in together))


def torque_missing(joint_quality: JointQuality) -> bool:
    """Return whether a joint's torque never changes although the joint moves, so that it was not recorded."""
    return joint_quality.torque[0] == joint_quality.torque[1] and joint_quality.standstill < _AT_REST


def wrapped(joint_quality: JointQuality) -> bool:
    """Return whether a joint's largest step is about one whole turn beside small ones: angles wrapped around."""
    return (
        abs(joint_quality.largest_step - _TURN) < _ABOUT_A_TURN and joint_quality.usual_step < _USUAL_OF_A_TURN * _TURN
    )


def torque_clipped(estimate: Estimate, joint_qualities: Sequence[Sequence[JointQuality]]) -> tuple[str, ...]:
    """Return a sentence per joint whose recorded torque stays at an extreme that the model misses: cut off there.

    Of a drive that gives its largest torque, what is recorded is its torque, and the model predicts it.

    Args:
        estimate: to judge.
        joint_qualities: quality of each joint's samples, per fitted recording.
    """
    errors = estimate.candidates[estimate.chosen].moving.joint_relative_percent
    found = []
    for index, name in enumerate(estimate.model.chain.names):
        seen = max((joints[index] for joints in joint_qualities), key=lambda joint: joint.clipped)
        if seen.clipped > _CLIPPED and errors[index] > _CLIPPED_ERROR:
            low, high = seen.torque
            found.append(
                f"the torque of {name} stays at exactly {low:.4g} or {high:.4g} in {100.0 * seen.clipped:.2g} % of the"
                f" samples while it moves, and its torque error is {errors[index]:.0f} %: it was cut off there; record"
                " it within the range of its sensor, or leave those times out"
            )
    return tuple(found)


def remarks_on_limits(recording_name: str, joint_qualities: Sequence[JointQuality], model: ArmModel) -> tuple[str, ...]:
    """Return a remark per joint that leaves its position limits a little, by less than makes a recording unusable.

    Args:
        recording_name: name of the recording, for the words.
        joint_qualities: quality of each joint's samples.
        model: the arm and its limits.
    """
    found = []
    for name, seen, revolute in zip(model.chain.names, joint_qualities, model.chain.revolute, strict=True):
        described = model.config.joints.get(name)
        limits = None if described is None else described.position
        if limits is None:
            continue
        span = limits[1] - limits[0]
        excess = max(limits[0] - seen.position[0], seen.position[1] - limits[1])
        if _NOISE * span < excess <= _OUTSIDE * span:
            value, when = _farthest(seen, limits)
            found.append(
                f"{recording_name}: {name} is at {value:.4g} {'rad' if revolute else 'm'} {when:.4g} s after the first"
                f" sample, outside its limits of {limits[0]:.4g} and {limits[1]:.4g}: correct the limits, or the offset"
            )
    return tuple(found)


def _farthest(seen: JointQuality, limits: tuple[float, float]) -> tuple[float, float]:
    """Return the position farthest outside [rad or m], and when it was [s]."""
    side = int(seen.position[1] - limits[1] > limits[0] - seen.position[0])
    return seen.position[side], seen.position_at[side]


def _errors(own: Candidate) -> Iterator[str]:
    fitted = own.moving.relative_percent
    judged: list[tuple[str, TorqueError]] = [(score.recording, score.moving) for score in own.validation]
    if not judged:
        judged = [("the recordings that it was fitted to", own.moving)]
    name, worst = max(judged, key=lambda one: one[1].relative_percent)
    error = worst.relative_percent
    if error > LARGEST_ERROR:
        yield (
            f"its torque error is {error:.0f} % where joints move on {name}, more than {LARGEST_ERROR:g} %: compare"
            " units (rad, N m), the order and the signs of the columns, gravity, and the kinematics with the arm's (DH"
            " convention, metres)"
        )
    elif own.validation and error > WORSE_FROM and error > MUCH_WORSE * fitted:
        yield (
            f"its torque error is {error:.0f} % where joints move on {name} but {fitted:.1f} % on the fitted"
            " recordings: compare load, tool and columns of the two recordings, and fit to a motion that excites more"
        )


def _joints_worse_than_nothing(own: Candidate, names: Sequence[str]) -> Iterator[str]:
    """Yield a reason for each joint whose torque is farther from what is predicted than from zero."""
    fitted = ("the recordings that it was fitted to", own.identification, own.moving)
    judged = [(score.recording, score.error, score.moving) for score in own.validation] or [fitted]
    for joint, name in enumerate(names):
        recording, whole, moving = max(judged, key=lambda one: float(one[2].joint_relative_percent[joint]))
        error = moving.joint_relative_percent[joint]
        usual = (
            100.0 * own.moving.joint_rms[joint] / max(own.moving.joint_relative_percent[joint], np.finfo(float).tiny)
        )
        if (
            min(error, whole.joint_relative_percent[joint]) > WORSE_THAN_NOTHING
            and moving.joint_rms[joint] > NOT_SMALL * usual
        ):
            yield (
                f"the torque of {name} is off by {error:.0f} % of itself where it moves on {recording}, so that none at"
                " all would be a better prediction: compare unit, gear and column of its torque and its position"
            )


def _compare_with_unconstrained(estimate: Estimate) -> Iterator[str]:
    free, own = estimate.candidates[0], estimate.candidates[estimate.chosen]
    before, after = free.moving.relative_percent, own.moving.relative_percent
    # With a prior or custom knowledge a larger error is the user's choice.
    held = estimate.constrained and estimate.prior is None and estimate.custom is None
    much = held and after > CONSTRAINED_FROM and after > CONSTRAINED_WORSE * before
    worse = held and after > CONSTRAINED_WORSE_WITH_SIGN * before
    wrong = _driving_friction(estimate, PERHAPS_WRONG_SIGN if worse else WRONG_SIGN)
    words = f"its torque error is {after:.1f} %, and {before:.1f} % without feasibility constraints"
    if wrong:
        which = ", ".join(name for name, _, _ in wrong)
        name, torque, deviation = min(wrong, key=lambda one: one[1] / one[2])
        yield (
            f"the torque, or the position, may have the wrong sign at {which}: without constraints, the friction of"
            f" {name} drives it ({torque:.3g} +- {deviation:.2g} at its usual speed)" + (f"; {words}" if much else "")
        )
    elif mirrored := _mirrored(estimate) if held else "":
        yield f"{mirrored}; {words}"
    elif much:
        yield (
            f"{words}: gravity, signs, order or units of the columns, or the description's bodies, contradict the"
            " recording"
        )


def _mirrored(estimate: Estimate) -> str:
    """Return the name of a joint whose torques fit the feasible set better with the other sign; else empty."""
    free, own = (estimate.candidates[place].moving.joint_relative_percent for place in (0, estimate.chosen))
    information, weights = estimate.information, estimate.fit.weights
    for joint, name in enumerate(estimate.model.chain.names):
        if own[joint] < max(MIRRORED_FROM, MIRRORED_WORSE * free[joint]):
            continue
        signs = np.ones(information.joints)
        signs[joint] = -1.0
        fit = ordinary_least_squares(information.with_torques_times(signs), weights)
        beta = constrained_least_squares(fit, estimate.base, estimate.conditions).beta
        turned = torque_error(estimate.prepared.equations.moving.with_torques_times(signs), beta)
        error = turned.joint_relative_percent[joint]
        if MIRRORED * error < own[joint] and error < MIRRORED_WORSE * free[joint]:
            return (
                f"the torque, or the position, may have the wrong sign at {name}: its torque error is"
                f" {own[joint]:.0f} %, and {error:.0f} % with the torque negated"
            )
    return ""


def _driving_friction(estimate: Estimate, deviations: float) -> list[tuple[str, float, float]]:
    """Return drives whose unconstrained friction adds energy: name, friction at the usual speed, its deviation.

    Coulomb, Stribeck and viscous terms explain each other's torque, so only their sum at a speed has a sign. The usual
    speed is the root mean square of the velocity, which is the viscous column's, of the rows that were fitted to.
    """
    # Use the plain equations, not the fitted ones, whose rows a robust method multiplies.
    layout, base, total = estimate.model.layout, estimate.base, estimate.prepared.equations.moving
    place = {int(column): index for index, column in enumerate(base.base)}
    coupling = estimate.model.chain.coupling
    driving: list[tuple[str, float, NDArray[np.float64]]] = []
    for drive, viscous in enumerate(layout.term_columns("viscous")):
        joint = drive if coupling[drive, drive] else int(np.argmax(np.abs(coupling[drive])))
        column = np.flatnonzero(total.supports[joint] == place[int(viscous)])[0]
        moved = np.linalg.norm(total.factors[joint][:, column]) / np.sqrt(max(total.rows[joint], 1))
        speed = float(moved / abs(coupling[drive, joint]))
        shares: dict[JointTerm, float] = {"viscous": speed, "coulomb": 1.0, "quadratic": speed**2}
        if layout.stribeck_velocity:
            shares["stribeck"] = float(np.exp(-((speed / layout.stribeck_velocity[drive]) ** 2)))
        row = np.zeros(base.size)
        for term, share in shares.items():
            if len(columns := layout.term_columns(term)):
                row[place[int(columns[drive])]] = share
        torque = float(row @ estimate.fit.beta)
        if torque < 0.0:
            driving.append((estimate.model.chain.names[joint], torque, row))
    if not driving:
        return []
    rows = np.array([row for _, _, row in driving]).T
    covariance, degrees, blind = jackknife(estimate.fitted.clusters, estimate.fit, rows)
    doubt = np.where(blind, np.inf, np.sqrt(np.diag(covariance)) * student_factors(degrees))
    return [
        (name, torque, float(deviation))
        for (name, torque, _), deviation in zip(driving, doubt, strict=True)
        if torque < -deviations * deviation
    ]


def _of_joint(name: str, seen: JointQuality, model: ArmModel, *, revolute: bool) -> Iterator[str]:
    unit, small = ("rad", "degrees") if revolute else ("m", "millimetres")
    low, high = seen.position
    described = model.config.joints.get(name)
    if revolute and wrapped(seen):
        yield (
            f"{name} jumps by {seen.largest_step:.4g} rad between two samples, {seen.where:.4g} s after the first: that"
            " is a whole turn, as of an angle that is recorded within one turn; unwrap the positions (numpy.unwrap)"
        )
        return
    limits = None if described is None else described.position
    if limits is not None:
        room = _OUTSIDE * (limits[1] - limits[0])
        if low < limits[0] - room or high > limits[1] + room:
            _, when = _farthest(seen, limits)
            yield (
                f"{name} is recorded from {low:.4g} to {high:.4g} {unit}, farthest outside its limits of"
                f" {limits[0]:.4g} and {limits[1]:.4g} at {when:.4g} s after the first sample: are the positions in"
                f" {small}, or those of another joint?"
            )
            return
    elif revolute and max(-low, high) > _TURNS:
        yield f"{name} is recorded from {low:.4g} to {high:.4g} rad: are the positions in {small}?"
        return
    speed = None if described is None else described.velocity
    if speed is not None and seen.speed > _TOO_FAST * speed:
        yield (
            f"{name} moves {seen.largest_step:.3g} {unit} between two samples, {_times(seen.speed / speed)} its"
            f" largest velocity: cut or correct the samples {seen.where:.4g} s after the first"
        )
    elif seen.largest_step > max(_LEAST_JUMP, _JUMP * seen.usual_step) and seen.steps > _SAMPLES_OF_A_JUMP:
        yield (
            f"{name} jumps by {seen.largest_step:.3g} {unit} between two samples, {seen.usual_step:.2g} as a rule: cut"
            f" or mend the samples {seen.where:.4g} s after the first"
        )
    frozen = seen.frozen
    if frozen is not None and frozen.torque[1] - frozen.torque[0] > _GOES_ON * (seen.torque[1] - seen.torque[0]):
        yield (
            f"the position of {name} stops changing {frozen.where:.4g} s after the first sample, from one sample to the"
            f" next, while it moves at {frozen.speed:.2g} {unit}/s, and its torque goes on changing: for"
            f" {frozen.seconds:.3g} s its encoder was frozen, or the joint blocked; leave that time out"
            " (FILE@START:END), or record again"
        )
    if torque_missing(seen):
        yield (
            f"the torque of {name} is always {seen.torque[0]:g} although it moves from {low:.4g} to {high:.4g} {unit}:"
            " it was not recorded, or another column was meant (recording.columns)"
        )
    torque, most = (None if described is None else described.torque), max(-seen.torque[0], seen.torque[1])
    if torque is not None and most > _TOO_STRONG * torque:
        yield (
            f"the torque of {name} reaches {most:.4g}, {_times(most / torque)} its limit of {torque:g}: is it in"
            " other units, or of another joint?"
        )


def _times(factor: float) -> str:
    return f"{factor:.0f} times" if factor < 1e6 else f"{factor:.3g} times"


def _without_sign(joints: Sequence[JointQuality]) -> Iterator[str]:
    """Yield a reason where torques of many joints come down to zero and turn round there, as magnitudes do."""
    moving = [seen for seen in joints if seen.standstill < _AT_REST and not torque_missing(seen)]
    turning = [seen for seen in moving if seen.torque[0] <= _NEARLY_NOTHING * seen.torque[1]]
    if len(turning) >= _JOINTS_WITH_SIGN and all(seen.torque[0] >= 0.0 for seen in moving):
        yield "no joint's torque is ever negative: were magnitudes recorded? The model needs their signs"


def _nearly_none(joints: Sequence[JointQuality], model: ArmModel) -> Iterator[str]:
    """Yield a reason where all torques are far too small for the drives: friction alone is more than that."""
    shares = []
    for name, seen in zip(model.chain.names, joints, strict=True):
        described = model.config.joints.get(name)
        limit = None if described is None else described.torque
        if limit is None or torque_missing(seen):
            return
        shares.append(max(map(abs, seen.torque)) / limit)
    if max(shares) < _WEAKEST:
        yield (
            f"no torque is ever more than {100.0 * max(shares):.2g} % of its joint's limit, less than its friction:"
            " are they in other units, or without gears (transmission, recording.columns)?"
        )


def _weight(joints: Sequence[JointQuality], model: ArmModel) -> Iterator[str]:
    """Yield reasons where the largest torque does not fit what could hold an arm of this size."""
    chain = model.chain
    # The offset from the base to the first joint does not count as reach.
    offsets = np.concatenate([chain.translation[1:], chain.link_translation])
    reach = float(np.linalg.norm(offsets, axis=1).sum())
    gravity = float(np.linalg.norm(chain.gravity))
    if reach <= 0.0 or gravity <= 0.0:
        return
    peaks = (max(-seen.torque[0], seen.torque[1]) for seen, turns in zip(joints, chain.revolute, strict=True) if turns)
    largest = max(peaks, default=0.0)
    held, allowed = largest / (gravity * reach), _DENSITY * max(reach, reach**3)
    if held > allowed:
        yield (
            f"a torque of {largest:.3g} N m would hold {held:.3g} kg at the end of this arm, which reaches"
            f" {reach:.2g} m: is it in other units?"
        )
