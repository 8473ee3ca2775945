"""Describe the mechanism of an arm: a DH table, or the part of a URDF or MJCF file that is the arm (decision 0054)."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from typing import Annotated, Any, Literal

from pydantic import (
    Field,
    SerializerFunctionWrapHandler,
    ValidationInfo,
    field_validator,
    model_serializer,
    model_validator,
)

from ident_service.config.quantities import Angle, Number, Section, TextBeside, TextFile

_LARGEST_ANGLE = 6.3  # rad
_LONGEST_LINK = 20.0  # m; the largest arms that move torque-controlled joints are a tenth of it


_SNAPPED_TO = math.pi / 12.0
_ROUNDED = 2e-3  # rad; 3.14 for pi is 1.6e-3
_BARELY, _EXACT = 1e-5, 1e-13  # rad; digits of a number that a person shortened, and of a floating-point one
_RPY = re.compile(r"""(\brpy\s*=\s*)(["'])([^"']*)\2""")


def snap_angles(urdf: str) -> str:
    """Return the URDF text with `rpy` angles within 2 mrad of a multiple of 15 degrees set to that multiple."""

    def angle(text: str) -> str:
        try:
            value = float(text)
        except ValueError:
            return text
        exact = round(value / _SNAPPED_TO) * _SNAPPED_TO
        return repr(exact) if abs(value - exact) <= _ROUNDED else text

    def attribute(found: re.Match[str]) -> str:
        start, quote, values = found.groups()
        return f"{start}{quote}{' '.join(angle(value) for value in values.split())}{quote}"

    return _RPY.sub(attribute, urdf)


def angles_barely_rounded(angles: Iterable[float]) -> bool:
    """Return whether angles [rad] near a multiple of 15 degrees are within 1e-5 of it, and one or more is not exact.

    So 1.5708 is a rounded pi/2, and a calibrated 1.5703 beside it shows that nothing is to be taken as exact.
    """
    off = [abs(angle - round(angle / _SNAPPED_TO) * _SNAPPED_TO) for angle in angles]
    near = [one for one in off if one <= _ROUNDED]
    return any(one > _EXACT for one in near) and max(near) <= _BARELY


class DHRow(Section):
    """One row of a Denavit-Hartenberg table (table 2)."""

    type: Literal["revolute", "prismatic"] = "revolute"
    """Kind of joint; its variable adds to `theta`, or to `d` if prismatic."""
    theta: Angle = 0.0
    """Angle about the old z axis [rad]."""
    d: Number = 0.0
    """Distance along the old z axis [m]."""
    a: Number = 0.0
    """Length of the link along the x axis [m]."""
    alpha: Angle = 0.0
    """Twist about the x axis [rad]."""

    @model_validator(mode="after")
    def _of_an_arm(self) -> DHRow:
        for name, angle in (("theta", self.theta), ("alpha", self.alpha)):
            if abs(angle) > _LARGEST_ANGLE:
                raise ValueError(
                    f"{name}: {angle:g} rad is more than a turn; numbers are rad, degrees are written '{angle:g} deg'"
                )
        for name, length in (("d", self.d), ("a", self.a)):
            if abs(length) > _LONGEST_LINK:
                raise ValueError(f"{name}: {length:g} m is longer than the link of any arm; in mm? lengths are metres")
        return self


class DHTable(Section):
    """A serial chain."""

    convention: Literal["standard", "modified"]
    """`standard` (distal frames, `Rz(theta) Tz(d) Tx(a) Rx(alpha)`), or `modified` (Craig)."""
    joints: Annotated[dict[str, DHRow], Field(min_length=1)]
    """Rows by joint name, from the base to the tip."""


class Kinematics(Section):
    """Exactly one description of the mechanism, and which part of it is the arm.

    Of a URDF or MJCF file, the arm is what moves between the links `base` and `tip`; what hangs on joints that are held
    is part of the link before them.
    """

    dh: DHTable | None = None
    """Denavit-Hartenberg table."""
    snap: bool = False
    """Angles in `rpy` of a URDF within 0.002 rad of a multiple of 15 degrees are that multiple."""
    urdf: TextBeside | None = None
    """URDF file beside the description."""
    mjcf: TextBeside | None = None
    """MJCF file beside the description."""
    base: Annotated[str, Field(min_length=1)] | None = None
    """Link that the arm stands on, whose frame is the world; the root of the file when left out."""
    tip: Annotated[str, Field(min_length=1)] | None = None
    """Link that the arm ends at; all that moves is the arm when left out."""
    lock: dict[str, Angle] = Field(default_factory=dict)
    """Positions of joints that are held [rad or m], by name. All others outside base and tip are held at zero."""

    @field_validator("urdf")
    @classmethod
    def _snapped(cls, urdf: TextFile | None, info: ValidationInfo) -> TextFile | None:
        if urdf is None or not info.data.get("snap"):
            return urdf
        return TextFile(name=urdf.name, text=snap_angles(urdf.text))

    @model_validator(mode="after")
    def _one(self) -> Kinematics:
        if sum(source is not None for source in (self.dh, self.urdf, self.mjcf)) != 1:
            raise ValueError("give exactly one of dh, urdf, mjcf")
        if self.dh is not None and (self.base or self.tip or self.lock):
            raise ValueError("base, tip and lock are of urdf and mjcf; a DH table lists the joints that move")
        if self.snap and self.urdf is None:
            raise ValueError("snap is of urdf; write the angles of a DH table or MJCF file with all their digits")
        return self

    @model_serializer(mode="wrap")
    def _without_part_defaults(self, serialized: SerializerFunctionWrapHandler) -> dict[str, Any]:
        # Left out at their defaults, so that older descriptions keep the hash that results and tickets store.
        document: dict[str, Any] = serialized(self)
        return {key: value for key, value in document.items() if key not in ("base", "tip", "lock", "snap") or value}
