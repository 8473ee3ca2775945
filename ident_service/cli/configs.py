"""Register and run the verbs about arm descriptions: `new`, `config check`."""

from __future__ import annotations

import argparse
from pathlib import Path

from ident_service.cli.answer import DONE, VERDICT_NO, Answer, print_to_person
from ident_service.cli.words import Verbs


def add(verbs: Verbs) -> None:
    """Register `new` and `config check`."""
    new = verbs.add("new", _new, "write a first description of an arm from its URDF, with a simulated arm to try it")
    new.add_argument("urdf", metavar="URDF", type=Path)
    new.add_argument("--out", metavar="FILE", type=Path, help="where it goes (default: NAME.yaml, here)")
    new.add_argument("--name", help="of the arm (default: the URDF's file name)")
    new.add_argument("--base", metavar="LINK", help="that the arm stands on (default: the root)")
    new.add_argument("--tip", metavar="LINK", help="that it ends at (default: where the gripper begins)")
    config = verbs.group("config", "arm descriptions")
    check = config.add(
        "check", _check, "every mistake with file, line and column; whether the gains are stable (exit code 3: not)"
    )
    check.add_argument("file", metavar="FILE")


def _new(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.new_description import new_description

    def tell(line: str) -> None:
        print_to_person(f"{line} ...\n")

    words = (arguments.urdf, arguments.out, arguments.name, arguments.base, arguments.tip)
    path, guessed = new_description(*words, tell)
    lines = [f"{path}: a first description, and a simulated arm to try it with"]
    lines += ["guessed or chosen:", *(f"  {line}" for line in guessed)] if guessed else []
    lines += ["next:", f"  ident config check {path}", f"  ident simulate {path}"]
    return DONE, "\n".join(lines), {"description": str(path), "guessed": list(guessed)}


def _check(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.description_check import check_description, description_document, description_text

    checked = check_description(arguments.file)
    document = {"file": arguments.file, **description_document(checked)}
    return DONE if checked.good else VERDICT_NO, description_text(arguments.file, checked), document
