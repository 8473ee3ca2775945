"""Write `parameters.json` from an estimate, and read one from anywhere, always held against its schema.

With it, a parameter file can be asked without its recording how well other parameters explain the same torques, and
what a change of parameters does to them.

Only the expressions and their values are required to read one, so that any paper's table can be tested.

Pure computation, no I/O; what the values say of an arm is each reader's business.
"""

from __future__ import annotations

import json
import math
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from importlib.resources import files
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import jsonschema_rs
import numpy as np

from ident_service import __version__
from ident_service.certificate_verifier import INERTIAL, JOINT_TERMS, VerificationError, split_name
from ident_service.config.arm import ArmConfig
from ident_service.errors import ParameterError, UsageError
from ident_service.model.base_parameters import BaseParameters, base_from_expressions, parse_expression
from ident_service.model.chain import Array
from ident_service.model.information import Information
from ident_service.model.notation import NOTATIONS, Notation, regrouped, translate
from ident_service.results.manifest import write_atomically

if TYPE_CHECKING:
    from ident_service.estimation.feasible.feasible_set import SetName
    from ident_service.estimation.identify import Estimate


def strict_json(text: str) -> Any:
    """Parse a JSON text; raise ValueError for NaN, Infinity and numbers too large for a double.

    Raises:
        ValueError: not JSON, or a number that is none.
        RecursionError: nested too deeply.
    """
    return json.loads(text, parse_constant=_refuse, parse_float=_finite, parse_int=_finite_whole)


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is not a number that JSON knows")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:40]} is too large for a double")
    return value


def _finite_whole(text: str) -> int:
    _finite(text)
    return int(text)


_MOST = 10  # mistakes that are reported
# Each mistake holds a copy of what is wrong: 16 MB of them took 5 GB. So only these parts of a document are checked.
_VALUES, _ENTRIES, _KEYS, _CHARACTERS = 20_000, 200, 1000, 1000


def require_schema(content: Any, schema_name: str, origin: object, expected: str) -> None:
    """Raise ParameterError unless a document fits the schema `NAME.schema.json`.

    Args:
        content: JSON values.
        schema_name: name of the schema: `parameters`, `evidence`, `comparison` or `payload`.
        origin: file that it comes from or goes to.
        expected: description of the document that is expected, for the message.

    Raises:
        ParameterError: it does not fit; the first mistakes with their places.
    """
    validator = _validator(schema_name)
    if validator.is_valid(content):
        return
    found = validator.iter_errors(_first(content, [_VALUES]))
    mistakes = sorted(((_place(one.instance_path), one.message) for one in found), key=lambda mistake: mistake[0])
    listed = "; ".join(f"{place}: {message[:200]}" for place, message in mistakes[:_MOST])
    raise ParameterError(
        f"{origin}: not {expected}: {listed or f'something is wrong beyond its first {_ENTRIES} entries'}"
    )


def _first(value: Any, room: list[int]) -> Any:
    """Copy the first parts of a document; `room` is how many values it may still have."""
    room[0] -= 1
    if isinstance(value, list):
        return [_first(one, room) for one in value[:_ENTRIES] if room[0] > 0]
    if isinstance(value, dict):
        return {key: _first(one, room) for key, one in islice(value.items(), _KEYS) if room[0] > 0}
    return value[:_CHARACTERS] if isinstance(value, str) else value


def _place(path: Sequence[str | int]) -> str:
    return "$" + "".join(f".{key}" if isinstance(key, str) else f"[{key}]" for key in path)


@cache
def _validator(name: str) -> jsonschema_rs.Draft202012Validator:
    schema = json.loads(files("ident_service.results").joinpath(f"{name}.schema.json").read_text(encoding="utf-8"))
    return jsonschema_rs.Draft202012Validator(schema)


def information_document(information: Information) -> list[dict[str, Any]]:
    """Return one entry per joint: equations, the base parameters it feels (from 0), its triangle row by row."""
    joints = []
    for support, factor, rows in zip(information.supports, information.factors, information.rows, strict=True):
        size = len(support) + 1
        square = np.zeros((size, size))
        square[: len(factor)] = factor
        triangle = square[np.triu_indices(size)]
        joints.append({"rows": int(rows), "parameters": support.tolist(), "triangle": triangle.tolist()})
    return joints


def information_from(entries: list[dict[str, Any]], base_count: int) -> Information:
    """Return the information of a document, the inverse of `information_document`.

    Args:
        entries: JSON value that `information_document` made.
        base_count: number of base parameters.

    Raises:
        ParameterError: triangles of the wrong size, or about parameters that are not there.
    """
    supports, factors = [], []
    for number, joint in enumerate(entries, 1):
        support = np.array(joint["parameters"], dtype=np.intp)
        size = len(support) + 1
        upper = np.triu_indices(size)
        if len(joint["triangle"]) != len(upper[0]) or np.any(np.diff(support) <= 0) or np.any(support >= base_count):
            raise ParameterError(f"information of joint {number} is not about {base_count} base parameters")
        factor = np.zeros((size, size))
        factor[upper] = joint["triangle"]
        supports.append(support)
        factors.append(factor)
    rows = np.array([joint["rows"] for joint in entries], dtype=np.int64)
    return Information(tuple(supports), tuple(factors), rows, base_count)


MAX_BYTES = 4 * 2**20
MOST_EXPRESSIONS = 1000
MOST_CHARACTERS = 2**18  # of all expressions
_TABLE = (
    'a table from a paper is typed as {"format": "ident-parameters", "version": 1, "base_parameters": {"expressions": '
    '["Lzz1 + 0.25*m2", "lx2"], "values": [0.9, 0.4]}}'
)


@dataclass(frozen=True)
class ParameterFile:
    """Parameter file that has been read.

    Attributes:
        base: the grouping its expressions define; link parameters that no expression names are free.
        values: base parameters in SI units, shape (base,).
        feasible_set: the set it claims, or None.
        content: everything in it, names in our notation.
        notes: notes for the reader on names that were translated.
    """

    base: BaseParameters
    values: Array
    feasible_set: SetName | None
    content: dict[str, Any]
    notes: tuple[str, ...] = ()


def read_parameters(
    parameter_file: Path, link_parameter_names: tuple[str, ...] | None = None, notation: Notation | None = None
) -> ParameterFile:
    """Read a parameter file; check its schema, and that its expressions are independent and name link parameters.

    Args:
        parameter_file: the file, or the folder of results that holds it.
        link_parameter_names: the link parameters of an arm; without them, the ten of every link up to the highest
            number that the expressions mention, and the joint terms that they mention.
        notation: notation of the file's names, where it is not ours.

    Raises:
        UsageError: no such file.
        ParameterError: not JSON, not of the schema, a name that is no link parameter, or expressions that do not parse
            or depend on each other.
    """
    if parameter_file.is_dir():
        parameter_file = parameter_file / "parameters.json"
    content = read_content(parameter_file)
    table = content["base_parameters"]
    expressions, values = tuple(table["expressions"]), np.array(table["values"], dtype=float)
    if len(expressions) > MOST_EXPRESSIONS or sum(map(len, expressions)) > MOST_CHARACTERS:
        raise ParameterError(
            f"{parameter_file}: more than {MOST_EXPRESSIONS} expressions, or more than {MOST_CHARACTERS} characters in "
            "them"
        )
    notes: tuple[str, ...] = ()
    try:
        if notation is not None:
            notes = _notes(expressions, notation)
            expressions = tuple(translate(text, notation) for text in expressions)
            table["expressions"] = list(expressions)
            if "link_parameters" in content:
                printed = content["link_parameters"]
                printed["names"] = [translate(name, notation) for name in printed["names"]]
        mentioned = _names_in(expressions, content.get("link_parameters", {}).get("names", ()))
        base = base_from_expressions(expressions, mentioned if link_parameter_names is None else link_parameter_names)
    except ParameterError as error:
        raise ParameterError(f"{parameter_file}: {error}") from None
    return ParameterFile(base, values, content.get("feasible_set"), content, notes)


def read_content(parameter_file: Path) -> dict[str, Any]:
    """Read a parameter file, check its schema and that its columns are equally long; expressions are not parsed.

    Raises:
        UsageError: no such file.
        ParameterError: too large, not JSON, not of the schema, or columns of different lengths.
    """
    if not parameter_file.is_file():
        raise UsageError(f"no such file: {parameter_file}")
    if parameter_file.stat().st_size > MAX_BYTES:
        raise ParameterError(f"{parameter_file}: larger than {MAX_BYTES} bytes")
    try:
        content = strict_json(parameter_file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ParameterError(f"{parameter_file}: not JSON: {error}") from None
    _require_document(content, parameter_file)
    expressions = content["base_parameters"]["expressions"]
    for key, column in content["base_parameters"].items():
        if len(column) != len(expressions):
            raise ParameterError(f"{parameter_file}: {len(expressions)} expressions but {len(column)} {key}")
    return dict(content)


def _notes(expressions: tuple[str, ...], notation: Notation) -> tuple[str, ...]:
    found = dict.fromkeys(name for text in expressions for name in regrouped(text, notation))
    if not found:
        return ()
    return (
        f"{', '.join(list(found)[:5])}{' ...' if len(found) > 5 else ''}: an R was read as the link parameter alone; "
        "the answer is about the expressions as they stand, so that each regrouping must be written in its expression",
    )


def _require_document(content: Any, path: Path) -> None:
    try:
        require_schema(content, "parameters", path, "a parameter file")
    except ParameterError as error:
        if isinstance(content, dict) and "format" in content:
            raise
        raise ParameterError(f"{error}; {_TABLE}") from None


def parameters_document(estimate: Estimate, described: ArmConfig | None = None) -> dict[str, Any]:
    """Return the content of `parameters.json` for an estimate, its feasibility certified in exact arithmetic.

    Args:
        estimate: identified estimate.
        described: the arm's description as it was read, where options or recordings changed it; sections that differ
            are named in the file, so that its hash can be compared with that of the description.

    Raises:
        SolverError: no proof was found where the solver should have led to one.
    """
    # These load for half a second, and whoever lists runs only reads files.
    from ident_service.estimation.certificate import certify
    from ident_service.results.assessment import error_document
    from ident_service.results.summary import how_fitted, implausible_links, torque_constants_document

    model, base = estimate.model, estimate.base
    errors = error_document(estimate)
    certificate = certify(estimate.beta, base, estimate.conditions, estimate.delta)
    options = model.config.identification
    document: dict[str, Any] = {
        "format": "ident-parameters",
        "version": 1,
        "arm": {
            "name": model.config.name,
            "joints": list(model.chain.names),
            "sha256": model.config.sha256,
            **({} if model.config.payload is None else {"payload": model.config.payload.model_dump(mode="json")}),
            **_changes(model.config, described),
        },
        "method": estimate.method,
        "feasible_set": estimate.conditions.kind if estimate.constrained else "none",
    }
    if estimate.delta is not None:
        document["link_parameters"] = {
            "names": list(model.layout.names),
            "units": list(model.layout.units),
            "values": estimate.delta.tolist(),
            **({} if estimate.nearest_to is None else {"nearest_to": estimate.nearest_to}),
            **({"implausible": strange} if (strange := list(implausible_links(estimate))) else {}),
        }
    apart = estimate.noise_deviations
    held = estimate.constrained_intervals
    intervals = {} if held is None else {"constrained_intervals": [finite_or_none(ends) for ends in held]}
    noise = {} if apart is None else {"noise_standard_deviations": finite_or_none(apart)}
    document |= {
        "base_parameters": {
            "expressions": list(base.expressions),
            "units": list(base.units),
            "values": estimate.beta.tolist(),
            "unconstrained_values": estimate.fit.beta.tolist(),
            "standard_deviations": finite_or_none(estimate.standard_deviations),
            "white_standard_deviations": finite_or_none(estimate.white_standard_deviations),
            "degrees_of_freedom": [round(value, 3) for value in estimate.degrees.tolist()],
            **noise,
            "covariance": [finite_or_none(row) for row in estimate.covariance],
            **intervals,
            "negligible": finite_or_none(estimate.negligible),
            "verdicts": list(estimate.verdicts),
        },
        "feasibility": {
            "feasible": certificate.verdict == "feasible",
            "margin": estimate.margin,
            "tight": list(estimate.tight),
            "certificate": certificate.document,
        },
        "friction": {
            "presliding": _numbers(options.friction.presliding, model.chain.joints),
            "stribeck_velocity": list(model.layout.stribeck_velocity),
        },
        "torque_delay": {
            "seconds": options.delay,
            "deviation": None if estimate.prepared.delay is None else estimate.prepared.delay.deviation,
        },
        "torque_scales": estimate.prepared.torque_scales.tolist(),
        **torque_constants_document(estimate),
        **convex_document(estimate),
        "fit": {
            "samples": estimate.samples,
            "blocks": len(estimate.fitted.clusters),
            "condition_number": estimate.fit.condition_number if np.isfinite(estimate.fit.condition_number) else None,
            **errors["fit"],
            "rows_and_filter": list(how_fitted(estimate)),
            "standstill_shares": estimate.standstill_shares.tolist(),
            "effective_rows": _effective_rows(estimate).tolist(),
            "choices": [
                {"option": one.option, "value": one.value, "held_out_error_percent": dict(one.held_out)}
                for one in estimate.choices
            ],
        },
        "information": information_document(estimate.information),
        "validation": errors["validation"],
        "provenance": {
            "recordings": [{"name": name, "sha256": digest} for name, digest in estimate.recordings],
            "software": f"ident-service {__version__}",
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
            "git": _commit(),
        },
    }
    return document


def _effective_rows(estimate: Estimate) -> Array:
    """Return the rows of `information`, those near standstill by the squares of their weights, shape (joints,)."""
    near, rows = estimate.prepared.equations.left_out, estimate.information.rows.astype(float)
    return rows if near is None else np.asarray(rows - (1.0 - estimate.standstill_shares**2) * near.rows)


def convex_document(estimate: Estimate) -> dict[str, Any]:
    """Return results through cvxpy as JSON values: custom knowledge and the second opinion, where there are."""
    document: dict[str, Any] = {}
    if (known := estimate.custom) is not None:
        document["custom"] = {
            "function": known.function.name,
            "file": known.function.file,
            "sha256": known.function.sha256,
            "solver": known.solver,
            "relative_error_percent": known.error,
            "relative_error_percent_without": known.error_without,
        }
    if (second := estimate.second) is not None:
        document["second_opinion"] = {
            "agrees": second.agrees,
            "conclusive": second.conclusive,
            "solvers": list(second.solvers),
            "status": second.status,
            "objectives": list(second.objectives),
            "torque_difference_percent": second.torque_percent,
            "largest_difference_in_deviations": second.deviations,
            "expression": second.expression,
            "margin": second.margin,
        }
    return document


def _changes(config: ArmConfig, described: ArmConfig | None) -> dict[str, Any]:
    if described is None:
        return {}
    used, before = (json.loads(one.model_dump_json()) for one in (config, described))
    changes = {key: section for key, section in used.items() if section != before[key]}
    return {"changes": changes} if changes else {}


def write_parameters(path: Path, document: dict[str, Any]) -> None:
    """Write a parameter document after validating it against the schema; floats round-trip.

    Raises:
        ParameterError: the document does not fit the schema.
        UsageError: the file cannot be written.
    """
    require_schema(document, "parameters", path, "a parameter file")
    write_atomically(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


def _names_in(expressions: tuple[str, ...], printed: Sequence[str]) -> tuple[str, ...]:
    """Return the ten parameter names of every link up to the highest number, with the joint terms mentioned."""
    mentioned = {name for expression in expressions for name in parse_expression(expression)}
    try:
        found = {split_name(name) for name in sorted(mentioned)}
        for name in printed:
            split_name(name)
    except VerificationError as error:
        raise ParameterError(
            f"{error}; a table in another notation is read with --notation {' or '.join(NOTATIONS)}"
        ) from None
    links = max((link for _, link in found), default=0)
    names: list[str] = []
    for link in range(1, links + 1):
        names += [f"{symbol}{link}" for symbol in INERTIAL]
        names += [f"{symbol}{link}" for symbol in JOINT_TERMS if (symbol, link) in found]
    return tuple(names)


def _numbers(value: Any, joints: int) -> list[float]:
    return [float(one) for one in np.broadcast_to(np.asarray(value, dtype=float), (joints,))]


def finite_or_none(values: Array) -> list[float | None]:
    """Return numbers as JSON has them: null for one that is not finite; shape (n,)."""
    return [float(value) if np.isfinite(value) else None for value in values]


def _commit() -> str | None:
    """Return the commit of the source this runs from; None where it is no checkout."""
    root = Path(__file__).parent.parent.parent
    if not (root / ".git").exists():
        return None
    try:
        done = subprocess.run(  # noqa: S603
            ["git", "-C", str(root), "rev-parse", "HEAD"],  # noqa: S607
            capture_output=True,
            text=True,
            timeout=5,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


AGREEMENT = 1e-9
"""Largest difference between base values and those of the link values, relative to the largest base value."""
_LARGEST = 1e30  # largest value in SI units; far beyond every arm, and its square is still finite


def require_consistent(file: ParameterFile, origin: Path) -> None:
    """Raise ParameterError unless the values of a parameter file agree with each other and are of possible size.

    Args:
        file: parameter file that was read.
        origin: origin of the file, for errors.

    Raises:
        ParameterError: a number that no parameter has; base values that the link values do not have; or, without
            constraints, unconstrained values that are not the values.
    """
    table = file.content["base_parameters"]
    rows = {key: table.get(key, []) for key in ("values", "unconstrained_values", "standard_deviations")}
    rows["link values"] = file.content.get("link_parameters", {}).get("values", [])
    rows["covariance"] = [value for row in table.get("covariance", []) for value in row]
    for key, values in rows.items():
        largest = max((abs(float(value)) for value in values if value is not None), default=0.0)
        if not largest <= _LARGEST:
            raise ParameterError(f"{origin}: {largest:g} among its {key}; no parameter of an arm is that large")
    scale = AGREEMENT * float(np.abs(file.values).max())
    free = table.get("unconstrained_values")
    unheld = free is not None and file.content.get("feasible_set") == "none"
    if unheld and np.abs(np.array(free, dtype=float) - file.values).max() > scale:
        raise ParameterError(
            f"{origin}: was fitted without constraints, but its values are not its unconstrained values; one of them "
            "was changed"
        )
    delta = named_link_values(file)
    if delta is not None and set(file.base.names) <= set(delta):
        require_base_values(file.base, np.array([delta[name] for name in file.base.names]), file.values, origin)


def named_link_values(file: ParameterFile) -> dict[str, float] | None:
    """Return link values by name; None where there are none, or names and values are not equally many."""
    table = file.content.get("link_parameters")
    if table is None or len(table["names"]) != len(table["values"]):
        return None
    return {name: float(value) for name, value in zip(table["names"], table["values"], strict=True)}


def require_base_values(base: BaseParameters, delta: Array, base_values: Array, origin: Path) -> None:
    """Raise ParameterError unless the link values have the base values.

    Args:
        base: the grouping.
        delta: link values in its order, shape (parameters,).
        base_values: base values, shape (base,).
        origin: origin of the values, for errors.

    Raises:
        ParameterError: they do not.
    """
    if np.abs(base.K @ delta - base_values).max() > AGREEMENT * np.abs(base_values).max():
        raise ParameterError(
            f"{origin}: its link parameters do not have the values of its base parameters; one of them was changed"
        )
