"""An arm with every kind of condition that a description can hold, and files about it that tests change."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from certificate_samples import random_bodies

from ident_service.certificate_verifier import Arm
from ident_service.config.load import load_arm, shipped_arms
from ident_service.estimation.certificate import certificate_arm, certify
from ident_service.estimation.feasible.feasible_set import feasible_set
from ident_service.model.arm_model import arm_model
from ident_service.model.base_parameters import base_parameters

Document = dict[str, Any]


@dataclass(frozen=True)
class Made:
    """One arm with a file that it proves, one that it disproves, and its description."""

    description: Path
    arm: Arm
    witness: Document
    dual: Document


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    tree = yaml.safe_load(shipped_arms()["planar2"].read_text(encoding="utf-8"))
    body = {
        "mass": [0.1, 5],
        "center_of_mass": {"lower": [-0.3, -0.3, -0.3], "upper": [0.3, 0.3, 0.3]},
        "hull": [[-0.4, -0.4, -0.4], [0.9, 0, 0], [0, 0.9, 0], [0, 0, 0.9]],
        "ellipsoid": {"center": [0.01, 0, 0], "semi_axes": [0.9, 0.8, 0.7]},
        "symmetry": ["xy"],
    }
    for joint in tree["joints"].values():
        joint["body"] = body
    tree |= {"constraints": {"total_mass": {"lower": 1.0, "upper": 12.0}}, "name": "rich"}
    path = tmp_path_factory.mktemp("arm") / "rich.yaml"
    path.write_text(json.dumps(tree), encoding="utf-8")
    config = load_arm(path)
    model = arm_model(config)
    base = base_parameters(model.chain, model.layout)
    conditions = feasible_set("pseudo_inertia", base.names, config)
    delta = _body(base.names)
    assert conditions.margin(delta)[0] > 0.0, conditions.margin(delta)
    stated = certificate_arm(
        config.name, config.sha256, base, conditions, units=model.layout.units, joints=model.chain.names
    )

    def document(beta: np.ndarray, delta: np.ndarray | None) -> Document:
        proof = certify(beta, base, conditions, delta)
        content: Document = {
            "format": "ident-parameters",
            "version": 1,
            "arm": {"name": config.name, "joints": list(model.chain.names), "sha256": config.sha256},
            "feasible_set": "pseudo_inertia",
            "base_parameters": {
                "expressions": list(base.expressions),
                "units": list(base.units),
                "values": beta.tolist(),
            },
            "feasibility": {
                "feasible": proof.verdict == "feasible",
                "margin": 1e-3 if proof.verdict == "feasible" else -1e-3,
                "certificate": proof.document,
            },
        }
        if delta is not None:
            table = {"names": list(base.names), "units": list(model.layout.units), "values": delta.tolist()}
            content["link_parameters"] = table
        return content

    # As printed: decimals that its own expressions give.
    witness = document(base.K @ delta, delta)
    broken = base.K @ delta
    broken[next(k for k, text in enumerate(base.expressions) if text.startswith("lx2"))] = 50.0
    dual = document(broken, None)
    return Made(path, stated, witness, dual)


def _body(names: tuple[str, ...]) -> np.ndarray:
    delta = random_bodies(np.random.default_rng(3), names)
    for link in ("1", "2"):
        values = {"Lxx": 0.05, "Lyy": 0.06, "Lzz": 0.07, "lx": 0.02, "ly": 0.01, "m": 2.0}
        for symbol in ("Lxx", "Lxy", "Lxz", "Lyy", "Lyz", "Lzz", "lx", "ly", "lz", "m"):
            delta[names.index(f"{symbol}{link}")] = values.get(symbol, 0.0)
    return delta
