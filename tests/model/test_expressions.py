"""Expressions of base parameters: what reads back, what is refused and where."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ident_service.errors import ParameterError
from ident_service.model.base_parameters import format_expression, format_number, parameter_matrix, parse_expression

NAMES = st.from_regex(r"[A-Za-z_][A-Za-z0-9_]{0,8}", fullmatch=True)
COEFFICIENTS = st.one_of(
    st.sampled_from([1.0, -1.0, 0.3, -0.3, 0.300475]),
    st.floats(allow_nan=False, allow_infinity=False).filter(lambda x: x != 0.0),
)
TERMS = st.dictionaries(NAMES, COEFFICIENTS, min_size=1, max_size=12)


@given(TERMS)
def test_what_is_written_reads_back_exactly(terms: dict[str, float]) -> None:
    assert parse_expression(format_expression([(c, name) for name, c in terms.items()])) == terms


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_numbers_read_back_exactly(value: float) -> None:
    assert float(format_number(value)) == value


@pytest.mark.parametrize(
    ("text", "terms"),
    [
        ("1.1*ly3 + 0.300475*(m3 + m4)", {"ly3": 1.1, "m3": 0.300475, "m4": 0.300475}),
        ("Lxx2 - Lzz2 + Lzz3 - 1.1*ly3", {"Lxx2": 1.0, "Lzz2": -1.0, "Lzz3": 1.0, "ly3": -1.1}),
        ("-a", {"a": -1.0}),
        ("+a", {"a": 1.0}),
        (" a+\tb\n", {"a": 1.0, "b": 1.0}),
        ("2*(a - 3*(b + 0.5*c))", {"a": 2.0, "b": -6.0, "c": -3.0}),
        ("-(a + b)", {"a": -1.0, "b": -1.0}),
        ("((a))", {"a": 1.0}),
        ("a + a", {"a": 2.0}),
        ("a - a + b", {"b": 1.0}),
        (".5*a + 5.*b + 1e-3*c + 2E+2*d", {"a": 0.5, "b": 5.0, "c": 0.001, "d": 200.0}),
        ("(" * 50 + "a" + ")" * 50, {"a": 1.0}),
    ],
)
def test_sums_are_read(text: str, terms: dict[str, float]) -> None:
    assert parse_expression(text) == terms


@pytest.mark.parametrize(
    ("terms", "text"),
    [
        ([(1.0, "Lxx2"), (-1.0, "Lzz2"), (-1.1, "ly3")], "Lxx2 - Lzz2 - 1.1*ly3"),
        ([(0.3, "m3"), (0.3, "m4"), (1.0, "a")], "0.3*(m3 + m4) + a"),
        ([(-0.3, "m3"), (1.0, "a"), (-0.3, "m4")], "-0.3*(m3 + m4) + a"),
        ([(2.0, "a"), (-2.0, "b")], "2*a - 2*b"),
        ([], ""),
    ],
)
def test_sums_are_written_for_people(terms: list[tuple[float, str]], text: str) -> None:
    assert format_expression(terms) == text


@pytest.mark.parametrize(
    ("text", "column", "message"),
    [
        ("", 1, "expected a name"),
        ("   ", 4, "expected a name"),
        ("a b", 3, "unexpected 'b'"),
        ("a*2", 2, "unexpected '*'"),
        ("2", 2, "expected * after a number"),
        ("2 a", 3, "expected * after a number"),
        ("2*3*a", 3, "expected a name"),
        ("(a + b", 7, "expected )"),
        ("a + b)", 6, "unexpected ')'"),
        ("a + + b", 5, "expected a name"),
        ("--a", 2, "expected a name"),
        ("a - ", 5, "expected a name"),
        ("a.b", 2, "unexpected character"),
        ("a/2", 2, "unexpected character"),
        ("a**2", 2, "unexpected '*'"),
        ("0x10*a", 2, "expected *"),
        ("__import__('os').system('true')", 11, "unexpected '('"),
        ("lambda: a", 7, "unexpected character"),
        ("1" * 401 + "*a", 1, "more than 400 digits"),
        ("a + 1" + "0" * 5000 + "*b", 5, "more than 400 digits"),
        ("[a]", 1, "unexpected character"),
        ("(" * 51 + "a" + ")" * 51, 52, "deeper than 50"),
        ("(" * 90_000, 52, "deeper than 50"),
    ],
)
def test_anything_else_is_refused_where_it_goes_wrong(text: str, column: int, message: str) -> None:
    with pytest.raises(ParameterError) as caught:
        parse_expression(text)
    assert message in str(caught.value)
    assert f"at column {column} of" in str(caught.value)


@pytest.mark.parametrize("text", ["1e999*a", "1e200*(1e200*a)", "1e308*a + 1e308*a"])
def test_coefficients_beyond_floats_are_refused(text: str) -> None:
    with pytest.raises(ParameterError, match="too large for a float"):
        parse_expression(text)


def test_texts_beyond_the_limit_are_refused_unread() -> None:
    with pytest.raises(ParameterError, match="at most 100000"):
        parse_expression("(" * 100_001)


@given(st.text(max_size=40))
def test_any_text_parses_or_is_refused_on_purpose(text: str) -> None:
    try:
        terms = parse_expression(text)
    except ParameterError:
        return
    assert all(np.isfinite(coefficient) for coefficient in terms.values())


@given(st.text(alphabet="ab1.5e+-*() ", max_size=30))
def test_texts_that_look_like_sums_agree_with_their_own_rewriting(text: str) -> None:
    try:
        terms = parse_expression(text)
    except ParameterError:
        return
    rewritten = format_expression([(coefficient, name) for name, coefficient in terms.items()])
    assert terms == (parse_expression(rewritten) if terms else {})


def test_a_table_becomes_a_matrix() -> None:
    K = parameter_matrix(["b - 2*a", "0.5*(a + c)"], ["a", "b", "c"])
    np.testing.assert_array_equal(K, [[-2.0, 1.0, 0.0], [0.5, 0.0, 0.5]])


def test_foreign_names_are_refused_with_their_expression() -> None:
    with pytest.raises(ParameterError, match=r"expression 2 \('a \+ q'\): no parameter is called 'q'"):
        parameter_matrix(["a", "a + q"], ["a", "b"])
