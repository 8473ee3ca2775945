"""Enclosures hold between samples: nothing finer ever leaves them, and at peaks they are close."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.random_tapes import Recipe, followed, recipes
from hypothesis import given, settings
from hypothesis import strategies as st

from ident_service.model.symbolic import ExpressionGraph, Program, Symbol, TaylorModel, Value, enclose

Array = np.ndarray
INPUTS, FINER = 4, 1000


def wave(rng: np.random.Generator, time: Array, half: Array) -> tuple[TaylorModel, Array]:
    """A sine as enclosures over stretches about `time`, and its values at `FINER` times in each of them."""
    size, rate, phase = rng.uniform(0.1, 1.5), rng.uniform(0.2, 5.0), rng.uniform(0.0, 6.0)
    inside = time[:, None] + half[:, None] * np.linspace(-1.0, 1.0, FINER)
    middle, slope = size * np.sin(rate * time + phase), size * rate * np.cos(rate * time + phase)
    return TaylorModel(middle, slope, 0.5 * size * (rate * half) ** 2, half), size * np.sin(rate * inside + phase)


def assert_inside(enclosure: TaylorModel, values: Array, size: float) -> None:
    """Every one of `values`, shape (stretches, FINER), lies where the enclosure says."""
    rounding = 1e-11 * size
    s = enclosure.h[:, None] * np.linspace(-1.0, 1.0, FINER)
    rest = np.abs(values - (enclosure.c[:, None] + enclosure.d[:, None] * s))
    assert (rest <= enclosure.r[:, None] * (1.0 + 1e-9) + rounding).all()
    assert (values <= enclosure.highest[:, None] + rounding).all()
    assert (values >= enclosure.lowest[:, None] - rounding).all()
    assert (np.abs(values) <= enclosure.size[:, None] + rounding).all()


@pytest.mark.slow
@settings(max_examples=150)
@given(recipe=recipes(), seed=st.integers(0, 2**16), longest=st.sampled_from([1e-4, 1e-2, 0.3]))
def test_a_thousand_times_finer_values_of_any_program_lie_inside(recipe: Recipe, seed: int, longest: float) -> None:
    rng = np.random.default_rng(seed)
    time, half = rng.uniform(0.0, 10.0, size=6), rng.uniform(0.1, 1.0, size=6) * longest
    waves = [wave(rng, time, half) for _ in range(INPUTS)]
    tape = ExpressionGraph()
    values = followed(recipe, tape, [fine.astype(complex) for _, fine in waves])
    enclosures = enclose(tape, [taylor for taylor, _ in waves], [value for value, _ in values])
    size = max(float(np.abs(numbers.real).max()) for _, numbers in values)
    for enclosure, (_, numbers) in zip(enclosures, values, strict=True):
        assert_inside(enclosure, numbers.real, 1.0 + size)


@pytest.mark.parametrize("name", ["sin", "cos", "exp", "abs", "sign", "neg"])
def test_functions_hold_where_their_argument_crosses_zero_and_where_it_is_wide(name: str) -> None:
    rng = np.random.default_rng(1)
    time, half = rng.uniform(0.0, 10.0, size=300), rng.uniform(1e-3, 1.0, size=300)
    taylor, fine = wave(rng, time, half)
    function = {"sin": np.sin, "cos": np.cos, "exp": np.exp, "abs": np.abs, "sign": np.sign, "neg": np.negative}[name]
    assert (taylor.lowest < 0.0).any()
    assert_inside(taylor.function(name), function(fine), 5.0)


def test_the_sign_of_what_may_be_zero_is_anything_between_both() -> None:
    h = np.ones(3)
    value = TaylorModel(np.array([0.5, -0.5, 2.0]), h, 0.0 * h, h)
    sign = value.function("sign")
    np.testing.assert_array_equal(sign.lowest, [-1.0, -1.0, 1.0 - 1e-12])
    np.testing.assert_array_equal(sign.highest, [1.0, 1.0, 1.0 + 1e-12])


def test_the_exponential_of_a_very_negative_argument_stays_small() -> None:
    # Stribeck's term far above its velocity: exp(-(v / v_s)^2) over stretches on which the square changes by thousands.
    h = np.ones(1)
    value = TaylorModel(-1e5 * h, 5e4 * h, 1e3 * h, h).function("exp")
    np.testing.assert_array_equal([value.lowest, value.highest], 0.0)


def test_a_straight_line_is_enclosed_exactly() -> None:
    h = np.array([0.5])
    line = TaylorModel(np.array([1.0]), np.array([2.0]), np.zeros(1), h)
    both = (line + line - line.scaled(0.5)).shifted(3.0)
    assert (both.c, both.d, both.r) == (4.5, 3.0, 0.0)
    assert both.deviation_bound == 1.5


def test_at_a_peak_the_excess_is_of_second_order() -> None:
    # cos(t)^2 about its peak: halving the stretch quarters the excess.
    def excess(half: float) -> float:
        h = np.array([half])
        x = TaylorModel(np.zeros(1), np.ones(1), np.zeros(1), h).function("cos")
        return float((x * x).highest[0] - 1.0)

    assert excess(0.01) == pytest.approx(1e-4, rel=1e-2)
    assert excess(0.02) / excess(0.01) == pytest.approx(4.0, rel=1e-2)


def test_many_stretches_are_many_single_stretches() -> None:
    # More than are run at once.
    rng = np.random.default_rng(2)
    time, half = rng.uniform(0.0, 10.0, size=5000), rng.uniform(1e-3, 0.1, size=5000)
    x, _ = wave(rng, time, half)
    tape = ExpressionGraph()
    symbol = tape.input()
    outputs: list[Value] = [tape.apply("sin", symbol) * symbol, symbol, 4.0, 1.0 - symbol]
    together = enclose(tape, [x], outputs)
    for begin in (0, 2047, 2048, 4999):
        part = slice(begin, begin + 1)
        alone = enclose(tape, [TaylorModel(x.c[part], x.d[part], x.r[part], x.h[part])], outputs)
        for one, many in zip(alone, together, strict=True):
            for name in ("c", "d", "r", "h"):
                np.testing.assert_array_equal(getattr(one, name), getattr(many, name)[part])


def test_the_middle_of_an_enclosure_is_what_the_program_computes() -> None:
    rng = np.random.default_rng(3)
    time, half = rng.uniform(0.0, 10.0, size=20), np.full(20, 0.1)
    x, _ = wave(rng, time, half)
    tape = ExpressionGraph()
    symbol = tape.input()
    assert isinstance(symbol, Symbol)
    outputs: list[Value] = [tape.apply("exp", symbol) - 2.0 * symbol, 5.0 - symbol * symbol]
    plain = np.empty((2, 20))
    Program(tape, outputs).run([x.c], list(plain))
    for enclosure, row in zip(enclose(tape, [x], outputs), plain, strict=True):
        np.testing.assert_allclose(enclosure.c, row, rtol=1e-14)
