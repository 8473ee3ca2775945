"""Describe the design of a motion: its aims, margins, workspace and supply.

SI units. Shapes of links are in the link frame, obstacles and the allowed box in the base frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, Literal

from pydantic import ConfigDict, Field, model_validator

from ident_service.config.quantities import (
    Angle,
    Count,
    Interval,
    NonNegative,
    Positive,
    Section,
    Vector3,
    did_you_mean,
)

BASE = "base"  # name of the fixed base among the links


class Capsule(Section):
    """All points within `radius` of the line from `from` to `to` [m]; a ball where the two are one point."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, populate_by_name=True)

    start: Vector3 = Field(alias="from")
    """One end of the axis [m]."""
    end: Vector3 = Field(alias="to")
    """Other end of the axis [m]."""
    radius: Positive
    """Distance from the axis [m]."""


class SolidBox(Section):
    """A box by its centre and its edge lengths [m], turned by roll, pitch and yaw about the base's axes [rad]."""

    center: Vector3
    """Centre [m]."""
    size: tuple[Positive, Positive, Positive]
    """Edge lengths [m]."""
    rpy: tuple[Angle, Angle, Angle] = (0.0, 0.0, 0.0)
    """Roll, pitch and yaw about the base's axes [rad]."""


class HalfSpace(Section):
    """Solid half-space behind a plane: points x with `normal . x < offset` [m]; the normal points to free space."""

    normal: Vector3
    """Direction to free space [1]."""
    offset: float
    """Points x with `normal . x` below it are solid [m]."""

    @model_validator(mode="after")
    def _direction(self) -> HalfSpace:
        if sum(component**2 for component in self.normal) < 1e-12:
            raise ValueError("a normal of length zero has no direction")
        return self


class Obstacle(Section):
    """Exactly one solid in the base frame: a table, a wall, a floor."""

    box: SolidBox | None = None
    """A box."""
    half_space: HalfSpace | None = None
    """All behind a plane: floor, wall, table."""
    capsule: Capsule | None = None
    """A capsule."""

    @model_validator(mode="after")
    def _one(self) -> Obstacle:
        if sum(shape is not None for shape in (self.box, self.half_space, self.capsule)) != 1:
            raise ValueError("give exactly one of box, half_space, capsule")
        return self


class Inside(Section):
    """Box in the base frame that no part of a moving link may leave [m]."""

    x: Interval | None = None
    """Lowest and highest x [m]."""
    y: Interval | None = None
    """Lowest and highest y [m]."""
    z: Interval | None = None
    """Lowest and highest z [m]."""


class Workspace(Section):
    """Allowed space of the arm and its obstacles."""

    clearance: NonNegative = 0.02
    """Smallest distance that must remain between any two things that may not touch [m]."""
    obstacles: dict[str, Obstacle] = Field(default_factory=dict)
    """Solids that do not move, by name, in the frame of the base."""
    inside: Inside | None = None
    """Box that the moving links must stay in."""
    may_touch: tuple[tuple[str, str], ...] = ()
    """Pairs of links (joint names, or `base`) that are not checked against each other. Links that a joint connects
    never are."""


Geometry = dict[str, tuple[Capsule, ...]]


class Supply(Section):
    """Power supply of the drives.

    Drive k draws `max(0, torque velocity + loss torque^2)` [W]: power that a braking drive feeds back is not
    counted on.
    """

    power: Positive | None = None
    """Most that all drives together may draw [W]."""
    voltage: Positive | None = None
    """Voltage [V]."""
    current: Positive | None = None
    """Most that it can give [A]."""
    loss: NonNegative | tuple[NonNegative, ...] = 0.0
    """Heat in the windings per torque squared [W/(N m)^2], one or per joint."""
    standby: NonNegative = 0.0
    """Power that is drawn without any torque [W]."""

    @model_validator(mode="after")
    def _complete(self) -> Supply:
        if self.current is not None and self.voltage is None:
            raise ValueError("a limit of the current needs the voltage")
        if self.power is None and self.current is None:
            raise ValueError("give power, or voltage and current")
        return self

    @property
    def budget(self) -> float:
        """Return the power that drives may draw [W]: the smaller of `power` and current times voltage; or inf."""
        from_current = float("inf") if self.current is None or self.voltage is None else self.current * self.voltage
        return min(self.power or float("inf"), from_current)


def disagreements(
    geometry: Geometry, workspace: Workspace, supply: Supply | None, joints: Sequence[str]
) -> Iterator[tuple[tuple[str | int, ...], str]]:
    """Yield (key path, message) for unknown joints in `geometry` and `workspace`, and a wrong count in `supply.loss`.

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
            near = did_you_mean(name, (*joints, BASE)) or f"; known are {', '.join((BASE, *joints))}"
            yield ("geometry", name), f"geometry: no joint {name!r}, and not {BASE!r}{near}"
    for number, pair in enumerate(workspace.may_touch):
        for side, name in enumerate(pair):
            if name not in (*joints, BASE):
                near = did_you_mean(name, (*joints, BASE)) or f"; known are {', '.join((BASE, *joints))}"
                yield (
                    ("workspace", "may_touch", number, side),
                    f"workspace.may_touch: no joint {name!r}, and not {BASE!r}{near}",
                )
    if supply is not None and isinstance(supply.loss, tuple) and len(supply.loss) != len(joints):
        yield ("supply", "loss"), f"supply.loss: {len(supply.loss)} values for {len(joints)} joints"


Criterion = Literal["d_optimal", "condition_number", "a_optimal"]


class Design(Section):
    """Settings for the design of motions for an arm; options of the command line override them."""

    criterion: Criterion = "d_optimal"
    """`d_optimal` (log-determinant of the whitened information), `condition_number` (of the stacked regressor, as in
    the paper) or `a_optimal` (sum of variances of `parameters`, each in units of its square)."""
    parameters: tuple[str, ...] = ()
    """Expressions of base parameters that `a_optimal` is about; all of them when empty."""
    motion: Literal["fourier", "postures"] = "fourier"
    """`fourier` (eq. 78), or `postures`: slow motions through a few postures and back, which identify gravity and
    friction only, where there is no space for more."""
    base_frequency: Annotated[float, Field(strict=True, ge=1e-4, le=100)] = 0.05
    """Frequency of the first harmonic [Hz]."""
    harmonics: Annotated[Count, Field(le=50)] = 5
    """Number of harmonics [1]."""
    periods: Annotated[Count, Field(le=10_000)] = 3
    """Number of periods [1]."""
    ramp: Annotated[float, Field(strict=True, ge=0, le=600)] = 2.0
    """Time in which the Fourier motion swells from rest and dies down [s]."""
    postures: Annotated[int, Field(strict=True, ge=2, le=100)] = 6
    """Number of postures [1]."""
    way: Annotated[float, Field(strict=True, ge=0.1, le=600)] = 2.5
    """Duration of the motion from posture to posture [s]; the motions back take twice as long."""
    dwell: Annotated[float, Field(strict=True, ge=0, le=600)] = 0.5
    """Time for which the arm stands at each posture [s]."""
    position_margin: NonNegative | tuple[NonNegative, ...] = 0.05
    """Distance kept free at every position limit [rad or m], one or per joint."""
    torque_margin: Annotated[float, Field(ge=0, lt=1)] = 0.2
    """Share of every torque limit kept free for torques that the model does not predict [1]."""
    friction_guess: tuple[NonNegative, NonNegative] = (0.02, 0.05)
    """Coulomb friction, and viscous friction at the velocity limit, in shares of the torque limit [1], where the prior
    has no friction: control does not compensate it, so it causes a following error."""


def design_disagreements(design: Design, joints: Sequence[str]) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield (key path, message) where `design.position_margin` is a list, and not of one value per joint.

    Args:
        design: the section `design`.
        joints: names of the arm's joints; none where the file does not name them.
    """
    margin = design.position_margin
    if joints and isinstance(margin, tuple) and len(margin) != len(joints):
        yield ("design", "position_margin"), f"design.position_margin: {len(margin)} values for {len(joints)} joints"
