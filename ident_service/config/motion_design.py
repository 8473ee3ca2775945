"""Describe the design of a motion: its aims, margins, workspace and supply.

SI units. Shapes of links are in the link frame, obstacles and the allowed box in the base frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, Literal

from pydantic import ConfigDict, Field, model_validator

from ident_service.config.quantities import Angle, Count, Interval, NonNegative, Positive, Section, Vector3

BASE = "base"  # name of the fixed base among the links


class Capsule(Section):
    """All points within `radius` of the line from `from` to `to` [m]; a ball where the two are one point."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, populate_by_name=True)

    start: Vector3 = Field(alias="from")
    end: Vector3 = Field(alias="to")
    radius: Positive


class SolidBox(Section):
    """A box by its centre and its edge lengths [m], turned by roll, pitch and yaw about the base's axes [rad]."""

    center: Vector3
    size: tuple[Positive, Positive, Positive]
    rpy: tuple[Angle, Angle, Angle] = (0.0, 0.0, 0.0)


class HalfSpace(Section):
    """Solid half-space behind a plane: points x with `normal . x < offset` [m]; the normal points to free space."""

    normal: Vector3
    offset: float

    @model_validator(mode="after")
    def _direction(self) -> HalfSpace:
        if sum(component**2 for component in self.normal) < 1e-12:
            raise ValueError("a normal of length zero has no direction")
        return self


class Obstacle(Section):
    """Exactly one solid in the base frame: a table, a wall, a floor."""

    box: SolidBox | None = None
    half_space: HalfSpace | None = None
    capsule: Capsule | None = None

    @model_validator(mode="after")
    def _one(self) -> Obstacle:
        if sum(shape is not None for shape in (self.box, self.half_space, self.capsule)) != 1:
            raise ValueError("give exactly one of box, half_space, capsule")
        return self


class Inside(Section):
    """Box in the base frame that no part of a moving link may leave [m]."""

    x: Interval | None = None
    y: Interval | None = None
    z: Interval | None = None


class Workspace(Section):
    """Allowed space of the arm and its obstacles.

    Attributes:
        clearance: smallest distance that must remain between any two things that may not touch [m].
        obstacles: solids that do not move.
        inside: the box that the moving links must stay in.
        may_touch: pairs of links (joint names, or `base`) that are not checked against each other. Links that a joint
            connects never are.
    """

    clearance: NonNegative = 0.02
    obstacles: dict[str, Obstacle] = Field(default_factory=dict)
    inside: Inside | None = None
    may_touch: tuple[tuple[str, str], ...] = ()


Geometry = dict[str, Annotated[tuple[Capsule, ...], Field(min_length=1)]]


class Supply(Section):
    """Power supply of the drives.

    Drive k draws `max(0, torque velocity + loss torque^2)` [W]: power that a braking drive feeds back is not
    counted on.

    Attributes:
        power: the most that all drives together may draw [W].
        voltage: of the supply [V].
        current: the most that it can give [A].
        loss: heat in the windings per torque squared [W/(N m)^2], per joint or one number for all.
        standby: what is drawn without any torque [W].
    """

    power: Positive | None = None
    voltage: Positive | None = None
    current: Positive | None = None
    loss: NonNegative | tuple[NonNegative, ...] = 0.0
    standby: NonNegative = 0.0

    @model_validator(mode="after")
    def _complete(self) -> Supply:
        if self.current is not None and self.voltage is None:
            raise ValueError("a limit of the current needs the voltage")
        if self.power is None and self.current is None:
            raise ValueError("give power, or voltage and current")
        return self

    @property
    def budget(self) -> float:
        """Return the power that the drives may draw, the smaller of both limits [W]."""
        from_current = float("inf") if self.current is None or self.voltage is None else self.current * self.voltage
        return min(self.power or float("inf"), from_current)


def disagreements(
    geometry: Geometry, workspace: Workspace, supply: Supply | None, joints: Sequence[str]
) -> Iterator[tuple[tuple[str | int, ...], str]]:
    """Yield what is inconsistent with an arm of these joints: the place in the file, and the mistake.

    Args:
        geometry: the section `geometry`.
        workspace: the section `workspace`.
        supply: the section `supply`.
        joints: names of the arm's joints; none where the file does not name them.
    """
    if not joints:
        return
    for name in geometry:
        if name not in (*joints, BASE):
            yield ("geometry", name), f"geometry: no joint {name!r}, and not {BASE!r}"
    for number, pair in enumerate(workspace.may_touch):
        for side, name in enumerate(pair):
            if name not in (*joints, BASE):
                yield (
                    ("workspace", "may_touch", number, side),
                    f"workspace.may_touch: no joint {name!r}, and not {BASE!r}",
                )
    if supply is not None and isinstance(supply.loss, tuple) and len(supply.loss) != len(joints):
        yield ("supply", "loss"), f"supply.loss: {len(supply.loss)} values for {len(joints)} joints"


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


def design_disagreements(design: Design, joints: Sequence[str]) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield what is inconsistent with an arm of these joints: the place in the file, and the mistake.

    Args:
        design: the section `design`.
        joints: names of the arm's joints; none where the file does not name them.
    """
    margin = design.position_margin
    if joints and isinstance(margin, tuple) and len(margin) != len(joints):
        yield ("design", "position_margin"), f"design.position_margin: {len(margin)} values for {len(joints)} joints"
