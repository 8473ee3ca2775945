"""Everything of one identification in one folder: parameters, URDF, report, and a manifest with hashes."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from ident_service import __version__
from ident_service.estimation.identify import Estimate
from ident_service.results.exports import write_urdf
from ident_service.results.files import write_atomically
from ident_service.results.parameter_file import parameters_document, write_parameters
from ident_service.results.summary import parameter_table, summary

PARAMETERS, URDF, REPORT, MANIFEST = "parameters.json", "identified.urdf", "report.txt", "manifest.json"


def write_results(folder: Path, estimate: Estimate, more: dict[str, Any] | None = None) -> list[str]:
    """Write an estimate's files into an existing folder.

    Args:
        folder: where to.
        estimate: what to write.
        more: further entries of `parameters.json`.

    Returns:
        The names of the files. An estimate that no body has comes without a URDF, because URDF cannot express it.
    """
    write_parameters(folder / PARAMETERS, parameters_document(estimate) | (more or {}))
    names = [PARAMETERS]
    if estimate.delta is not None:
        write_urdf(folder / URDF, estimate.model, estimate.delta)
        names.append(URDF)
    write_atomically(folder / REPORT, summary(estimate) + "\n" + parameter_table(estimate))
    return [*names, REPORT]


def write_manifest(folder: Path) -> None:
    """Name and SHA-256 of every file in the folder, for verification on another machine."""
    files = {}
    for path in sorted(folder.iterdir()):
        if path.is_file() and path.name != MANIFEST and not path.name.startswith("."):
            with path.open("rb") as stream:
                files[path.name] = hashlib.file_digest(stream, "sha256").hexdigest()
    manifest = {"format": "ident-run", "version": 1, "software": f"ident-service {__version__}", "files": files}
    write_atomically(folder / MANIFEST, json.dumps(manifest, indent=1) + "\n")
