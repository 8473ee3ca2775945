"""Intervals of constrained estimates: they hold the truth, stay in the set, and are short where a condition tells."""

from __future__ import annotations

import numpy as np
import pytest
from estimation.synthetic import random_information
from helpers.random_arms import model_around, random_chain, random_delta

from ident_service.estimation.bootstrap import constrained_intervals
from ident_service.estimation.feasible.feasible_set import feasible_set
from ident_service.estimation.feasible.problems import constrained_least_squares
from ident_service.estimation.least_squares import ordinary_least_squares
from ident_service.model.base_parameters import base_parameters


@pytest.mark.campaign
@pytest.mark.slow
def test_they_hold_the_truth_and_end_at_a_bound() -> None:
    arm = model_around(random_chain(np.random.default_rng(2), 2, branches=False, prismatic=False))
    base = base_parameters(arm.chain, arm.layout)
    delta = random_delta(np.random.default_rng(2), arm.layout)
    dry = arm.layout.names.index("fc1")
    delta[dry] = 0.0  # so that about every second unconstrained estimate is below what a drive can have
    conditions = feasible_set("pseudo_inertia", base.names, arm.config)
    truth = base.K @ delta
    place = base.base.tolist().index(dry)
    inside, bound, shorter = [], 0, []
    for seed in range(30):
        fit = ordinary_least_squares(random_information(arm, base, delta, seed=seed, samples=100, noise=0.5))
        held = constrained_least_squares(fit, base, conditions)
        sigma = fit.rho2 / np.sqrt(2 * 100 - base.size)
        covariance = sigma**2 * fit.inverse @ fit.inverse.T
        ends = constrained_intervals(fit, covariance, held.beta, base, conditions)
        assert (ends[:, 0] <= held.beta).all()
        assert (held.beta <= ends[:, 1]).all()
        inside.append((ends[:, 0] <= truth + 1e-6) & (truth <= ends[:, 1]))
        if held.beta[place] < 1e-4:
            bound += 1
            assert ends[place, 0] > -1e-4
            shorter.append((ends[place, 1] - ends[place, 0]) / (2 * 1.96 * np.sqrt(covariance[place, place])))
    assert bound > 5
    assert np.mean(inside) > 0.9
    assert np.median(shorter) < 0.75
