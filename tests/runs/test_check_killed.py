"""A preflight that is killed politely lets go of the arm before it ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ident_service.registry.state_folder import control_path


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.campaign)])
def test_a_killed_check_says_so_and_leaves_no_ticket(real_arm: Path, tmp_path: Path, number: signal.Signals) -> None:
    state = tmp_path / "state"
    words = ["check", str(real_arm), "--confirm", "planar2", "--state", str(state)]
    with subprocess.Popen(
        [sys.executable, "-m", "ident_service", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        controls, until = control_path(state, "planar2"), time.monotonic() + 60.0
        while not controls.exists() and time.monotonic() < until:
            time.sleep(0.02)
        assert controls.exists()
        time.sleep(0.5)
        os.kill(process.pid, number)
        out, err = process.communicate(timeout=60.0)
    assert process.returncode == 1, (out, err)
    assert "interrupted" in err
    assert not (state / "arms" / "planar2" / "ticket.json").exists()
