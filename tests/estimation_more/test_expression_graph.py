"""The tape computes what numpy computes, in as few steps and in no memory that something else still needs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ident_service.model.symbolic import ExpressionGraph, Program, Symbol, Value

SAMPLES = 5
CONSTANTS = (0.0, 1.0, -1.0, 2.0, 3.0, 0.5, -2.0)
UNARY = {"sin": np.sin, "cos": np.cos, "abs": np.abs, "exp": np.exp}


def run(tape: ExpressionGraph, outputs: list[Value], inputs: np.ndarray) -> np.ndarray:
    result = np.full((len(outputs), inputs.shape[1]), np.nan)
    Program(tape, outputs).run(list(inputs), list(result))
    return result


def states(seed: int, count: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.5, 1.5, size=(count, SAMPLES))


@st.composite
def recipes(draw: st.DrawFn) -> list[tuple[str, int, int]]:
    """Steps as (operation, operand, operand); operands count backwards from the newest value."""
    operations = st.sampled_from(["add", "sub", "mul", "neg", "sin", "cos", "abs", "exp", "constant"])
    return draw(st.lists(st.tuples(operations, st.integers(0, 11), st.integers(0, 11)), min_size=1, max_size=40))


def followed(
    recipe: list[tuple[str, int, int]], tape: ExpressionGraph, inputs: np.ndarray
) -> list[tuple[Value, np.ndarray]]:
    """Every value of a recipe, as the tape has it and as numpy has it."""
    values: list[tuple[Value, np.ndarray]] = [(tape.input(), row) for row in inputs]
    for operation, first, second in recipe:
        a, x = values[-1 - first % len(values)]
        b, y = values[-1 - second % len(values)]
        if operation == "constant":
            constant = CONSTANTS[first % len(CONSTANTS)]
            values.append((constant, np.full(SAMPLES, constant)))
        elif operation == "add":
            values.append((a + b, x + y))
        elif operation == "sub":
            values.append((a - b, x - y))
        elif operation == "mul":
            values.append((a * b, x * y))
        elif operation == "neg":
            values.append((-a, -x))
        elif isinstance(a, Symbol) and np.abs(x).max() < 5.0:
            values.append((tape.apply(operation, a), UNARY[operation](x)))
        if np.abs(values[-1][1]).max() > 1e6:
            values.pop()
    return values


@given(recipe=recipes(), seed=st.integers(0, 2**16), data=st.data())
def test_random_expressions_equal_numpy(recipe: list[tuple[str, int, int]], seed: int, data: st.DataObject) -> None:
    tape, inputs = ExpressionGraph(), states(seed, 4)
    values = followed(recipe, tape, inputs)
    # Any of them may be wanted, any of them more than once, in any order: inputs and constants too.
    chosen = data.draw(st.lists(st.integers(0, len(values) - 1), min_size=1, max_size=12))
    wanted = np.array([values[index][1] for index in chosen])
    got = run(tape, [values[index][0] for index in chosen], inputs)
    np.testing.assert_allclose(got, wanted, rtol=1e-12, atol=1e-12 * max(1.0, np.abs(wanted).max()))


def test_inputs_are_not_written_to() -> None:
    tape = ExpressionGraph()
    x, y = tape.input(), tape.input()
    inputs = states(1, 2)
    before = inputs.copy()
    run(tape, [x, y, x * y + x, -x], inputs)
    np.testing.assert_array_equal(inputs, before)


def test_a_step_s_number_is_not_a_constant() -> None:
    # Step 2 and the constant 2.0 are equal and have the same hash.
    tape = ExpressionGraph()
    symbols = [tape.input() for _ in range(4)]
    inputs = states(2, 4)
    for a in range(4):
        for b in range(2, 4):
            outputs = [symbols[a] * symbols[b], symbols[a] * float(b), symbols[a] + symbols[b], symbols[a] + float(b)]
            outputs += [symbols[b] - symbols[a], float(b) - symbols[a]]
            x, y = inputs[a], inputs[b]
            wanted = [x * y, x * b, x + y, x + b, y - x, b - x]
            np.testing.assert_allclose(run(tape, outputs, inputs), wanted, rtol=1e-15, atol=1e-15)


def test_whole_numbers_are_constants_too() -> None:
    tape = ExpressionGraph()
    x, y = tape.input(), tape.input()
    inputs = states(3, 2)
    wanted = [inputs[0] * 3, inputs[0] + 1, inputs[1] - 1, 1 - inputs[1]]
    np.testing.assert_allclose(run(tape, [x * 3, x + 1, y - 1, 1 - y], inputs), wanted, rtol=1e-15)


def test_constants_are_folded() -> None:
    tape = ExpressionGraph()
    x = tape.input()
    assert x * 0.0 == 0.0
    assert 0.0 * x == 0.0
    assert x - x == 0.0
    assert x * 1.0 is x
    assert x + 0.0 is x
    assert 0.0 + x is x
    assert x - 0.0 is x
    assert len(tape.steps) == 1
    assert x * -1.0 is -x
    assert 0.0 - x is -x
    assert len(tape.steps) == 2


def test_equal_steps_are_shared() -> None:
    tape = ExpressionGraph()
    x, y = tape.input(), tape.input()
    assert x * y is y * x
    assert x + y is y + x
    assert x - y is not y - x
    assert tape.apply("sin", x) is tape.apply("sin", x)
    assert tape.apply("sin", x) is not tape.apply("cos", x)
    assert x * 2.5 is 2.5 * x
    assert tape.input() is not tape.input()
    product = x * y
    assert Program(tape, [product + x, y * x + y]).steps == 3


def test_only_what_is_wanted_is_computed() -> None:
    tape = ExpressionGraph()
    x, y = tape.input(), tape.input()
    _ = tape.apply("sin", x) + y
    assert Program(tape, [x * y]).steps == 1
    assert Program(tape, [x, 3.0]).steps == 0


def test_the_same_value_twice_an_input_and_a_constant() -> None:
    tape = ExpressionGraph()
    x, y = tape.input(), tape.input()
    product, inputs = x * y, states(4, 2)
    outputs: list[Value] = [product, 7.0, product, y, product + 1.0, y, 0.0]
    xy = inputs[0] * inputs[1]
    ones = np.ones(SAMPLES)
    wanted = [xy, 7.0 * ones, xy, inputs[1], xy + 1.0, inputs[1], 0.0 * ones]
    np.testing.assert_array_equal(run(tape, outputs, inputs), wanted)


@pytest.mark.parametrize("length", [3, 50])
def test_memory_is_used_again(length: int) -> None:
    # A long chain of steps whose every value is needed only once, beside one that is needed at the very end.
    tape = ExpressionGraph()
    x = tape.input()
    early = tape.apply("cos", x)
    value: Value = x
    for k in range(length):
        value = tape.apply("sin", value * (1.0 + 0.1 * (k + 1)))
    inputs = states(5, 1)
    wanted = inputs[0].copy()
    for k in range(length):
        wanted = np.sin(wanted * (1.0 + 0.1 * (k + 1)))
    program = Program(tape, [value * early])
    result = np.empty((1, SAMPLES))
    program.run(list(inputs), list(result))
    np.testing.assert_allclose(result[0], wanted * np.cos(inputs[0]), rtol=1e-14)
    assert program._slots == 2


def test_a_program_runs_again_and_into_strided_rows() -> None:
    tape = ExpressionGraph()
    x, y = tape.input(), tape.input()
    program = Program(tape, [x * y + x, tape.apply("exp", x * y)])
    for seed in range(3):
        inputs, memory = states(seed, 2), np.zeros((2, 2 * SAMPLES))
        program.run(list(inputs), list(memory[:, ::2]))
        xy = inputs[0] * inputs[1]
        np.testing.assert_allclose(memory[:, ::2], [xy + inputs[0], np.exp(xy)], rtol=1e-15)
        assert not memory[:, 1::2].any()
