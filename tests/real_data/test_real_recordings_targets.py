"""Real arms: the targets that a reference reached, on recordings that were never fitted to, and no impossible link."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from real_data.conftest import Identified

from benchmarks.real_data import CASES, Case, case_estimate, judged, violations
from ident_service.config.load import load_arm
from ident_service.estimation.feasible.problems import constrained_least_squares
from ident_service.estimation.identify import Estimate
from ident_service.model.arm_model import arm_model
from ident_service.results.summary import implausible_links

pytestmark = pytest.mark.slow


def assert_met(case: Case, estimate: Estimate) -> None:
    whole, joints = judged(case, estimate.candidates[estimate.chosen])
    assert whole <= case.target
    assert len(joints) == estimate.model.chain.joints
    assert estimate.feasible
    assert violations(estimate) == 0


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.arm)
def test_the_descriptions_say_nothing_of_how_to_identify(case: Case) -> None:
    assert "identification" not in load_arm(case.arm).model_fields_set


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.arm)
def test_the_target_is_met_by_parameters_that_a_body_could_have(case: Case, identified: Identified) -> None:
    assert_met(case, identified(case.arm))


@pytest.mark.parametrize(
    ("arm", "stribeck"), [("kuka_lwr4", "none"), ("ur10", "fit"), ("tx40", "fit")], ids=["kuka_lwr4", "ur10", "tx40"]
)
def test_stribeck_friction_is_taken_where_held_out_thirds_are_predicted_better_with_it(
    arm: str, stribeck: str, identified: Identified
) -> None:
    estimate = identified(arm)
    (choice,) = (one for one in estimate.choices if one.option == "friction.stribeck_velocity")
    assert choice.value == stribeck == min(choice.held_out, key=lambda name: choice.held_out[name])
    assert ("stribeck_velocity" in estimate.prepared.shapes) is (stribeck == "fit")
    told = [
        np.isfinite(estimate.standard_deviations[k]) for k, name in enumerate(estimate.base.expressions) if "fs" in name
    ]
    assert any(told) is (stribeck == "fit")


def test_link_values_are_those_of_an_arm(shared: Path) -> None:
    """The maker's table of the UR10 (7.1, 12.7, 4.3, 2.0, 2.0 and 0.4 kg); the description says nothing of masses."""
    (case,) = (case for case in CASES if case.arm == "ur10")
    estimate = case_estimate(case, None, "none", arm_model(load_arm(case.arm)))
    assert estimate.nearest_to == "geometry"
    assert estimate.delta is not None
    layout = estimate.model.layout
    bodies = [estimate.delta[layout.inertial(link)] for link in range(layout.joints)]
    masses = np.array([body[-1] for body in bodies])
    assert (masses > 0.3).all()
    assert 20.0 < masses.sum() < 40.0  # 28.6 by the maker
    assert masses[1] == masses.max()
    assert 10.0 < masses[1] < 16.0
    assert all(np.linalg.norm(body[6:9]) / body[-1] < 0.4 for body in bodies)


def test_a_wrist_of_fifty_grams_beside_the_arm_is_reported_as_implausible(identified: Identified) -> None:
    lines = {line.split(":")[0]: line for line in implausible_links(identified("kuka_lwr4"))}
    assert "kg, where 0.16 to 16 kg are likely" in lines["lwr_5_joint"]
    assert "m from a likely place, where 0.36 m would be much" in lines["lwr_5_joint"]
    assert not {"lwr_1_joint", "lwr_2_joint", "lwr_3_joint"} & set(lines)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.arm)
def test_for_likely_link_values_no_parameter_moves_by_more_than_a_hundredth_of_its_deviation(
    case: Case, identified: Identified
) -> None:
    estimate = identified(case.arm)
    held = constrained_least_squares(estimate.fit, estimate.base, estimate.conditions)
    moved = np.abs(estimate.beta - held.beta)
    # What data do not see has no deviation, and does not move.
    assert (moved <= 0.0101 * estimate.standard_deviations)[np.isfinite(estimate.standard_deviations)].all()
    assert moved.max() > 0.0


@pytest.mark.campaign
def test_the_entropic_prior_of_the_kuka_is_no_worse(identified: Identified) -> None:
    case = CASES[0]
    plain, pulled = (identified(case.arm, prior) for prior in ("none", "entropic"))
    assert pulled.prior is not None
    assert violations(pulled) == 0
    errors = [judged(case, estimate.candidates[3])[0] for estimate in (plain, pulled)]
    assert errors[1] <= errors[0] + 0.005
