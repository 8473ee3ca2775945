"""Build the arm's model from its configuration: chain, parameter layout and prior parameters in one frozen object."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ident_service.config.arm import ArmConfig, Identification
from ident_service.config.quantities import TextFile
from ident_service.config.recording import mismatched_units
from ident_service.errors import ModelError
from ident_service.model.chain import WORLD, Array, Chain, chain_from_dh
from ident_service.model.parameter_layout import Layout

_LONGEST_LINK = 20.0  # m, as in DH tables


@dataclass(frozen=True)
class ArmModel:
    """Mechanism with named parameters.

    Attributes:
        config: configuration that the model was made from.
        chain: the mechanism.
        layout: names and order of delta.
        prior: CAD parameters, the description's payload included [SI], shape (layout.size,), or None where nothing is
            known.
    """

    config: ArmConfig
    chain: Chain
    layout: Layout
    prior: Array | None

    def with_options(self, options: Identification | None = None, **changes: Any) -> ArmModel:
        """Return a copy with these identification `options` (None: its own), the given keys replaced in them."""
        options = (options or self.config.identification).model_copy(update=changes)
        return replace(self, config=self.config.model_copy(update={"identification": options}))


def arm_model(config: ArmConfig, *, require_masses: bool = True) -> ArmModel:
    """Build chain, parameter layout and prior parameters of an arm from its description; raises where they do not fit.

    Args:
        config: the description.
        require_masses: whether a URDF whose bodies are the prior is refused for masses that no link has.

    Raises:
        ModelError: a mechanism that is not a tree of one-degree-of-freedom joints, or joints of the configuration
            that the mechanism does not have, masses that no link has, recorded columns in units of other joints, or a
            payload on a link that the arm does not have.
        ParameterError: prior parameters that the arm does not have.
    """
    kinematics = config.kinematics
    inertias: Array | None = None
    if kinematics.dh is not None:
        chain = chain_from_dh(kinematics.dh, config.gravity)
    else:
        # Pinocchio is not needed, and not loaded, for an arm that a DH table describes.
        from ident_service.model.pinocchio_models import read_mjcf, read_urdf

        if kinematics.urdf is not None:
            chain, inertias = read_urdf(kinematics.urdf, config.gravity, kinematics)
            if require_masses and config.prior is None:
                _require_bodies(config, kinematics.urdf, inertias)
        elif kinematics.mjcf is not None:
            chain, inertias = read_mjcf(kinematics.mjcf, config.gravity, kinematics)
        else:
            raise ModelError(f"{config.name}: no kinematics")
    offsets = np.maximum(np.abs(chain.translation), np.abs(chain.link_translation)).max(axis=1)
    if too_long := [name for name, offset in zip(chain.names, offsets, strict=True) if offset > _LONGEST_LINK]:
        raise ModelError(
            f"{config.name}: {', '.join(too_long)} is more than {_LONGEST_LINK:g} m from the joint before it; lengths"
            " are metres"
        )
    if config.joints and tuple(config.joints) != chain.names:
        raise ModelError(
            f"{config.name}: joints are configured as {', '.join(config.joints)} "
            f"but the mechanism has {', '.join(chain.names)}, in this order"
        )
    if wrong := list(mismatched_units(config.recording, chain.names, chain.revolute)):
        raise ModelError(f"{config.name}: {'; '.join(wrong)}")
    gears = config.transmission
    if gears is not None and gears.coupling is not None and gears.drive_terms == "motors":
        chain = replace(chain, coupling=np.array(gears.coupling, dtype=float))
    velocity = config.identification.friction.stribeck_velocity
    stribeck = np.broadcast_to(np.asarray(0.1 if velocity == "fit" else velocity, dtype=float), (chain.joints,))
    layout = Layout(chain.revolute, config.terms, tuple(stribeck.tolist()) if "stribeck" in config.terms else ())
    prior: Array | None = None
    if config.prior is not None:
        prior = layout.vector(config.prior)
    elif inertias is not None and bool(np.all(inertias[:, 9] > 0.0)) and bool(np.isfinite(inertias).all()):
        prior = np.zeros(layout.size)
        for link in range(layout.joints):
            prior[layout.inertial(link)] = inertias[link]
    if prior is not None:
        prior = with_payload(config, chain.names, layout, prior)
        prior.setflags(write=False)
    elif config.payload is not None:
        with_payload(config, chain.names, layout, np.zeros(layout.size))
    return ArmModel(config, chain, layout, prior)


def _require_bodies(config: ArmConfig, urdf: TextFile, inertias: Array) -> None:
    """Refuse masses that are no number, negative or, where a joint then moves nothing, zero.

    Raises:
        ModelError: with the line in the URDF; a URDF that says nothing of masses is none of this arm's bodies.
    """
    from ident_service.model.mechanism import bad_inertias, read_mechanism

    weightless = {k for k, mass in enumerate(inertias[:, 9]) if not mass > 0.0}
    frames = read_mechanism(urdf, "urdf", config.kinematics).frames
    for bad in bad_inertias(urdf):
        moved_by = frames[bad.link][0] if bad.link in frames else WORLD
        if bad.zero and moved_by not in weightless:
            continue  # a frame without a body of its own
        raise ModelError(
            f"kinematics.urdf: {urdf.name}:{bad.line}: link {bad.link!r} has {bad.what}; give what it has, in kg and"
            " kg m^2, or prior parameters in the description"
        )


def with_payload(config: ArmConfig, joint_names: tuple[str, ...], layout: Layout, delta: Array) -> Array:
    """Return link parameters `delta` with the description's payload added, shape (layout.size,); `delta` without one.

    Args:
        config: the description.
        joint_names: of the joints.
        layout: of `delta`.
        delta: parameters of the arm alone [SI], shape (layout.size,).

    Raises:
        ModelError: the payload is on a link that the arm does not have.
    """
    payload = config.payload
    if payload is None:
        return delta
    if payload.link is not None and payload.link not in joint_names:
        raise ModelError(f"{config.name}: payload.link: {payload.link!r} is none of {', '.join(joint_names)}")
    loaded = delta.copy()
    loaded[layout.inertial(len(joint_names) - 1 if payload.link is None else joint_names.index(payload.link))] += (
        payload.parameters
    )
    return loaded


def control_model(model: ArmModel) -> ArmModel:
    """Return the model for the control law and its predictions: the prior with at least the stated drive inertia.

    Its prior has the drive inertia that the description states (`joints.*.drive_inertia`) where the prior, often a CAD
    model of the links alone, has less. The description states what is felt at the joint, `sum_d C_dj^2 Ia_d` of drives
    that move several joints; their own share is the non-negative solution nearest to that.
    """
    columns = model.layout.term_columns("drive_inertia")
    joints = [model.config.joints.get(name) for name in model.chain.names]
    at_joints = np.array([0.0 if joint is None else joint.drive_inertia or 0.0 for joint in joints])
    if model.prior is None or not len(columns) or not at_joints.any():
        return model
    stated = at_joints
    felt = (model.chain.coupling**2).T
    if not np.array_equal(felt, np.eye(len(felt))):
        from scipy.optimize import nnls  # loads for 0.1 s, and few arms have coupled drives

        stated, _ = nnls(felt, at_joints)
    prior = model.prior.copy()
    prior[columns] = np.maximum(prior[columns], stated)
    prior.setflags(write=False)
    return replace(model, prior=prior)
