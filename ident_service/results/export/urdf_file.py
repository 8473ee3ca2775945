"""Exports, each read back by an independent reader before it is kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ident_service.config.quantities import TextFile
from ident_service.errors import ModelError
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import Array
from ident_service.model.urdf import urdf_text
from ident_service.results.files import write_atomically

_AGREEMENT = 1e-9


def write_urdf(path: Path, model: ArmModel, delta: Array) -> None:
    """Write the identified URDF, after pinocchio has read the same inertias out of it.

    Args:
        path: the file.
        model: the arm.
        delta: link parameters, shape (layout.size,).

    Raises:
        ModelError: a link has no positive mass, or the file does not say what it should.
        UsageError: the file cannot be written.
    """
    from ident_service.model.rigid_body import delta_from_inertia, joint_frame_inertias, read_urdf

    text = urdf_text(model, delta)
    chain, found = read_urdf(TextFile(name=path.name, text=text), model.config.gravity)
    meant = np.array(
        [delta_from_inertia(inertia) for inertia in joint_frame_inertias(model.chain, model.layout, delta)]
    )
    scale = np.maximum(np.abs(meant), np.abs(meant[:, 9:]))
    if chain.names != model.chain.names or not np.allclose(found / scale, meant / scale, rtol=0.0, atol=_AGREEMENT):
        raise ModelError(f"{path}: the URDF read back differs from the parameters; it was not written")
    write_atomically(path, text)
