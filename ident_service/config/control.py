"""Describe the control loop of an arm, and what follows when the arm has been stopped."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, Literal

from pydantic import Field

from ident_service.config.quantities import ExtendedSection, Number, Positive, Section

_FASTEST = 10_000.0  # Hz; no torque loop over a fieldbus is faster


class Control(ExtendedSection):
    """Computed-torque loop (eq. 76), and what follows a stop."""

    rate: Annotated[Positive, Field(le=_FASTEST)] = 1000.0
    """Cycles per second [Hz]."""
    velocity_cutoff: Positive | tuple[Positive, ...] = 30.0
    """Cut-off of the velocity's low-pass [Hz], one or per joint: light joints need a fast loop, heavy ones a quiet
    torque."""
    after_stop: Literal["brake", "hold", "lower"] | None = None
    """`brake` for drives with brakes, and for arms that gravity does not move, which need not say it; `hold`: held
    under control until a person confirms that the arm is supported or home; `lower`: lowered under damped control until
    it rests, or its lowest point is at `floor`."""
    floor: Number | None = None
    """Height above the base's origin at which lowering ends [m]."""
    friction_feedforward: Annotated[float, Field(strict=True, ge=0, lt=1)] = 0.8
    """Share of the expected friction (the prior's, or `design.friction_guess`) that is added to the torque for the
    reference's velocity [1]. It stays below 1: overcompensated friction pushes the arm ahead of its reference at every
    reversal."""
    longest_stall: Annotated[float, Field(strict=True, gt=0, le=0.02)] | None = None
    """Stall of this computer that ends no motion [s]: the drives go on with the last torque meanwhile. 10 ms or one
    period when left out; at most half of the time after which drives stop by themselves, and 19 periods."""
    later = frozenset({"after_stop", "floor", "friction_feedforward", "longest_stall"})


class Realtime(Section):
    """Scheduling of the motion process on this computer, beside `control`, which says what it does."""

    priority: Annotated[int, Field(strict=True, ge=1, le=98)] = 50
    """Priority of SCHED_FIFO [1], below the kernel's own threads at 99 and by default ros2_control's choice."""
    cores: tuple[Annotated[int, Field(strict=True, ge=0, le=8191)], ...] = ()
    """Numbers of the cores that it may have [1], of which it takes the first that no other arm's loop has; left out,
    isolated cores come first, then the last of the computer's."""


def disagreements(control: Control, joints: Sequence[str]) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield (key path, message) where `velocity_cutoff` is a list, and not of one value per joint.

    Args:
        control: the section `control`.
        joints: names of the arm's joints; none where the file does not name them.
    """
    cutoff = control.velocity_cutoff
    if joints and isinstance(cutoff, tuple) and len(cutoff) != len(joints):
        yield ("control", "velocity_cutoff"), f"control.velocity_cutoff: {len(cutoff)} values for {len(joints)} joints"
