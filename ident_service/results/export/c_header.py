"""Export a C99 header with the arm's dynamics in base parameters: nothing but <math.h>.

The reader knows nothing of the tape: what it computes is what the text says.

The state of friction with pre-sliding is the caller's.

The formulas are those of `model/newton_euler.py`, printed one operation a line, with a zero for every link parameter
that is no base column. What is written is read back as text and run.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ident_service import __version__
from ident_service.config.arm import JointTerm
from ident_service.errors import ModelError
from ident_service.model.chain import Array
from ident_service.model.friction_state import advance_dahl_state, presliding_distances
from ident_service.model.newton_euler import drive_torque, friction_torque, mass_matrix, rigid_torque
from ident_service.model.regressor import joint_regressor
from ident_service.model.symbolic import ExpressionGraph, Symbol, Value, needed_steps
from ident_service.results.export.identified_arm import IdentifiedArm
from ident_service.results.export.round_trip import (
    AGREEMENT,
    disagreement,
    presliding_left_out,
    random_states,
    torque,
    with_terms,
)
from ident_service.results.export.words import comment_text, identifier, unique

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


def c_lines(graph: ExpressionGraph, inputs: Mapping[int, str], outputs: Sequence[tuple[str, Value]]) -> list[str]:
    """Return the C statements, indented, that compute the outputs of an expression graph from its inputs.

    Args:
        graph: recorded expression graph.
        inputs: C expressions of the tape's inputs, by index.
        outputs: targets and their values; all of them are written after everything has been read.
    """
    names = dict(inputs)
    lines: list[str] = []
    for at in needed_steps(graph, [value.index for _, value in outputs if isinstance(value, Symbol)]):
        operation, a, b = graph.steps[at]
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
    """Compute, with numpy, the statements that `c_lines` has written, and return the arrays that they write to.

    Args:
        lines: the body of a function.
        arrays: arrays that `name[k]` stands for, by name, each of shape (length, samples).

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


_PARAMETER = re.compile(r"^    (-?[\d.e+-]+),? /\* \d+ ")
_DRIVES: tuple[JointTerm, ...] = ("drive_inertia",)
_Formulas = Callable[[ExpressionGraph, dict[int, Value], dict[str, list[Symbol]]], list[Value]]


def c_prefix(arm: IdentifiedArm) -> str:
    """Return the prefix of every name in the header: the arm's name as a C identifier."""
    return identifier(arm.model.config.name)


def c_header(arm: IdentifiedArm) -> str:
    """Return the arm as a C header, read back and found to have the torques and mass matrix of the base parameters.

    Raises:
        ModelError: what is read back differs.
    """
    text = _written(arm)
    _check(arm, text)
    return text


def _written(arm: IdentifiedArm) -> str:
    name, model = c_prefix(arm), arm.model
    guard, n, nb = f"{name}_dynamics_H".upper(), model.chain.joints, arm.base.size
    joints = unique(identifier(f"{name}_joint_{joint}") for joint in model.chain.names)
    parts = [
        _preface(arm, name),
        f"#ifndef {guard}\n#define {guard}\n\n#include <math.h>\n",
        f"#define {name}_JOINTS {n}\n#define {name}_BASE_PARAMETERS {nb}\n",
        "/* Places of the joints in every array. */\nenum {\n"
        + ",\n".join(
            f"    {joint} = {k} /* {comment_text(own)}, {'rad' if turns else 'm'} */"
            for k, (joint, own, turns) in enumerate(zip(joints, model.chain.names, model.chain.revolute, strict=True))
        )
        + "\n};\n",
        _parameters(arm, name),
        *(_function(arm, name, *what) for what in _functions(arm)),
        _INVERSE_DYNAMICS.replace("NAME", name),
        f"#endif /* {guard} */\n",
    ]
    return "\n".join(parts)


def _preface(arm: IdentifiedArm, name: str) -> str:
    gravity = ", ".join(repr(float(g)) for g in arm.model.chain.gravity)
    terms = ", ".join(arm.model.layout.terms).replace("_", " ") or "none"
    sigma = f" * Mind: {comment_text(arm.deviations_note)}.\n *\n" if arm.deviations_note else ""
    lines = textwrap.wrap(comment_text(arm.forbidden_note), 115)
    forbidden = "".join(f" * {line}".rstrip() + "\n" for line in [*lines, ""] if lines)
    return f"""\
/* Dynamics of the arm {comment_text(arm.model.config.name)} in identified base parameters.
 *
{forbidden} * SI units: rad or m, rad/s or m/s, rad/s^2 or m/s^2, N m or N, kg, s. Torque and force are on the
 * joint's side, positive along the joint's axis. Gravity ({gravity}) m/s^2 in the base frame is part of the formulas.
 * Joint terms: {terms}. Dry friction has the sign of the velocity and is zero at rest.
 *
 *   {name}_inverse_dynamics(q, dq, ddq, tau)  tau = M(q) ddq + c(q, dq) + g(q) + friction(dq)
 *   {name}_rigid_dynamics(q, dq, ddq, tau)    the same without friction, drive inertia included
 *   {name}_friction(dq, tau)                  friction and torque offsets
 *   {name}_gravity(q, tau)                    g(q)
 *   {name}_mass_matrix(q, M)                  M(q) by rows, all of it, drive inertia included
 *
 * The offset of a sliding joint, if no motion tells it from gravity, is part of g(q), which {name}_friction then lacks.
 * Every array has {name}_JOINTS entries, M their square; results may overwrite arguments. No memory is allocated,
 * nothing global is written, only <math.h> is used; C99 and C++.
 *
{_turning_comment(arm, name)}{sigma} * Made by ident-service {__version__} from parameters with SHA-256
 * {arm.source}.
 */
"""


def presliding_notes(arm: IdentifiedArm) -> tuple[str, ...]:
    """Return notes on friction with pre-sliding, for the header's reader; none where there is none."""
    name = c_prefix(arm)
    return tuple(
        f"{name}_inverse_dynamics and {name}_friction are without {words}; with {name}_turned and "
        f"{name}_turning_friction the caller carries its state"
        for words in presliding_left_out(arm.model, arm.base_delta if arm.delta is None else arm.delta)
    )


def _turning_comment(arm: IdentifiedArm, name: str) -> str:
    said = presliding_notes(arm)
    if not said:
        return ""
    lines = textwrap.wrap(comment_text(said[0]) + ".", 115)
    lines += [
        "",
        f"  {name}_turned(step, before, direction)          direction of each drive's dry friction after a step of the",
        "      joints [rad or m], in which no drive turns round; begin with the signs of the first motion",
        f"  {name}_turning_friction(dq, direction, tau)     friction and torque offsets with that direction",
        "",
    ]
    return "".join(f" * {line}".rstrip() + "\n" for line in lines)


def _parameters(arm: IdentifiedArm, name: str) -> str:
    count = arm.base.size
    lines = []
    for k, (expression, unit, value) in enumerate(zip(arm.base.expressions, arm.base.units, arm.beta, strict=True)):
        sigma = "" if (deviation := arm.sigma[k]) is None else f", standard deviation {deviation:.2g}"
        comma = "," if k + 1 < count else ""
        said = f"{k} {comment_text(expression)} [{unit}]{sigma}"
        lines.append(f"    {float(value)!r}{comma} /* {said} */")
    body = "\n".join(lines)
    return (
        "/* Base parameters: each the value of the sum of link parameters beside it; of the link parameters in a sum,\n"
        " * the formulas use the one that comes first. */\n"
        f"static const double {name}_base_parameters[{name}_BASE_PARAMETERS] = {{\n{body}\n}};\n"
    )


def _functions(arm: IdentifiedArm) -> list[tuple[str, tuple[str, ...], str, _Formulas]]:
    chain, layout, n = arm.model.chain, arm.model.layout, arm.model.chain.joints

    def rigid(tape: ExpressionGraph, p: dict[int, Value], s: dict[str, list[Symbol]]) -> list[Value]:
        links = rigid_torque(tape, chain, layout, p, s["q"], s["dq"], s["ddq"])
        drives = drive_torque(chain, layout, p, s["ddq"])
        return [a + b for a, b in zip(links, drives, strict=True)]

    def friction(tape: ExpressionGraph, p: dict[int, Value], s: dict[str, list[Symbol]]) -> list[Value]:
        return friction_torque(tape, chain, layout, p, s["dq"])

    def gravity(tape: ExpressionGraph, p: dict[int, Value], s: dict[str, list[Symbol]]) -> list[Value]:
        return rigid_torque(tape, chain, layout, p, s["q"])

    def mass(tape: ExpressionGraph, p: dict[int, Value], s: dict[str, list[Symbol]]) -> list[Value]:
        M = mass_matrix(tape, chain, layout, p, s["q"])
        return [M[i][j] for i in range(n) for j in range(n)]

    ways = presliding_distances(arm.model)

    def turn(tape: ExpressionGraph, p: dict[int, Value], s: dict[str, list[Symbol]]) -> list[Value]:
        return [
            _turned(tape, share, s["step"], before, x0)
            for share, before, x0 in zip(chain.coupling, s["before"], ways, strict=True)
        ]

    def turning(tape: ExpressionGraph, p: dict[int, Value], s: dict[str, list[Symbol]]) -> list[Value]:
        return friction_torque(tape, chain, layout, p, s["dq"], s["direction"])

    found: list[tuple[str, tuple[str, ...], str, _Formulas]] = [
        ("rigid_dynamics", ("q", "dq", "ddq"), "tau", rigid),
        ("friction", ("dq",), "tau", friction),
        ("gravity", ("q",), "tau", gravity),
        ("mass_matrix", ("q",), "M", mass),
    ]
    if presliding_notes(arm):
        found += [("turned", ("step", "before"), "direction", turn)]
        found += [("turning_friction", ("dq", "direction"), "tau", turning)]
    return found


def _turned(tape: ExpressionGraph, share: Array, step: list[Symbol], before: Symbol, length: float) -> Value:
    """Return the friction state of one drive after one step of Dahl's law (`model/friction_state.py`)."""
    travelled: Value = sum((float(c) * x for c, x in zip(share, step, strict=True) if c), 0.0)
    if not isinstance(travelled, Symbol):
        return before  # a drive that moves no joint
    sign = tape.apply("sign", travelled)
    if not length > 0.0:
        return sign
    spent = tape.apply("abs", travelled) * (-1.0 / length)
    return sign + (before - sign) * (tape.apply("exp", spent) if isinstance(spent, Symbol) else 1.0)


def _function(
    arm: IdentifiedArm, name: str, what: str, arguments: tuple[str, ...], result: str, formulas: _Formulas
) -> str:
    tape, n = ExpressionGraph(), arm.model.chain.joints
    states = {argument: [tape.input() for _ in range(n)] for argument in arguments}
    inputs = {symbol.index: f"{key}[{k}]" for key, symbols in states.items() for k, symbol in enumerate(symbols)}
    parameters: dict[int, Value] = {}
    if not np.array_equal(arm.base.K[:, arm.base.base], np.eye(arm.base.size)):
        raise ModelError(f"{arm.model.config.name}: base parameters that do not begin with their own link parameter")
    for k, column in enumerate(arm.base.base):
        symbol = tape.input()
        parameters[int(column)], inputs[symbol.index] = symbol, f"p[{k}]"
    values = formulas(tape, parameters, states)
    lines = c_lines(tape, inputs, [(f"{result}[{k}]", value) for k, value in enumerate(values)])
    taken = ", ".join(f"const double {argument}[]" for argument in arguments)
    unused = "".join(f"    (void){argument};\n" for argument in arguments)
    return (
        f"static inline void {name}_{what}({taken}, double {result}[])\n{{\n"
        f"    const double *const p = {name}_base_parameters;\n{unused}    (void)p;\n" + "\n".join(lines) + "\n}\n"
    )


_INVERSE_DYNAMICS = """\
static inline void NAME_inverse_dynamics(const double q[], const double dq[], const double ddq[], double tau[])
{
    double friction[NAME_JOINTS];
    int k;
    NAME_friction(dq, friction);
    NAME_rigid_dynamics(q, dq, ddq, tau);
    for (k = 0; k < NAME_JOINTS; ++k) {
        tau[k] += friction[k];
    }
}
"""


def read_c_header(text: str, prefix: str, function: str, states: dict[str, Array]) -> Array:
    """Compute, from a header's text alone, what one of its functions writes for these states, (values, samples).

    Args:
        text: the header.
        prefix: prefix of the names in it.
        function: `rigid_dynamics`, `friction`, `gravity` or `mass_matrix`.
        states: `q`, `dq` and `ddq`, each of shape (joints, samples).

    Raises:
        ModelError: no such function, or lines that are not generated code.
    """
    lines = text.splitlines()
    try:
        at = lines.index(f"static const double {prefix}_base_parameters[{prefix}_BASE_PARAMETERS] = {{")
        begin = next(k for k, line in enumerate(lines) if line.startswith(f"static inline void {prefix}_{function}("))
        numbers, body = lines[at + 1 : lines.index("};", at)], lines[begin + 2 : lines.index("}", begin)]
    except (ValueError, StopIteration):
        raise ModelError(f"not a header of {prefix} with {function}") from None
    found = [_PARAMETER.match(line) for line in numbers]
    samples = next(iter(states.values())).shape[1]
    p = np.array([[float(match.group(1)) if match else np.nan] * samples for match in found])
    code = [line for line in body if not line.startswith(("    (void)", "    const double *const p"))]
    (result,) = run_c_lines(code, {**states, "p": p}).values()
    return result


def _check(arm: IdentifiedArm, text: str) -> None:
    q, dq, ddq = random_states(arm.model.chain.joints)
    model, still, n = arm.model, np.zeros_like(q), arm.model.chain.joints
    delta = arm.base_delta if arm.delta is None else arm.delta
    states = {"q": q.T, "dq": dq.T, "ddq": ddq.T}

    def run(function: str, at: dict[str, Array] = states) -> Array:
        return read_c_header(text, c_prefix(arm), function, at).T

    links = with_terms(model, delta, _DRIVES)
    g = torque(model, links, (q, still, still))
    M = np.array([torque(model, links, (q, still, still + unit)) - g for unit in np.eye(n)]).transpose(1, 2, 0)
    pairs: Sequence[tuple[str, Array, Array]] = (
        ("inverse dynamics", run("rigid_dynamics") + run("friction"), torque(model, delta, (q, dq, ddq))),
        # Where offsets are grouped with masses, only the sum is the same.
        ("gravity", run("gravity") + run("friction", {"dq": still.T}), torque(model, delta, (q, still, still))),
        ("mass matrix", run("mass_matrix"), M.reshape(len(q), n * n)),
        *_friction_check_pairs(arm, delta, run),
    )
    for what, found, meant in pairs:
        if np.abs(meant).max() == 0.0 == np.abs(found).max():
            continue
        if not disagreement(found, meant) <= AGREEMENT:
            raise ModelError(
                f"{arm.model.config.name}: {what} read back from the C header differs from the parameters'"
            )


def _friction_check_pairs(
    arm: IdentifiedArm, delta: Array, run: Callable[[str, dict[str, Array]], Array]
) -> list[tuple[str, Array, Array]]:
    """Return friction with a state, as read back and as meant, after small steps and after none."""
    if not presliding_notes(arm):
        return []
    model, ways = arm.model, presliding_distances(arm.model)
    still, dq, before = random_states(model.chain.joints)
    step = np.where(np.arange(len(dq))[:, None] % 3 == 0, 0.0, 1e-3 * dq)
    before = np.tanh(before)
    direction = advance_dahl_state(before, step @ model.chain.coupling.T, ways)
    H = joint_regressor(model.chain, model.layout, 0.0 * still, dq, 0.0 * dq, direction=direction)
    without = with_terms(model, delta, [term for term in model.layout.terms if term != "drive_inertia"])
    without -= with_terms(model, delta, ())
    friction = run("turning_friction", {"dq": dq.T, "direction": direction.T})
    memoryless = run("friction", {"dq": dq.T})
    dry = np.einsum("jps,p->sj", H - joint_regressor(model.chain, model.layout, 0.0 * still, dq, 0.0 * dq), without)
    return [
        ("direction of friction", run("turned", {"step": step.T, "before": before.T}), direction),
        # Where offsets are grouped with masses, only differences of friction are the same.
        ("friction with a state", friction - memoryless, dry),
    ]
