"""Record arithmetic once as a graph of expressions, and run it on many samples.

A `Tape` records sums and products of symbols, folding what is constant and sharing what is equal; the `Program` it ends
in runs them on arrays, one numpy call a step, in a workspace small enough for the cache. For the regressor that is
about a third of the time of the same formulas on fresh arrays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_UNARY = {"sin": np.sin, "cos": np.cos, "exp": np.exp, "abs": np.abs, "sign": np.sign, "neg": np.negative}
_BINARY = {"mul": np.multiply, "add": np.add, "sub": np.subtract}


@dataclass(frozen=True, eq=False)
class Symbol:
    """Value per sample that a tape knows how to compute."""

    tape: Tape
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


class Tape:
    """Expression graph: a record of steps; equal steps are recorded once."""

    def __init__(self) -> None:
        self.steps: list[tuple[str, _Operand, _Operand]] = []
        self._known: dict[tuple[object, ...], Symbol] = {}

    def input(self) -> Symbol:
        """Record a value that is given when the program runs, in the order of these calls."""
        return self.step("input", len(self.steps), None)

    def apply(self, function: str, value: Symbol) -> Symbol:
        """Record `sin`, `cos`, `exp`, `abs` or `sign` of a value."""
        return self.step(function, value.index, None)

    def step(self, operation: str, a: _Operand, b: _Operand) -> Symbol:
        """Record one operation on indices of earlier steps (int) or constants (float)."""
        # The types tell step 2 from the constant 2.0, which are equal.
        key = (operation, a, type(a), b, type(b))
        if (known := self._known.get(key)) is None:
            known = self._known[key] = Symbol(self, len(self.steps))
            self.steps.append((operation, a, b))
        return known


class Program:
    """Executable plan of a tape for given outputs."""

    def __init__(self, tape: Tape, outputs: Sequence[Value]) -> None:
        """Plan the run: which steps are needed, and which may use the same memory one after another.

        Args:
            tape: what was recorded.
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
        """Return the number of numpy calls per run."""
        return len(self._plan)

    def run(self, inputs: Sequence[Array], output: Sequence[Array]) -> None:
        """Compute the outputs for arrays of inputs.

        Args:
            inputs: arrays of one shape, in the order of `Tape.input` calls.
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


def operands_of(tape: Tape, at: int) -> list[int]:
    """Return the earlier steps that a step is made of."""
    operation, a, b = tape.steps[at]
    return [] if operation == "input" else [value for value in (a, b) if isinstance(value, int)]


def needed_steps(tape: Tape, wanted: list[int]) -> list[int]:
    """Return the steps that the wanted ones depend on, in order."""
    found: set[int] = set()
    waiting = list(wanted)
    while waiting:
        at = waiting.pop()
        if at not in found:
            found.add(at)
            waiting += operands_of(tape, at)
    return sorted(found)
