"""Real arms: the targets that a reference reached, on recordings that were never fitted to, and no impossible link."""

from __future__ import annotations

from pathlib import Path

import pytest
from real_data.conftest import Identified
from real_data.known_friction import FRICTION

from benchmarks.real_data import CASES, Case, case_estimate, judged, violations
from ident_service.estimation.identify import Estimate

pytestmark = pytest.mark.slow


def assert_met(case: Case, estimate: Estimate) -> None:
    whole, joints = judged(case, estimate.candidates[estimate.chosen])
    assert whole <= case.target
    assert len(joints) == estimate.model.chain.joints
    assert estimate.feasible
    assert violations(estimate) == 0


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.arm)
def test_the_target_is_met_by_parameters_that_a_body_could_have(case: Case, identified: Identified) -> None:
    assert_met(case, identified(case.arm))


@pytest.mark.parametrize(
    "case",
    [pytest.param(case, id=case.arm, marks=[] if case.arm == "ur10" else [pytest.mark.campaign]) for case in CASES],
)
def test_the_shape_of_the_friction_is_found_too(case: Case, identified: Identified, shared: Path) -> None:
    estimate = case_estimate(case, "wls")
    assert_met(case, estimate)
    # The search may end beside the numbers that are known, on another processor too, but predicts as well as they do.
    found, known = (judged(case, one.candidates[one.chosen])[0] for one in (estimate, identified(case.arm)))
    assert found == pytest.approx(known, abs=0.05)
    shape = estimate.model.config.identification.friction
    assert len(shape.presliding) == len(shape.stribeck_velocity) == len(FRICTION[case.arm].presliding)


def test_the_entropic_prior_of_the_kuka_is_no_worse(identified: Identified) -> None:
    case = CASES[0]
    plain, pulled = (identified(case.arm, prior) for prior in ("none", "entropic"))
    assert pulled.prior is not None
    assert violations(pulled) == 0
    errors = [judged(case, estimate.candidates[3])[0] for estimate in (plain, pulled)]
    assert errors[1] <= errors[0] + 0.005
