"""Represent an identified arm as a pinocchio model with friction, and read one back from a file.

Pinocchio's algorithms use armature and ignore friction, though its models can hold both.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pinocchio as pin

from ident_service.config.arm import Joint
from ident_service.config.kinematics import Kinematics
from ident_service.config.quantities import TextFile
from ident_service.errors import ModelError
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import Array
from ident_service.model.friction_state import advance_dahl_state, presliding_distances
from ident_service.model.mechanism import read_mechanism
from ident_service.model.parameter_layout import WrittenArm, joint_drives
from ident_service.model.pinocchio_models import chain_of, pinocchio_model


class DynamicModel:
    """Arm with known parameters: a pinocchio model, with friction and coupled drives.

    Attributes:
        model: model for pinocchio's own algorithms: one position and one velocity per joint, gravity, armature, and
            damping, dry friction and limits as far as they are known. Where drives move several joints, no joint has an
            armature, damping or friction of its own, and only the methods here know these terms.
        arm: the mechanism and its configuration.
        delta: link parameters, shape (arm.layout.size,).
        presliding: distance over which each drive's dry friction reverses [rad or m], shape (joints,). Where one is not
            zero, friction has a memory: update `direction` by `turned` after every step and pass it on. Without it
            friction reverses at once, which is not how the parameters were fitted.
    """

    model: pin.Model
    arm: ArmModel
    delta: Array
    presliding: Array

    def __init__(self, arm: ArmModel, delta: Array) -> None:
        """Build the model.

        Raises:
            ModelError: `delta` does not fit the arm, or a link has no positive mass.
        """
        if delta.shape != (arm.layout.size,):
            raise ModelError(f"{delta.shape=} but the arm has {arm.layout.size} parameters")
        chain, layout = arm.chain, arm.layout
        links_only = np.array(delta, dtype=float)
        links_only[layout.term_columns("drive_inertia")] = 0.0
        self.arm, self.delta, self.presliding = arm, delta, presliding_distances(arm)
        self.model = pinocchio_model(replace(chain, coupling=np.eye(chain.joints)), layout, links_only)
        self.model.name = arm.config.name
        drives = joint_drives(chain, layout, delta)
        self.model.armature = drives.armature
        self.model.damping = drives.damping
        _set_dry_friction(self.model, drives.friction)
        _set_limits(self.model, arm)
        self._data = self.model.createData()
        inertia = layout.term_values("drive_inertia", delta)
        # Drive inertia beyond the armatures: zero where every joint has its own drive.
        self._shared = chain.coupling.T @ (inertia[:, None] * chain.coupling) - np.diag(drives.armature)

    def turned(self, direction: Array, displacement: Array) -> Array:
        """Return each drive's dry-friction direction, -1 to 1, after a displacement of the joints (Dahl 1968).

        Exact where no drive reverses in the step.

        Args:
            direction: direction before the step, per drive, between -1 and 1, shape (..., joints); the signs of the
                first motion, where nothing is known.
            displacement: displacement of the joints in the step [rad or m], shape (..., joints).

        Returns:
            Shape (..., joints).
        """
        return advance_dahl_state(
            direction, np.asarray(displacement, dtype=float) @ self.arm.chain.coupling.T, self.presliding
        )

    def friction(self, velocity: Array, direction: Array | None = None) -> Array:
        """Return the friction torque of the joints [N m or N], offsets included, shape (..., joints).

        Args:
            velocity: [rad/s or m/s], shape (..., joints).
            direction: direction of dry friction per drive, from `turned`, shape (..., joints); when None, the sign of
                the drive's velocity: none at rest, and no pre-sliding.
        """
        coupling, layout = self.arm.chain.coupling, self.arm.layout
        rate = np.asarray(velocity, dtype=float) @ coupling.T
        fv, fc, fo = (layout.term_values(term, self.delta) for term in ("viscous", "coulomb", "offset"))
        fq, fa = (layout.term_values(term, self.delta) for term in ("quadratic", "viscous_asymmetry"))
        sign = np.sign(rate) if direction is None else np.asarray(direction, dtype=float)
        taken = fv * rate + fc * sign + fo + fq * rate * np.abs(rate) + fa * np.abs(rate)
        if "stribeck" in layout.terms:
            bell = np.exp(-((rate / np.array(layout.stribeck_velocity)) ** 2))
            taken = taken + layout.term_values("stribeck", self.delta) * sign * bell
        return np.asarray(taken @ coupling)

    def inverse_dynamics(
        self, position: Array, velocity: Array, acceleration: Array, direction: Array | None = None
    ) -> Array:
        """Return the joint torques [N m or N] of links, drives and friction at one state of motion (eq. 29).

        Args:
            position: [rad or m], shape (joints,).
            velocity: [rad/s or m/s], shape (joints,).
            acceleration: [rad/s^2 or m/s^2], shape (joints,).
            direction: direction of dry friction, as for `friction`.

        Returns:
            [N m or N], shape (joints,).
        """
        rigid = pin.rnea(self.model, self._data, position, velocity, acceleration)
        return np.asarray(rigid + self._shared @ acceleration + self.friction(velocity, direction))


def _set_dry_friction(model: pin.Model, friction: Array) -> None:
    if hasattr(model, "upperDryFrictionLimit"):
        model.lowerDryFrictionLimit, model.upperDryFrictionLimit = -friction, friction
    else:
        model.friction = friction


def _set_limits(model: pin.Model, arm: ArmModel) -> None:
    joints = [arm.config.joints.get(name, Joint()) for name in arm.chain.names]
    ranges = [joint.position or (-np.inf, np.inf) for joint in joints]
    model.lowerPositionLimit, model.upperPositionLimit = np.array(ranges).T
    speed = np.array([joint.velocity or np.inf for joint in joints])
    torque = np.array([joint.torque or np.inf for joint in joints])
    if hasattr(model, "upperVelocityLimit"):
        model.lowerVelocityLimit, model.upperVelocityLimit = -speed, speed
        model.lowerEffortLimit, model.upperEffortLimit = -torque, torque
    else:
        model.velocityLimit, model.effortLimit = speed, torque


def read_back(
    file: TextFile,
    kind: Literal["urdf", "mjcf"],
    gravity: tuple[float, float, float],
    kinematics: Kinematics | None = None,
) -> WrittenArm:
    """Read an exported URDF or MJCF back: chain, bodies, armature, damping and dry friction, for comparison.

    Args:
        file: the exported file.
        kind: of file.
        gravity: gravity in the base frame [m/s^2].
        kinematics: part of the file that is the arm; all of it when None.

    Raises:
        ModelError: it cannot be read.
    """
    found = read_mechanism(file, kind, kinematics, trusted=True)
    chain, bodies = chain_of(found, gravity)
    return WrittenArm(chain, bodies, found.armature.copy(), found.damping.copy(), found.dry_friction.copy())
