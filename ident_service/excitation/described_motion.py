"""Build the motion that an arm description asks for: a published Fourier series, or a seeded one within the limits."""

from __future__ import annotations

from typing import Literal

import numpy as np

from ident_service.config.arm import FourierMotion, SeededMotion
from ident_service.config.motion_limits import MotionLimits, motion_limits
from ident_service.errors import MotionRefused
from ident_service.excitation.limit_proof import peak_bounds, require_within_limits
from ident_service.excitation.motion_file import Excitation
from ident_service.excitation.trajectory import FourierPath, FourierSeries
from ident_service.model.arm_model import ArmModel

_HELD = 0.7  # of the torque limits, that a motion about home takes at most


def excitation(
    model: ArmModel, purpose: Literal["identification", "validation"], *, checked: bool = True
) -> Excitation:
    """Return the motion configured for a purpose; MotionRefused for limits missing or, if `checked`, that it may leave.

    Raises:
        MotionRefused: limits are missing, or the motion leaves them.
    """
    limits = motion_limits(model.config)
    motion = getattr(model.config.motions, purpose)
    series = _published(motion) if isinstance(motion, FourierMotion) else _seeded(motion, model, limits)
    path = FourierPath(series, motion.periods, motion.ramp)
    if checked:
        require_within_limits(path, model, limits)
    return Excitation(purpose, path, model.config.motion_sha256)


def _published(motion: FourierMotion) -> FourierSeries:
    joints = motion.joints.values()
    return FourierSeries(
        motion.base_frequency,
        np.array([joint.a for joint in joints]),
        np.array([joint.b for joint in joints]),
        np.array([joint.q0 for joint in joints]),
    )


def _seeded(motion: SeededMotion, model: ArmModel, limits: MotionLimits) -> FourierSeries:
    """Return a random series, each joint scaled to the same share of its tightest limit, then all for torque."""
    rng = np.random.default_rng(motion.seed)
    shape = (model.chain.joints, motion.harmonics)
    middle = limits.home if motion.about == "home" else 0.5 * (limits.lower + limits.upper)
    series = FourierSeries(motion.base_frequency, rng.normal(size=shape), rng.normal(size=shape), middle)
    asked = peak_bounds(FourierPath(series, 1, motion.ramp), model)
    room = np.minimum(limits.upper - middle, middle - limits.lower)
    used = np.max(
        [
            np.maximum(asked.highest - middle, middle - asked.lowest) / room,
            asked.velocity / limits.velocity,
            asked.acceleration / limits.acceleration,
            asked.jerk / limits.jerk,
        ],
        axis=0,
    )
    factor = (motion.use / used)[:, None]
    series = FourierSeries(motion.base_frequency, series.a * factor, series.b * factor, middle)
    most = motion.use if motion.about == "middle" else max(motion.use, _HELD)
    for _ in range(20):
        asked = peak_bounds(FourierPath(series, 1, motion.ramp), model)
        torque, motors = asked.torque, asked.motors
        if (torque is None or bool(np.all(torque <= most * limits.torque))) and (
            motors is None or limits.motors is None or bool(np.all(motors <= most * limits.motors.torque))
        ):
            return series
        series = series.scaled(0.8)
    raise MotionRefused(
        f"{model.config.name}: gravity alone asks for more than {most:.0%} of a torque limit around "
        f"{'home' if motion.about == 'home' else 'the middle of the position limits'}; give a Fourier motion of your"
        " own under motions"
    )
