"""Identifications of the real arms that several tests look at, each made once."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import pytest
from real_data.known_friction import with_known_friction

from benchmarks.real_data import CASES, case_estimate, case_model
from ident_service.estimation.identify import Estimate

Identified = Callable[..., Estimate]


@pytest.fixture(scope="session")
def identified(shared: Path) -> Identified:
    """An arm by its name, its friction of the shape that is known, drawn to a prior or not; nobody may change it."""

    @lru_cache
    def estimate(arm: str, prior: str = "none") -> Estimate:
        (case,) = (case for case in CASES if case.arm == arm)
        return case_estimate(case, "wls", prior, with_known_friction(case_model(case)))

    return estimate
