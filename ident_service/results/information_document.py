"""Convert the information of a fit to and from JSON: per joint, the triangle of `[H_b | tau]` (eqs. 64-70).

With it, a parameter file can be asked without its recording how well other parameters explain the same torques, and
what a change of parameters does to them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ident_service.errors import ParameterError
from ident_service.model.information import Information


def information_document(information: Information) -> list[dict[str, Any]]:
    """Return one entry per joint: equations, the base parameters it feels (from 0), its triangle row by row."""
    joints = []
    for support, factor, rows in zip(information.supports, information.factors, information.rows, strict=True):
        size = len(support) + 1
        square = np.zeros((size, size))
        square[: len(factor)] = factor
        triangle = square[np.triu_indices(size)]
        joints.append({"rows": int(rows), "parameters": support.tolist(), "triangle": triangle.tolist()})
    return joints


def information_from(joints: list[dict[str, Any]], base: int) -> Information:
    """Return the information of a document, the inverse of `information_document`.

    Args:
        joints: as it was written.
        base: number of base parameters.

    Raises:
        ParameterError: triangles of the wrong size, or about parameters that are not there.
    """
    supports, factors = [], []
    for number, joint in enumerate(joints, 1):
        support = np.array(joint["parameters"], dtype=np.intp)
        size = len(support) + 1
        upper = np.triu_indices(size)
        if len(joint["triangle"]) != len(upper[0]) or np.any(np.diff(support) <= 0) or np.any(support >= base):
            raise ParameterError(f"information of joint {number} is not about {base} base parameters")
        factor = np.zeros((size, size))
        factor[upper] = joint["triangle"]
        supports.append(support)
        factors.append(factor)
    rows = np.array([joint["rows"] for joint in joints], dtype=np.int64)
    return Information(tuple(supports), tuple(factors), rows, base)
