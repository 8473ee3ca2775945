"""Verbs about parameters that are there already: `base`, `feasible`, `correct`, `verify`.

Boundary: words to calls, results to words; the work is `model/base.py`, `service/parameters.py`, `service/verify.py`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ident_service.cli.answer import DONE, VERDICT_NO, Answer
from ident_service.cli.words import FEASIBLE_SETS, Verbs
from ident_service.errors import ParameterError


def add(verbs: Verbs) -> None:
    """Register `base`, `feasible`, `correct` and `verify`."""
    sub = verbs.add("base", _base, "base parameters and their expressions")
    sub.add_argument("arm", metavar="ARM")

    sub = verbs.add("feasible", _feasible, "could a real body have these parameters? (exit code 3: no)")
    sub.add_argument("file", type=Path, metavar="FILE")
    sub.add_argument("--feasible-set", choices=FEASIBLE_SETS)
    sub.add_argument("--arm", metavar="ARM", help="adds the arm's mass, centre-of-mass and sign conditions")

    sub = verbs.add("correct", _correct, "the nearest feasible parameters")
    sub.add_argument("file", type=Path, metavar="FILE")
    sub.add_argument("--metric", choices=["euclidean", "covariance"], default="euclidean", help="what nearest means")
    sub.add_argument("--out", type=Path, required=True, metavar="FILE")
    sub.add_argument("--feasible-set", choices=FEASIBLE_SETS)
    sub.add_argument("--arm", metavar="ARM", help="adds the arm's mass, centre-of-mass and sign conditions")

    sub = verbs.add("verify", _verify, "check a certificate in exact arithmetic (exit code 3: not proven feasible)")
    sub.add_argument("file", type=Path, metavar="FILE")


def _base(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.load import load_arm
    from ident_service.model.arm_model import arm_model
    from ident_service.model.base import base_parameters

    model = arm_model(load_arm(arguments.arm))
    base = base_parameters(model.chain, model.layout)
    text = "".join(f"{number:4d}  {expression}\n" for number, expression in enumerate(base.expressions, 1))
    text += f"{base.size} base parameters of {len(base.names)} link parameters\n"
    return (
        DONE,
        text,
        {
            "arm": model.config.name,
            "link_parameters": list(base.names),
            "base_parameters": {"expressions": list(base.expressions), "units": list(base.units)},
        },
    )


def _feasible(arguments: argparse.Namespace) -> Answer:
    from ident_service.service.parameters import check_file

    tested = check_file(arguments.file, arguments.feasible_set, arguments.arm)
    result = tested.result
    word = "feasible" if result.feasible else "INFEASIBLE"
    text = f"{arguments.file}: {word} ({tested.kind}), margin {result.margin:.6g}\n"
    if not result.feasible:
        text += "contradicted by:\n" + "".join(f"  {name}\n" for name in result.tight)
    document = {
        "file": str(arguments.file),
        "feasible_set": tested.kind,
        "feasible": result.feasible,
        "margin": result.margin,
        "tight": list(result.tight),
    }
    return (DONE if result.feasible else VERDICT_NO), text, document


def _correct(arguments: argparse.Namespace) -> Answer:
    from ident_service.service.parameters import correct_file

    corrected = correct_file(arguments.file, arguments.out, arguments.feasible_set, arguments.arm, arguments.metric)
    result = corrected.result
    text = (
        f"{arguments.out}: feasible ({corrected.kind}), margin {result.margin:.3g}, "
        f"{result.objective:.6g} away from {arguments.file} in the {arguments.metric} metric\n"
    )
    document = {
        "file": str(arguments.out),
        "feasible_set": corrected.kind,
        "distance": result.objective,
        "margin": result.margin,
        "values": result.beta.tolist(),
    }
    return DONE, text, document


def _verify(arguments: argparse.Namespace) -> Answer:
    from ident_service.service.verify import verify_file

    result = verify_file(arguments.file)
    if result.verdict == "failed" and result.message.startswith("not a parameter file"):
        raise ParameterError(f"{arguments.file}: {result.message}")
    text = f"{arguments.file}: {result.verdict}: {result.message}\n" + "".join(f"  {line}\n" for line in result.checked)
    document = {"file": str(arguments.file), "verdict": result.verdict, "message": result.message}
    return (DONE if result.verdict == "feasible" else VERDICT_NO), text, document | {"checked": list(result.checked)}
