"""Read from a URDF which part of it is an arm, and the limits of its joints."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from typing import Any

import numpy as np

from ident_service.errors import ModelError

_ARM = 3  # joints that make a branch an arm and not a gripper


@dataclass(frozen=True)
class Said:
    """Limits of a joint in a URDF; None where it has none that is plausible."""

    position: tuple[float, float] | None
    velocity: float | None
    effort: float | None


def arm_part(text: str, file: str, base: str | None, tip: str | None) -> dict[str, Any]:
    """Return which part of a URDF is the arm: from the root along the branch with most joints to its gripper.

    Args:
        text: of the file, whose elements were counted.
        file: its name.
        base: link that the arm stands on; the root when None.
        tip: link that it ends at; found when None.

    Returns:
        The keys of `kinematics`.

    Raises:
        ModelError: not well-formed, or several roots.
    """
    try:
        robot = ET.fromstring(text)  # noqa: S314 - counted before
    except ET.ParseError as error:
        raise ModelError(f"{file}: not well-formed XML: {error}") from None
    part: dict[str, Any] = {"urdf": file}
    if base is not None:
        part["base"] = base
    if tip is not None:
        return part | {"tip": tip}
    children: dict[str, list[tuple[str, str, bool]]] = {}
    carried, leaders = set(), set()
    for joint in robot.findall("joint"):
        parent, child = (joint.find(role) for role in ("parent", "child"))
        if parent is None or child is None:
            continue
        mimic = joint.find("mimic")
        moves = joint.get("type") in ("revolute", "continuous", "prismatic") and mimic is None
        if mimic is not None:
            leaders.add(mimic.get("joint", ""))
        children.setdefault(parent.get("link", ""), []).append((child.get("link", ""), joint.get("name", ""), moves))
        carried.add(child.get("link", ""))
    roots = [link.get("name", "") for link in robot.findall("link") if link.get("name", "") not in carried]
    if base is None and len(roots) != 1:
        raise ModelError(f"{file}: {len(roots)} links hang on no joint; name the arm's --base")

    def depth(link: str) -> int:
        return max((moves + depth(child) for child, _, moves in children.get(link, [])), default=0)

    link, branched = roots[0] if base is None else base, False
    while True:
        ways = [(moves + depth(child), child, name, moves) for child, name, moves in children.get(link, [])]
        ways = [way for way in ways if way[0] > 0]
        if not ways:
            break
        longest = max(ways, key=lambda way: way[0])
        count, onward, joint_name, moves = longest
        # The gripper begins where branches too short for an arm part, or at a joint that others mimic.
        if count < _ARM and (len(ways) > 1 or (moves and joint_name in leaders)):
            branched = True
            break
        branched = branched or len(ways) > 1 or len(children.get(link, [])) > 1
        link = onward
    return part | {"tip": link} if branched else part


def said_of(text: str) -> dict[str, Said]:
    """Return the limits of every joint of a URDF whose elements were counted, by its name."""
    found = {}
    for joint in ET.fromstring(text).findall("joint"):  # noqa: S314 - counted before
        limit = joint.find("limit")

        def number(key: str, limit: ET.Element | None = limit) -> float | None:
            try:
                value = float(limit.get(key, "nan")) if limit is not None else float("nan")
            except ValueError:
                return None
            return value if np.isfinite(value) else None

        lower, upper = number("lower"), number("upper")
        ranged = lower is not None and upper is not None and lower < upper and joint.get("type") != "continuous"
        position = (float(lower or 0.0), float(upper or 0.0)) if ranged else None
        velocity, effort = number("velocity"), number("effort")
        found[joint.get("name", "")] = Said(
            position,
            velocity if velocity is not None and 0.0 < velocity < 100.0 else None,
            effort if effort is not None and 0.0 < effort < 1e5 else None,
        )
    return found
