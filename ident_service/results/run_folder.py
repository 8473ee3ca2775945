"""Everything of one identification in one folder: the arm, parameters, URDF, report, and a manifest with hashes.

Nothing is believed of a folder that is read before every file has the hash that its manifest names.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ident_service import __version__
from ident_service.config.load import arm_from_json
from ident_service.config.schema import ArmConfig
from ident_service.errors import ParameterError, UsageError
from ident_service.estimation.identify import Estimate
from ident_service.results.export.urdf_file import write_urdf
from ident_service.results.files import write_atomically
from ident_service.results.parameter_file import (
    ParameterFile,
    parameters_document,
    read_parameters,
    write_parameters,
)
from ident_service.results.summary import parameter_table, summary

PARAMETERS, URDF, REPORT, MANIFEST = "parameters.json", "identified.urdf", "report.txt", "manifest.json"
ARM = "arm.json"
_MAX_BYTES = 64 * 2**20
_REMEDY = "identify again, or copy the folder again"


@dataclass(frozen=True)
class Results:
    """A folder of results that has been read and is what its manifest says.

    Attributes:
        folder: where it is.
        config: the arm as the parameters were identified for it, what the recordings said of its friction included.
        parameters: the parameter file.
        sha256: name to SHA-256 of every file that the manifest names.
    """

    folder: Path
    config: ArmConfig
    parameters: ParameterFile
    sha256: Mapping[str, str]


def read_results(folder: Path) -> Results:
    """Read what `write_results` and `write_manifest` wrote, here or on another machine.

    Raises:
        UsageError: no such folder, or nothing was identified in it.
        ParameterError: its files are torn, changed, foreign, or do not belong together.
        ConfigError: the arm in it is not one that this version reads.
    """
    sha256 = _verified(folder)
    for name in (PARAMETERS, ARM):
        if name not in sha256:
            raise UsageError(f"{folder}: {name} is not among its files; it comes from `ident identify` or `simulate`")
    config = arm_from_json(folder / ARM)
    parameters = read_parameters(folder / PARAMETERS)
    named = parameters.content.get("arm", {}).get("sha256")
    if named != config.sha256:
        raise ParameterError(f"{folder}: {PARAMETERS} was identified for another arm than {ARM} describes")
    return Results(folder, config, parameters, sha256)


def _verified(folder: Path) -> Mapping[str, str]:
    """Name to SHA-256, each found to be true."""
    if not folder.is_dir():
        raise UsageError(f"{folder}: no such folder; give one that `ident identify` or `ident simulate` made")
    path = folder / MANIFEST
    if not path.is_file():
        raise UsageError(f"{folder}: no {MANIFEST} in it; give a folder that `ident identify` or `ident simulate` made")
    if path.stat().st_size > _MAX_BYTES:
        raise ParameterError(f"{path}: larger than {_MAX_BYTES} bytes")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        kind, files = content["format"], dict(content["files"].items())
    except KeyError as error:
        raise ParameterError(f"{path}: not a manifest: it has no {error}; {_REMEDY}") from None
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise ParameterError(f"{path}: not a manifest: {error}; {_REMEDY}") from None
    if kind != "ident-run":
        raise ParameterError(f"{path}: not the manifest of a run: its format is {kind!r:.60}, not 'ident-run'")
    for name, wanted in files.items():
        if Path(name).name != name:
            raise ParameterError(f"{path}: not the manifest of a run: {name!r:.60} is no name of a file; {_REMEDY}")
        if not isinstance(wanted, str):
            raise ParameterError(f"{path}: not the manifest of a run: the hash of {name!r:.60} is no text; {_REMEDY}")
    for name, wanted in files.items():
        if not (folder / name).is_file():
            raise ParameterError(f"{folder / name}: named by the manifest, but not there; {_REMEDY}")
        if _sha256(folder / name) != wanted:
            raise ParameterError(f"{folder / name}: not what the manifest names; it was changed, or is torn; {_REMEDY}")
    return dict(files)


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


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
    write_atomically(folder / ARM, estimate.model.config.model_dump_json(indent=1) + "\n")
    names = [PARAMETERS, ARM]
    if estimate.delta is not None:
        write_urdf(folder / URDF, estimate.model, estimate.delta)
        names.append(URDF)
    write_atomically(folder / REPORT, summary(estimate) + "\n" + parameter_table(estimate))
    return [*names, REPORT]


def write_manifest(folder: Path) -> None:
    """Name and SHA-256 of every file in the folder, for verification on another machine."""
    manifest = {
        "format": "ident-run",
        "version": 1,
        "software": f"ident-service {__version__}",
        "files": hashes(folder),
    }
    write_atomically(folder / MANIFEST, json.dumps(manifest, indent=1) + "\n")


def hashes(folder: Path) -> dict[str, str]:
    """Name to SHA-256 of every file in a folder but its manifest and hidden ones."""
    paths = [path for path in sorted(folder.iterdir()) if path.is_file() and not path.name.startswith(".")]
    return {path.name: _sha256(path) for path in paths if path.name != MANIFEST}
