"""Exact definiteness, equations and numbers, and the blocks written down twice."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ident_service.certificate_verifier import (
    Affine,
    Kind,
    Matrix,
    VerificationError,
    is_positive_definite,
    is_positive_semidefinite,
    link_condition,
    rational,
    rational_text,
)
from ident_service.estimation.certificate import exact_block, repair
from ident_service.estimation.feasible.feasible_set import feasible_set
from ident_service.model.parameter_layout import INERTIAL

small = st.fractions(min_value=-3, max_value=3, max_denominator=7)


def matrices(rows: int, columns: int) -> st.SearchStrategy[Matrix]:
    return st.lists(st.lists(small, min_size=columns, max_size=columns), min_size=rows, max_size=rows)


def gram(factor: Matrix) -> Matrix:
    return [[sum((a * b for a, b in zip(x, y, strict=True)), Fraction(0)) for y in factor] for x in factor]


@pytest.mark.slow
@given(matrices(4, 2))
def test_a_gram_matrix_of_low_rank_is_semidefinite_and_not_definite(factor: Matrix) -> None:
    assert is_positive_semidefinite(gram(factor))
    assert not is_positive_definite(gram(factor))


@pytest.mark.slow
@given(matrices(4, 3), st.fractions(min_value=Fraction(1, 10**12), max_value=1))
def test_a_gram_matrix_with_the_least_lift_is_definite_and_with_the_least_drop_is_nothing(
    factor: Matrix, lift: Fraction
) -> None:
    lifted, dropped = gram(factor), gram(factor)
    for i in range(4):
        lifted[i][i] += lift
        dropped[i][i] -= lift
    assert is_positive_definite(lifted)
    assert is_positive_semidefinite(lifted)
    # Rank three of four rows: lowered by anything, the null direction becomes negative.
    assert not is_positive_semidefinite(dropped)


@pytest.mark.slow
@given(matrices(3, 3), st.lists(small, min_size=3, max_size=3))
def test_a_negative_direction_is_found(factor: Matrix, direction: list[Fraction]) -> None:
    matrix = [[factor[min(i, j)][max(i, j)] for j in range(3)] for i in range(3)]
    form = sum((matrix[i][j] * direction[i] * direction[j] for i in range(3) for j in range(3)), Fraction(0))
    if form < 0:
        assert not is_positive_semidefinite(matrix)
    if form <= 0 and any(direction):
        assert not is_positive_definite(matrix)


def test_a_zero_pivot_needs_a_zero_row() -> None:
    zero, one = Fraction(0), Fraction(1)
    assert is_positive_semidefinite([[zero, zero], [zero, one]])
    assert not is_positive_semidefinite([[zero, one], [one, one]])
    assert not is_positive_semidefinite([[one, one], [one, one - Fraction(1, 10**30)]])


@pytest.mark.slow
@given(matrices(3, 5), st.lists(small, min_size=5, max_size=5), st.lists(small, min_size=5, max_size=5))
def test_repaired_values_solve_the_equations_exactly(
    matrix: Matrix, solution: list[Fraction], start: list[Fraction]
) -> None:
    equations = [dict(enumerate(row)) for row in matrix]
    right = [sum((c * solution[k] for k, c in row.items()), Fraction(0)) for row in equations]
    repaired = repair(equations, right, dict(enumerate(start)), lambda _: 1.0)
    assert repaired is not None
    assert [sum((c * repaired[k] for k, c in row.items()), Fraction(0)) for row in equations] == right


def test_equations_that_contradict_each_other_are_not_repaired() -> None:
    one = Fraction(1)
    assert repair([{"a": one}, {"a": one}], [one, 2 * one], {"a": one}, lambda _: 1.0) is None


@pytest.mark.slow
@given(st.fractions() | st.floats(allow_nan=False, allow_infinity=False).map(lambda x: Fraction(repr(x))))
def test_numbers_are_written_and_read_without_loss(value: Fraction) -> None:
    assert rational(rational_text(value)) == value


@pytest.mark.parametrize(
    "bad", ["", "1/0", "1e9999", "nan", "inf", "1_0", " 1", "1/2/3", "0x1", "٣", "9" * 3000, "--1"]
)
def test_what_is_no_number_is_refused(bad: str) -> None:
    with pytest.raises(VerificationError):
        rational(bad)


def test_an_affine_number_can_be_read() -> None:
    affine = Affine({"lx3": Fraction(1), "m3": Fraction(-9, 200)}, Fraction(0))
    assert str(affine) == "lx3 - 0.045*m3"
    assert str(Affine({"m1": Fraction(-1)}, Fraction(27))) == "27 - m1"


@pytest.mark.parametrize("kind", ["inertia", "pseudo_inertia"])
def test_the_blocks_of_the_solver_are_those_of_the_verifier(kind: Kind) -> None:
    names = tuple(f"{symbol}{link}" for link in (1, 2) for symbol in INERTIAL)
    for link, block in enumerate(feasible_set(kind, names).blocks, 1):
        assert exact_block(block, names) == link_condition(kind, link)


def test_a_point_mass_stands_on_the_edge_of_the_4x4_condition() -> None:
    # x = (1/3, -2, 5), 7 kg: moments of a point have rank one, to the last digit.
    x, m = [Fraction(1, 3), Fraction(-2), Fraction(5)], Fraction(7)
    square = sum((c * c for c in x), Fraction(0))
    values = {"m1": m} | {f"l{axis}1": m * c for axis, c in zip("xyz", x, strict=True)}
    for i, a in enumerate("xyz"):
        for j, b in enumerate("xyz"):
            if i <= j:
                values[f"L{a}{b}1"] = m * ((square if i == j else 0) - x[i] * x[j])
    for kind in ("inertia", "pseudo_inertia"):
        block = link_condition(kind, 1)
        assert not block.is_positive(values)
        heavier = values | {"m1": m + Fraction(1, 10**20)}
        spread = heavier | {name: heavier[name] + Fraction(1, 10**20) for name in ("Lxx1", "Lyy1", "Lzz1")}
        assert block.is_positive(spread)
    assert np.isclose(float(square), 1 / 9 + 29)
