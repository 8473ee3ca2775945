"""Triangular factors of equations: merging in any order, weights and residuals, against all rows at once."""

from __future__ import annotations

from functools import reduce
from itertools import pairwise
from typing import Literal

import numpy as np
import pytest
from helpers.random_arms import random_chain, random_delta, random_states
from hypothesis import given, settings
from hypothesis import strategies as st

from ident_service.errors import ModelError
from ident_service.model import information
from ident_service.model.base_parameters import BaseParameters, base_parameters
from ident_service.model.chain import Chain
from ident_service.model.information import Information, empty_information, information_of, sparsity
from ident_service.model.parameter_layout import Layout
from ident_service.model.regressor import joint_regressor

Array = np.ndarray
Block = tuple[Array, Array, Array]


class Equations:
    """A random mechanism's equations, whole and in blocks."""

    def __init__(self, seed: int, joints: int, samples: int = 120) -> None:
        rng = np.random.default_rng(seed)
        self.rng = rng
        self.chain: Chain = random_chain(rng, joints)
        self.layout = Layout(self.chain.revolute, ("drive_inertia", "viscous", "coulomb", "offset"))
        self.base: BaseParameters = base_parameters(self.chain, self.layout)
        states = random_states(rng, samples, joints)
        self.H_b = joint_regressor(self.chain, self.layout, *states, columns=self.base.base)
        self.beta = self.base.K @ random_delta(rng, self.layout)
        self.torque = np.einsum("jps,p->sj", self.H_b, self.beta) + rng.normal(size=(samples, joints))
        self.keep = rng.random((samples, joints)) < 0.9
        self.supports = sparsity(self.chain, self.layout, self.base.base)

    def information(self, part: slice = slice(None)) -> Information:
        return information_of(self.H_b[:, :, part], self.torque[part], self.keep[part], self.supports)

    def blocks(self, cuts: list[int]) -> list[Information]:
        edges = [0, *sorted(cuts), len(self.torque)]
        return [self.information(slice(a, b)) for a, b in pairwise(edges)]

    def rows(self, weights: Array | None = None) -> tuple[Array, Array]:
        """W and omega of every kept equation."""
        joints = self.torque.shape[1]
        w = np.ones(joints) if weights is None else weights
        W = np.vstack([w[j] * self.H_b[j].T[self.keep[:, j]] for j in range(joints)])
        omega = np.concatenate([w[j] * self.torque[self.keep[:, j], j] for j in range(joints)])
        return W, omega


def solved(R: Array) -> Array:
    """Least squares from `[R1 rho1; 0 rho2]`."""
    return np.linalg.solve(R[:-1, :-1], R[:-1, -1])


@pytest.mark.slow
@settings(max_examples=25)
@given(
    seed=st.integers(0, 10_000),
    joints=st.integers(1, 4),
    cuts=st.lists(st.integers(0, 120), max_size=6),
    data=st.data(),
)
def test_merging_in_any_order_and_grouping_gives_the_same_estimate(
    seed: int, joints: int, cuts: list[int], data: st.DataObject
) -> None:
    equations = Equations(seed, joints)
    W, omega = equations.rows()
    expected = np.linalg.lstsq(W / (norms := np.linalg.norm(W, axis=0)), omega, rcond=None)[0] / norms
    pieces = data.draw(st.permutations(equations.blocks(cuts)))
    while len(pieces) > 1:
        index = data.draw(st.integers(0, len(pieces) - 2))
        pieces[index : index + 2] = [pieces[index].merged(pieces[index + 1])]
    (merged,) = pieces
    estimate = solved(merged.stacked())
    np.testing.assert_allclose(estimate, expected, rtol=0, atol=1e-9 * np.linalg.norm(expected))
    np.testing.assert_array_equal(merged.rows, equations.keep.sum(axis=0))


@pytest.mark.slow
@settings(max_examples=25)
@given(seed=st.integers(0, 10_000), joints=st.integers(1, 4), weighted=st.booleans())
def test_the_stacked_factor_is_the_qr_of_all_rows(seed: int, joints: int, weighted: bool) -> None:
    equations = Equations(seed, joints)
    weights = equations.rng.uniform(0.1, 10.0, size=joints) if weighted else None
    W, omega = equations.rows(weights)
    R = equations.information().stacked(weights)
    assert R.shape == (equations.base.size + 1, equations.base.size + 1)
    np.testing.assert_array_equal(R, np.triu(R))
    direct = np.linalg.qr(np.column_stack([W, omega]), mode="r")
    signs = np.sign(np.diag(R)) * np.sign(np.diag(direct))
    np.testing.assert_allclose(R, signs[:, None] * direct, rtol=0, atol=1e-9 * np.linalg.norm(direct))


def test_weights_are_what_rows_are_multiplied_by() -> None:
    equations = Equations(3, 3)
    information = equations.information()
    np.testing.assert_allclose(
        np.abs(information.stacked(np.array([2.0, 2.0, 2.0]))),
        2.0 * np.abs(information.stacked()),
        rtol=1e-9,
        atol=1e-9,
    )
    only_last = information.stacked(np.array([0.0, 0.0, 1.0]))
    H, torque = equations.H_b[2].T[equations.keep[:, 2]], equations.torque[equations.keep[:, 2], 2]
    np.testing.assert_allclose(only_last.T @ only_last, _gram(H, torque), rtol=1e-8, atol=1e-8)


def _gram(H: Array, torque: Array) -> Array:
    rows = np.column_stack([H, torque])
    return rows.T @ rows


@settings(max_examples=25)
@given(seed=st.integers(0, 10_000), joints=st.integers(1, 4), cut=st.integers(0, 120))
def test_residuals_torques_and_scores_are_those_of_the_rows(seed: int, joints: int, cut: int) -> None:
    equations = Equations(seed, joints)
    information = reduce(Information.merged, equations.blocks([cut]))
    beta = equations.beta + 0.1 * equations.rng.normal(size=equations.base.size)
    squares, torques, score = [], [], np.zeros(equations.base.size)
    for joint in range(joints):
        mask = equations.keep[:, joint]
        H, torque = equations.H_b[joint].T[mask], equations.torque[mask, joint]
        squares.append(np.sum((torque - H @ beta) ** 2))
        torques.append(np.sum(torque**2))
        score += H.T @ (torque - H @ beta)
    np.testing.assert_allclose(information.squared_residuals(beta), squares, rtol=1e-9)
    np.testing.assert_allclose(information.squared_torques(), torques, rtol=1e-9)
    np.testing.assert_allclose(information.scores(beta), score, rtol=0, atol=1e-9 * np.linalg.norm(score))


@pytest.mark.slow
@settings(max_examples=25)
@given(seed=st.integers(0, 10_000), joints=st.integers(1, 5))
def test_supports_are_the_columns_that_a_joint_feels(seed: int, joints: int) -> None:
    equations = Equations(seed, joints)
    for joint, support in enumerate(equations.supports):
        felt = np.flatnonzero(np.abs(equations.H_b[joint]).max(axis=1) > 1e-12)
        assert set(felt) <= set(support)
        assert (np.diff(support) > 0).all()
        links = equations.base.base[support] // equations.layout.per_link
        assert all(joint in equations.chain.ancestors(int(link)) for link in links)


def test_nothing_is_the_neutral_element() -> None:
    equations = Equations(4, 3)
    information = equations.information()
    nothing = empty_information(equations.supports, equations.base.size)
    assert nothing.rows.tolist() == [0, 0, 0]
    assert nothing.stacked().shape == (equations.base.size + 1,) * 2
    assert not nothing.stacked().any()
    assert not nothing.squared_residuals(equations.beta).any()
    for merged in (nothing.merged(information), information.merged(nothing)):
        np.testing.assert_allclose(solved(merged.stacked()), solved(information.stacked()), rtol=1e-9)


def test_blocks_without_a_kept_equation_say_nothing() -> None:
    equations = Equations(5, 2)
    none = information_of(equations.H_b, equations.torque, np.zeros_like(equations.keep), equations.supports)
    assert none.rows.tolist() == [0, 0]
    merged = none.merged(equations.information())
    np.testing.assert_allclose(solved(merged.stacked()), solved(equations.information().stacked()), rtol=1e-9)


def test_factors_stay_small_however_many_rows_they_hold() -> None:
    equations = Equations(6, 3)
    information = reduce(Information.merged, [equations.information()] * 20)
    for support, factor in zip(information.supports, information.factors, strict=True):
        assert factor.shape == (len(support) + 1, len(support) + 1)
    np.testing.assert_array_equal(information.rows, 20 * equations.keep.sum(axis=0))


def test_information_of_different_models_does_not_merge() -> None:
    with pytest.raises(ModelError, match="base parameters of"):
        Equations(7, 2).information().merged(Equations(8, 3).information())


def test_factors_cannot_be_changed() -> None:
    information = Equations(9, 2).information()
    with pytest.raises(ValueError, match="read-only"):
        information.factors[0][0, 0] = 1.0


def test_where_only_one_has_equations_its_factors_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    arm = Equations(3, 2)
    some, none = arm.information(), empty_information(arm.supports, arm.base.size)
    nothing_kept = information_of(arm.H_b, arm.torque, np.zeros_like(arm.keep), arm.supports)
    monkeypatch.setattr(information, "triangle", None)  # nothing is factored
    for empty in (none, nothing_kept):
        for both in (some.merged(empty), empty.merged(some), Information.sum([empty, some, empty])):
            assert all(np.array_equal(one, other) for one, other in zip(both.factors, some.factors, strict=True))
            assert both.rows.tolist() == some.rows.tolist()
        assert not empty.merged(empty).rows.any()


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (3, 9), (9, 9), (10, 9), (500, 9), (70, 1)])
@pytest.mark.parametrize("order", ["C", "F"])
def test_a_triangle_has_the_products_of_its_rows(rows: int, columns: int, order: Literal["C", "F"]) -> None:
    made = np.asarray(np.random.default_rng(rows).standard_normal((rows, columns)), order=order)
    made[:, -1:] *= 1e-9  # a column's digits are its own, unlike those of products
    before = made.copy()
    R = information.triangle(made)
    np.testing.assert_array_equal(made, before)
    assert R.shape == (min(rows, columns), columns)
    assert not np.tril(R, -1).any()
    sizes = np.linalg.norm(made, axis=0)
    np.testing.assert_allclose(R.T @ R / np.outer(sizes, sizes), made.T @ made / np.outer(sizes, sizes), atol=1e-13)
