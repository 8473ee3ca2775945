"""An arm whose encoders count from power-up, in two processes: zeroed, moved, identified, and switched off again.

The rate is one that a busy machine keeps. A run that a stall of the machine ended is run again.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from canopen_run_bench import (
    STALLS,
    TRIES,
    Said,
    acknowledge,
    canopen,
    channel,
    checked,
    described,
    emulated,
    truth,
    write,
)

from ident_service.cli import main
from ident_service.config.load import load_arm
from ident_service.model.arm_model import arm_model
from ident_service.model.base_parameters import base_parameters

NAME, RATE, KP, KD = "relative", 50.0, 100.0, 16.0
HOME = {"shoulder": 0.3, "elbow": -0.2}  # so that a zero that were ignored would show in every parameter

# In lock step, tests/runs/test_zero.py does the same for every change.
pytestmark = [pytest.mark.slow, pytest.mark.realtime, pytest.mark.campaign, pytest.mark.timeout(600)]


def test_a_zeroed_arm_is_identified_and_one_that_was_switched_off_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tree = described(NAME, RATE, KP, KD)
    for joint, home in HOME.items():
        tree["joints"][joint] = tree["joints"][joint] | {"home": home}
    bus = {"interface": "ident_wire", "channel": channel()}
    arm = write(tmp_path, canopen(tree, bus, 1, torque_deadline=0.2, zero="at_home"))
    state = tmp_path / "state"
    zero = ["home", str(arm), "--zero", "--confirm", NAME, "--state", str(state)]
    folder = None
    for number in range(TRIES):
        with emulated(arm):
            assert main(zero) == 0
            if not checked(arm, NAME, state):
                continue
            with Said("run", arm, "--out", tmp_path / f"run{number}", "--state", state) as run:
                if run.code() == 0:
                    folder = tmp_path / f"run{number}"
                    break
        assert any(word in run.text for word in STALLS), run.text
        acknowledge(arm, NAME, state)
    assert folder is not None, "the machine stalls all the time"
    out = tmp_path / "out"
    assert main(["identify", str(folder / "run.mcap"), "--arm", str(arm), "--out", str(out)]) == 0
    document = json.loads((out / "parameters.json").read_text())["base_parameters"]
    model = arm_model(load_arm(arm))
    base = base_parameters(model.chain, model.layout)
    true = base.K @ np.array([truth().get(name, 0.0) for name in model.layout.names])
    z = (np.array(document["values"]) - true) / np.array(document["standard_deviations"])
    # Coulomb and viscous friction of the shoulder explain each other; each alone is up to 5.4 deviations off.
    assert np.abs(z).max() < 7.0, z
    with emulated(arm):  # other power: their counts begin anew
        for words in (["watch"], ["run", "--out", str(tmp_path / "refused")]):
            capsys.readouterr()
            assert main([words[0], str(arm), *words[1:], "--state", str(state)]) == 1
            assert "drives 1, 2 do not know where the arm stands" in capsys.readouterr().err
        assert main(["recover", str(arm), "--state", str(state)]) == 3
        assert main(zero) == 0
        assert main(["recover", str(arm), "--state", str(state)]) == 0
