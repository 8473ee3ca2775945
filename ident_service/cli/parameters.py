"""Register and run the verbs about existing parameters: `base`, `feasible`, `correct`, `verify`."""

from __future__ import annotations

import argparse
from pathlib import Path

from ident_service.cli.answer import DONE, VERDICT_NO, Answer
from ident_service.cli.words import FEASIBLE_SETS, Verbs
from ident_service.errors import ParameterError
from ident_service.model.notation import NOTATIONS


def add(verbs: Verbs) -> None:
    """Register `base`, `feasible`, `correct` and `verify`."""
    sub = verbs.add("base", _base, "base parameters and their expressions")
    sub.add_argument("arm", metavar="ARM")

    sub = verbs.add("feasible", _feasible, "could a real body have these parameters? (exit code 3: no)")
    sub.add_argument("file", type=Path, metavar="FILE")
    sub.add_argument("--feasible-set", choices=FEASIBLE_SETS)
    sub.add_argument("--arm", metavar="ARM", help="adds the arm's mass, centre-of-mass and sign conditions")
    sub.add_argument("--notation", choices=NOTATIONS, help="of the file's names, where it is not ours")

    sub = verbs.add("correct", _correct, "the nearest feasible parameters")
    sub.add_argument("file", type=Path, metavar="FILE")
    sub.add_argument("--metric", choices=["euclidean", "covariance"], default="euclidean", help="what nearest means")
    sub.add_argument("--out", type=Path, required=True, metavar="FILE")
    sub.add_argument("--feasible-set", choices=FEASIBLE_SETS)
    sub.add_argument("--arm", metavar="ARM", help="adds the arm's mass, centre-of-mass and sign conditions")
    sub.add_argument("--notation", choices=NOTATIONS, help="of the file's names, where it is not ours")

    sub = verbs.add(
        "verify", _verify, "check a certificate in exact arithmetic (exit code 3: infeasible, or not valid)"
    )
    sub.add_argument("file", type=Path, metavar="FILE", help="parameters.json, or the folder that holds it")
    sub.add_argument(
        "--arm",
        metavar="ARM",
        help="description that the conditions must come from; without it, a file is held against its own conditions",
    )


def _base(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.load import load_arm
    from ident_service.model.arm_model import arm_model
    from ident_service.model.base import base_parameters, remarks_on_angles

    model = arm_model(load_arm(arguments.arm))
    base = base_parameters(model.chain, model.layout)
    warnings = remarks_on_angles(base)
    text = "".join(f"{number:4d}  {expression}\n" for number, expression in enumerate(base.expressions, 1))
    text += f"{base.size} base parameters of {len(base.names)} link parameters\n"
    text += "".join(f"WARNING: {line}\n" for line in warnings)
    return (
        DONE,
        text,
        {
            "arm": model.config.name,
            "warnings": list(warnings),
            "link_parameters": list(base.names),
            "base_parameters": {"expressions": list(base.expressions), "units": list(base.units)},
        },
    )


def _feasible(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.parameters import check_file

    tested = check_file(arguments.file, arguments.feasible_set, arguments.arm, arguments.notation)
    result = tested.result
    word = "feasible" if result.feasible else "INFEASIBLE"
    text = f"{arguments.file}: {word} ({tested.kind}), margin {result.margin:.6g}\n"
    if not result.feasible:
        text += "contradicted by:\n" + "".join(f"  {name}\n" for name in result.tight)
    text += "".join(f"note: {note}\n" for note in tested.notes)
    document = {
        "file": str(arguments.file),
        "feasible_set": tested.kind,
        "feasible": result.feasible,
        "margin": result.margin,
        "tight": list(result.tight),
        "notes": list(tested.notes),
    }
    return (DONE if result.feasible else VERDICT_NO), text, document


def _correct(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.parameters import correct_file

    corrected = correct_file(
        arguments.file, arguments.out, arguments.feasible_set, arguments.arm, arguments.metric, arguments.notation
    )
    result = corrected.result
    text = (
        f"{arguments.out}: feasible ({corrected.kind}), margin {result.margin:.3g}, "
        f"{result.objective:.6g} away from {arguments.file} in the {arguments.metric} metric\n"
    )
    text += "".join(f"note: {note}\n" for note in corrected.notes)
    document = {
        "file": str(arguments.out),
        "feasible_set": corrected.kind,
        "distance": result.objective,
        "margin": result.margin,
        "values": result.beta.tolist(),
        "notes": list(corrected.notes),
    }
    return DONE, text, document


def _verify(arguments: argparse.Namespace) -> Answer:
    from ident_service.certificate_verifier import answer_text
    from ident_service.operations.verify import verify_file

    result = verify_file(arguments.file, arguments.arm)
    if result.verdict == "failed" and result.message.startswith("not a parameter file"):
        raise ParameterError(f"{arguments.file}: {result.message}")
    document = {
        "file": str(arguments.file),
        "arm": result.arm,
        "verdict": result.verdict,
        "message": result.message,
        "checked": list(result.checked),
    }
    return (DONE if result.verdict == "feasible" else VERDICT_NO), answer_text(arguments.file, result), document
