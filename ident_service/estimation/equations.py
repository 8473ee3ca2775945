"""One pass over a recording: smoothed samples become information, in blocks of about a second.

Residuals of neighbouring samples are correlated, so doubt is computed from blocks (`doubt.py`). The number of blocks is
bounded: when there are too many, neighbours merge in pairs and blocks become longer, so memory stays constant.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import numpy as np

from ident_service.config.schema import Identification
from ident_service.errors import RecordingError
from ident_service.estimation.smoothing import Motion, smoothed
from ident_service.model.arm_model import ArmModel
from ident_service.model.base import BaseParameters
from ident_service.model.information import Information, information_of, supports
from ident_service.model.regressor import joint_regressor
from ident_service.record.recording import Recording

MAX_BLOCKS = 256


@dataclass(frozen=True)
class Equations:
    """What recordings say about the base parameters.

    Attributes:
        blocks: information of consecutive stretches of time.
        samples: smoothed samples that went in.
    """

    blocks: tuple[Information, ...]
    samples: int

    @property
    def total(self) -> Information:
        """All blocks together."""
        return reduce(Information.merged, self.blocks)

    def joined(self, other: Equations) -> Equations:
        """The equations of both."""
        return Equations(_bounded([*self.blocks, *other.blocks]), self.samples + other.samples)


def equations(recording: Recording, model: ArmModel, base: BaseParameters) -> Equations:
    """Read a recording once and keep what it knows.

    Raises:
        RecordingError: the recording does not fit the arm, or no joint moves enough to give an equation.
    """
    if recording.joints != model.chain.joints:
        raise RecordingError(
            recording.path, f"has {recording.joints} joints but the arm {model.config.name} has {model.chain.joints}"
        )
    options: Identification = model.config.identification
    joint_supports = supports(model.chain, model.layout, base.base)
    blocks: list[Information] = []
    samples = 0
    for motion in smoothed(recording, options):
        samples += len(motion.time)
        length = len(motion.time)
        step = max(1, round(options.block / float(np.median(np.diff(motion.time))))) if length > 1 else 1
        count = max(1, round(length / step))
        for part in np.array_split(np.arange(length), count):
            H_b = joint_regressor(
                model.chain,
                model.layout,
                motion.position[part],
                motion.velocity[part],
                motion.acceleration[part],
                base.base,
            )
            blocks.append(information_of(H_b, motion.torque[part], motion.keep[part], joint_supports))
        blocks = list(_bounded(blocks))
    result = Equations(tuple(blocks), samples)
    still = [name for name, rows in zip(model.chain.names, result.total.rows, strict=True) if rows == 0]
    if still:
        raise RecordingError(
            recording.path,
            f"{', '.join(still)}: never faster than identification.reversal.speed, nothing to identify from",
        )
    return result


def _bounded(blocks: list[Information]) -> tuple[Information, ...]:
    while len(blocks) > MAX_BLOCKS:
        pairs = [blocks[i].merged(blocks[i + 1]) for i in range(0, len(blocks) - 1, 2)]
        blocks = pairs + blocks[2 * len(pairs) :]
    return tuple(blocks)


def kept_motion(recording: Recording, options: Identification) -> Motion:
    """All smoothed samples of a recording at once, for scoring and drawing short recordings."""
    parts = list(smoothed(recording, options))
    return Motion(*(np.concatenate([getattr(part, name) for part in parts]) for name in Motion.__dataclass_fields__))
