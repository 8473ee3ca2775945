"""Verbs about arm descriptions: `config check`.

Boundary: words to calls, results to words; the work is `service/description_check.py`.
"""

from __future__ import annotations

import argparse

from ident_service.cli.answer import DONE, VERDICT_NO, Answer
from ident_service.cli.words import Verbs


def add(verbs: Verbs) -> None:
    """Register `config check`."""
    config = verbs.group("config", "arm descriptions")
    check = config.add(
        "check", _check, "every mistake with file, line and column; whether the gains are stable (exit code 3: not)"
    )
    check.add_argument("file", metavar="FILE")


def _check(arguments: argparse.Namespace) -> Answer:
    from ident_service.service.description_check import check_description, description_document, description_text

    checked = check_description(arguments.file)
    document = {"file": arguments.file, **description_document(checked)}
    return DONE if checked.good else VERDICT_NO, description_text(arguments.file, checked), document
