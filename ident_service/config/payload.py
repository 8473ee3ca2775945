"""A payload that is mounted, as an arm's description states it; and what is known of an arm that carries it.

A body of mass m with its centre of mass at c in the frame of the link that carries it, and the inertia J about that
centre along the axes of that frame, adds to the link's parameters (eqs. 5, 8)

    L = J + m (c.c 1 - c c^T),    l = m c,    m.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from pydantic import Field, field_validator

from ident_service.config.quantities import Interval, Number, Positive, Section, Vector3

if TYPE_CHECKING:
    from ident_service.config.arm import ArmConfig

_FARTHEST = 3.0  # m from the link's frame; a number in millimetres is beyond
_HEAVIEST = 1000.0  # kg; a number in grams is beyond
_ROUNDING = 1e-9


class Payload(Section):
    """A tool or load that is on the arm for as long as the description says so."""

    mass: Annotated[Positive, Field(le=_HEAVIEST)]
    """Mass [kg]."""
    center_of_mass: Vector3
    """Centre of mass in the frame of the link that carries it [m]."""
    inertia: tuple[Number, Number, Number, Number, Number, Number] | None = None
    """Jxx, Jxy, Jxz, Jyy, Jyz, Jzz about the centre of mass, along the axes of that frame [kg m^2]; those of a point
    when left out."""
    link: str | None = None
    """Link that carries it, by the name of the joint that moves it; the last one when left out."""

    @field_validator("center_of_mass")
    @classmethod
    def _near(cls, center: Vector3) -> Vector3:
        if max(map(abs, center)) > _FARTHEST:
            raise ValueError(
                f"{max(center, key=abs):g} m is more than {_FARTHEST:g} m from the link's frame; lengths are metres"
            )
        return center

    @field_validator("inertia")
    @classmethod
    def _of_a_body(cls, inertia: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if inertia is None:
            return None
        import numpy as np  # loads for 0.1 s, and few descriptions have a payload

        xx, xy, xz, yy, yz, zz = inertia
        smallest, middle, largest = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]).tolist()
        if smallest < -_ROUNDING * largest or smallest + middle < (1.0 - _ROUNDING) * largest:
            raise ValueError(
                f"no body has principal moments of {smallest:.3g}, {middle:.3g} and {largest:.3g} kg m^2: none is"
                " negative, and none is more than the sum of the others; give Jxx, Jxy, Jxz, Jyy, Jyz, Jzz about the"
                " centre of mass"
            )
        return inertia

    @property
    def parameters(self) -> tuple[float, ...]:
        """Return what the payload adds to Lxx Lxy Lxz Lyy Lyz Lzz lx ly lz m of the link that carries it [SI]."""
        x, y, z = self.center_of_mass
        m = self.mass
        xx, xy, xz, yy, yz, zz = self.inertia or (0.0,) * 6
        moved = (
            xx + m * (y * y + z * z),
            xy - m * x * y,
            xz - m * x * z,
            yy + m * (x * x + z * z),
            yz - m * y * z,
            zz + m * (x * x + y * y),
        )
        return (*moved, m * x, m * y, m * z, m)

    @property
    def words(self) -> str:
        """Return a phrase for people: the payload's mass, its center of mass and the link that carries it."""
        x, y, z = self.center_of_mass
        where = "the last link" if self.link is None else f"the link of {self.link}"
        return f"{self.mass:g} kg at ({x:g}, {y:g}, {z:g}) m of {where}"


def constraints_with_payload(config: ArmConfig) -> ArmConfig:
    """Return the description with mass bounds raised by the payload, and without the shape of the link that carries it.

    Bounds of masses move by the payload's mass. What is known about the shape of the link that carries it (box, hull,
    ellipsoid, symmetry) is left out: it is not known of both together.
    """
    payload = config.payload
    if payload is None:
        return config
    joints = dict(config.joints)
    carrier = payload.link if payload.link is not None else next(reversed(joints), None)
    if carrier in joints:
        mass = joints[carrier].body.mass
        body = type(joints[carrier].body)(mass=None if mass is None else _moved(mass, payload.mass))
        joints[carrier] = joints[carrier].model_copy(update={"body": body})
    total = config.constraints.total_mass
    lower, upper = total.lower, total.upper
    total = total.model_copy(
        update={
            "lower": _round(lower + payload.mass) if lower > 0.0 else lower,
            "upper": None if upper is None else _round(upper + payload.mass),
        }
    )
    constraints = config.constraints.model_copy(update={"total_mass": total})
    return config.model_copy(update={"joints": joints, "constraints": constraints})


def _moved(bounds: Interval, mass: float) -> Interval:
    return _round(bounds[0] + mass), _round(bounds[1] + mass)


def _round(value: float) -> float:
    """Return a number as a certificate's sentences have it, which name bounds to six digits."""
    return float(f"{value:g}")
