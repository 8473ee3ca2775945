"""Record arithmetic once and evaluate it on many samples: values, derivatives, enclosures over time.

A `ExpressionGraph` records sums and products of symbols, folding what is constant and sharing what is equal; the
`Program` it ends in runs them on arrays, one numpy call a step, in a workspace small enough for the cache. For the
regressor that is about a third of the time of the same formulas on fresh arrays.

For a program y = f(x) and seeds s, one per output, the pull is the gradient of `sum(s y)` with respect to x. The
reverse sweep is itself written on a tape, so that it is folded, shared and planned like any other program; forward
values that it needs are kept by the run before it.

A value on the stretch `|s| <= h` about a sample is `x(s) = c + d s + rho` with `|rho| <= r`: value and time derivative
at the sample, and a bound of everything else (a Taylor model of first order: Makino and Berz 2003). Sums, products and
functions of such values are such values again. Where a value has its peak d vanishes, so the bound exceeds the peak by
second-order terms only. Rounding errors are covered by a share of 1e-12, which is far more than they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident_service.errors import ModelError

Array = NDArray[np.float64]
_UNARY = {"sin": np.sin, "cos": np.cos, "exp": np.exp, "abs": np.abs, "sign": np.sign, "neg": np.negative}
_BINARY = {"mul": np.multiply, "add": np.add, "sub": np.subtract}


@dataclass(frozen=True, eq=False)
class Symbol:
    """Value per sample that a tape knows how to compute."""

    tape: ExpressionGraph
    index: int

    def __mul__(self, other: Value) -> Value:
        if isinstance(other, Symbol):
            first, second = sorted((self.index, other.index))
            return self.tape.step("mul", first, second)
        if other == 0.0:
            return 0.0
        return self if other == 1.0 else -self if other == -1.0 else self.tape.step("mul", self.index, float(other))

    __rmul__ = __mul__

    def __add__(self, other: Value) -> Value:
        if isinstance(other, Symbol):
            first, second = sorted((self.index, other.index))
            return self.tape.step("add", first, second)
        return self if other == 0.0 else self.tape.step("add", self.index, float(other))

    __radd__ = __add__

    def __sub__(self, other: Value) -> Value:
        if isinstance(other, Symbol):
            return self.tape.step("sub", self.index, other.index) if other is not self else 0.0
        return self if other == 0.0 else self.tape.step("add", self.index, -float(other))

    def __rsub__(self, other: float) -> Value:
        return -self if other == 0.0 else self.tape.step("sub", float(other), self.index)

    def __neg__(self) -> Symbol:
        return self.tape.step("neg", self.index, None)


Value = Symbol | float
_Operand = int | float | None


class ExpressionGraph:
    """Expression graph: a record of steps; equal steps are recorded once."""

    def __init__(self) -> None:
        self.steps: list[tuple[str, _Operand, _Operand]] = []
        self._known: dict[tuple[object, ...], Symbol] = {}

    def input(self) -> Symbol:
        """Record an input and return its symbol; inputs are given in the order of these calls when evaluated."""
        return self.step("input", len(self.steps), None)

    def apply(self, function: str, value: Symbol) -> Symbol:
        """Record `sin`, `cos`, `exp`, `abs` or `sign` of a value, and return the result's symbol."""
        return self.step(function, value.index, None)

    def step(self, operation: str, a: _Operand, b: _Operand) -> Symbol:
        """Record an operation on earlier steps (int) or constants (float), each once; return its symbol."""
        # The types tell step 2 from the constant 2.0, which are equal.
        key = (operation, a, type(a), b, type(b))
        if (known := self._known.get(key)) is None:
            known = self._known[key] = Symbol(self, len(self.steps))
            self.steps.append((operation, a, b))
        return known


class Program:
    """Executable plan of a tape for given outputs."""

    def __init__(self, tape: ExpressionGraph, outputs: Sequence[Value]) -> None:
        """Plan the run: which steps are needed, and which may use the same memory one after another.

        Args:
            tape: recorded expression graph.
            outputs: the values wanted, in the order of the rows of `run`'s output.
        """
        self._constants = [(row, value) for row, value in enumerate(outputs) if not isinstance(value, Symbol)]
        wanted = [(row, value.index) for row, value in enumerate(outputs) if isinstance(value, Symbol)]
        needed = needed_steps(tape, [index for _, index in wanted])
        inputs = [index for index, step in enumerate(tape.steps) if step[0] == "input"]
        # A value that is wanted lives in its output row from the start; others share slots of a workspace.
        home: dict[int, tuple[str, int]] = {index: ("input", number) for number, index in enumerate(inputs)}
        self._copies: list[tuple[int, tuple[str, int]]] = []
        for row, index in wanted:
            if index in home:
                self._copies.append((row, home[index]))
            else:
                home[index] = ("output", row)
        last_use = {index: at for at in needed for index in operands_of(tape, at)}
        free: list[int] = []
        self._slots = 0
        plan: list[tuple[np.ufunc, tuple[str, int] | float, tuple[str, int] | float | None, tuple[str, int]]] = []
        for at in needed:
            operation, a, b = tape.steps[at]
            if operation == "input":
                continue
            operands = [home[value] if isinstance(value, int) else value for value in (a, b)]
            done = {home[index] for index in operands_of(tape, at) if last_use[index] == at}
            free += [number for kind, number in done if kind == "slot"]
            if at not in home:
                if not free:
                    free.append(self._slots)
                    self._slots += 1
                home[at] = ("slot", free.pop())
            function = _UNARY.get(operation) or _BINARY[operation]
            first = operands[0]
            if first is None:
                raise AssertionError("every step has an operand")
            plan.append((function, first, operands[1], home[at]))
        # While running, all values stand in one list: inputs, outputs, slots, constants; a step knows its places in it.
        begins = {"input": 0, "output": len(inputs), "slot": len(inputs) + len(outputs)}
        self._numbers: list[float] = []

        def place(value: tuple[str, int] | float | None) -> int:
            if value is None:
                return -1
            if isinstance(value, float):
                self._numbers.append(value)
                return begins["slot"] + self._slots + len(self._numbers) - 1
            return begins[value[0]] + value[1]

        self._plan = [(function, place(a), place(b), place(target)) for function, a, b, target in plan]

    @property
    def steps(self) -> int:
        """Return the number of numpy operations per run."""
        return len(self._plan)

    def run(self, inputs: Sequence[Array], output: Sequence[Array]) -> None:
        """Evaluate the recorded outputs for arrays of inputs, into the `output` arrays; returns nothing.

        Args:
            inputs: arrays of one shape, in the order of `ExpressionGraph.input` calls.
            output: arrays of that shape to write to, in the order of the outputs.
        """
        workspace = np.empty((self._slots, *inputs[0].shape))
        places = {"input": inputs, "output": output, "slot": list(workspace)}
        values = [*inputs, *output, *workspace, *self._numbers]
        for function, a, b, target in self._plan:
            if b < 0:
                function(values[a], values[target])
            else:
                function(values[a], values[b], values[target])
        for row, (kind, index) in self._copies:
            output[row][...] = places[kind][index]
        for row, value in self._constants:
            output[row][...] = value


def operands_of(tape: ExpressionGraph, step: int) -> list[int]:
    """Return the indices of the earlier steps that the step with this index is computed from; [] for an input."""
    operation, a, b = tape.steps[step]
    return [] if operation == "input" else [value for value in (a, b) if isinstance(value, int)]


def needed_steps(tape: ExpressionGraph, results: list[int]) -> list[int]:
    """Return the indices of all steps that the steps `results` depend on, themselves included, increasing."""
    found: set[int] = set()
    waiting = list(results)
    while waiting:
        at = waiting.pop()
        if at not in found:
            found.add(at)
            waiting += operands_of(tape, at)
    return sorted(found)


class Differentiable:
    """Program of a tape that can also be run backwards, for gradients."""

    def __init__(self, tape: ExpressionGraph, inputs: Sequence[Symbol], outputs: Sequence[Value]) -> None:
        """Plan the forward and the backward run.

        Args:
            tape: recorded expression graph; `run` takes all of its inputs, in the order they were made.
            inputs: inputs to differentiate with respect to.
            outputs: the values wanted.
        """
        self._outputs = len(outputs)
        self._all_inputs = sum(step[0] == "input" for step in tape.steps)
        back = _Backwards(tape, outputs)
        gradients = [back.adjoints.get(symbol.index, 0.0) for symbol in inputs]
        self._kept = list(back.known)
        self._forward = Program(tape, [*outputs, *(Symbol(tape, index) for index in self._kept)])
        # Its inputs are seeds and kept forward values, in the order in which the sweep made them.
        self._backward = Program(back.tape, gradients)
        self._gradients = len(inputs)
        self._order = back.order
        self._values: Array | None = None

    @property
    def steps(self) -> tuple[int, int]:
        """Return the numbers of numpy operations per run and per pull."""
        return self._forward.steps, self._backward.steps

    def run(self, values: Array) -> Array:
        """Return the outputs, (outputs, samples), overwritten by the next run; keep the values that `pull` needs.

        Args:
            values: all inputs of the tape, shape (inputs, samples).

        Returns:
            The outputs, shape (outputs, samples); written over by the next run of as many samples.

        Raises:
            ModelError: another number of inputs than the tape has.
        """
        if values.ndim != 2 or len(values) != self._all_inputs:
            raise ModelError(f"{values.shape=} but expected ({self._all_inputs}, samples)")
        shape = (self._outputs + len(self._kept), values.shape[1])
        if self._values is None or self._values.shape != shape:
            self._values = np.empty(shape)
        self._forward.run(list(values), list(self._values))
        return self._values[: self._outputs]

    def pull(self, seeds: Array) -> Array:
        """Return the gradient of `sum(seeds * outputs)` over the inputs at the last run, shape (inputs, samples).

        Args:
            seeds: shape (outputs, samples).

        Returns:
            Shape (inputs, samples).

        Raises:
            ModelError: nothing was run, or the shape is another one.
        """
        if self._values is None or seeds.shape != (self._outputs, self._values.shape[1]):
            raise ModelError(f"{seeds.shape=} does not belong to the last run")
        kept = self._values[self._outputs :]
        sources = {"seed": seeds, "kept": kept}
        gradient = np.zeros((self._gradients, seeds.shape[1]))
        if not self._order:
            return gradient  # nothing was wanted
        self._backward.run([sources[kind][number] for kind, number in self._order], list(gradient))
        return gradient


class _Backwards:
    """Reverse sweep on a tape of its own.

    Attributes:
        tape: expression graph of the sweep; its inputs are seeds and forward values, in the order of `order`.
        order: meaning of each input: ("seed", output) or ("kept", place in `known`).
        known: forward steps whose values the sweep needs, in the order they were met.
        adjoints: derivative of `sum(seeds * outputs)` with respect to each forward step, by step.
    """

    def __init__(self, tape: ExpressionGraph, outputs: Sequence[Value]) -> None:
        self.tape = ExpressionGraph()
        self.order: list[tuple[str, int]] = []
        self.known: dict[int, Symbol] = {}
        self.adjoints: dict[int, Value] = {}
        self._steps = tape.steps
        for number, value in enumerate(outputs):
            seed = self._input("seed", number)
            if isinstance(value, Symbol):
                self._add(value.index, seed)
        for at in range(len(tape.steps) - 1, -1, -1):
            if at in self.adjoints:
                self._propagate_adjoint(at, self.adjoints[at])

    def _input(self, kind: str, number: int) -> Symbol:
        self.order.append((kind, number))
        return self.tape.input()

    def _add(self, at: int | float | None, term: Value) -> None:
        if isinstance(at, int):
            self.adjoints[at] = self.adjoints.get(at, 0.0) + term

    def _value(self, at: int | float | None) -> Value:
        """Return a forward value as an input of the sweep."""
        if not isinstance(at, int):
            return float(at or 0.0)
        if at not in self.known:
            number = len(self.known)
            self.known[at] = self._input("kept", number)
        return self.known[at]

    def _propagate_adjoint(self, at: int, adjoint: Value) -> None:
        """Propagate the adjoint of a step to its operands."""
        operation, a, b = self._steps[at]
        if operation == "mul":
            self._add(a, adjoint * self._value(b) if isinstance(a, int) else 0.0)
            self._add(b, adjoint * self._value(a) if isinstance(b, int) else 0.0)
        elif operation == "add":
            self._add(a, adjoint)
            self._add(b, adjoint)
        elif operation == "sub":
            self._add(a, adjoint)
            self._add(b, -adjoint)
        elif operation == "neg":
            self._add(a, -adjoint)
        elif operation == "sin":
            self._add(a, adjoint * self._apply("cos", a))
        elif operation == "cos":
            self._add(a, -(adjoint * self._apply("sin", a)))
        elif operation == "exp":
            self._add(a, adjoint * self._value(at))
        elif operation == "abs":
            self._add(a, adjoint * self._apply("sign", a))

    def _apply(self, function: str, at: int | float | None) -> Value:
        """Return a function of a forward value; the forward run's own where it has computed it already."""
        key = (function, at)
        for index, step in enumerate(self._steps):
            if (step[0], step[1]) == key:
                return self._value(index)
        value = self._value(at)
        return self.tape.apply(function, value) if isinstance(value, Symbol) else value


_ROUNDING = 1e-12
_CHUNK = 2048


@dataclass(frozen=True)
class TaylorModel:
    """Taylor model of a value on many stretches of time; all arrays of shape (stretches,).

    Attributes:
        c: value in the middle.
        d: time derivative in the middle [1/s].
        r: how far the value may be from `c + d s` anywhere on the stretch.
        h: half the length of the stretch [s].
    """

    c: Array
    d: Array
    r: Array
    h: Array

    @property
    def deviation_bound(self) -> Array:
        """Return a bound of the value's distance from its middle `c` over each time interval."""
        return np.asarray(np.abs(self.d) * self.h + self.r)

    @property
    def size(self) -> Array:
        """Return an upper bound of `|x|` over each time interval."""
        return np.asarray((np.abs(self.c) + self.deviation_bound) * (1.0 + _ROUNDING))

    @property
    def highest(self) -> Array:
        """Return an upper bound of x over each time interval."""
        return np.asarray(self.c + self.deviation_bound + _ROUNDING * np.abs(self.c))

    @property
    def lowest(self) -> Array:
        """Return a lower bound of x over each time interval."""
        return np.asarray(self.c - self.deviation_bound - _ROUNDING * np.abs(self.c))

    def __add__(self, other: TaylorModel) -> TaylorModel:
        return TaylorModel(self.c + other.c, self.d + other.d, self.r + other.r, self.h)

    def __sub__(self, other: TaylorModel) -> TaylorModel:
        return TaylorModel(self.c - other.c, self.d - other.d, self.r + other.r, self.h)

    def __neg__(self) -> TaylorModel:
        return TaylorModel(-self.c, -self.d, self.r, self.h)

    def __mul__(self, other: TaylorModel) -> TaylorModel:
        own, others = np.abs(self.d) * self.h, np.abs(other.d) * self.h
        r = own * others + self.r * (np.abs(other.c) + others) + other.r * (np.abs(self.c) + own) + self.r * other.r
        return TaylorModel(self.c * other.c, self.c * other.d + self.d * other.c, r, self.h)

    def shifted(self, constant: float) -> TaylorModel:
        """Return the enclosure of this value plus a number."""
        return TaylorModel(self.c + constant, self.d, self.r, self.h)

    def scaled(self, constant: float) -> TaylorModel:
        """Return the enclosure of this value times a number."""
        return TaylorModel(self.c * constant, self.d * constant, self.r * abs(constant), self.h)

    def function(self, name: str) -> TaylorModel:
        """Return the enclosure of `sin`, `cos`, `exp`, `abs`, `sign` or `neg` of this value."""
        reach = self.deviation_bound
        if name == "neg":
            return -self
        if name in ("sin", "cos"):
            # |f(c + e) - f(c) - f'(c) e| <= e^2 / 2
            value, slope = (np.sin, np.cos) if name == "sin" else (np.cos, lambda x: -np.sin(x))
            f = slope(self.c)
            return TaylorModel(value(self.c), f * self.d, np.abs(f) * self.r + 0.5 * reach**2, self.h)
        if name == "exp":
            # The remainder is half e^2 times the largest second derivative, which is where the argument is largest.
            f, most = np.exp(self.c), np.exp(self.c + reach)
            return TaylorModel(f, f * self.d, f * self.r + 0.5 * reach**2 * most, self.h)
        clear = np.abs(self.c) > reach
        sign = np.sign(self.c)
        if name == "sign":
            return TaylorModel(np.where(clear, sign, 0.0), np.zeros_like(self.c), np.where(clear, 0.0, 1.0), self.h)
        if name == "abs":
            return TaylorModel(
                np.abs(self.c), np.where(clear, sign * self.d, 0.0), np.where(clear, self.r, reach), self.h
            )
        raise AssertionError(f"no enclosure for {name}")


def enclose(tape: ExpressionGraph, inputs: Sequence[TaylorModel], outputs: Sequence[Value]) -> list[TaylorModel]:
    """Evaluate an expression graph on enclosures; return the enclosures of the outputs, one each.

    Args:
        tape: recorded expression graph.
        inputs: inputs in the order of `ExpressionGraph.input` calls, all of the same stretches.
        outputs: the values wanted.
    """
    chunks = []
    for begin in range(0, max(1, len(inputs[0].c)), _CHUNK):
        part = slice(begin, begin + _CHUNK)
        cut = [TaylorModel(x.c[part], x.d[part], x.r[part], x.h[part]) for x in inputs]
        chunks.append(_run(tape, cut, outputs))
    return [
        TaylorModel(*(np.concatenate([getattr(chunk[k], name) for chunk in chunks]) for name in ("c", "d", "r", "h")))
        for k in range(len(outputs))
    ]


def _run(tape: ExpressionGraph, inputs: Sequence[TaylorModel], outputs: Sequence[Value]) -> list[TaylorModel]:
    wanted = [value.index for value in outputs if isinstance(value, Symbol)]
    steps = needed_steps(tape, wanted)
    last_use = {index: at for at in steps for index in operands_of(tape, at)}
    last_use |= dict.fromkeys(wanted, len(tape.steps))
    zero = np.zeros_like(inputs[0].c)
    values: dict[int, TaylorModel] = {}
    numbers = {at: number for number, at in enumerate(k for k, step in enumerate(tape.steps) if step[0] == "input")}
    for at in steps:
        operation, a, b = tape.steps[at]
        if operation == "input":
            values[at] = inputs[numbers[at]]
        elif b is None:
            values[at] = values[int(a or 0)].function(operation)
        else:
            values[at] = _combined(operation, values[a] if isinstance(a, int) else a, values, b)
        for index in operands_of(tape, at):
            if last_use[index] == at:
                values.pop(index, None)
    return [
        values[value.index] if isinstance(value, Symbol) else TaylorModel(zero + value, zero, zero, inputs[0].h)
        for value in outputs
    ]


def _combined(
    operation: str, first: TaylorModel | float | None, values: dict[int, TaylorModel], b: int | float
) -> TaylorModel:
    if isinstance(first, TaylorModel) and isinstance(b, int):
        second = values[b]
        return first * second if operation == "mul" else first + second if operation == "add" else first - second
    if isinstance(first, TaylorModel):
        return first.scaled(b) if operation == "mul" else first.shifted(b if operation == "add" else -b)
    return (-values[int(b)]).shifted(float(first or 0.0))  # a number less a value, the only step that begins so
