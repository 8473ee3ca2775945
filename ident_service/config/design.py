"""Describe the search for an excitation motion: its criterion, and the margins it keeps to the arm's limits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, Literal

from pydantic import Field

from ident_service.config.quantities import Count, NonNegative, Section

Criterion = Literal["d_optimal", "condition_number", "a_optimal"]


class Design(Section):
    """Settings for the design of motions for an arm; options of the command line override them.

    Attributes:
        criterion: `d_optimal` (log-determinant of the whitened information), `condition_number` (of the stacked
            regressor, as in the paper) or `a_optimal` (sum of variances of `parameters`, each in units of its square).
        parameters: expressions of the base parameters that `a_optimal` is about; all of them when empty.
        motion: `fourier` (eq. 78), or `postures`: slow motions through a few postures and back, which identify gravity
            and friction only, where there is no space for more.
        base_frequency: [Hz].
        harmonics: of the Fourier series.
        periods: how often it repeats.
        ramp: how long the Fourier motion takes to swell from rest and to die down [s].
        postures: how many.
        way: duration of the motion from posture to posture [s]; the motions back take twice as long.
        dwell: how long the arm stands at each posture [s].
        position_margin: kept free at every position limit [rad or m], per joint or one number for all.
        torque_margin: share of every torque limit kept free for torques that the model does not predict.
        friction_guess: Coulomb friction, and viscous friction at the velocity limit, in shares of the torque limit,
            where the prior has no friction: control does not compensate it, so it causes a following error.
    """

    criterion: Criterion = "d_optimal"
    parameters: tuple[str, ...] = ()
    motion: Literal["fourier", "postures"] = "fourier"
    base_frequency: Annotated[float, Field(strict=True, ge=1e-4, le=100)] = 0.05
    harmonics: Annotated[Count, Field(le=50)] = 5
    periods: Annotated[Count, Field(le=10_000)] = 3
    ramp: Annotated[float, Field(strict=True, ge=0, le=600)] = 2.0
    postures: Annotated[int, Field(strict=True, ge=2, le=100)] = 6
    way: Annotated[float, Field(strict=True, ge=0.1, le=600)] = 2.5
    dwell: Annotated[float, Field(strict=True, ge=0, le=600)] = 0.5
    position_margin: NonNegative | tuple[NonNegative, ...] = 0.05
    torque_margin: Annotated[float, Field(ge=0, lt=1)] = 0.2
    friction_guess: tuple[NonNegative, NonNegative] = (0.02, 0.05)


def disagreements(design: Design, joints: Sequence[str]) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield what is inconsistent with an arm of these joints: the place in the file, and the mistake.

    Args:
        design: the section `design`.
        joints: names of the arm's joints; none where the file does not name them.
    """
    margin = design.position_margin
    if joints and isinstance(margin, tuple) and len(margin) != len(joints):
        yield ("design", "position_margin"), f"design.position_margin: {len(margin)} values for {len(joints)} joints"
