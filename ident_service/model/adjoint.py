"""Differentiate the program of a tape: reverse accumulation, recorded once and run on many samples.

For a program y = f(x) and seeds s, one per output, the pull is the gradient of `sum(s y)` with respect to x. The
reverse sweep is itself written on a tape, so that it is folded, shared and planned like any other program; forward
values that it needs are kept by the run before it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ident_service.errors import ModelError
from ident_service.model.tape import Program, Symbol, Tape, Value

Array = NDArray[np.float64]


class Differentiable:
    """Program of a tape that can also be run backwards, for gradients."""

    def __init__(self, tape: Tape, inputs: Sequence[Symbol], outputs: Sequence[Value]) -> None:
        """Plan the forward and the backward run.

        Args:
            tape: what was recorded; all of its inputs, in the order they were made.
            inputs: what to differentiate with respect to.
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
        """Return the numbers of numpy calls per run and per pull."""
        return self._forward.steps, self._backward.steps

    def run(self, values: Array) -> Array:
        """Compute the outputs, and keep the values that `pull` needs.

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
        """Return the gradient of `sum(seeds * outputs)`, sample by sample, at the values of the last run.

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
        tape: of the sweep; its inputs are seeds and forward values, in the order of `order`.
        order: what each input is: ("seed", output) or ("kept", place in `known`).
        known: forward steps whose values the sweep needs, in the order they were met.
        adjoints: by forward step, the derivative of `sum(seeds * outputs)` with respect to it.
    """

    def __init__(self, tape: Tape, outputs: Sequence[Value]) -> None:
        self.tape = Tape()
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
                self._through(at, self.adjoints[at])

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

    def _through(self, at: int, adjoint: Value) -> None:
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
