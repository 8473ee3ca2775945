"""Simulate the control loop over a motion, to bound where the arm goes, not only its reference.

The plant has the control law's own model with other friction and heavier links; between two cycles it is integrated
with its friction taken implicitly. The law is that of `motion/controller.py`, with its velocity
filter, its torque limits and its delay: the torque of a sample acts `delay` cycles later.

    tau_k+d = M(q_k) (ddq_r + K_d (dq_r - v_k) + K_p (q_r - q_k)) + c(q_k, v_k) + g(q_k) + f(dq_r)

This is a simulation of stated cases, no bound over all; the safety monitor keeps the limits of the arm itself.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident_service.config.motion_limits import MotionLimits, motion_limits
from ident_service.errors import ModelError
from ident_service.excitation.prediction import DOUBT
from ident_service.excitation.trajectory import FourierPath, MotionPath
from ident_service.model.arm_model import ArmModel, control_model
from ident_service.model.chain import Array
from ident_service.model.expected_friction import expected_friction, friction_feedforward
from ident_service.model.pinocchio_models import ForwardDynamics, InverseDynamics

# Shares of the safety monitor's limits that a simulated arm may use: it stops at 1.0 times the following error allowed
# and at 1.2 times the velocity limit, and an arm has noise that no case has.
_ERROR_USED, _VELOCITY_USED = 0.85, 1.1
_BIN = 0.02  # s, over which the tube around the reference has one width
_WIDENED = 1.1  # times the simulated errors, for cases between and beside the simulated ones
# A calm way of a slow joint takes minutes, in which the error follows the reference's pace: of a way longer than
# `_WHOLE` [s] so many parts are simulated, each until the loop has settled: `_SETTLES / sqrt(kp)` [s].
_WHOLE, _PARTS, _SETTLES = 15.0, 24, 8.0


@dataclass(frozen=True)
class Case:
    """Deviation of a simulated arm from its description.

    Attributes:
        words: difference of the arm from its description, in words.
        friction: factor of the expected friction.
        weight: factor of the modelled inertia of every link.
    """

    words: str
    friction: float
    weight: float


@dataclass(frozen=True)
class Tracking:
    """Following error and velocity of an arm on a motion, in the worst of the simulated cases.

    Attributes:
        error: largest distance from the reference [rad or m], shape (joints,).
        velocity: largest filtered velocity [rad/s or m/s], shape (joints,).
        beyond: farthest outside the position limits [rad or m], shape (joints,); negative inside.
        worst: the case in which the error was largest in terms of its limit.
        tube: largest error in every stretch of `_BIN` seconds [rad or m], shape (stretches, joints).
        repeated: how much of the motion repeats what was simulated [s], from the time `repeats_from` on [s].
        repeats_from: see `repeated`.
    """

    error: Array
    velocity: Array
    beyond: Array
    worst: str
    tube: Array
    repeated: float = 0.0
    repeats_from: float = np.inf

    def lagging_joints(self, limits: MotionLimits) -> NDArray[np.bool_]:
        """Return a mask of joints whose simulated following error exceeds 85 % of its limit, shape (joints,)."""
        return np.asarray(~(self.limit_shares(limits)[0] <= 1.0))

    def limit_shares(self, limits: MotionLimits) -> tuple[Array, Array]:
        """Return following error over 85 % of its limit, and velocity over 110 % of its limit, shape (joints,) each."""
        return self.error / (_ERROR_USED * limits.following_error), self.velocity / (_VELOCITY_USED * limits.velocity)

    def objections(self, joint_names: Sequence[str], limits: MotionLimits) -> list[str]:
        """Return a sentence per joint that lags, speeds or leaves its limits too far in simulation; empty if none.

        Args:
            joint_names: of the joints.
            limits: of the arm.
        """
        found, late = [], self.lagging_joints(limits)
        for k, name in enumerate(joint_names):
            if late[k]:
                found.append(
                    f"{name}: lags by {self.error[k]:.3f}, with {self.worst}; of its following_error of "
                    f"{limits.following_error[k]:g} a simulated arm may use {_ERROR_USED:.0%}"
                )
            if not self.velocity[k] <= _VELOCITY_USED * limits.velocity[k]:
                found.append(
                    f"{name}: catches up at {self.velocity[k]:.3f}, more than {_VELOCITY_USED:g} times its velocity "
                    f"limit of {limits.velocity[k]:g}, with {self.worst}"
                )
            if not self.beyond[k] <= 0.0:
                found.append(f"{name}: the arm leaves its position limits by {self.beyond[k]:.3f}, with {self.worst}")
        return found

    def tube_width(self, time: Array, half_widths: Array) -> Array:
        """Return the simulated arm's largest distance from its reference, widened [rad or m], shape (cells, joints).

        Args:
            time: middles of cells of time in the motion [s], shape (cells,).
            half_widths: half widths of the cells [s], shape (cells,).
        """
        time = np.where(time > self.repeats_from, time - self.repeated, time)
        last = len(self.tube) - 1
        first = np.clip(((time - half_widths) / _BIN).astype(int), 0, last)
        until = np.clip(((time + half_widths) / _BIN).astype(int), 0, last)
        width = np.maximum(self.tube[first], self.tube[until])
        for step in range(1, int((until - first).max(initial=0))):
            width = np.maximum(width, self.tube[np.minimum(first + step, until)])
        return np.asarray(_WIDENED * width)


def cases(torque_margin: float) -> tuple[Case, ...]:
    """Return the cases to simulate: 1.4 times the friction with links heavier by the margin; 0.6 times the friction."""
    heavier = 1.0 + torque_margin
    down, up = DOUBT
    return (
        Case(f"{up:g} times the expected friction and links {heavier:g} times as heavy", up, heavier),
        Case(f"{down:g} times the expected friction", down, 1.0),
    )


def track(path: MotionPath, model: ArmModel, torque_margin: float) -> Tracking:
    """Simulate the arm on a motion with friction times 0.6, and 1.4 with heavier links; return errors and speeds.

    Of a periodic motion both ramps and one period are simulated, which the others repeat.

    Args:
        path: the motion, a reference of the joints over time.
        model: of the arm, with prior parameters.
        torque_margin: share of every torque limit that the motion keeps free, by which links are heavier in one case.

    Raises:
        ModelError: no prior, or one that no real body has.
        MotionRefused: the description lacks limits.
    """
    limits = motion_limits(model.config)  # all of the torque: a motion's margin is for what these cases need
    control = model.config.control
    period = 1.0 / control.rate
    once = FourierPath(path.series, 1, path.ramp) if isinstance(path, FourierPath) else path
    times = period * np.arange(int(np.ceil(once.duration / period)) + 1)
    reference = once.at(np.minimum(times, once.duration))[:3]
    stretches = int(times[-1] / _BIN) + 1
    place = np.minimum((times / _BIN).astype(int), stretches - 1)
    tube = np.zeros((stretches, once.joints))
    error, worst = np.zeros(once.joints), ""
    velocity, beyond = np.zeros(once.joints), np.full(once.joints, -np.inf)
    for case in cases(torque_margin):
        position, rate = _followed(case, model, limits, period, reference)
        away = np.abs(reference[0] - position)
        np.maximum.at(tube, place, away)
        peak = away.max(axis=0)
        if not worst or (peak / limits.following_error).max() > (error / limits.following_error).max():
            worst = case.words
        error = np.maximum(error, peak)
        velocity = np.maximum(velocity, rate)
        outside = np.maximum(limits.lower - position, position - limits.upper).max(axis=0)
        beyond = np.maximum(beyond, outside)
    repeated = path.duration - once.duration
    from_ = once.duration - once.ramp if isinstance(once, FourierPath) else np.inf
    return Tracking(error, velocity, beyond, worst, tube, repeated, from_)


def segment_tube_width(path: MotionPath, model: ArmModel, torque_margin: float) -> Callable[[Array, Array], Array]:
    """Simulate the arm over slow segments; return the function of its largest distance from the reference.

    Long segments are simulated in parts, whose largest error then counts throughout.

    A joint that dry friction holds moves only when the reference has left it behind by `|M^-1| f / kp`, which on a slow
    way takes longer than a part; so that is added.

    Args:
        path: the segments.
        model: of the arm, with prior parameters.
        torque_margin: as for `track`.

    Returns:
        A function of times and half widths [s], as `Tracking.tube_width`.

    Raises:
        ModelError, MotionRefused: as `track`.
    """
    limits = motion_limits(model.config)
    period = 1.0 / model.config.control.rate
    part = _SETTLES / float(np.sqrt(limits.kp.min()))
    if path.duration <= max(_WHOLE, _PARTS * part):
        return track(path, model, torque_margin).tube_width
    times = period * np.arange(int(np.ceil(part / period)) + 1)
    used = control_model(model)
    if used.prior is None:
        raise ModelError(f"{model.config.name}: without prior parameters no arm can be simulated")
    law = InverseDynamics(model.chain, model.layout, used.prior)
    expected = expected_friction(model, limits, model.config.design.friction_guess).at_joints(model.chain)
    dry = DOUBT[1] * expected.coulomb
    error, stuck = np.zeros(path.joints), np.zeros(path.joints)
    for begin in np.linspace(0.0, path.duration - part, _PARTS):
        reference = path.at(np.minimum(begin + times, path.duration))[:3]
        stuck = np.maximum(stuck, np.abs(np.linalg.inv(law.mass_matrix(reference[0][0]))) @ dry / limits.kp)
        for case in cases(torque_margin):
            away = np.abs(reference[0] - _followed(case, model, limits, period, reference)[0])
            error = np.maximum(error, away.max(axis=0))
    width = _WIDENED * (error + stuck)
    return lambda time, half: np.broadcast_to(width, (len(time), len(width)))


def _followed(
    case: Case, model: ArmModel, limits: MotionLimits, period: float, reference: Sequence[Array]
) -> tuple[Array, Array]:
    """Return positions, shape (samples, joints), and the largest filtered velocity, shape (joints,)."""
    used = control_model(model)
    if used.prior is None:
        raise ModelError(f"{model.config.name}: without prior parameters no arm can be simulated")
    control, layout = model.config.control, model.layout
    expected = expected_friction(model, limits, model.config.design.friction_guess)
    truth = used.prior.copy()
    for link in range(layout.joints):
        truth[layout.inertial(link)] *= case.weight
    friction = case.friction * expected.coulomb, case.friction * expected.viscous
    plant = ForwardDynamics(model.chain, layout, truth, friction)
    law = InverseDynamics(model.chain, layout, used.prior)
    wanted, pace, push = reference
    feedforward = friction_feedforward(model, limits).torque(pace)
    gain = 1.0 - np.exp(-2.0 * np.pi * np.asarray(control.velocity_cutoff, dtype=float) * period)
    q, v = wanted[0].copy(), pace[0].copy()
    before, rate = q - period * v, v.copy()
    delay = max(1, int(getattr(model.config.driver, "delay_cycles", 1)))
    first = law.torque(q, v, push[0]) + feedforward[0]
    queue = deque([first] * delay)
    positions = np.empty_like(wanted)
    fastest = np.zeros_like(q)
    lost = 10.0 * limits.following_error
    kp, kd, limit = limits.kp, limits.kd, limits.torque
    for k in range(len(wanted)):
        positions[k] = q
        rate = rate + gain * ((q - before) / period - rate)
        before = q
        away = wanted[k] - q
        if not (np.abs(away) < lost).all():  # it will not come back, and the numbers might overflow
            positions[k:] = q
            break
        torque = law.torque(q, rate, push[k] + kd * (pace[k] - rate) + kp * away) + feedforward[k]
        np.maximum(fastest, np.abs(rate), out=fastest)
        torque = np.minimum(np.maximum(torque, -limit), limit)
        queue.append(torque if limits.motors is None else limits.motors.scaled_within(torque))
        after = plant.next_velocity(q, v, queue.popleft(), period)
        q, v = q + 0.5 * period * (v + after), after
    return positions, fastest
