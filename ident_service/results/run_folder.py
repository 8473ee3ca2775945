"""Write and read one identification in one folder: arm, parameters, URDF, report, and a manifest with hashes.

Nothing is believed of a folder that is read before every file has the hash that its manifest names.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ident_service import certificate_verifier
from ident_service.config.arm import ArmConfig
from ident_service.config.load import arm_from_json
from ident_service.errors import ParameterError, UsageError
from ident_service.estimation.identify import Estimate
from ident_service.results.export.urdf import write_urdf
from ident_service.results.manifest import MANIFEST as MANIFEST
from ident_service.results.manifest import hashes as hashes
from ident_service.results.manifest import verified_files, write_atomically
from ident_service.results.manifest import write_manifest as write_manifest
from ident_service.results.parameter_file import (
    ParameterFile,
    parameters_document,
    read_parameters,
    write_parameters,
)
from ident_service.results.summary import parameter_table, summary

PARAMETERS, URDF, REPORT = "parameters.json", "identified.urdf", "report.txt"
ARM, VERIFIER = "arm.json", "verify.py"


@dataclass(frozen=True)
class Results:
    """Folder of results that has been read and is what its manifest says.

    Attributes:
        folder: folder of the results.
        config: the arm as the parameters were identified for it, what the recordings said of its friction included.
        parameters: the parameter file.
        sha256: name to SHA-256 of every file that the manifest names.
    """

    folder: Path
    config: ArmConfig
    parameters: ParameterFile
    sha256: Mapping[str, str]


def read_results(folder: Path) -> Results:
    """Read a folder of results, each file verified by its manifest; raise unless arm and parameters fit together.

    Raises:
        UsageError: no such folder, or nothing was identified in it.
        ParameterError: its files are torn, changed, foreign, or do not belong together.
        ConfigError: the arm in it is not one that this version reads.
    """
    sha256 = verified_files(folder)
    for name in (PARAMETERS, ARM):
        if name not in sha256:
            raise UsageError(f"{folder}: {name} is not among its files; it comes from `ident identify` or `simulate`")
    config = arm_from_json(folder / ARM)
    parameters = read_parameters(folder / PARAMETERS)
    named = parameters.content.get("arm", {}).get("sha256")
    if named != config.sha256:
        raise ParameterError(f"{folder}: {PARAMETERS} was identified for another arm than {ARM} describes")
    return Results(folder, config, parameters, sha256)


def write_results(
    folder: Path,
    estimate: Estimate,
    more_entries: dict[str, Any] | None = None,
    unusable: Sequence[str] = (),
    described: ArmConfig | None = None,
    torque_kind: str = "commanded",
) -> list[str]:
    """Write an estimate's files and its certificate's verifier into a folder, no manifest; return their names.

    Args:
        folder: folder to write.
        estimate: estimate to write.
        more_entries: further entries of `parameters.json`.
        unusable: reasons why the estimate must not be used.
        described: the arm's description as it was read, where options or recordings changed it.
        torque_kind: kind of torque in the recordings: `measured` by the drives, `commanded`, or `recorded` by another
            program.

    Returns:
        The names of the files. An estimate that no body has comes without a URDF, because URDF cannot express it.
    """
    document = (
        parameters_document(estimate, described)
        | {"unusable": list(unusable), "torque": torque_kind}
        | (more_entries or {})
    )
    write_parameters(folder / PARAMETERS, document)
    write_atomically(folder / ARM, estimate.model.config.model_dump_json(indent=1) + "\n")
    names = [PARAMETERS, ARM]
    if estimate.delta is not None:
        write_urdf(folder / URDF, estimate.model, estimate.delta)
        names.append(URDF)
    text = summary(estimate, unusable, torque_kind, document.get("warnings", ()))
    write_atomically(folder / REPORT, text + "\n" + parameter_table(estimate))
    write_verifier(folder)
    return [*names, REPORT, VERIFIER]


def write_verifier(folder: Path) -> None:
    """Write the verifier into a folder of results: one file of the standard library alone."""
    write_atomically(folder / VERIFIER, Path(certificate_verifier.__file__).read_text(encoding="utf-8"))
