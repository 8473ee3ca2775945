"""Parameter files with certificates, for tests: the paper's tables and random arms."""

from __future__ import annotations

import copy
import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from ident_service.config.arm import ArmConfig
from ident_service.estimation.certificate import Certificate
from ident_service.model.base_parameters import BaseParameters, base_from_expressions
from ident_service.model.parameter_layout import INERTIAL

Array = np.ndarray


def parameter_file(
    beta: Array, base: BaseParameters, certificate: Certificate, delta: Array | None = None
) -> dict[str, Any]:
    """A parameter file with this certificate; with `delta`, link parameters too."""
    document: dict[str, Any] = {
        "format": "ident-parameters",
        "version": 1,
        "feasible_set": certificate.document["set"],
        "base_parameters": {"expressions": list(base.expressions), "values": beta.tolist()},
        "feasibility": {
            "feasible": certificate.verdict == "feasible",
            "margin": 1e-6 if certificate.verdict == "feasible" else -1e-6,
            "certificate": copy.deepcopy(certificate.document),
        },
    }
    if delta is not None:
        document["link_parameters"] = {"names": list(base.names), "values": delta.tolist()}
    return document


def text(document: dict[str, Any]) -> str:
    return json.dumps(document)


def table_1(folder: Path) -> tuple[BaseParameters, dict[str, Array]]:
    """The three-link robot: its grouping, and its columns r1, r2 and r2 corrected."""
    rows = json.loads((folder / "table1.json").read_text(encoding="utf-8"))["rows"]
    expressions = tuple(re.sub(r"(L|l|m)_\{?(\d)([xyz]*)\}?", r"\1\3\2", row[0]) for row in rows)
    names = tuple(f"{symbol}{link}" for link in (1, 2, 3) for symbol in INERTIAL)
    columns = {name: np.array([float(row[k]) for row in rows]) for k, name in enumerate(("r1", "r2", "corrected"), 1)}
    return base_from_expressions(expressions, names), columns


def table_6(folder: Path) -> dict[str, Array]:
    """The WAM's columns beta_ols and beta_star_c, in the order of its base parameters."""
    rows = json.loads((folder / "table6.json").read_text(encoding="utf-8"))["rows"]
    return {key: np.array([row["resolved"][key] for row in rows], dtype=float) for key in ("beta_ols", "beta_star_c")}


def random_config(rng: np.random.Generator, joints: int, *, square: bool) -> ArmConfig:
    """A standard-DH arm; with `square`, neighbouring axes are parallel or perpendicular, as in most real ones."""
    rows = {}
    for k in range(1, joints + 1):
        alpha = float(rng.choice([-0.5, 0.0, 0.5])) * np.pi if square else float(rng.uniform(-1.5, 1.5))
        a, d = (round(float(x), 3) for x in rng.uniform(-0.4, 0.4, size=2))
        rows[f"j{k}"] = {"alpha": alpha, "a": a, "d": d}
    content = {
        "format": "ident-arm",
        "version": 1,
        "name": "random",
        "kinematics": {"dh": {"convention": "standard", "joints": rows}},
        "joints": {},
    }
    return ArmConfig.model_validate(content)


def random_bodies(rng: np.random.Generator, names: tuple[str, ...]) -> Array:
    """Link parameters of mass points on every link, and positive joint terms."""
    values = {name: float(rng.uniform(0.05, 0.5)) for name in names}
    for name in names:
        if not (name.startswith("m") and name[1:].isdigit()):
            continue
        points, masses = rng.normal(scale=0.15, size=(6, 3)), rng.uniform(0.1, 1.0, size=6)
        second = np.einsum("p,pi,pj->ij", masses, points, points)
        L = np.trace(second) * np.eye(3) - second
        body = (L[0, 0], L[0, 1], L[0, 2], L[1, 1], L[1, 2], L[2, 2], *(masses @ points), masses.sum())
        values |= {f"{symbol}{name[1:]}": float(value) for symbol, value in zip(INERTIAL, body, strict=True)}
    return np.array([values[name] for name in names])
