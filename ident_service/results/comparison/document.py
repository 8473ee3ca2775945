"""Write a comparison as JSON, validated against its schema."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ident_service import __version__
from ident_service.estimation.drift import ALPHA, RELEVANT_RESIDUAL, RELEVANT_TORQUE, Test
from ident_service.estimation.least_squares import TorqueError
from ident_service.model.chain import Array
from ident_service.results.comparison.comparison import Comparison, Pair
from ident_service.results.comparison.findings import findings
from ident_service.results.comparison.sides import Side
from ident_service.results.comparison.text import contradiction
from ident_service.results.files import write_atomically
from ident_service.results.schemas import require_schema


def comparison_document(comparison: Comparison) -> dict[str, Any]:
    """Return the content of `comparison.json`."""
    return {
        "format": "ident-comparison",
        "version": 1,
        "verdict": comparison.verdict,
        "thresholds": {"p": ALPHA, "torque_share": RELEVANT_TORQUE, "residual_share": RELEVANT_RESIDUAL},
        "reference": _side(comparison.reference),
        "compared": [_pair(comparison.reference, pair) for pair in comparison.pairs],
        "software": f"ident-service {__version__}",
    }


def write_comparison(path: Path, comparison: Comparison) -> None:
    """Write `comparison.json`.

    Raises:
        ParameterError: the document does not fit the schema.
        UsageError: the file cannot be written.
    """
    document = comparison_document(comparison)
    require_schema(document, "comparison", path, "a comparison")
    write_atomically(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


def _side(side: Side) -> dict[str, Any]:
    content = side.content
    return {
        "path": str(side.path),
        "sha256": side.sha256,
        "arm": content.get("arm"),
        "fit": _error_percent(content.get("fit")),
        "validation": [_error_percent(one) for one in content.get("validation", [])],
    }


def _error_percent(entry: Any) -> float | None:
    return None if entry is None else entry.get("relative_error_percent")


def _pair(reference: Side, pair: Pair) -> dict[str, Any]:
    found, expressions = pair.drift, reference.content["base_parameters"]["expressions"]
    first, second = (side.file.values[at] for side, at in zip((reference, pair.side), pair.places, strict=True))
    if pair.compared is not None:
        first, second = pair.compared[0].values, pair.compared[1].values
    document: dict[str, Any] = {
        "side": _side(pair.side),
        "verdict": pair.verdict,
        "reason": pair.reason,
        "contradiction": contradiction(pair),
        "parameters": {
            "expressions": [expressions[place] for place in pair.places[0]],
            "reference": first.tolist(),
            "compared": second.tolist(),
            "difference": pair.difference.tolist(),
            "tested": "unconstrained_values" if pair.free else "values",
            "used": {"reference": pair.in_use.reference.tolist(), "compared": pair.in_use.side.tolist()},
            "used_torque_share": None if pair.in_use.shares is None else pair.in_use.shares[0].tolist(),
            "standard_deviations": None if found is None else _perhaps(found.deviations),
            "z": None if found is None else found.z.tolist(),
            "p": None if found is None else found.p.tolist(),
        },
        "only_in_reference": list(pair.only_reference),
        "only_in_compared": list(pair.only_side),
        "findings": [asdict(finding) for finding in findings(pair)],
        "causes": [
            {"kind": one.kind, "number": one.number, "explained": one.explained, "changes": dict(one.changes)}
            for one in pair.causes
        ],
        "torque_error_percent": None,
        "provenance": {key: list(both) for key, both in pair.provenance.items()},
        "notes": list(pair.notes),
    }
    if found is not None:
        document["joint_test"] = _test(found.joint) | {"p_holm": found.joint_p}
        document["effects"] = [
            {
                "kind": one.kind,
                "number": one.number,
                **_test(one.test),
                "p_holm": one.p,
                "torque_share": one.torque_share,
                "residual_share": one.residual_share,
                "changed": one.changed,
            }
            for one in found.effects
        ]
    if pair.crossed is not None:
        document["torque_error_percent"] = {
            "own": _error(pair.crossed.own),
            "reference": _error(pair.crossed.reference),
        }
    return document


def _test(test: Test) -> dict[str, Any]:
    return {
        "sigma": test.sigma,
        "directions": test.directions,
        "degrees_of_freedom": test.degrees if np.isfinite(test.degrees) else None,
        "p": test.p,
        "left_out": test.left_out,
    }


def _error(error: TorqueError) -> dict[str, Any]:
    return {"whole": error.relative_percent, "per_joint": error.joint_relative_percent.tolist()}


def _perhaps(values: Array) -> list[float | None]:
    return [float(value) if np.isfinite(value) else None for value in values]
