"""The bootstrap: calibrated where the noise is coloured and a bound binds, exact in how it draws."""

from __future__ import annotations

from functools import reduce

import numpy as np
import pytest
import scipy  # its parts load for a second where they are used
from estimation.synthetic import one_joint_information, random_information, serial_chain
from helpers.random_arms import model_around, random_delta

from ident_service.errors import ModelError, SolverError
from ident_service.estimation.bootstrap import block_resample_counts, bootstrap, run_length
from ident_service.estimation.equations import Equations
from ident_service.estimation.feasible.feasible_set import Block, FeasibleSet, feasible_set
from ident_service.estimation.feasible.priors import Prior
from ident_service.estimation.feasible.problems import constrained_least_squares
from ident_service.estimation.least_squares import LeastSquares, ordinary_least_squares
from ident_service.model.base_parameters import BaseParameters, base_parameters
from ident_service.model.information import Information

Array = np.ndarray
NAMES = ("fv1", "fc1", "fv2", "fc2")
BASE = BaseParameters(NAMES, np.eye(4), np.arange(4), ("",) * 4)
POSITIVE = FeasibleSet("inertia", NAMES, (Block("friction positive", 0, np.eye(4), np.zeros(4)),))


def coloured(rng: np.random.Generator, samples: int, memory: float) -> Array:
    """First-order autoregression of unit variance, forgetting by a factor of e in `memory` samples."""
    decay = np.exp(-1.0 / memory)
    noise = scipy.signal.lfilter([np.sqrt(1.0 - decay**2)], [1.0, -decay], rng.normal(size=samples + 1000))
    return np.asarray(noise[1000:])


def equations_with(noise: Array, beta: Array, blocks: int = 60, slower: float = 1.0) -> Equations:
    time = np.arange(len(noise)) / 40.0 / slower
    W = np.column_stack([np.sin(w * time + w) for w in (0.5, 0.9, 1.4, 2.1)])
    pairs = zip(np.split(W, blocks), np.split(W @ beta + noise, blocks), strict=True)
    return Equations(tuple(one_joint_information(*pair) for pair in pairs), len(noise))


def nonnegative(least: LeastSquares) -> Array:
    """The constrained estimate of `POSITIVE` by another algorithm, active sets."""
    return np.asarray(scipy.optimize.nnls(least.R1, least.rho1)[0])


def free(least: LeastSquares) -> Array:
    return least.beta


def arm_equations(noise: float = 0.3) -> tuple[Equations, BaseParameters, FeasibleSet]:
    """A two-joint arm whose noise pushes parts of the estimate out of the feasible set."""
    arm = model_around(serial_chain(4, 2))
    base = base_parameters(arm.chain, arm.layout)
    delta = random_delta(np.random.default_rng(4), arm.layout)
    delta[arm.layout.term_columns("coulomb")] = 0.01
    blocks = [random_information(arm, base, delta, seed=seed, samples=12, noise=noise) for seed in range(30)]
    return Equations(tuple(blocks), 360), base, feasible_set("pseudo_inertia", base.names, arm.config)


@pytest.mark.campaign
def test_it_is_calibrated_where_noise_is_coloured_and_a_bound_binds() -> None:
    # The second parameter is a quarter of its deviation above zero, so that the bound binds two times out of five.
    truth = np.array([1.0, 0.03, 2.0, 0.5])
    rng = np.random.default_rng(8)
    estimates, claimed, unconstrained = [], [], []
    for repetition in range(100):
        gathered = equations_with(coloured(rng, 2400, 10.0), truth)
        fit = ordinary_least_squares(gathered.total)
        estimates.append(nonnegative(fit))
        made = bootstrap(gathered, fit, BASE, POSITIVE, 80, seed=repetition, solve=nonnegative)
        claimed.append(made.standard_deviations)
        unconstrained.append(bootstrap(gathered, fit, BASE, POSITIVE, 80, seed=repetition, solve=free))
    empirical = np.std(estimates, axis=0)
    np.testing.assert_allclose(np.mean(claimed, axis=0) / empirical, 1.0, rtol=0, atol=0.3)
    share = np.mean(claimed, axis=0) / np.mean([u.standard_deviations for u in unconstrained], axis=0)
    assert share[1] < 0.8
    assert np.all(share < 1.01)


@pytest.mark.campaign
@pytest.mark.slow
def test_a_run_holds_what_neighbours_have_in_common() -> None:
    # Columns hardly move while the noise remembers four blocks: single blocks promise too much, runs much less so.
    rng = np.random.default_rng(3)
    truth = np.array([1.0, 1.0, 2.0, 0.5])
    errors, single, chosen, lengths = [], [], [], []
    for repetition in range(60):
        gathered = equations_with(coloured(rng, 8000, 160.0), truth, 200, slower=10.0)
        fit = ordinary_least_squares(gathered.total)
        errors.append(fit.beta - truth)
        lengths.append(run_length(gathered, fit))
        made = bootstrap(gathered, fit, BASE, POSITIVE, 60, seed=repetition, solve=free)
        assert made.run == lengths[-1]
        chosen.append(made.covariance.diagonal())
        single.append(
            bootstrap(gathered, fit, BASE, POSITIVE, 60, repetition, free, blocks_per_run=1).covariance.diagonal()
        )
    empirical = np.sqrt(np.mean(np.square(errors), axis=0)).mean()
    by_runs, by_blocks = (np.sqrt(np.mean(variances, axis=0)).mean() for variances in (chosen, single))
    assert np.median(lengths) >= 2
    assert by_blocks / empirical < by_runs / empirical < 1.3
    assert by_runs / by_blocks > 1.15


def test_white_blocks_are_drawn_one_by_one() -> None:
    rng = np.random.default_rng(6)
    lengths = []
    for _ in range(20):
        gathered = equations_with(rng.normal(size=2400), np.ones(4))
        lengths.append(run_length(gathered, ordinary_least_squares(gathered.total)))
    assert np.median(lengths) == 1


@pytest.mark.parametrize(("count", "length"), [(60, 1), (60, 7), (5, 5), (13, 4)])
def test_runs_are_consecutive_and_fill_a_recording(count: int, length: int) -> None:
    times = block_resample_counts(np.random.default_rng(1), count, length)
    again = np.random.default_rng(1).integers(0, count, size=-(-count // length))
    wanted = np.zeros(count, dtype=int)
    for block in [(start + k) % count for start in again for k in range(length)][:count]:
        wanted[block] += 1
    np.testing.assert_array_equal(times, wanted)
    assert times.sum() == count


def test_a_replicate_is_the_estimate_from_the_blocks_it_drew() -> None:
    gathered, base, conditions = arm_equations()
    weights = np.array([0.4, 2.5])
    fit = ordinary_least_squares(gathered.total, weights)
    made = bootstrap(gathered, fit, base, conditions, 3, seed=11, blocks_per_run=2)
    rng = np.random.default_rng(11)
    for beta in made.betas:
        times = block_resample_counts(rng, len(gathered.blocks), 2)
        blocks = [block for block, count in zip(gathered.blocks, times, strict=True) for _ in range(count)]
        least = ordinary_least_squares(reduce(Information.merged, blocks), weights)
        wanted = constrained_least_squares(least, base, conditions).beta
        np.testing.assert_allclose(least.R1 @ beta, least.R1 @ wanted, rtol=0, atol=1e-6 * np.linalg.norm(least.rho1))
        assert conditions.margin(constrained_least_squares(least, base, conditions).delta)[0] > 0.0


def test_replicates_are_drawn_to_the_prior_of_the_estimate() -> None:
    gathered, base, conditions = arm_equations()
    fit = ordinary_least_squares(gathered.total)
    known = constrained_least_squares(fit, base, conditions).delta
    prior = Prior("euclidean", base.names, known, 1e6)
    made = bootstrap(gathered, fit, base, conditions, 5, prior=prior)
    loose = bootstrap(gathered, fit, base, conditions, 5)
    np.testing.assert_allclose(made.betas, np.tile(base.K @ known, (5, 1)), rtol=0, atol=1e-3)
    assert made.standard_deviations.max() < 0.01 * loose.standard_deviations.max()


def test_the_interior_point_method_and_active_sets_scatter_alike() -> None:
    gathered = equations_with(coloured(np.random.default_rng(1), 2400, 5.0), np.array([1.0, 0.0, 2.0, 0.0]))
    fit = ordinary_least_squares(gathered.total)
    ours = bootstrap(gathered, fit, BASE, POSITIVE, 20)
    theirs = bootstrap(gathered, fit, BASE, POSITIVE, 20, solve=nonnegative)
    np.testing.assert_allclose(ours.betas, theirs.betas, rtol=0, atol=1e-4)


def test_the_scale_of_all_weights_does_not_matter() -> None:
    gathered, base, conditions = arm_equations()
    weights = np.array([1.0, 3.0])
    fit = ordinary_least_squares(gathered.total, weights)
    one, other = (
        bootstrap(gathered, ordinary_least_squares(gathered.total, w), base, conditions, 10)
        for w in (weights, 50 * weights)
    )
    # In torque: along directions that the data hardly see, components are the solver's rounding.
    torques = [made.betas @ fit.R1.T for made in (one, other)]
    np.testing.assert_allclose(*torques, rtol=0, atol=1e-6 * np.linalg.norm(fit.rho1))


def test_constraints_narrow_where_they_bind() -> None:
    gathered, base, conditions = arm_equations()
    fit = ordinary_least_squares(gathered.total)
    held = bootstrap(gathered, fit, base, conditions, 60)
    loose = bootstrap(gathered, fit, base, conditions, 60, solve=free)
    friction = [base.names[column].startswith("fc") for column in base.base]
    assert np.all(held.standard_deviations[friction] < loose.standard_deviations[friction])
    assert np.mean(held.standard_deviations) <= np.mean(loose.standard_deviations)
    assert np.all(held.intervals[friction, 0] >= 0.0)


def test_it_reports_what_it_did_and_repeats_it() -> None:
    gathered, base, conditions = arm_equations()
    fit = ordinary_least_squares(gathered.total)
    seen: list[tuple[int, int]] = []
    made = bootstrap(gathered, fit, base, conditions, 5, 3, free, level=0.8, progress=lambda *at: seen.append(at))
    assert seen == [(k, 5) for k in range(1, 6)]
    np.testing.assert_array_equal(made.betas, bootstrap(gathered, fit, base, conditions, 5, 3, free).betas)
    assert not np.array_equal(made.betas, bootstrap(gathered, fit, base, conditions, 5, 4, free).betas)
    np.testing.assert_allclose(made.mean, made.betas.mean(axis=0))
    np.testing.assert_allclose(made.standard_deviations, made.betas.std(axis=0, ddof=1))
    np.testing.assert_allclose(made.intervals[:, 1], np.quantile(made.betas, 0.9, axis=0))
    assert (made.blocks, made.seed, made.level) == (30, 3, 0.8)


def test_what_no_data_tell_has_infinite_deviation() -> None:
    W = np.random.default_rng(2).normal(size=(80, 4))
    W[:, 2] = 0.0
    blocks = tuple(one_joint_information(part, part @ np.ones(4)) for part in np.split(W, 8))
    gathered = Equations(blocks, 80)
    made = bootstrap(gathered, ordinary_least_squares(gathered.total), BASE, POSITIVE, 5, solve=free)
    np.testing.assert_array_equal(np.isinf(made.standard_deviations), [False, False, True, False])
    np.testing.assert_array_equal(made.intervals[2], [-np.inf, np.inf])


def test_a_replicate_that_fails_is_named() -> None:
    gathered, base, conditions = arm_equations()
    fit = ordinary_least_squares(gathered.total)
    calls = 0

    def third_fails(least: LeastSquares) -> Array:
        nonlocal calls
        calls += 1
        if calls == 3:
            raise SolverError("estimate", "NumericalError")
        return least.beta

    with pytest.raises(SolverError, match=r"replicate 3 of 10, estimate.*NumericalError") as caught:
        bootstrap(gathered, fit, base, conditions, solve=third_fails, replicates=10)
    assert caught.value.status == "NumericalError"


def test_what_cannot_be_drawn_is_refused() -> None:
    gathered, base, conditions = arm_equations()
    fit = ordinary_least_squares(gathered.total)
    with pytest.raises(ModelError, match="1 blocks"):
        bootstrap(Equations(gathered.blocks[:1], 12), fit, base, conditions)
    with pytest.raises(ModelError, match="1 replicates"):
        bootstrap(gathered, fit, base, conditions, 1)
    with pytest.raises(ModelError, match="runs of 31 blocks out of 30"):
        bootstrap(gathered, fit, base, conditions, blocks_per_run=31)
    with pytest.raises(ModelError, match="intervals at 1"):
        bootstrap(gathered, fit, base, conditions, level=1.0)
    with pytest.raises(ModelError, match=r"beta\.shape=\(2,\)"):
        bootstrap(gathered, fit, base, conditions, solve=lambda _: np.zeros(2))
