"""Payloads on simulated arms that stick, are noisy and late: mass and centre of mass within three deviations."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.changed_arms import changed, recorded_arm
from payload.known_arms import body

from ident_service.estimation.fit import gather
from ident_service.estimation.identify import identify
from ident_service.estimation.payload import KnownArm, center_of_mass, identify_payload
from ident_service.model.arm_model import arm_model
from ident_service.model.parameter_layout import INERTIAL

SEEDS = {"planar2": 20, "sixaxis": 10}
LOADS = {"planar2": body(0.2, (0.03, 0.01, 0.0), 0.02), "sixaxis": body(1.0, (0.02, -0.01, 0.06))}


def found_on(arm: str, seeds: range, folder: Path) -> tuple[int, int, list[float]]:
    """Wrong words for an arm with a load, for one without, and every error of the loads in deviations."""
    load, config = LOADS[arm], changed(arm, seed=seeds.start)
    model = arm_model(config)
    last = model.layout.joints
    added = dict(zip([f"{symbol}{last}" for symbol in INERTIAL], load.tolist(), strict=True))
    estimate = identify(model, [recorded_arm(config, folder / "arm.mcap")])
    known = KnownArm(
        estimate.model, estimate.base, estimate.beta, estimate.covariance, len(estimate.prepared.equations.blocks)
    )
    missed, invented, errors = 0, 0, list[float]()
    for seed in seeds:
        for name, truth in (("with", added), ("without", {})):
            recording = recorded_arm(
                changed(arm, seed=1000 + 2 * seed + len(truth), added=truth), folder / f"{name}{seed}.mcap"
            )
            payload = identify_payload(known, gather([recording], known.model, known.base))
            if not truth:
                invented += payload.verdict != "none"
                continue
            missed += payload.verdict != "added"
            off = (payload.fit.beta - payload.base.K @ load) / payload.standard_deviations
            errors += np.abs(off).tolist()
            if (center := center_of_mass(payload)) is not None:
                errors += (np.abs(center[0] - load[6:9] / load[9]) / center[1]).tolist()
    return missed, invented, errors


@pytest.mark.campaign
@pytest.mark.parametrize("arm", LOADS)
def test_loads_of_simulated_arms(arm: str, tmp_path: Path) -> None:
    missed, invented, errors = found_on(arm, range(SEEDS[arm]), tmp_path)
    assert missed == 0
    assert invented <= 1
    # All seeds share one arm, whose doubt is in all of them.
    assert np.mean(np.array(errors) < 3.0) > 0.97
    assert max(errors) < 4.5
