"""Plan the references of a run from where the arm stands: an excitation and back, or a move to a destination.

A plan is asked twice: whether it can be made at all, before the arm is opened, and for its references from where the
arm has been measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from ident_service.config.motion_limits import MotionLimits, Vector
from ident_service.errors import MotionRefused
from ident_service.excitation.limit_proof import require_within_limits
from ident_service.excitation.motion_file import Excitation
from ident_service.model.arm_model import ArmModel
from ident_service.motion.clearance import (
    just_inside,
    position_limit_violations,
    relaxed_limits,
    require_clear,
    require_clear_trajectories,
    require_near,
)
from ident_service.motion.speed_scaling import ScaledMotion
from ident_service.motion.state_machine import State
from ident_service.motion.stop_trajectory import require_stops_within_limits
from ident_service.motion.trajectory import PathReference, Reference, plan_reduced_trajectory, rest

HOMING_SPEED = 0.2  # of a calm way's speed, which is half of the limits: so at most a tenth of every velocity limit

Leg = tuple[State, Reference]


class Plan(Protocol):
    """Define what a run is to do."""

    @property
    def speed(self) -> float:
        """Return the share of the references' own speed at which they are played, trajectories out of pauses too."""

    @property
    def held(self) -> bool:
        """Return whether the arm is held at the end and secured as after a stop, since nothing may support it there."""

    def require_possible(self, model: ArmModel, limits: MotionLimits) -> None:
        """Raise MotionRefused where the plan cannot be followed, wherever the arm stands."""

    def run_limits(self, model: ArmModel, position: Vector, limits: MotionLimits) -> MotionLimits:
        """Return the limits of a run from this position [rad or m], (joints,); MotionRefused if it may not begin."""

    def legs(self, model: ArmModel, start: Vector, limits: MotionLimits) -> Sequence[Leg]:
        """Return (state, reference) pairs from `start`, in order; MotionRefused if one is impossible or not clear."""


@dataclass(frozen=True)
class ExcitationPlan:
    """Plan to move to an excitation, along it, and back to where the arm stood, all at one share of its speed."""

    excitation: Excitation
    speed: float = 1.0
    held = False  # it stands again where it stood, supported, before

    def require_possible(self, model: ArmModel, limits: MotionLimits) -> None:
        """Raise MotionRefused where the motion is for another description, or it or a stop out of it exceeds limits."""
        if self.excitation.arm_sha256 != model.config.motion_sha256:
            raise MotionRefused(f"the {self.excitation.name} motion was made for another description of the arm")
        require_within_limits(self.excitation.path, model, limits)
        require_stops_within_limits(self.excitation.path, limits, model.chain.names)

    def run_limits(self, model: ArmModel, position: Vector, limits: MotionLimits) -> MotionLimits:
        """Return `limits` unchanged; raise MotionRefused where a joint stands outside its position limits."""
        if found := position_limit_violations(position, limits, model.chain.names):
            raise MotionRefused(f"outside the position limits: {'; '.join(found)}; `ident recover` says what to do")
        return limits

    def legs(self, model: ArmModel, start: Vector, limits: MotionLimits) -> Sequence[Leg]:
        """Return approach, excitation, return as (state, slowed reference) pairs; MotionRefused if impossible."""
        exciting = PathReference(self.excitation.path)
        begin, end = exciting.at(0.0), exciting.at(exciting.duration)
        there, back = (
            plan_reduced_trajectory(rest(start), begin, limits),
            plan_reduced_trajectory(end, rest(start), limits),
        )
        slowed = [ScaledMotion(way, self.speed) for way in (there, exciting, back)]
        require_clear(model, self.excitation.path, [slowed[0], slowed[-1]], limits)
        return list(zip((State.APPROACHING, State.EXCITING, State.RETURNING), slowed, strict=True))


class Destination(Enum):
    """Name the destinations of a point-to-point motion."""

    HOME = "home"  # the description's
    INSIDE = "inside"  # the nearest posture inside the position limits


@dataclass(frozen=True)
class PointToPointPlan:
    """Plan a slow straight motion in joint space from rest to rest; it may begin a little outside the position limits.

    All joints share one time profile, so that each moves from its start towards its end without turning
    round; the end is inside the limits, and so the way of a joint that stands outside leads inwards all the time.
    """

    destination: Destination
    speed: float = HOMING_SPEED
    held = True  # whatever supported the arm where it stood is not where it ends

    def require_possible(self, model: ArmModel, limits: MotionLimits) -> None:
        """Do nothing: home is inside the limits by the description's own check, as is the nearest posture inside."""

    def run_limits(self, model: ArmModel, position: Vector, limits: MotionLimits) -> MotionLimits:
        """Return limits widened to the arm's position; MotionRefused if too far outside, or if `INSIDE` is reached."""
        require_near(position, limits, model.chain.names)
        if self.destination is Destination.INSIDE and not position_limit_violations(
            position, limits, model.chain.names
        ):
            raise MotionRefused("the arm stands inside all its position limits; there is nothing to leave")
        return relaxed_limits(position, limits)

    def legs(self, model: ArmModel, start: Vector, limits: MotionLimits) -> Sequence[Leg]:
        """Return one (state, slowed reference) pair to home or just inside the limits; MotionRefused if impossible."""
        end = limits.home if self.destination is Destination.HOME else just_inside(start, limits)
        way = plan_reduced_trajectory(rest(start), rest(end), relaxed_limits(start, limits))
        try:
            require_clear_trajectories(model, [(f"the path {self.destination.value}", way)], limits)
        except MotionRefused as error:
            raise MotionRefused(f"{error}; move the arm by hand to where the straight path is free") from None
        return [(State.RETURNING, ScaledMotion(way, self.speed))]
