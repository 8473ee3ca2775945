"""Read exported arms in SDF (specification 1.9: joint.sdf, link.sdf, inertial.sdf, pose.sdf), to check them.

A pose is relative to the frame it names, to the model where it names none, and to the child link for a joint; angles
are fixed-axis roll, pitch, yaw [rad]. An axis is expressed in its joint's frame. Inertias are about the centre of mass,
in the frame of the inertial's pose. Whatever could mean something else is refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from xml.sax.saxutils import unescape

import numpy as np

from ident_service.errors import ModelError
from ident_service.model.chain import WORLD, Array, Chain
from ident_service.model.drives import WrittenArm
from ident_service.results.export.bodies import about_origin, moved, rotation_rpy
from ident_service.results.export.xml_places import Element, xml_places

_KINDS = {"revolute": True, "continuous": True, "prismatic": False}
_ENTITIES = {"&quot;": '"', "&apos;": "'"}


def read_sdf(
    text: str, name: str, gravity: tuple[float, float, float], joint_names: Mapping[str, str] | None = None
) -> WrittenArm:
    """Read a model of revolute, continuous and prismatic joints that stands on `world`, parents before children.

    Args:
        text: the file.
        name: of the file, for errors.
        gravity: of the world it is put in [m/s^2].
        joint_names: other names for its joints.

    Raises:
        ModelError: not such a model.
    """
    try:
        return _Reader(text, name).arm(gravity, joint_names or {})
    except (KeyError, ValueError, StopIteration) as error:
        raise ModelError(f"{name}: not an SDF arm that can be read: {error!r}") from None


class _Reader:
    def __init__(self, text: str, name: str) -> None:
        root = xml_places(text, name)
        self._data = text.encode("utf-8")
        model = root.first("model") if root.tag == "sdf" else None
        if model is None:
            raise ModelError(f"{name}: no model in it")
        self._links = {link.attributes["name"]: link for link in model.all("link")}
        self._joints = list(model.all("joint"))
        self._name = name

    def arm(self, gravity: tuple[float, float, float], names: Mapping[str, str]) -> WrittenArm:
        carrying = {self._words(joint, "child"): k for k, joint in enumerate(self._joints)}
        frames, parents, placements = [], [], []
        bodies, revolute, axes, damping, friction = [], [], [], [], []
        for joint in self._joints:
            parent, child = self._words(joint, "parent"), self._words(joint, "child")
            in_child = self._pose(joint)
            frames.append(self._link_pose(child) @ in_child)
            parents.append(WORLD if parent == "world" else carrying[parent])
            before = np.eye(4) if parents[-1] == WORLD else frames[parents[-1]]
            placements.append(np.linalg.inv(before) @ frames[-1])
            to_joint: Array = np.linalg.inv(in_child).astype(float)
            bodies.append(moved(self._body(self._links[child]), to_joint[:3, :3], to_joint[:3, 3]))
            revolute.append(_KINDS[joint.attributes["type"]])
            axis = _only(joint, "axis")
            if _only(axis, "xyz").attributes:
                raise ModelError(f"{self._name}: an axis that is expressed in another frame than its joint's")
            axes.append(self._numbers(axis, "xyz", 3))
            dynamics = axis.first("dynamics")
            damping.append(0.0 if dynamics is None else self._numbers(dynamics, "damping", 1)[0])
            friction.append(0.0 if dynamics is None else self._numbers(dynamics, "friction", 1)[0])
        n = len(self._joints)
        chain = Chain(
            names=tuple(names.get(joint.attributes["name"], joint.attributes["name"]) for joint in self._joints),
            parents=tuple(parents),
            revolute=tuple(revolute),
            axes=np.array([axis / np.linalg.norm(axis) for axis in axes]),
            rotation=np.array([placement[:3, :3] for placement in placements]),
            translation=np.array([placement[:3, 3] for placement in placements]),
            link_rotation=np.tile(np.eye(3), (n, 1, 1)),
            link_translation=np.zeros((n, 3)),
            gravity=np.array(gravity, dtype=float),
        )
        return WrittenArm(chain, np.array(bodies), np.zeros(n), np.array(damping), np.array(friction))

    def _words(self, element: Element, tag: str) -> str:
        leaf = _only(element, tag)
        return unescape(self._data[leaf.head : leaf.foot].decode("utf-8").strip(), _ENTITIES)

    def _numbers(self, element: Element, tag: str, count: int) -> Array:
        values = np.array([float(word) for word in self._words(element, tag).split()])
        if values.shape != (count,) or not np.all(np.isfinite(values)):
            raise ModelError(f"{self._name}: {tag} is not {count} numbers")
        return values

    def _pose(self, element: Element) -> Array:
        T = np.eye(4)
        pose = element.first("pose")
        if pose is not None:
            if set(pose.attributes) - {"relative_to"}:
                raise ModelError(f"{self._name}: a pose in degrees or as a quaternion")
            x, y, z, roll, pitch, yaw = self._numbers(element, "pose", 6)
            T[:3, :3], T[:3, 3] = rotation_rpy(roll, pitch, yaw), (x, y, z)
        return T

    def _link_pose(self, name: str) -> Array:
        """Return the pose of a link in the model's frame."""
        T, seen = np.eye(4), set()
        while name not in ("", "__model__"):
            if name in seen:
                raise ModelError(f"{self._name}: poses relative to each other")
            seen.add(name)
            link = self._links[name]
            T = self._pose(link) @ T
            pose = link.first("pose")
            name = "" if pose is None else pose.attributes.get("relative_to", "")
        return T

    def _body(self, link: Element) -> Array:
        inertial = _only(link, "inertial")
        matrix, place = np.zeros((3, 3)), self._pose(inertial)
        for i, first in enumerate("xyz"):
            for j, second in enumerate("xyz"[i:], i):
                entry = self._numbers(_only(inertial, "inertia"), f"i{first}{second}", 1)[0]
                matrix[i, j] = matrix[j, i] = entry
        mass = float(self._numbers(inertial, "mass", 1)[0])
        turned = place[:3, :3] @ matrix @ place[:3, :3].T
        return about_origin(mass, place[:3, 3], turned)


def _only(element: Element, tag: str) -> Element:
    found = list(element.all(tag))
    if len(found) != 1:
        raise KeyError(f"{len(found)} elements {tag} in {element.tag}")
    return found[0]
