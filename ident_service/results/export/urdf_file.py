"""Write URDF: the arm's own file with identified values where a URDF describes it, a generated one elsewhere.

URDF has a place for viscous and dry friction of a joint, none for gravity, drive inertia or any other term.
"""

from __future__ import annotations

import re
from pathlib import Path

from ident_service.config.quantities import TextFile
from ident_service.config.schema import JointTerm
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import Array
from ident_service.model.urdf import urdf_text
from ident_service.results.export.check import (
    carried,
    gravity_of,
    left_out,
    presliding_left_out,
    require_same_torques,
)
from ident_service.results.export.original_urdf import original_urdf
from ident_service.results.export.words import plain
from ident_service.results.files import write_atomically

_MARK = "ident-service: "
_EARLIER = re.compile(rf"(?:<!-- {_MARK}[^<>]*-->\n)+\Z")
_TERMS: tuple[JointTerm, ...] = ("viscous", "coulomb")


def urdf_export(
    model: ArmModel, delta: Array, name: str, said: tuple[str, ...] = ()
) -> tuple[str, tuple[str, ...], tuple[str, ...]]:
    """Return the identified URDF, after pinocchio has read it back with the same torques.

    Args:
        model: the arm.
        delta: link parameters, shape (layout.size,).
        name: of the file, for errors.
        said: of its bodies, for a comment at its end.

    Returns:
        The text, what it does not carry, and notes.

    Raises:
        ModelError: a link has no positive mass, or the file does not say what it should.
    """
    from ident_service.model.dynamic_model import read_back

    has = carried(model, delta, _TERMS)
    notes: tuple[str, ...] = ()
    own = model.config.kinematics if model.config.kinematics.urdf is not None else None
    if own is not None:
        text, notes = original_urdf(model, delta, has)
    else:
        text = urdf_text(model, delta)
    gravity = "gravity" if model.chain.gravity.any() else ""
    unwritten = left_out(model, delta, has)
    text = _commented(text, (*presliding_left_out(model, delta), *said))
    written = read_back(TextFile(name=name, text=text), "urdf", gravity_of(model), own)
    require_same_torques(model, delta, written, has, name)
    return text, tuple(filter(None, (gravity, *unwritten))), notes


def _commented(text: str, said: tuple[str, ...]) -> str:
    """Return the text with comments at the end instead of those of an earlier export; all else is as it was."""
    kept = _EARLIER.sub("", text)
    if not said:
        return kept
    return kept + ("" if kept.endswith("\n") else "\n") + "".join(f"<!-- {_MARK}{plain(one)}. -->\n" for one in said)


def write_urdf(path: Path, model: ArmModel, delta: Array) -> None:
    """Write the identified URDF, after pinocchio has read it back with the same torques.

    Args:
        path: the file.
        model: the arm.
        delta: link parameters, shape (layout.size,).

    Raises:
        ModelError: a link has no positive mass, or the file does not say what it should.
        UsageError: the file cannot be written.
    """
    text, _, _ = urdf_export(model, delta, str(path))
    write_atomically(path, text)
