"""An arm whose drives move several joints is checked, moved and identified: simulated, and over emulated drives."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from canopen_run_bench import canopen, checked, described, simulated, truth, write

from ident_service.cli import main
from ident_service.config.load import load_arm
from ident_service.config.motion_limits import motion_limits
from ident_service.errors import ConfigError
from ident_service.excitation.described_motion import excitation
from ident_service.excitation.limit_proof import peak_bounds
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.base_parameters import base_parameters
from ident_service.model.regressor import joint_regressor

Array = np.ndarray
RATE, KP, KD = 500.0, 900.0, 60.0
GEARS = {"ratios": [20.0, -20.0], "coupling": [[1.0, -0.5], [1.0, 0.5]], "drive_terms": "motors"}


def simulated_arm(folder: Path, name: str = "coupled", **gears: Any) -> Path:
    return write(folder, simulated(described(name, RATE, KP, KD), 1) | {"transmission": GEARS | gears})


def emulated_arm(folder: Path) -> Path:
    tree = canopen(described("coupled", RATE, KP, KD), {"interface": "lock_step"}, 2)
    return write(folder, tree | {"transmission": GEARS})


@pytest.mark.slow
@pytest.mark.parametrize(
    "make",
    [
        pytest.param(simulated_arm, marks=pytest.mark.campaign, id="simulated"),
        pytest.param(emulated_arm, marks=pytest.mark.campaign, id="emulated"),
    ],
)
def test_it_is_checked_moved_and_its_drives_parameters_are_found(make: Any, tmp_path: Path) -> None:
    arm, state, run, out = make(tmp_path), tmp_path / "state", tmp_path / "run", tmp_path / "out"
    assert checked(arm, "coupled", state)
    assert main(["run", str(arm), "--out", str(run), "--state", str(state)]) == 0
    assert main(["identify", str(run / "run.mcap"), "--arm", str(arm), "--out", str(out), "--state", str(state)]) == 0
    model = arm_model(load_arm(arm))
    base = base_parameters(model.chain, model.layout)
    found = json.loads((out / "parameters.json").read_text())["base_parameters"]
    assert found["expressions"] == list(base.expressions)
    names = model.layout.names
    expected = base.K @ np.array([truth().get(name, 0.0) for name in names])
    deviation = np.array(found["standard_deviations"])
    z = (np.array(found["values"]) - expected) / deviation
    # 13 figures: none beyond what one in ten thousand is, nor all of them together.
    assert np.abs(z).max() < 4.0, dict(zip(base.expressions, z, strict=True))
    assert z @ z < 35.0
    # The drives' own terms are told from the joints', which have other values for them.
    own = [k for k, name in enumerate(base.expressions) if name[:2] in ("fv", "fc")]
    assert len(own) == 4
    assert (np.abs(np.array(found["values"])[own]) > 5.0 * deviation[own]).all()


def test_the_torque_of_each_motor_is_proven_and_a_motion_made_smaller_for_it(tmp_path: Path) -> None:
    free = arm_model(load_arm(simulated_arm(tmp_path, "free")))
    path = excitation(free, "identification").path
    H = joint_regressor(free.chain, free.layout, *path.at(np.linspace(0.0, path.duration, 2000))[:3])
    assert free.prior is not None
    # Written out: tau = C^T diag(r) tau_motor.
    J = np.diag(GEARS["ratios"]) @ np.array(GEARS["coupling"])
    motors = np.abs(np.linalg.solve(J.T, np.einsum("jps,p->js", H, free.prior))).max(axis=1)

    def of(name: str, share: float) -> tuple[ArmModel, Array]:
        limit = share * motors
        return arm_model(load_arm(simulated_arm(tmp_path, name, motor_torque=limit.tolist()))), limit

    weak, _ = of("weak", 0.9)
    asked = peak_bounds(path, weak)
    assert asked.motors is not None
    assert (asked.motors >= motors).all()
    assert (asked.motors <= 1.1 * motors).all()
    said = asked.violations(weak.chain.names, motion_limits(weak.config))
    assert [line.split(":")[0] for line in said] == ["motor 1", "motor 2"]
    assert all("exceeds" in line for line in said)
    held, limit = of("held", 1.3)
    smaller = peak_bounds(excitation(held, "identification").path, held)
    assert smaller.motors is not None
    assert (smaller.motors <= 0.7 * limit).all()  # the share that a seeded motion uses


def test_drives_limits_are_the_motors(tmp_path: Path) -> None:
    config = load_arm(emulated_arm(tmp_path))
    motors = motion_limits(config).motors
    assert motors is not None
    np.testing.assert_allclose(motors.torque, [3.0, 3.0])


def test_joints_with_a_motor_each_have_no_other_limits(tmp_path: Path) -> None:
    alone = load_arm(simulated_arm(tmp_path, "alone", coupling=[[1.0, 0.0], [0.0, 2.0]]))
    assert motion_limits(alone).motors is None
    path = simulated_arm(tmp_path, "told", coupling=[[1.0, 0.0], [0.0, 2.0]], motor_torque=[1.0, 1.0])
    with pytest.raises(ConfigError, match=r"transmission\.motor_torque: is for motors that share joints"):
        load_arm(path)
    with pytest.raises(ConfigError, match=r"transmission\.motor_torque: 1 torques for 2 ratios"):
        load_arm(simulated_arm(tmp_path, "few", motor_torque=[1.0]))
