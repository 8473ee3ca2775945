"""The shape of the friction that the search finds in the real recordings, so that not every test searches for it."""

from __future__ import annotations

from ident_service.config.arm import FrictionShape
from ident_service.estimation.friction_fit import with_friction
from ident_service.model.arm_model import ArmModel

FRICTION = {
    "kuka_lwr4": FrictionShape(
        presliding=(2.2430e-4, 0.05, 1.11283e-2, 4.6584e-4, 1.2940e-3, 5.3582e-3, 0.0),
        stribeck_velocity=(0.100383, 0.105359, 0.223074, 0.0325212, 0.02, 0.0512, 0.278842),
    ),
    "ur10": FrictionShape(
        presliding=(3.0e-4, 4.9845e-4, 2.14997e-3, 4.8e-4, 0.0, 1.44899e-2),
        stribeck_velocity=(0.121489, 0.0338763, 0.0423453, 0.0573801, 0.0271010, 0.248810),
    ),
    "tx40": FrictionShape(
        presliding=(1.8e-4, 1.08e-4, 1.08e-4, 3.75e-4, 1.08e-4, 1.08e-4),
        stribeck_velocity=(0.8, 0.8, 0.121489, 0.8, 0.0971912, 0.8),
    ),
}


def with_known_friction(model: ArmModel) -> ArmModel:
    """A real arm whose friction has the known shape, so that nothing is searched for."""
    return with_friction(model, FRICTION[model.config.name])
