"""Random arithmetic for a tape, beside the same arithmetic in numpy."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from ident_service.model.symbolic import ExpressionGraph, Symbol, Value

Recipe = list[tuple[str, int, int]]
OPERATIONS = ("add", "sub", "mul", "neg", "sin", "cos", "exp", "abs", "sign", "constant")
_CONSTANTS = (0.0, 1.0, -1.0, 2.0, 3.0, 0.5, -2.0)
_LARGEST, _STEEPEST, _KINK = 1e2, 1e4, 1e-3
STEP = 1e-30  # of the imaginary parts that carry derivatives


def recipes(longest: int = 25) -> st.SearchStrategy[Recipe]:
    """Steps as (operation, operand, operand); operands count backwards from the newest value."""
    operand = st.integers(0, 9)
    return st.lists(st.tuples(st.sampled_from(OPERATIONS), operand, operand), min_size=1, max_size=longest)


def followed(recipe: Recipe, tape: ExpressionGraph, inputs: list[np.ndarray]) -> list[tuple[Value, np.ndarray]]:
    """Every value of a recipe, as the tape has it and as numpy has it; steps that grow too large are left out.

    Args:
        recipe: the steps.
        tape: to be recorded on.
        inputs: their numbers, of any one shape; imaginary parts of `STEP` carry a derivative along, exactly.
    """
    values: list[tuple[Value, np.ndarray]] = [(tape.input(), numbers) for numbers in inputs]
    for operation, first, second in recipe:
        a, x = values[-1 - first % len(values)]
        b, y = values[-1 - second % len(values)]
        done = _step(operation, tape, (a, x), (b, y), _CONSTANTS[first % len(_CONSTANTS)])
        if done is not None and np.abs(done[1].real).max() < _LARGEST and np.abs(done[1].imag).max() < _STEEPEST * STEP:
            values.append(done)
    return values


def _step(
    operation: str,
    tape: ExpressionGraph,
    first: tuple[Value, np.ndarray],
    second: tuple[Value, np.ndarray],
    constant: float,
) -> tuple[Value, np.ndarray] | None:
    (a, x), (b, y) = first, second
    if operation == "constant":
        return constant, np.full_like(x, constant)
    if operation == "add":
        return a + b, x + y
    if operation == "sub":
        return a - b, x - y
    if operation == "mul":
        return a * b, x * y
    if operation == "neg":
        return -a, -x
    # At a kink there is no derivative.
    if not isinstance(a, Symbol) or np.abs(x.real).max() > 4.0 or np.abs(x.real).min() < _KINK:
        return None
    if operation == "abs":
        return tape.apply("abs", a), x * np.sign(x.real)
    if operation == "sign":
        return tape.apply("sign", a), np.sign(x.real) + 0.0 * x
    return tape.apply(operation, a), {"sin": np.sin, "cos": np.cos, "exp": np.exp}[operation](x)
