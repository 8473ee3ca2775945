"""The control loop of an arm as its description has it, and what follows when the arm has been stopped.

Boundary: data only; what it does is `motion/`.
"""

from __future__ import annotations

from typing import Literal

from ident_service.config.quantities import GrownSection, Number, Positive


class Control(GrownSection):
    """The computed-torque loop (eq. 76): rate [Hz] and cut-off of the velocity low-pass [Hz].

    `after_stop` says what follows a stop: `brake` for drives with brakes, and for arms that gravity does not move,
    which need not say it; `hold`: held under control until a person confirms that the arm is supported or home;
    `lower`: lowered under damped control until it rests, or its lowest point is at `floor` [m above the base's origin].
    """

    rate: Positive = 1000.0
    velocity_cutoff: Positive = 30.0
    after_stop: Literal["brake", "hold", "lower"] | None = None
    floor: Number | None = None
    later = frozenset({"after_stop", "floor"})
