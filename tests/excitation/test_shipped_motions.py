"""The motions of shipped arms may be made: what a newcomer types first is not refused."""

from __future__ import annotations

import pytest

from ident_service.config.load import load_arm, shipped_arms
from ident_service.config.simulation import SimulatedDriver
from ident_service.errors import MotionRefused
from ident_service.excitation.plan import excitation
from ident_service.model.arm_model import arm_model
from ident_service.service.commission import require_clear_from_home

SIMULATED = [name for name in shipped_arms() if isinstance(load_arm(name).driver, SimulatedDriver)]


def test_every_simulated_arm_is_here() -> None:
    assert set(SIMULATED) >= {"wam7_sim", "planar2", "sixaxis", "threelink"}


@pytest.mark.slow
@pytest.mark.parametrize("motion", ["identification", "validation"])
@pytest.mark.parametrize("name", SIMULATED)
def test_a_shipped_motion_may_be_made_from_home(name: str, motion: str) -> None:
    model = arm_model(load_arm(name))
    require_clear_from_home(model, excitation(model, motion))  # type: ignore[arg-type]


def test_a_motion_that_comes_too_near_is_refused() -> None:
    config = load_arm("sixaxis")
    near = config.motions.validation.model_copy(update={"seed": 10})
    model = arm_model(config.model_copy(update={"motions": config.motions.model_copy(update={"validation": near})}))
    with pytest.raises(MotionRefused, match="j5 - j3"):
        require_clear_from_home(model, excitation(model, "validation"))
