"""Identifications of the real arms that several tests look at, each made once."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import pytest

from benchmarks.real_data import CASES, case_estimate, case_model
from ident_service.estimation.identify import Estimate

Identified = Callable[..., Estimate]


@pytest.fixture(scope="session")
def identified(shared: Path) -> Identified:
    """Identify an arm by its name with default settings, drawn to a prior or not; nobody may change the estimate."""

    @lru_cache
    def estimate(arm: str, prior: str = "none") -> Estimate:
        (case,) = (case for case in CASES if case.arm == arm)
        return case_estimate(case, None, prior, case_model(case))

    return estimate
