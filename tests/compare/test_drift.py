"""The statistics of a difference: uniform under the null, the same in any units, blind where nothing was seen."""

from __future__ import annotations

import numpy as np
import pytest
import scipy  # its statistics load for a second where they are used
from hypothesis import given, settings
from hypothesis import strategies as st

from ident_service.errors import ParameterError
from ident_service.estimation.change_detection import ALPHA, ComparedEstimate, Motion, detect_change, holm

LEADING = ("Lzz1", "lx1", "ly1", "fv1", "fc1", "fo1", "Lzz2", "lx2", "fv2", "fc2", "fo2")
SIZE = len(LEADING)


def covariance(seed: int, size: int = SIZE) -> np.ndarray:
    """A covariance with units and correlations that differ widely."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(size, 3 * size)) * 10.0 ** rng.uniform(-4, 1, size)[:, None]
    return A @ A.T / A.shape[1]


def drawn(rng: np.random.Generator, S: np.ndarray, blocks: int | None = None, shift: float = 0.0) -> ComparedEstimate:
    """An estimate with this covariance around the same truth; the covariance estimated from so many blocks."""
    values = rng.multivariate_normal(np.zeros(len(S)), S, method="cholesky")
    values[8] += shift * np.sqrt(S[8, 8])
    if blocks is not None:
        scores = rng.multivariate_normal(np.zeros(len(S)), S, size=blocks, method="cholesky")
        S = np.cov(scores.T)
    return ComparedEstimate(LEADING, values, S, blocks)


def uniform(p: list[float]) -> float:
    """How likely these are drawn from the uniform distribution."""
    return float(scipy.stats.kstest(p, "uniform").pvalue)


@pytest.mark.slow
def test_p_is_uniform_under_the_null_where_covariances_are_known() -> None:
    rng = np.random.default_rng(1)
    S1, S2 = covariance(1), covariance(2)
    found = [detect_change(drawn(rng, S1), drawn(rng, S2)) for _ in range(250)]
    assert uniform([one.joint.p for one in found]) > 0.01
    for number in range(len(found[0].effects)):
        assert uniform([one.effects[number].test.p for one in found]) > 0.001
    assert all(one.joint.directions == SIZE for one in found)
    false = sum(one.verdict == "changed" for one in found)
    assert false <= scipy.stats.binom.ppf(0.999, 250, ALPHA)


@pytest.mark.slow
@pytest.mark.parametrize("blocks", [(40, 40), (30, 80)])
def test_p_is_uniform_where_covariances_come_from_few_blocks(blocks: tuple[int, int]) -> None:
    rng = np.random.default_rng(2)
    S1, S2 = covariance(3), covariance(4)
    found = [detect_change(drawn(rng, S1, blocks[0]), drawn(rng, S2, blocks[1])) for _ in range(250)]
    assert uniform([one.joint.p for one in found]) > 0.01
    assert uniform([one.effects[2].test.p for one in found]) > 0.01
    # Taken for known, the same covariances cry wolf.
    naive = np.mean([scipy.stats.chi2.sf(one.joint.statistic, one.joint.directions) < 0.05 for one in found])
    assert naive > 0.1


@pytest.mark.slow
def test_more_parameters_than_blocks_give_no_false_alarms() -> None:
    rng = np.random.default_rng(3)
    S = covariance(5)
    found = [detect_change(drawn(rng, S, 8), drawn(rng, S, 9)) for _ in range(200)]
    assert all(0 < one.joint.directions < SIZE for one in found)
    assert all(one.joint.left_out == SIZE - one.joint.directions for one in found)
    assert np.mean([one.joint.p < 0.05 for one in found]) < 0.08
    assert sum(one.verdict == "changed" for one in found) <= scipy.stats.binom.ppf(0.999, 200, ALPHA)


def test_a_change_of_one_friction_is_found_and_named() -> None:
    rng = np.random.default_rng(4)
    S = covariance(6)
    for _ in range(50):
        found = detect_change(drawn(rng, S, 60), drawn(rng, S, 60, shift=12.0))
        assert found.verdict == "changed"
        assert [(one.kind, one.number) for one in found.changes] == [("friction", 2)]


@pytest.mark.slow
@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1))
def test_neither_order_nor_units_matter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    S1, S2 = covariance(seed), covariance(seed + 1)
    first, second = drawn(rng, S1, 30), drawn(rng, S2, 50)
    plain, backwards = detect_change(first, second), detect_change(second, first)
    units = 10.0 ** rng.uniform(-3, 3, SIZE)

    def other_units(one: ComparedEstimate) -> ComparedEstimate:
        return ComparedEstimate(LEADING, one.values * units, one.covariance * np.outer(units, units), one.blocks)

    scaled = detect_change(other_units(first), other_units(second))
    order = rng.permutation(SIZE)

    def shuffled(one: ComparedEstimate) -> ComparedEstimate:
        leading = tuple(LEADING[k] for k in order)
        return ComparedEstimate(leading, one.values[order], one.covariance[np.ix_(order, order)], one.blocks)

    mixed = detect_change(shuffled(first), shuffled(second))
    for other in (backwards, scaled, mixed):
        assert other.joint.statistic == pytest.approx(plain.joint.statistic, rel=1e-5)
        assert other.joint.p == pytest.approx(plain.joint.p, rel=1e-4, abs=1e-12)
        assert other.verdict == plain.verdict
    np.testing.assert_allclose(backwards.z, -plain.z, rtol=1e-9)
    np.testing.assert_allclose(scaled.z, plain.z, rtol=1e-6)
    np.testing.assert_allclose(mixed.z, plain.z[order], rtol=1e-9)


def test_what_is_identical_has_not_changed() -> None:
    one = drawn(np.random.default_rng(5), covariance(7), 30)
    found = detect_change(one, one)
    assert not found.z.any()
    assert found.joint.statistic == 0.0
    assert found.joint.p == 1.0
    assert found.verdict == "unchanged"


def test_what_nobody_saw_is_left_out_and_stated() -> None:
    rng = np.random.default_rng(6)
    S = covariance(8)
    first, second = drawn(rng, S), drawn(rng, S)
    blind = S.copy()
    blind[1, :] = blind[:, 1] = 0.0
    blind[1, 1] = np.inf
    values = second.values.copy()
    values[1] += 1e9
    found = detect_change(first, ComparedEstimate(LEADING, values, blind))
    assert found.joint.left_out == 1
    assert found.joint.directions == SIZE - 1
    assert found.z[1] == 0.0
    assert found.deviations[1] == np.inf
    assert found.verdict == "unchanged"
    nothing = np.diag(np.full(SIZE, np.inf))
    assert detect_change(first, ComparedEstimate(LEADING, values, nothing)).joint.p == 1.0


def test_small_torques_do_not_alarm_however_significant() -> None:
    S = np.diag(np.full(SIZE, 1e-12))
    values, moved = np.ones(SIZE), np.ones(SIZE)
    moved[3] += 1e-3
    # Both joints feel every parameter alike, 10 N m of torque, 0.1 N m of residual.
    response = np.full((1, SIZE), 1.0)
    motion = Motion((response, response), np.array([10.0, 10.0]), np.array([0.1, 0.1]))
    found = detect_change(ComparedEstimate(LEADING, values, S), ComparedEstimate(LEADING, moved, S, None, motion))
    assert found.joint.p < 1e-100
    assert found.verdict == "unchanged"
    assert found.torque_share is not None
    np.testing.assert_allclose(found.torque_share, 1e-4)
    moved[3] += 0.2
    found = detect_change(ComparedEstimate(LEADING, values, S), ComparedEstimate(LEADING, moved, S, None, motion))
    assert [(one.kind, one.number, one.joint) for one in found.changes] == [("friction", 1, 0)]
    # Two per cent of the torque, but a tenth of what nobody can explain.
    poor = Motion((response, response), np.array([10.0, 10.0]), np.array([2.1, 2.1]))
    assert (
        detect_change(ComparedEstimate(LEADING, values, S), ComparedEstimate(LEADING, moved, S, None, poor)).verdict
        == "unchanged"
    )


def test_holm_is_the_textbook_s() -> None:
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([0.02]) == [0.02]


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=20))
def test_holm_keeps_the_order_and_never_helps(p: list[float]) -> None:
    adjusted = holm(p)
    assert all(a >= b for a, b in zip(adjusted, p, strict=True))
    assert all(0.0 <= a <= 1.0 for a in adjusted)
    order = np.argsort(p, kind="stable")
    assert (np.diff(np.array(adjusted)[order]) >= 0.0).all()


def test_what_does_not_belong_together_is_refused() -> None:
    S = np.eye(2)
    first = ComparedEstimate(("fv1", "fc1"), np.zeros(2), S)
    with pytest.raises(ParameterError, match="different base parameters"):
        detect_change(first, ComparedEstimate(("fv1", "fo1"), np.zeros(2), S))
    with pytest.raises(ParameterError, match=r"values\.shape=\(3,\)"):
        ComparedEstimate(("fv1", "fc1"), np.zeros(3), S)
    with pytest.raises(ParameterError, match="from 1 blocks says nothing"):
        ComparedEstimate(("fv1", "fc1"), np.zeros(2), S, 1)
