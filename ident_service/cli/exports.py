"""Register and run the verb `export`: write identified parameters in the formats of other tools."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ident_service.cli.answer import DONE, Answer, own_state_folder
from ident_service.cli.words import Verbs

_FORMATS = "urdf,mjcf,sdf,json,csv,c"


def add(verbs: Verbs) -> None:
    """Register `export`."""
    sub = verbs.add("export", _export, "identified parameters for other tools, each file read back and checked")
    sub.add_argument("run", type=Path, metavar="RUN", help="folder of results of `identify` or `simulate`")
    sub.add_argument("--format", default=_FORMATS, metavar="LIST", help=f"with commas between (default: {_FORMATS})")
    sub.add_argument("--out", type=Path, metavar="DIR", help="default: a new folder below the state folder")


def _export(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.folders import new_run_folder
    from ident_service.results.export.formats import export_run, known_formats

    formats = known_formats(arguments.format)
    folder = arguments.out or new_run_folder(own_state_folder(arguments), arguments.run.resolve().name, "exports")
    made = export_run(arguments.run, formats, folder)
    lines, files = [f"files: {folder}"], []
    for export in made:
        lines.append(f"  {export.name} ({export.format})")
        lines += [f"    has no place for: {what}" for what in export.not_carried]
        lines += [f"    {note}" for note in export.notes]
        entry: dict[str, Any] = {"format": export.format, "file": export.name}
        files.append({**entry, "not_carried": list(export.not_carried), "notes": list(export.notes)})
    return DONE, "\n".join(lines) + "\n", {"folder": str(folder), "files": files}
