"""Read and write results: parameter file, manifest, report, comparison and exports."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ident_service.model.dynamic_model import DynamicModel


def load_model(path: str | Path, arm: str | Path | None = None) -> DynamicModel:
    """Load identified parameters into a pinocchio model, friction included.

    The result has `model` (a `pinocchio.Model` with gravity, armature, damping, dry friction and limits),
    `friction(dq)` and `inverse_dynamics(q, dq, ddq)`, all in SI units with arrays of shape (joints,). Where its
    `presliding` is not zero, friction has a memory, which both take as `direction` from `turned`. Without it friction
    reverses at once, as in pinocchio's own algorithms.

    Args:
        path: a folder of results, every file of which must be what its manifest names, or a `parameters.json`.
        arm: description file, or the name of a shipped one; that of the folder when None.

    Raises:
        UsageError: no such file, or no arm is known for it.
        ParameterError: the files are torn, changed or foreign, or the parameters are not those of the arm.
        ConfigError: the arm's description cannot be used.
        ModelError: no body has the parameters, or the mechanism cannot be represented.
    """
    # Pinocchio is loaded here, and not by whoever only imports this package.
    from ident_service.results.loader import dynamic_model

    return dynamic_model(Path(path), arm)
