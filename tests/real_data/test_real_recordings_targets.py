"""Real arms: the targets that a reference reached, on recordings that were never fitted to, and no impossible link."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.real_data import CASES, Case, case_estimate, judged, violations

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.arm)
def test_the_target_is_met_by_parameters_that_a_body_could_have(shared: Path, case: Case) -> None:
    estimate = case_estimate(case, "wls")
    whole, joints = judged(case, estimate.candidates[estimate.chosen])
    assert whole <= case.target
    assert len(joints) == estimate.model.chain.joints
    assert estimate.feasible
    assert violations(estimate) == 0


def test_the_entropic_prior_of_the_kuka_is_no_worse(shared: Path) -> None:
    case = CASES[0]
    plain, pulled = (case_estimate(case, "wls", prior) for prior in ("none", "entropic"))
    assert pulled.prior is not None
    assert violations(pulled) == 0
    errors = [judged(case, estimate.candidates[3])[0] for estimate in (plain, pulled)]
    assert errors[1] <= errors[0] + 0.005
