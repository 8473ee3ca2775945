"""Verbs that hold results against each other: `compare`.

Boundary: words to calls, results to words; the work is `service/comparison.py`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ident_service.cli.answer import DONE, VERDICT_NO, Answer
from ident_service.cli.words import Verbs


def add(verbs: Verbs) -> None:
    """Register `compare`."""
    sub = verbs.add("compare", _compare, "has the arm changed? (exit code 3: yes, or it cannot be said)")
    sub.add_argument("reference", type=Path, metavar="A", help="folder of results, or parameters.json: the reference")
    sub.add_argument("others", type=Path, nargs="+", metavar="B", help="what is compared with it")
    sub.add_argument("--out", type=Path, metavar="PATH", help="FILE.json, or a folder for JSON and text")


def _compare(arguments: argparse.Namespace) -> Answer:
    from ident_service.results.comparison_document import comparison_document
    from ident_service.results.comparison_text import comparison_text
    from ident_service.service.comparison import compare_files

    comparison, files = compare_files([arguments.reference, *arguments.others], arguments.out)
    text = comparison_text(comparison) + "".join(f"file: {path}\n" for path in files)
    document = comparison_document(comparison) | {"files": [str(path) for path in files]}
    return (DONE if comparison.verdict == "unchanged" else VERDICT_NO), text, document
