"""Identify the payload of an identified arm from recordings and write a folder, as `ident payload` does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ident_service.errors import ParameterError, UsageError
from ident_service.estimation.fit import gather
from ident_service.estimation.payload import KnownArm, Payload, identify_payload
from ident_service.model.arm_model import arm_model
from ident_service.operations.comparison import write_comparison_files
from ident_service.operations.recordings import open_together, require_no_fault
from ident_service.recordings.part import overlap
from ident_service.recordings.recording import Recording
from ident_service.results.comparison.comparison import Comparison, compare
from ident_service.results.comparison.sides import Side, read_side
from ident_service.results.export.urdf_file import write_urdf
from ident_service.results.files import require_place, write_atomically
from ident_service.results.parameter_file import read_parameters, write_parameters
from ident_service.results.payload_document import (
    loaded_config,
    loaded_parameters,
    payload_document,
    payload_text,
    write_payload,
)
from ident_service.results.replacing import replacing_folder, require_replaceable
from ident_service.results.run_folder import ARM, MANIFEST, PARAMETERS, URDF, VERIFIER, write_manifest, write_verifier

DOCUMENT, TEXT = "payload.json", "payload.txt"


@dataclass(frozen=True)
class Found:
    """Result of a payload identification, and the files written.

    Attributes:
        arm: as it was identified.
        payload: what it carries.
        document: the content of `payload.json`.
        text: for a person.
        comparison: the arm against the arm with its load; None where there is no body.
        files: names of the files in the folder.
    """

    arm: KnownArm
    payload: Payload
    document: dict[str, Any]
    text: str
    comparison: Comparison | None
    files: tuple[str, ...]


def payload_files(run: Path, recordings: Sequence[Path], out: Path, *, refit_offsets: bool = False) -> Found:
    """Identify the payload that an identified arm carries, and write the results.

    Args:
        run: folder of results of the arm.
        recordings: with the load; a path may end in `@START:END`, the seconds to read.
        out: where results go; an earlier result there is replaced as a whole.
        refit_offsets: whether torque offsets may differ from those of the arm.

    Raises:
        UsageError, ConfigError, ParameterError: the folder cannot be used, or is no folder of results.
        RecordingError: a recording cannot be used, or ended in a fault.
        SolverError: the solver stopped without an optimum.
    """
    require_place(out)
    if not run.is_dir():
        raise UsageError(f"{run}: not a folder; give the folder of results of the arm without the load")
    if out.exists() and out.samefile(run):
        raise UsageError(f"{out}: would replace the arm's own parameters; give another folder")
    require_replaceable(out)
    side = read_side(run)
    arm = known_arm(side)
    known = side.content.get("torque")  # the torque difference is the load's only if both torques are of the same kind
    opened = open_together(
        recordings, arm.model, torque=known if known in ("measured", "commanded") else None
    ).recordings
    _require_new(side, opened)
    for path, recording in zip(recordings, opened, strict=True):
        require_no_fault(path, recording)
    scales = np.array(side.content.get("torque_scales", np.ones(arm.model.chain.joints)), dtype=float)
    recorded = gather(opened, arm.model, arm.base).with_torques_times(scales)
    payload = identify_payload(arm, recorded, refit_offsets=refit_offsets)
    sources = [{"name": one.path.name, "sha256": one.sha256} for one in opened]
    document = payload_document(payload, arm, side.sha256, sources)
    text, comparison = payload_text(payload, arm), None
    with replacing_folder(out) as staging:
        write_payload(staging / DOCUMENT, document)
        write_atomically(staging / TEXT, text)
        names = [DOCUMENT, TEXT]
        if payload.body is not None:
            content, delta = loaded_parameters(side.content, arm, payload, recorded, sources)
            write_parameters(staging / PARAMETERS, content)
            write_verifier(staging)
            write_atomically(staging / ARM, loaded_config(arm.model.config).model_dump_json(indent=1) + "\n")
            names += [PARAMETERS, VERIFIER, ARM]
            if delta is not None:
                write_urdf(staging / URDF, arm.model, delta)
                names.append(URDF)
            comparison = _compared(side, staging, out)
            names += write_comparison_files(staging, comparison)
        write_manifest(staging)
    return Found(arm, payload, document, text, comparison, (*names, MANIFEST))


def known_arm(side: Side) -> KnownArm:
    """Return the identified arm of a folder of results.

    Raises:
        ParameterError: the parameters have no covariance, or belong to another mechanism.
    """
    if side.config is None:
        raise ParameterError(f"{side.path}: a payload needs the arm's model; give a folder of results")
    if side.covariance is None:
        raise ParameterError(f"{side.path}: its parameters have no covariance; identify the arm again")
    model = arm_model(side.config)
    file = read_parameters(side.path / PARAMETERS, model.layout.names)
    fit = side.content.get("fit", {})
    residual = np.array([one["rms"] for one in fit.get("per_joint", [])], dtype=float)
    known = residual if residual.shape == (model.chain.joints,) else None
    return KnownArm(model, file.base, file.values, side.covariance, fit.get("blocks"), known)


def _require_new(side: Side, recordings: Sequence[Recording]) -> None:
    fitted = {one["sha256"] for one in side.content.get("provenance", {}).get("recordings", [])}
    for index, recording in enumerate(recordings):
        if recording.sha256 in fitted:
            raise UsageError(f"{recording.path}: the arm was identified from it; give a recording with the load")
        if any(overlap(recording, other) for other in recordings[:index]):
            raise UsageError(f"{recording.path}: the same recording twice would make the doubt too small")


def _compared(side: Side, staging: Path, out: Path) -> Comparison:
    """Return the comparison of the arm with the arm under load, under the paths of the final folder."""
    loaded = read_side(staging / PARAMETERS)
    config = None if side.config is None else loaded_config(side.config)
    return compare([side, Side(out / PARAMETERS, loaded.sha256, loaded.file, config)])
