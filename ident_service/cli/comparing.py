"""Register and run `compare` (results with results) and `payload` (results with recordings under load)."""

from __future__ import annotations

import argparse
from pathlib import Path

from ident_service.cli.answer import DONE, VERDICT_NO, Answer, own_state_folder
from ident_service.cli.words import Verbs
from ident_service.errors import UsageError


def add(verbs: Verbs) -> None:
    """Register `compare` and `payload`."""
    sub = verbs.add("compare", _compare, "has the arm changed? (exit code 3: yes, or it cannot be said)")
    sub.add_argument("reference", type=Path, metavar="A", help="folder of results, or parameters.json: the reference")
    sub.add_argument("others", type=Path, nargs="+", metavar="B", help="what is compared with it")
    out = sub.add_mutually_exclusive_group()
    out.add_argument("--out", type=Path, metavar="PATH", help="FILE.json, or a folder for JSON, text and page")
    out.add_argument("--keep", action="store_true", help="in the folder B itself, named by its manifest; one B")

    sub = verbs.add("payload", _payload, "what does an identified arm carry? (exit code 3: nothing, or no real body)")
    sub.add_argument("run", type=Path, metavar="RUN", help="folder of results of the arm without the load")
    sub.add_argument("recordings", nargs="+", type=Path, metavar="RECORDING", help="with the load; or FILE@41:60")
    sub.add_argument("--refit-offsets", action="store_true", help="torque offsets may differ from the arm's")
    sub.add_argument(
        "--out", type=Path, metavar="DIR", help="where results go (default: a new folder below the state folder)"
    )


def _compare(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.comparison import KEPT, compare_files, compare_into
    from ident_service.results.comparison.document import comparison_document
    from ident_service.results.comparison.text import comparison_text

    if arguments.keep:
        if len(arguments.others) != 1 or not arguments.others[0].is_dir():
            raise UsageError("--keep is for one folder of results that is compared with the reference")
        folder = arguments.others[0]
        comparison, files = compare_into(arguments.reference, folder), tuple(folder / name for name in KEPT)
    else:
        comparison, files = compare_files([arguments.reference, *arguments.others], arguments.out)
    text = comparison_text(comparison) + "".join(f"file: {path}\n" for path in files)
    document = comparison_document(comparison) | {"files": [str(path) for path in files]}
    return (DONE if comparison.verdict == "unchanged" else VERDICT_NO), text, document


def _payload(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.folders import new_run_folder
    from ident_service.operations.payload import payload_files
    from ident_service.results.comparison.text import comparison_text

    folder = arguments.out or new_run_folder(own_state_folder(arguments), arguments.run.resolve().name, "payloads")
    found = payload_files(arguments.run, arguments.recordings, folder, refit_offsets=arguments.refit_offsets)
    text = found.text
    if found.comparison is not None:
        text += "\n" + comparison_text(found.comparison)
    text += f"files: {folder}\n" + "".join(f"  {name}\n" for name in found.files)
    code = DONE if found.payload.verdict in ("added", "removed") else VERDICT_NO
    return code, text, found.document | {"folder": str(folder), "files": list(found.files)}
