"""A program run backwards gives the gradient of what it gives forwards."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.random_tapes import STEP, Recipe, followed, recipes
from hypothesis import given, settings
from hypothesis import strategies as st

from ident_service.errors import ModelError
from ident_service.model.symbolic import Differentiable, ExpressionGraph, Symbol, Value

INPUTS, SAMPLES = 4, 5


def symbols_of(tape: ExpressionGraph) -> list[Symbol]:
    return [Symbol(tape, at) for at, step in enumerate(tape.steps) if step[0] == "input"]


@pytest.mark.slow
@settings(max_examples=200)
@given(recipe=recipes(), seed=st.integers(0, 2**16), data=st.data())
def test_the_pull_is_the_derivative_of_any_program(recipe: Recipe, seed: int, data: st.DataObject) -> None:
    rng = np.random.default_rng(seed)
    states = rng.uniform(-1.5, 1.5, size=(INPUTS, SAMPLES))
    # Direction j, the second axis, goes along input j; the imaginary part carries its derivative without rounding.
    inputs = [states[k] + 1j * STEP * np.repeat(np.eye(INPUTS)[:, k, None], SAMPLES, axis=1) for k in range(INPUTS)]
    tape = ExpressionGraph()
    values = followed(recipe, tape, inputs)
    # Any may be wanted, more than once and in any order, inputs and constants too.
    chosen = data.draw(st.lists(st.integers(0, len(values) - 1), min_size=1, max_size=6))
    program = Differentiable(tape, symbols_of(tape), [values[index][0] for index in chosen])
    numbers = np.array([values[index][1] for index in chosen])
    np.testing.assert_allclose(program.run(states), numbers[:, 0].real, rtol=1e-11, atol=1e-10)
    seeds = rng.normal(size=(len(chosen), SAMPLES))
    slopes = numbers.imag / STEP
    size = max(1.0, float(np.abs(slopes).max()))
    np.testing.assert_allclose(program.pull(seeds), np.einsum("ks,kjs->js", seeds, slopes), rtol=1e-9, atol=1e-9 * size)


def every_operation() -> Differentiable:
    """Two outputs of three inputs that need every operation there is."""
    tape = ExpressionGraph()
    x, y, z = (tape.input() for _ in range(3))
    product = x * y
    assert isinstance(product, Symbol)
    first = tape.apply("sin", product) + tape.apply("exp", -z) * 2.0
    second: Value = tape.apply("abs", x) * tape.apply("cos", y) - tape.apply("sign", z) * x + (3.0 - y * y)
    return Differentiable(tape, [x, y, z], [first, second])


def test_central_differences_agree() -> None:
    program, rng = every_operation(), np.random.default_rng(3)
    states, seeds = rng.uniform(0.3, 1.2, size=(3, 7)), rng.normal(size=(2, 7))
    program.run(states)
    gradient = program.pull(seeds)
    for k, step in enumerate(1e-6 * np.eye(3)):
        above = program.run(states + step[:, None]).copy()
        below = program.run(states - step[:, None]).copy()
        np.testing.assert_allclose(gradient[k], (seeds * (above - below)).sum(axis=0) / 2e-6, rtol=1e-7, atol=1e-8)


def test_another_number_of_samples_is_another_run() -> None:
    program, rng = every_operation(), np.random.default_rng(4)
    states, seeds = rng.uniform(0.3, 1.2, size=(3, 9)), rng.normal(size=(2, 9))
    program.run(states)
    whole = program.pull(seeds)
    program.run(states[:, 2:6])
    np.testing.assert_array_equal(program.pull(seeds[:, 2:6]), whole[:, 2:6])
    program.run(states)
    np.testing.assert_array_equal(program.pull(seeds), whole)


def test_one_run_can_be_pulled_many_times() -> None:
    program, rng = every_operation(), np.random.default_rng(5)
    program.run(rng.uniform(0.3, 1.2, size=(3, 4)))
    one, other = rng.normal(size=(2, 2, 4))
    np.testing.assert_allclose(program.pull(one) + program.pull(other), program.pull(one + other), rtol=1e-12)


def test_what_an_output_does_not_depend_on_has_no_slope() -> None:
    tape = ExpressionGraph()
    x, y = tape.input(), tape.input()
    program = Differentiable(tape, [x, y], [x * 2.0, 7.0])
    np.testing.assert_array_equal(program.run(np.ones((2, 3))), [[2.0] * 3, [7.0] * 3])
    np.testing.assert_array_equal(program.pull(np.ones((2, 3))), [[2.0] * 3, [0.0] * 3])


def test_a_program_without_outputs_has_no_slope_either() -> None:
    tape = ExpressionGraph()
    program = Differentiable(tape, [tape.input()], [])
    assert program.run(np.ones((1, 3))).shape == (0, 3)
    np.testing.assert_array_equal(program.pull(np.ones((0, 3))), np.zeros((1, 3)))


def test_only_the_requested_inputs_are_differentiated() -> None:
    tape = ExpressionGraph()
    x, y = tape.input(), tape.input()
    program = Differentiable(tape, [y], [x * y])
    program.run(np.array([[3.0], [5.0]]))
    np.testing.assert_array_equal(program.pull(np.ones((1, 1))), [[3.0]])


def test_the_forward_run_s_own_cosine_is_used_for_the_slope_of_a_sine() -> None:
    tape = ExpressionGraph()
    x = tape.input()
    alone = Differentiable(tape, [x], [tape.apply("sin", x)])
    beside = Differentiable(tape, [x], [tape.apply("sin", x), tape.apply("cos", x)])
    assert alone.steps == (1, 2)  # cos(x), and its product with the seed
    assert beside.steps == (2, 4)  # both products, a sign, and their sum: no function


def test_a_pull_without_a_run_is_refused() -> None:
    with pytest.raises(ModelError, match="does not belong to the last run"):
        every_operation().pull(np.ones((2, 3)))


@pytest.mark.parametrize("shape", [(2, 4), (1, 3), (3, 3)])
def test_seeds_of_another_shape_are_refused(shape: tuple[int, int]) -> None:
    program = every_operation()
    program.run(np.ones((3, 3)))
    with pytest.raises(ModelError, match="does not belong to the last run"):
        program.pull(np.ones(shape))


@pytest.mark.parametrize("shape", [(2, 4), (4, 4), (3,)])
def test_another_number_of_inputs_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ModelError, match=r"expected \(3, samples\)"):
        every_operation().run(np.ones(shape))
