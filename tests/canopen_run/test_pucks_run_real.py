"""`ident emulate` with pucks and `ident run` in two processes, by the machine's clock, with a hand on the pendant."""

from __future__ import annotations

import json
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Self

import numpy as np
import pytest
from canopen_run_bench import STALLS, TRIES, Said, channel, checked, ident, truth, wait_for, write
from puck_run_bench import puck_arm

from ident_service.cli import main
from ident_service.config.load import load_arm
from ident_service.model.arm_model import arm_model
from ident_service.model.base_parameters import base_parameters
from ident_service.recordings.open import open_recording
from ident_service.registry.state_folder import arm_fault_store

NAME, RATE, KP, KD = "farpucks", 50.0, 100.0, 16.0
NAMES = ("shoulder", "elbow")

pytestmark = [pytest.mark.slow, pytest.mark.realtime, pytest.mark.timeout(600)]


class Pucks(Said):
    """`ident emulate`, to whose pendant and faults lines can be said."""

    def __init__(self, arm: Path) -> None:
        self.lines: list[str] = []
        self.process = subprocess.Popen(
            ident("emulate", arm),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            bufsize=1,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def __enter__(self) -> Self:
        self.says("safety, node 10: ")
        return self

    def __exit__(self, *error: object) -> None:
        super().__exit__(*error)
        if self.process.stdin is not None:
            self.process.stdin.close()

    def hears(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{line}\n")
        self.process.stdin.flush()


class Bench:
    def __init__(self, folder: Path) -> None:
        self.folder, self.state = folder, folder / "state"
        bus = {"interface": "ident_wire", "channel": channel()}
        emulation = {"operator": 0.3, "heartbeat": 0.25, "braking": [4.0, 2.0], "zeroed": False}
        self.arm = write(folder, puck_arm(NAME, RATE, KP, KD, bus, heartbeat=0.4, emulation=emulation))
        self.faults = arm_fault_store(self.state, NAME)
        self.runs = 0

    def run(self) -> tuple[Said, Path]:
        self.runs += 1
        folder = self.folder / f"run{self.runs}"
        return Said("run", self.arm, "--out", folder, "--state", self.state), folder

    def acknowledge(self) -> None:
        for code in list(self.faults.latched()):
            assert main(["ack", str(self.arm), code, "--state", str(self.state)]) == 0

    def zero(self) -> None:
        words = ["set-home", str(self.arm), "--confirm", NAME, "--state", str(self.state)]
        assert main(words) == 0


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    return Bench(tmp_path_factory.mktemp("farpucks"))


@pytest.fixture(scope="module")
def pucks(bench: Bench) -> Iterator[Pucks]:
    with Pucks(bench.arm) as pucks:
        bench.zero()
        for _ in range(TRIES):
            if checked(bench.arm, NAME, bench.state):
                break
        else:
            raise AssertionError("preflight never passed")
        yield pucks


def test_a_run_against_pucks_in_another_process_finds_the_arms_parameters(
    bench: Bench, pucks: Pucks, tmp_path: Path
) -> None:
    for left in reversed(range(TRIES)):
        run, folder = bench.run()
        with run:
            code = run.code()
        if code == 0:
            assert "waiting for a person: stand clear" in run.text
            assert json.loads((folder / "ended.json").read_text())["state"] == "done"
            out = tmp_path / f"out{left}"
            verdict = main(["identify", str(folder / "run.mcap"), "--arm", str(bench.arm), "--out", str(out)])
            if verdict == 0:
                break
            assert verdict == 3  # where stalls have left gaps, too little of the motion is whole
            continue
        assert any(word in run.text for word in STALLS), run.text
        bench.acknowledge()
        pucks.hears("idle")
    else:
        raise AssertionError("the machine stalls all the time")
    document = json.loads((out / "parameters.json").read_text())["base_parameters"]
    model = arm_model(load_arm(bench.arm))
    base = base_parameters(model.chain, model.layout)
    true = base.K @ np.array([truth().get(name, 0.0) for name in model.layout.names])
    z = (np.array(document["values"]) - true) / np.array(document["standard_deviations"])
    assert np.abs(z).max() < 7.0, z


def test_an_emergency_stop_in_the_middle_of_a_run_is_latched_and_its_recording_can_be_read(
    bench: Bench, pucks: Pucks
) -> None:
    for _ in range(TRIES):
        run, folder = bench.run()
        try:
            run.says("exciting")
            break
        except AssertionError:
            with run:
                assert any(word in run.text for word in STALLS), run.text
            bench.acknowledge()
            pucks.hears("idle")
    else:
        raise AssertionError("the machine stalls all the time")
    with run:
        time.sleep(1.0)
        before = len(pucks.lines)
        pucks.hears("emergency_stop")
        pucks.says("safety, node 10: ESTOP, pendant: e-stop fault", before)
        assert run.code() == 4
    assert "leaked" not in run.text  # which nanobind says of what outlives the interpreter
    assert "emergency_stop" in wait_for(bench.faults.latched, "no fault was latched"), run.text
    blocks = list(open_recording(folder / "run.mcap", NAMES).blocks())
    assert sum(len(block.position) for block in blocks) > RATE
    # Latched twice over: by this program, and by the safety puck until somebody presses Shift-Idle.
    again, _ = bench.run()
    with again:
        assert again.code() == 3
    bench.acknowledge()
    pucks.hears("clear")
    assert main(["recover", str(bench.arm), "--state", str(bench.state)]) == 3
    before = len(pucks.lines)
    pucks.hears("idle")
    pucks.says("safety, node 10: IDLE, pendant: no fault", before)
