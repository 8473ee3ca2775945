"""Describe the control loop of an arm, and what follows when the arm has been stopped."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, Literal

from pydantic import Field

from ident_service.config.quantities import ExtendedSection, Number, Positive, Section

_FASTEST = 10_000.0  # Hz; no torque loop over a fieldbus is faster


class Control(ExtendedSection):
    """Computed-torque loop (eq. 76): rate [Hz] and cut-off of the velocity low-pass [Hz].

    The cut-off is one number or one per joint: light joints need a fast loop, heavy ones a quiet torque.

    `friction_feedforward` is the share of the expected friction (the prior's, or `design.friction_guess`) that is added
    to the torque for the reference's velocity. It stays below 1: friction that is smaller than expected would otherwise
    be overcompensated, and push the arm ahead of its reference at every reversal.

    A stall of this computer of up to `longest_stall` [s] ends no motion, 10 ms or one period by default: the drives go
    on with the last torque meanwhile. It is at most half of the time after which they would stop by themselves, and 19
    periods.

    `after_stop` says what follows a stop: `brake` for drives with brakes, and for arms that gravity does not move,
    which need not say it; `hold`: held under control until a person confirms that the arm is supported or home;
    `lower`: lowered under damped control until it rests, or its lowest point is at `floor` [m above the base's origin].
    """

    rate: Annotated[Positive, Field(le=_FASTEST)] = 1000.0
    velocity_cutoff: Positive | tuple[Positive, ...] = 30.0
    after_stop: Literal["brake", "hold", "lower"] | None = None
    floor: Number | None = None
    friction_feedforward: Annotated[float, Field(strict=True, ge=0, lt=1)] = 0.8
    longest_stall: Annotated[float, Field(strict=True, gt=0, le=0.02)] | None = None
    later = frozenset({"after_stop", "floor", "friction_feedforward", "longest_stall"})


class Realtime(Section):
    """Scheduling of the motion process on this computer, beside `control`, which says what it does.

    `priority` is that of SCHED_FIFO, below the kernel's own threads at 99 and by default ros2_control's choice. `cores`
    are the numbers of those that it may have, of which it takes the first that no other arm's loop has; left out,
    isolated cores come first, then the last of the computer's.
    """

    priority: Annotated[int, Field(strict=True, ge=1, le=98)] = 50
    cores: tuple[Annotated[int, Field(strict=True, ge=0, le=8191)], ...] = ()


def disagreements(control: Control, joints: Sequence[str]) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield what is inconsistent with an arm of these joints: the place in the file, and the mistake.

    Args:
        control: the section `control`.
        joints: names of the arm's joints; none where the file does not name them.
    """
    cutoff = control.velocity_cutoff
    if joints and isinstance(cutoff, tuple) and len(cutoff) != len(joints):
        yield ("control", "velocity_cutoff"), f"control.velocity_cutoff: {len(cutoff)} values for {len(joints)} joints"
