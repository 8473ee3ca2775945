"""Write a chain with parameters as URDF: link frames are joint frames, inertias about centres of mass, no meshes.

URDF has viscous damping and Coulomb friction per joint, written where a joint has a drive of its own and they are not
negative; drive inertia and torque offset have no place in it and stay in the parameter file.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET  # only writes here; reading goes through pinocchio after a check

import numpy as np

from ident_service.config.schema import Joint
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import WORLD, Array
from ident_service.model.drives import joint_drives

BASE_LINK = "base_link"


def urdf_text(model: ArmModel, delta: Array | None) -> str:
    """Return the arm as URDF text.

    Args:
        model: the mechanism and its limits.
        delta: link parameters, shape (layout.size,); without them the file has kinematics only.

    Raises:
        ModelError: a link without positive mass, which URDF cannot express.
    """
    robot = ET.Element("robot", name=model.config.name)
    root = _root_name(model)
    ET.SubElement(robot, "link", name=root)
    inertials = None if delta is None else _inertials(model, delta)
    chain, layout = model.chain, model.layout
    for k, name in enumerate(chain.names):
        link = ET.SubElement(robot, "link", name=_link_name(model, k))
        if inertials is not None:
            mass, center, inertia = inertials[k]
            inertial = ET.SubElement(link, "inertial")
            ET.SubElement(inertial, "origin", xyz=_numbers(center), rpy="0 0 0")
            ET.SubElement(inertial, "mass", value=repr(mass))
            entries = {key: repr(float(inertia[i, j])) for key, (i, j) in _ENTRIES.items()}
            ET.SubElement(inertial, "inertia", entries)
        settings = model.config.joints.get(name, Joint())
        bounded = settings.position is not None or not chain.revolute[k]
        kind = ("revolute" if bounded else "continuous") if chain.revolute[k] else "prismatic"
        joint = ET.SubElement(robot, "joint", name=name, type=kind)
        parent = chain.parents[k]
        ET.SubElement(joint, "parent", link=root if parent == WORLD else _link_name(model, parent))
        ET.SubElement(joint, "child", link=_link_name(model, k))
        ET.SubElement(
            joint, "origin", xyz=_numbers(chain.translation[k]), rpy=_numbers(roll_pitch_yaw(chain.rotation[k]))
        )
        ET.SubElement(joint, "axis", xyz=_numbers(chain.axes[k]))
        if bounded:
            lower, upper = settings.position or (-1.0, 1.0)
            ET.SubElement(
                joint,
                "limit",
                lower=repr(lower),
                upper=repr(upper),
                velocity=repr(settings.velocity or 0.0),
                effort=repr(settings.torque or 0.0),
            )
        if delta is not None:
            drives = joint_drives(chain, layout, delta)
            damping, friction = (max(float(values[k]), 0.0) for values in (drives.damping, drives.friction))
            ET.SubElement(joint, "dynamics", damping=repr(damping), friction=repr(friction))
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


_ENTRIES = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}


def _inertials(model: ArmModel, delta: Array) -> list[tuple[float, Array, Array]]:
    from ident_service.model.rigid_body import joint_frame_inertias

    return [
        (float(inertia.mass), np.asarray(inertia.lever), np.asarray(inertia.inertia))
        for inertia in joint_frame_inertias(model.chain, model.layout, delta)
    ]


def _root_name(model: ArmModel) -> str:
    # A joint may well be called "base".
    taken = {_link_name(model, link) for link in range(model.chain.joints)}
    name = BASE_LINK
    while name in taken:
        name += "_0"
    return name


def _link_name(model: ArmModel, link: int) -> str:
    return f"{model.chain.names[link]}_link"


def _numbers(values: Array) -> str:
    return " ".join(repr(float(value) + 0.0) for value in values)


def roll_pitch_yaw(rotation: Array) -> Array:
    """Return URDF's fixed-axis angles [rad]: R = Rz(yaw) Ry(pitch) Rx(roll); exact near gimbal lock too."""
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    # Roll and pitch of what is left after that very yaw, so that where it is arbitrary, they make up for it.
    c, s = np.cos(yaw), np.sin(yaw)
    pitch = np.arctan2(-rotation[2, 0], c * rotation[0, 0] + s * rotation[1, 0])
    roll = np.arctan2(s * rotation[0, 2] - c * rotation[1, 2], c * rotation[1, 1] - s * rotation[0, 1])
    return np.array([roll, pitch, yaw])
