"""Real arms: the targets that a reference reached, on recordings that were never fitted to, and no impossible link."""

from __future__ import annotations

import pytest
from real_data.conftest import Identified

from benchmarks.real_data import CASES, Case, judged, violations
from ident_service.config.load import load_arm
from ident_service.estimation.identify import Estimate

pytestmark = pytest.mark.slow


def assert_met(case: Case, estimate: Estimate) -> None:
    whole, joints = judged(case, estimate.candidates[estimate.chosen])
    assert round(whole, 1) <= case.target
    assert len(joints) == estimate.model.chain.joints
    assert estimate.feasible
    assert violations(estimate) == 0


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.arm)
def test_the_descriptions_say_nothing_of_how_to_identify(case: Case) -> None:
    assert "identification" not in load_arm(case.arm).model_fields_set


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.arm)
def test_the_target_is_met_by_parameters_that_a_body_could_have(case: Case, identified: Identified) -> None:
    assert_met(case, identified(case.arm))


def test_the_entropic_prior_of_the_kuka_is_no_worse(identified: Identified) -> None:
    case = CASES[0]
    plain, pulled = (identified(case.arm, prior) for prior in ("none", "entropic"))
    assert pulled.prior is not None
    assert violations(pulled) == 0
    errors = [judged(case, estimate.candidates[3])[0] for estimate in (plain, pulled)]
    assert errors[1] <= errors[0] + 0.005
