"""Motors that give less torque than their pucks are told, found with a load that is known.

Both motors move both joints. What they really give is a fault of the emulated drives that nothing but the motion
shows: no puck measures torque.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from canopen_run_bench import truth, write
from puck_run_bench import GEARS, puck_arm

from drivers.barrett.driver import BarrettArm
from ident_service.cli import main
from ident_service.config.arm import ArmConfig
from ident_service.config.load import load_arm
from ident_service.estimation.feasible.feasible_set import feasible_set
from ident_service.estimation.torque_constants import identify_torque_constants
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import arm_model
from ident_service.model.base_parameters import base_parameters
from ident_service.operations.commissioning import record_motion
from ident_service.operations.recordings import known_payloads, open_together
from sim_backend.emulator.faults import DriveFault
from sim_backend.emulator.lock_step import LockStepArm

pytestmark = pytest.mark.slow  # whole runs

LOCK_STEP = {"interface": "lock_step", "channel": "constants"}
RATE, KP, KD = 250.0, 225.0, 30.0
GIVEN = (0.95, 0.88)  # of the torque that each motor is told
MOTION = {"kind": "seeded", "base_frequency": 0.1, "harmonics": 7, "periods": 1}
MASS, CENTER = 0.7, (-0.06, 0.03, 0.0)
FILES = ("free.mcap", "loaded.mcap")


def record(folder: Path, name: str, *, loaded: bool) -> None:
    """Run the arm whose motors give less than they are told, with a load or without."""
    tree = puck_arm(name, RATE, KP, KD, LOCK_STEP, emulation={"operator": 0.02, "seed": 3 + loaded})
    tree["motions"] = {"identification": MOTION | {"seed": 1 + loaded}}
    config = load_arm(write(folder, tree | {"transmission": GEARS | {"drive_terms": "motors"}}))
    faults = [DriveFault("torque_fraction", motor, size=share) for motor, share in enumerate(GIVEN)]
    if loaded:
        faults.append(DriveFault("load_attached", size=MASS, offset=CENTER))
    behind, model = LockStepArm(config, faults), arm_model(config)
    arm = BarrettArm(config, lambda _: [behind.link(0)])
    record_motion(arm, model, excitation(model, "identification"), folder / f"{name}.mcap")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("constants")
    with pytest.MonkeyPatch.context() as inside:
        inside.chdir(folder)
        record(folder, "loaded", loaded=True)
        record(folder, "free", loaded=False)
        (folder / "load.yaml").write_text(yaml.safe_dump({"mass": MASS, "center_of_mass": list(CENTER)}))
        yield folder


def identify(*words: str) -> int:
    return main(["identify", *words, "--arm", "free.yaml", "--state", "state"])


def deviations_off(document: dict[str, Any]) -> np.ndarray:
    """Return by how many of its standard deviations each base parameter is off."""
    model = arm_model(load_arm("free.yaml"))
    base = base_parameters(model.chain, model.layout)
    true = base.K @ np.array([truth().get(key, 0.0) for key in model.layout.names])
    found = document["base_parameters"]
    return (np.array(found["values"]) - true) / np.array(found["standard_deviations"])


@pytest.mark.campaign
def test_they_are_identified_with_the_parameters(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    load = "--payload", "loaded.mcap=load.yaml"
    assert identify(*FILES, *load, "--torque-constants", "--out", "found") == 0
    assert "motor 2 (shoulder, elbow): 0.8" in capsys.readouterr().out
    document = json.loads(Path("found/parameters.json").read_text())
    found = document["torque_constants"]
    factors = np.array([one["factor"] for one in found])
    deviations = np.array([one["standard_deviation"] for one in found])
    assert (deviations < 0.01).all()
    assert (np.abs(factors - GIVEN) < 4.0 * deviations).all()
    assert [one["verdict"] for one in found] == ["identified", "identified"]
    assert document["known_payloads"][0]["recording"] == "loaded.mcap"
    assert np.abs(deviations_off(document)).max() < 4.0
    # Whatever reads another recording of this arm by these results multiplies its torques, too.
    told = json.loads(Path("found/arm.json").read_text())["identification"]["torque_factors"]
    np.testing.assert_allclose(told, factors)
    # Without the factors nothing fits, and the estimate says so.
    assert identify(*FILES, *load, "--out", "as_described") == 3
    mistaken = json.loads(Path("as_described/parameters.json").read_text())
    spread = [np.array(one["base_parameters"]["standard_deviations"]) for one in (mistaken, document)]
    assert np.median(spread[0] / spread[1]) > 5.0


def test_the_factors_and_a_feasible_arm_are_sought_together(runs: Path) -> None:
    config = load_arm("free.yaml")
    model = arm_model(_settled(config))
    base = base_parameters(model.chain, model.layout)
    paths = [Path(name) for name in FILES]
    loads = known_payloads({paths[1]: Path("load.yaml")}, paths, model)
    recordings = open_together(paths, model, payloads=loads).recordings
    free = identify_torque_constants(recordings, model, base, None)
    # The second link's first moment about its joint cannot be as large as it is.
    light = _with_body(
        config, {"mass": (0.5, 0.8), "center_of_mass": {"lower": (-0.35, -0.1, -0.1), "upper": (-0.2, 0.1, 0.1)}}
    )
    inside = identify_torque_constants(recordings, model, base, feasible_set("pseudo_inertia", base.names, light))
    assert free.error_percent < inside.error_percent < free.error_before
    assert np.abs(inside.factors - free.factors).max() > 3.0 * free.deviations.max()
    wide = _with_body(config, {"mass": (0.5, 2.0)})
    same = identify_torque_constants(recordings, model, base, feasible_set("pseudo_inertia", base.names, wide))
    np.testing.assert_allclose(same.factors, free.factors, atol=0.1 * free.deviations.min())


def _settled(config: ArmConfig) -> ArmConfig:
    """Return the description with nothing left to be chosen."""
    smoothing = config.identification.smoothing.model_copy(
        update={"cutoff": 8.0, "decimate": 3, "velocity": "position"}
    )
    friction = config.identification.friction.model_copy(update={"presliding": 0.0})
    update = {"smoothing": smoothing, "friction": friction, "delay": 0.0, "edge": 0.25}
    return config.model_copy(update={"identification": config.identification.model_copy(update=update)})


def _with_body(config: ArmConfig, body: dict[str, Any]) -> ArmConfig:
    document = config.model_dump(mode="json")
    document["joints"]["elbow"]["body"] = body
    return ArmConfig.model_validate(document)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--torque-constants"], "without a load that is known"),
        (["--payload", "load.yaml"], "write RECORDING=FILE"),
        (["--payload", "other.mcap=load.yaml"], "other.mcap is none of the recordings"),
        (["--payload", "loaded.mcap=nothing.yaml"], "nothing.yaml: no such file"),
        (["--payload", "loaded.mcap=bad.yaml"], r"bad.yaml:1:1: mass"),
        (["--payload", "loaded.mcap=hand.yaml"], "link: 'hand' is none of shoulder, elbow"),
    ],
)
def test_what_cannot_be_is_reported(
    runs: Path, words: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("bad.yaml").write_text("mass: -1\ncenter_of_mass: [0, 0, 0]\n")
    Path("hand.yaml").write_text("mass: 1\ncenter_of_mass: [0, 0, 0]\nlink: hand\n")
    assert identify(*FILES, *words, "--out", "nothing") == 2
    assert told in capsys.readouterr().err
    assert not Path("nothing").exists()
