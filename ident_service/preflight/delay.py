"""Measure the delay from torque command to motion, by a small sinusoidal torque on top of a joint's test motion.

A sliding joint accelerates as its torque says; when it does so later than that, the delay is hidden in the drive, on
the bus, or in stale positions. Slow motions do not tell it: their torque hardly changes within a cycle. A loop with a
hidden delay of one cycle has lost the margin that its gains were checked with.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivers.arm import Vector
from ident_service.model.arm_model import ArmModel
from ident_service.model.zero_phase import local_polynomial
from ident_service.motion.safety_monitor import TORQUE_RATE, TORQUE_RATE_SHARE
from ident_service.motion.ticket import Measure, measure
from ident_service.preflight.session import Session, Trace

FREQUENCY = 15.0  # Hz: high enough for a phase, low enough for an amplitude of some encoder steps
_LEAST_SAMPLES = 10.0  # a period of the sine; a slower loop would take it for motion of its own
_SPEED = 0.03  # rad/s or m/s, of the motion's 0.2, so that the joint goes on sliding
_TORQUE = 0.05  # of the limit, at most
CALM = 0.3  # of the fastest change of torque that the guard lets pass: friction learned and control need theirs
_SLIDING = 0.3  # of the largest speed asked for, above which the joint is taken to slide
_WINDOW = 0.02  # s, of the filter that differentiates: the sine must pass
_STEPS, _FARTHEST = 4, 0.005  # s a step
_LEAST = 3.0  # periods of the sine that it must slide for
_SURE = 0.2  # of a cycle: a delay with a larger deviation is not judged
# Of a cycle, by which the delay may exceed the configured one. Measured on the emulated WAM at 500 Hz, all joints
# together: -0.94 ms with a deviation of 0.27 ms; with a hidden cycle of 2 ms 1.31 ms, deviation 0.22 ms.
MOST = 0.25


@dataclass(frozen=True)
class Delay:
    """Represent the hidden delay measured at one joint and its standard deviation [s]."""

    joint: int
    seconds: float
    deviation: float


def dither_amplitude(session: Session, torque_limit: Vector, joint: int) -> Vector:
    """Return the amplitude of a sinusoidal test torque on one joint [N m or N], (joints,); zero in too slow a loop."""
    if FREQUENCY * session.period > 1.0 / _LEAST_SAMPLES:
        return np.zeros(len(torque_limit))
    pace = 2.0 * np.pi * FREQUENCY
    calm = CALM * min(TORQUE_RATE, TORQUE_RATE_SHARE * torque_limit[joint]) / pace
    size = min(_TORQUE * torque_limit[joint], _SPEED * session.inertia[joint, joint] * pace, calm)
    return np.where(np.arange(len(torque_limit)) == joint, size, 0.0)


def hidden_delay(trace: Trace, expected_path: Vector, joint: int) -> Delay | None:
    """Return a joint's hidden delay and its deviation [s]; None where it did not slide long enough, or respond.

    With a the measured and b the expected acceleration, both through one filter, `a(t) = g b(t - d) + friction`, and so
    `a = g b - g d db/dt + f_c sign(v) + f_v v + c` to first order.

    Args:
        trace: trace of a test motion with the sinusoidal torque; nothing is measured in a loop too slow for it.
        expected_path: positions that the model expects of the torque that acted [rad or m], shape (cycles, joints).
        joint: index of the joint that was moved.
    """
    period, rate = trace.period, trace.rate[:, joint]
    if FREQUENCY * period > 1.0 / _LEAST_SAMPLES:
        return None
    window = max(5, 2 * round(0.5 * _WINDOW / period) + 1)
    if len(rate) < 2 * window or not np.abs(rate).max() > 0.0:
        return None
    measured = local_polynomial(trace.position[:, joint], window, 2, 2, period)
    speed = local_polynomial(trace.position[:, joint], window, 2, 1, period)
    sliding = (np.abs(rate) > _SLIDING * np.abs(rate).max()) & (np.sign(speed) == np.sign(rate))
    if int(sliding.sum()) * period < _LEAST / FREQUENCY:
        return None
    time, seconds, deviation = np.arange(len(rate)) * period, 0.0, 0.0
    for _ in range(_STEPS):  # of Gauss and Newton: each is of first order in what is left of the delay
        way = np.interp(time - seconds, time, expected_path[:, joint])
        asked = local_polynomial(way, window, 2, 2, period)
        friction = [np.sign(rate), speed, np.ones_like(speed)]
        columns = np.column_stack([asked, np.gradient(asked, period), *friction])[sliding]
        size = np.linalg.norm(columns, axis=0)
        solution = np.linalg.lstsq(columns / size, measured[sliding], rcond=None)[0]
        if not solution[0] > 0.0:
            return None
        left = measured[sliding] - (columns / size) @ solution
        variance = float(left @ left) / (len(left) - columns.shape[1]) * window
        inverse = np.linalg.pinv((columns / size).T @ (columns / size))
        gain = solution[0] / size[0]
        deviation = float(np.sqrt(variance * inverse[1, 1]) / size[1] / gain)
        seconds -= float(np.clip(solution[1] / size[1] / gain, -_FARTHEST, _FARTHEST))
    return Delay(joint, seconds, deviation)


def delay_measures(delays: Sequence[Delay], model: ArmModel, period: float) -> list[Measure]:
    """Return a measure of all joints' hidden delay together, with a limit if it is known well, and one of each joint.

    Each joint's own delay is told, too. Nothing is judged where all together do not know it to `_SURE` of a cycle.
    """
    if not delays:
        return []
    configured = model.config.identification.delay
    known = float(configured) if isinstance(configured, int | float) else 0.0
    weights = np.array([1.0 / max(one.deviation, 1e-6) ** 2 for one in delays])
    together = float(weights @ [one.seconds for one in delays] / weights.sum())
    deviation = float(weights.sum() ** -0.5)
    what = f"hidden delay from torque to position, known to {1e3 * deviation:.2g} ms"
    sure = deviation <= _SURE * period
    found = [measure(what, 1e3 * together, "ms", most=1e3 * (known + MOST * period) if sure else None)]
    return found + [
        measure("hidden delay", 1e3 * one.seconds, "ms", joint=model.chain.names[one.joint]) for one in delays
    ]
