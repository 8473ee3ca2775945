"""Arms and runs for the verbs of the daemon: drives that need a zero on a bus of their own, and a run that is there."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from daemon.conftest import Asked, known_arm, quick_text

from ident_service.config.load import shipped_arms
from ident_service.operations.run_archive import import_run
from ident_service.results.manifest import write_manifest

ON_A_BUS = "relative"


def on_a_bus() -> dict[str, Any]:
    """Upload of the planar arm behind two drives whose encoders count from where they were when power came."""
    drive = {"counts": 65536, "rated_torque": 0.1, "max_torque": 3.0, "max_speed": 6000.0}
    tree = {
        "extends": "planar2",
        "name": ON_A_BUS,
        "joints": {"shoulder": {"home": 0.3}, "elbow": {"home": -0.2}},
        "transmission": {"ratios": [20.0, -20.0], "coupling": [[1.0, -0.5], [1.0, 0.5]], "drive_terms": "joints"},
        "driver": {
            "kind": "canopen",
            "eds": "emulated_drive.eds",
            "buses": [{"interface": "lock_step", "channel": "bench"}],
            "drives": [drive | {"node": 1}, drive | {"node": 2}],
            "emulation": {"seed": 1},
            "zero": "at_home",
        },
    }
    eds = (shipped_arms()["planar2"].parent / "emulated_drive.eds").read_text(encoding="utf-8")
    return {"description": json.dumps(tree), "files": {"emulated_drive.eds": eds}}


def unstable_text() -> str:
    """The arm `quick` with far too much damping."""
    text, changed = re.subn(r"\bkd: [0-9.]+", "kd: 100000", quick_text())
    assert changed == 2
    return text


def with_arms(daemon: Asked) -> None:
    """`quick` and the arm on a bus are known."""
    known_arm(daemon, quick_text())
    bus = on_a_bus()
    known_arm(daemon, bus["description"], bus["files"])


def with_run(daemon: Asked, state: Path, commissioned: Path) -> str:
    """The whole job on `quick` is a run of this daemon."""
    return str(import_run(daemon.service.db, state, commissioned, "test")["id"])


def singular_copy(commissioned: Path, folder: Path) -> Path:
    """A copy of a run whose first two base parameters err together, so that their covariance has no inverse."""
    shutil.copytree(commissioned, folder)
    path = folder / "parameters.json"
    document = json.loads(path.read_text())
    covariance = np.array(document["base_parameters"]["covariance"])
    covariance[1] = covariance[0]
    covariance[:, 1] = covariance[:, 0]
    document["base_parameters"]["covariance"] = covariance.tolist()
    path.write_text(json.dumps(document))
    write_manifest(folder)
    return folder


def answered(daemon: Asked, job: dict[str, Any], *, confirmed: bool = False) -> tuple[dict[str, Any], dict[str, Any]]:
    """A job at its end, and what its command answered."""
    made = daemon.begin(job, confirmed=confirmed)
    ended = daemon.follow(made["id"], lease=confirmed)
    return ended, dict(daemon.get(f"/api/v1/jobs/{made['id']}/result").json()["answer"])
