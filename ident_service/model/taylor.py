"""Enclose the values of a tape over short stretches of time, between samples too, by Taylor models.

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

from ident_service.model.tape import Symbol, Tape, Value, needed_steps, operands_of

Array = NDArray[np.float64]
_ROUNDING = 1e-12
_CHUNK = 2048


@dataclass(frozen=True)
class Taylor:
    """Taylor model of a value on many stretches of time; all arrays of shape (stretches,).

    Attributes:
        c: value in the middle.
        d: its time derivative there [1/s].
        r: how far the value may be from `c + d s` anywhere on the stretch.
        h: half the length of the stretch [s].
    """

    c: Array
    d: Array
    r: Array
    h: Array

    @property
    def reach(self) -> Array:
        """Return the largest distance of the value from `c`."""
        return np.asarray(np.abs(self.d) * self.h + self.r)

    @property
    def size(self) -> Array:
        """Return the largest that `|x|` can be."""
        return np.asarray((np.abs(self.c) + self.reach) * (1.0 + _ROUNDING))

    @property
    def highest(self) -> Array:
        """Return the largest that x can be."""
        return np.asarray(self.c + self.reach + _ROUNDING * np.abs(self.c))

    @property
    def lowest(self) -> Array:
        """Return the smallest that x can be."""
        return np.asarray(self.c - self.reach - _ROUNDING * np.abs(self.c))

    def __add__(self, other: Taylor) -> Taylor:
        return Taylor(self.c + other.c, self.d + other.d, self.r + other.r, self.h)

    def __sub__(self, other: Taylor) -> Taylor:
        return Taylor(self.c - other.c, self.d - other.d, self.r + other.r, self.h)

    def __neg__(self) -> Taylor:
        return Taylor(-self.c, -self.d, self.r, self.h)

    def __mul__(self, other: Taylor) -> Taylor:
        own, others = np.abs(self.d) * self.h, np.abs(other.d) * self.h
        r = own * others + self.r * (np.abs(other.c) + others) + other.r * (np.abs(self.c) + own) + self.r * other.r
        return Taylor(self.c * other.c, self.c * other.d + self.d * other.c, r, self.h)

    def shifted(self, constant: float) -> Taylor:
        """Return the sum of this value and a number."""
        return Taylor(self.c + constant, self.d, self.r, self.h)

    def scaled(self, constant: float) -> Taylor:
        """Return the product of this value and a number."""
        return Taylor(self.c * constant, self.d * constant, self.r * abs(constant), self.h)

    def function(self, name: str) -> Taylor:
        """Return `sin`, `cos`, `exp`, `abs`, `sign` or `neg` of this value."""
        reach = self.reach
        if name == "neg":
            return -self
        if name in ("sin", "cos"):
            # |f(c + e) - f(c) - f'(c) e| <= e^2 / 2
            value, slope = (np.sin, np.cos) if name == "sin" else (np.cos, lambda x: -np.sin(x))
            f = slope(self.c)
            return Taylor(value(self.c), f * self.d, np.abs(f) * self.r + 0.5 * reach**2, self.h)
        if name == "exp":
            # The remainder is half e^2 times the largest second derivative, which is where the argument is largest.
            f, most = np.exp(self.c), np.exp(self.c + reach)
            return Taylor(f, f * self.d, f * self.r + 0.5 * reach**2 * most, self.h)
        clear = np.abs(self.c) > reach
        sign = np.sign(self.c)
        if name == "sign":
            return Taylor(np.where(clear, sign, 0.0), np.zeros_like(self.c), np.where(clear, 0.0, 1.0), self.h)
        if name == "abs":
            return Taylor(np.abs(self.c), np.where(clear, sign * self.d, 0.0), np.where(clear, self.r, reach), self.h)
        raise AssertionError(f"no enclosure for {name}")


def enclose(tape: Tape, inputs: Sequence[Taylor], outputs: Sequence[Value]) -> list[Taylor]:
    """Run a tape on enclosures and return the enclosures of its outputs.

    Args:
        tape: what was recorded.
        inputs: in the order of `Tape.input` calls, all of the same stretches.
        outputs: the values wanted.
    """
    chunks = []
    for begin in range(0, max(1, len(inputs[0].c)), _CHUNK):
        part = slice(begin, begin + _CHUNK)
        cut = [Taylor(x.c[part], x.d[part], x.r[part], x.h[part]) for x in inputs]
        chunks.append(_run(tape, cut, outputs))
    return [
        Taylor(*(np.concatenate([getattr(chunk[k], name) for chunk in chunks]) for name in ("c", "d", "r", "h")))
        for k in range(len(outputs))
    ]


def _run(tape: Tape, inputs: Sequence[Taylor], outputs: Sequence[Value]) -> list[Taylor]:
    wanted = [value.index for value in outputs if isinstance(value, Symbol)]
    steps = needed_steps(tape, wanted)
    last_use = {index: at for at in steps for index in operands_of(tape, at)}
    last_use |= dict.fromkeys(wanted, len(tape.steps))
    zero = np.zeros_like(inputs[0].c)
    values: dict[int, Taylor] = {}
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
        values[value.index] if isinstance(value, Symbol) else Taylor(zero + value, zero, zero, inputs[0].h)
        for value in outputs
    ]


def _combined(operation: str, first: Taylor | float | None, values: dict[int, Taylor], b: int | float) -> Taylor:
    if isinstance(first, Taylor) and isinstance(b, int):
        second = values[b]
        return first * second if operation == "mul" else first + second if operation == "add" else first - second
    if isinstance(first, Taylor):
        return first.scaled(b) if operation == "mul" else first.shifted(b if operation == "add" else -b)
    return (-values[int(b)]).shifted(float(first or 0.0))  # a number less a value, the only step that begins so
