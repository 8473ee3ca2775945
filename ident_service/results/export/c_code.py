"""Print formulas of a tape as lines of C99, one operation a line, and run such lines from their text.

The reader knows nothing of the tape: what it computes is what the text says.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from ident_service.errors import ModelError
from ident_service.model.chain import Array
from ident_service.model.tape import Symbol, Tape, Value, needed_steps

_OPERATORS = {"mul": "*", "add": "+", "sub": "-"}
_FUNCTIONS = {"sin": "sin", "cos": "cos", "exp": "exp", "abs": "fabs"}
_UNARY = {"sin": np.sin, "cos": np.cos, "exp": np.exp, "fabs": np.abs}
_BINARY = {"*": np.multiply, "+": np.add, "-": np.subtract}

_OPERAND = r"-?[a-z]+\[\d+\]|-?x\d+|-?\d[\d.e+-]*|\(-\d[\d.e+-]*\)"
_STEP = re.compile(
    rf"^    const double (x\d+) = (?:({_OPERAND}) ([-+*]) ({_OPERAND})|(\w+)\((.+)\)|(-x\d+|-[a-z]+\[\d+\]));$"
)
_SIGN = re.compile(rf"^    const double (x\d+) = \(double\)\(\(({_OPERAND}) > 0\.0\) - \(\2 < 0\.0\)\);$")
_RESULT = re.compile(rf"^    ([a-zA-Z]+)\[(\d+)\] = ({_OPERAND});$")


def c_lines(tape: Tape, inputs: Mapping[int, str], outputs: Sequence[tuple[str, Value]]) -> list[str]:
    """Return the body of a C function, indented.

    Args:
        tape: what was recorded.
        inputs: C expressions of the tape's inputs, by index.
        outputs: targets and their values; all of them are written after everything has been read.
    """
    names = dict(inputs)
    lines: list[str] = []
    for at in needed_steps(tape, [value.index for _, value in outputs if isinstance(value, Symbol)]):
        operation, a, b = tape.steps[at]
        if operation == "input":
            continue
        first, second = (_operand(value, names) for value in (a, b))
        names[at] = f"x{len(lines)}"
        if operation == "sign":
            text = f"(double)(({first} > 0.0) - ({first} < 0.0))"
        elif operation == "neg":
            text = f"-{first}"
        elif operation in _FUNCTIONS:
            text = f"{_FUNCTIONS[operation]}({first})"
        else:
            text = f"{first} {_OPERATORS[operation]} {second}"
        lines.append(f"    const double {names[at]} = {text};")
    for target, value in outputs:
        lines.append(f"    {target} = {_operand(value.index if isinstance(value, Symbol) else float(value), names)};")
    return lines


def _operand(value: int | float | None, names: Mapping[int, str]) -> str:
    if isinstance(value, int):
        return names[value]
    number = repr(float(value or 0.0) + 0.0)
    return f"({number})" if number.startswith("-") else number


def run_c_lines(lines: Sequence[str], arrays: Mapping[str, Array]) -> dict[str, Array]:
    """Run lines that `c_lines` has written, from their text alone.

    Args:
        lines: the body of a function.
        arrays: what `name[k]` stands for: arrays of shape (length, samples).

    Returns:
        By name, the arrays that were written to, shape (length, samples).

    Raises:
        ModelError: a line that is not one of these.
    """
    samples = max(array.shape[1] for array in arrays.values())
    known: dict[str, Array] = {}
    results: dict[str, dict[int, Array]] = {}

    def value(text: str) -> Array:
        text = text.strip("()")
        if text.startswith("-") and not text[1].isdigit():
            return np.asarray(-value(text[1:]))
        if text in known:
            return known[text]
        if text.endswith("]"):
            name, number = text[:-1].split("[")
            return np.asarray(arrays[name][int(number)])
        return np.full(samples, float(text))

    for line in lines:
        try:
            if step := _STEP.match(line):
                target, a, operator, b, function, argument, negated = step.groups()
                if operator is not None:
                    known[target] = _BINARY[operator](value(a), value(b))
                else:
                    known[target] = value(negated) if function is None else _UNARY[function](value(argument))
            elif step := _SIGN.match(line):
                known[step.group(1)] = np.sign(value(step.group(2)))
            elif step := _RESULT.match(line):
                results.setdefault(step.group(1), {})[int(step.group(2))] = value(step.group(3))
            else:
                raise ModelError(f"not a line of generated code: {line.strip()[:80]!r}")
        except (KeyError, IndexError, ValueError) as error:
            raise ModelError(f"generated code that cannot be run: {line.strip()[:80]!r} ({error})") from None
    return {name: np.array([rows[k] for k in sorted(rows)]) for name, rows in results.items()}
