"""Options of the identification with every number given, for tests that know what each of them does."""

from __future__ import annotations

from typing import Any

from ident_service.config.arm import FrictionShape, Identification, Smoothing


def plain_smoothing(**given: Any) -> Smoothing:
    """Smooth positions at 8 Hz, the torque as it is, and keep each sample."""
    return Smoothing.model_validate({"cutoff": 8.0, "filter_torque": False, "decimate": 1} | given)


def plain_friction(**given: Any) -> FrictionShape:
    """Turn dry friction round at once."""
    return FrictionShape.model_validate({"presliding": 0.0, "stribeck_velocity": 0.1} | given)


def plain_options(**given: Any) -> Identification:
    """Estimate by ordinary least squares without a delay, leaving out half a second at both ends."""
    return Identification.model_validate(
        {"method": "ols", "smoothing": plain_smoothing(), "friction": plain_friction(), "edge": 0.5, "delay": 0.0}
        | given
    )
