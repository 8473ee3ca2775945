"""An arm that carries what its description says: checked, moved and identified as the arm with its payload."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ident_service.cli import main
from ident_service.config.load import load_arm
from ident_service.model.arm_model import arm_model
from ident_service.model.base_parameters import base_parameters
from ident_service.operations.commissioning import true_parameters

CONFIGS = Path(__file__).parents[2] / "configs"
MOTION = "{kind: seeded, seed: 1, base_frequency: 0.2, harmonics: 5, periods: 2}"
LOAD = "payload: {mass: 1.2, center_of_mass: [0.03, -0.02, 0.0], inertia: [0.002, 0, 0, 0.003, 0, 0.004]}"


def described(folder: Path, name: str, more: str) -> Path:
    path = folder / f"{name}.yaml"
    path.write_text(
        f"extends: {CONFIGS / 'planar2.yaml'}\nname: {name}\ncontrol: {{rate: 500}}\n"
        f"motions: {{identification: {MOTION}, validation: {MOTION}}}\n{more}\n"
    )
    return path


@pytest.mark.campaign
@pytest.mark.slow
def test_it_is_held_moved_and_identified_with_its_payload_and_results_say_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arm, state, run, out = described(tmp_path, "loaded", LOAD), tmp_path / "state", tmp_path / "run", tmp_path / "out"
    assert main(["config", "check", str(arm)]) == 0
    assert "payload: 1.2 kg at (0.03, -0.02, 0) m of the last link" in capsys.readouterr().out
    assert main(["check", str(arm), "--confirm", "loaded", "--state", str(state)]) == 0
    assert main(["run", str(arm), "--out", str(run), "--state", str(state)]) == 0
    assert main(["identify", str(run / "run.mcap"), "--arm", str(arm), "--out", str(out), "--state", str(state)]) == 0
    said = capsys.readouterr().out
    assert "payload, by the description: 1.2 kg at (0.03, -0.02, 0) m of the last link" in said
    assert "with its payload of 1.2\xa0kg" in (out / "report.html").read_text()
    content = json.loads((out / "parameters.json").read_text())
    assert content["arm"]["payload"] == {
        "mass": 1.2,
        "center_of_mass": [0.03, -0.02, 0.0],
        "inertia": [0.002, 0, 0, 0.003, 0, 0.004],
        "link": None,
    }
    config = load_arm(arm)
    model = arm_model(config)
    truth, base = true_parameters(config, model), base_parameters(model.chain, model.layout)
    assert truth is not None
    found = content["base_parameters"]
    z = (np.array(found["values"]) - base.K @ truth) / np.array(found["standard_deviations"])
    assert np.abs(z).max() < 4.0, dict(zip(base.expressions, z, strict=True))
    names = content["link_parameters"]["names"]
    assert content["link_parameters"]["values"][names.index("m2")] > 1.9
    # Bounds of masses moved with it, and the exact verifier agrees with them.
    assert main(["verify", str(out / "parameters.json"), "--arm", str(arm)]) == 0
    assert main(["export", str(out), "--format", "urdf", "--out", str(tmp_path / "urdf")]) == 0
    texts = [path.read_text() for path in (tmp_path / "urdf").rglob("*.urdf")]
    assert texts
    assert all("include the payload of the description: 1.2 kg" in text for text in texts)


@pytest.mark.slow
def test_a_payload_that_is_not_on_is_reported_before_anything_moves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Taken off again by the simulator, as a person who forgot to mount it."""
    arm = described(tmp_path, "bare", "payload: {mass: 1.2, center_of_mass: [0.05, 0, 0]}")
    off = tmp_path / "off.yaml"
    config = load_arm(arm)
    model = arm_model(config)
    truth = true_parameters(config, model)
    assert truth is not None
    assert config.payload is not None
    truth[model.layout.inertial(1)] -= 2.0 * np.array(config.payload.parameters)
    table = {name: float(value) for name, value in zip(model.layout.names, truth, strict=True)}
    off.write_text(f"extends: bare.yaml\nname: off\ndriver: {{truth: {json.dumps(table)}}}\n")
    assert main(["check", str(off), "--confirm", "off", "--state", str(tmp_path / "state")]) == 3
    assert "lighter than described" in capsys.readouterr().out
