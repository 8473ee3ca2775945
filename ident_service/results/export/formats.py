"""Define the export formats, and write several of them: all of them appear, or none.

What each format carries is said where it is written; what of this arm it did not carry comes with the answer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ident_service.errors import UsageError
from ident_service.results.export.arm import IdentifiedArm, read_identified
from ident_service.results.export.bodies_said import body_notes
from ident_service.results.export.c_header import c_header, c_prefix, turning_said
from ident_service.results.export.json_model import json_export
from ident_service.results.export.mjcf import mjcf_export
from ident_service.results.export.sdf import sdf_export
from ident_service.results.export.table import csv_export
from ident_service.results.export.urdf_file import urdf_export
from ident_service.results.files import appearing_folder, write_atomically


@dataclass(frozen=True)
class Export:
    """File of an export, with the data that it does not carry.

    Attributes:
        format: of `FORMATS`.
        name: of the file.
        text: its content.
        not_carried: what of the arm the format has no place for, in words.
        notes: what else its reader should know.
    """

    format: str
    name: str
    text: str
    not_carried: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


_BASE_ONLY = "no body has these parameters: base parameters only"


def _urdf(arm: IdentifiedArm) -> Export:
    name = f"{arm.model.config.name}.urdf"
    said = body_notes(arm)
    text, lost, notes = urdf_export(arm.model, arm.body(), name, said)
    return Export("urdf", name, text, lost, (*notes, *said))


def _mjcf(arm: IdentifiedArm) -> Export:
    name = f"{arm.model.config.name}.xml"
    said = body_notes(arm)
    text, lost = mjcf_export(arm.model, arm.body(), name, said)
    return Export("mjcf", name, text, lost, said)


def _sdf(arm: IdentifiedArm) -> Export:
    name = f"{arm.model.config.name}.sdf"
    said = body_notes(arm)
    text, lost, notes = sdf_export(arm.model, arm.body(), name, said)
    return Export("sdf", name, text, lost, (*notes, *said))


def _json(arm: IdentifiedArm) -> Export:
    name = f"{arm.model.config.name}.json"
    return Export("json", name, json_export(arm, name), notes=_notes(arm))


def _csv(arm: IdentifiedArm) -> Export:
    name = f"{arm.model.config.name}.csv"
    lost = ("kinematics",)
    return Export("csv", name, csv_export(arm, name), lost, _notes(arm))


def _c(arm: IdentifiedArm) -> Export:
    notes = (*turning_said(arm), *filter(None, (arm.sigma_said,)))
    return Export("c", f"{c_prefix(arm)}_dynamics.h", c_header(arm), notes=notes)


def _notes(arm: IdentifiedArm) -> tuple[str, ...]:
    """Return the notes of the formats with base and link values."""
    notes = (_BASE_ONLY,) if arm.delta is None else body_notes(arm)
    return (*notes, arm.sigma_said) if arm.sigma_said else notes


FORMATS: dict[str, Callable[[IdentifiedArm], Export]] = {
    "urdf": _urdf,
    "mjcf": _mjcf,
    "sdf": _sdf,
    "json": _json,
    "csv": _csv,
    "c": _c,
}


def known_formats(words: str) -> tuple[str, ...]:
    """Parse formats named in a list with commas, each once.

    Raises:
        UsageError: none, or one that is not there.
    """
    named = tuple(dict.fromkeys(word.strip() for word in words.split(",") if word.strip()))
    if unknown := [word for word in named if word not in FORMATS]:
        raise UsageError(f"no export format {', '.join(map(repr, unknown))}: formats are {', '.join(FORMATS)}")
    if not named:
        raise UsageError(f"no export format given: formats are {', '.join(FORMATS)}")
    return named


def export_texts(arm: IdentifiedArm, formats: Sequence[str]) -> tuple[Export, ...]:
    """Return the files of an export, each read back and found to say what the parameters say.

    Raises:
        UsageError: no such format.
        ModelError: a format cannot carry the arm, the message says why.
    """
    return tuple(FORMATS[name](arm) for name in known_formats(",".join(formats)))


def export_run(run: Path, formats: Sequence[str], folder: Path) -> tuple[Export, ...]:
    """Export a folder of results: all files, or none.

    Args:
        run: the folder, every file in it as its manifest says.
        formats: of `FORMATS`.
        folder: where the files appear; others in it stay.

    Returns:
        What was written, without the texts.

    Raises:
        UsageError: no such format or folder, or nothing can be written there.
        ParameterError: the files of the run are torn, changed or foreign.
        ConfigError, ModelError: the arm in it cannot be used, or a format cannot carry it.
    """
    made = export_texts(read_identified(run), formats)
    with appearing_folder(folder) as staging:
        for export in made:
            write_atomically(staging / export.name, export.text)
    return tuple(replace(export, text="") for export in made)
