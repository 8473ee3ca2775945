"""A small arm behind CANopen drives, run from end to end by the commands that people use."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
import yaml
from motion.motion_bench import Story

from drivers.canopen.driver import CanopenArm
from ident_service.cli import main
from ident_service.config.load import load_arm
from ident_service.errors import ArmFault
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import arm_model
from ident_service.motion.command_channel import StopCondition
from ident_service.motion.run import RunReport, run
from ident_service.registry.state_folder import arm_fault_store
from sim_backend.emulator.faults import parse_fault
from sim_backend.emulator.lock_step import LockStepArm

CONFIGS = Path(__file__).parents[2] / "configs"
PATIENCE = 60.0  # s of the machine's time; nothing is judged by it but what never happens
TRIES = 5
MOTION = {"kind": "seeded", "seed": 1, "base_frequency": 0.2, "harmonics": 5, "periods": 2}
SHORT = {"kind": "seeded", "seed": 1, "base_frequency": 0.4, "harmonics": 2, "periods": 1}
MIDST = 2.4  # s; such a motion moves then
TORQUE_NOISE = [0.05, 0.02]
# What a machine that stalls does to an arm in real time; a run that ended so is run again. 8250h is the emergency of a
# drive whose torque frame is overdue, which may be heard before its watchdog's status.
STALLS = (
    "bus_silent",
    "clock_jump",
    "drive_watchdog",
    "feedback_gone",
    "late",
    "not ready to switch on within",
    "repeated_warnings",
    "lease_lost",
    "8250h",
    "not every axis answers",  # before anything moves
)


def acknowledge(arm: Path, name: str, state: Path) -> None:
    """Acknowledge whatever is latched."""
    for code in arm_fault_store(state, name).latched():
        assert main(["ack", str(arm), code, "--state", str(state)]) == 0


def described(name: str, rate: float, kp: float, kd: float) -> dict[str, Any]:
    """planar2 with its motions made short, at a rate that the test can keep, on no drives yet."""
    gains = {"kp": kp, "kd": kd, "following_error": 0.4}
    return {
        "extends": str(CONFIGS / "planar2.yaml"),
        "name": name,
        "control": {"rate": rate, "velocity_cutoff": 30},
        "joints": {"shoulder": gains, "elbow": gains},
        "motions": {"identification": MOTION, "validation": MOTION},
    }


def truth() -> dict[str, float]:
    """What planar2 really is."""
    tree = yaml.safe_load((CONFIGS / "planar2.yaml").read_text(encoding="utf-8"))
    return dict(tree["driver"]["truth"])


def simulated(tree: dict[str, Any], seed: int) -> dict[str, Any]:
    """The arm of the simulator, with encoders and drives without any error."""
    driver = {"kind": "simulated", "seed": seed, "truth": truth(), "torque_noise": TORQUE_NOISE}
    return tree | {"driver": driver}


def canopen(tree: dict[str, Any], bus: dict[str, Any], seed: int, **driver: Any) -> dict[str, Any]:
    """The same arm behind a differential and two drives."""
    drive = {"counts": 65536, "rated_torque": 0.1, "max_torque": 3.0, "max_speed": 6000.0}
    section = {
        "kind": "canopen",
        "eds": str(CONFIGS / "emulated_drive.eds"),
        "buses": [bus],
        "drives": [drive | {"node": 1}, drive | {"node": 2}],
        "emulation": {"seed": seed, "truth": truth(), "torque_noise": TORQUE_NOISE},
        "watchdog_reason": "an emulated arm behind a machine that stalls",
        "torque_deadline": max(0.01, 2.0 / tree["control"]["rate"]),  # two cycles at least
    }
    gears = {"ratios": [20.0, -20.0], "coupling": [[1.0, -0.5], [1.0, 0.5]], "drive_terms": "joints"}
    return tree | {"transmission": gears, "driver": section | driver}


def write(folder: Path, tree: dict[str, Any]) -> Path:
    path = folder / f"{tree['name']}.yaml"
    path.write_text(json.dumps(tree), encoding="utf-8")  # YAML without anchors
    return path


def ident(*words: object) -> list[str]:
    return [sys.executable, "-m", "ident_service", *map(str, words)]


def wait_for(what: Callable[[], Any], sentence: object) -> Any:
    """What it answers as soon as that is something."""
    end = time.monotonic() + PATIENCE
    while not (answer := what()):
        assert time.monotonic() < end, sentence() if callable(sentence) else sentence
        time.sleep(0.02)
    return answer


class Said:
    """A command in the background, and the lines that it has said."""

    def __init__(self, *words: object) -> None:
        self.lines: list[str] = []
        self.process = subprocess.Popen(
            ident(*words),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            bufsize=1,
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        self._reader.join()
        if self.process.stdout is not None:
            self.process.stdout.close()

    def _read(self) -> None:
        assert self.process.stdout is not None
        self.lines.extend(iter(self.process.stdout.readline, ""))

    @property
    def text(self) -> str:
        return "".join(self.lines)

    def says(self, words: str, after: int = 0) -> None:
        """Wait for a line with a match of this expression, after the first ones; or for the end, which fails."""

        def found() -> bool:
            ended = self.process.poll() is not None
            if any(re.search(words, line) for line in self.lines[after:]):
                return True
            assert not ended, f"never said {words!r}: {self.text}"
            return False

        wait_for(found, lambda: f"never said {words!r}: {self.text}")

    def code(self) -> int:
        """Wait for its end; its exit code."""
        code = self.process.wait(PATIENCE)
        self._reader.join()
        return code


def emulated(arm: Path) -> Said:
    """`ident emulate`, ready."""
    drives = Said("emulate", arm)
    drives.says("node 2: pre operational")
    return drives


def checked(arm: Path, name: str, state: Path) -> bool:
    return main(["check", str(arm), "--confirm", name, "--state", str(state)]) == 0


def child(parent: int, words: str) -> int | None:
    """The child of a process whose command has these words, or of its children."""
    for task in Path(f"/proc/{parent}/task").glob("*/children"):
        for number in task.read_text().split():
            pid = int(number)
            if words in Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode():
                return pid
            if (found := child(pid, words)) is not None:
                return found
    return None


def channel() -> str:
    return f"run-{os.getpid()}-{time.monotonic_ns() % 1_000_000}"


@dataclass
class Moved:
    """A motion with a fault in its midst, and what came of it."""

    behind: LockStepArm
    story: Story
    report: RunReport | None = None
    fault: ArmFault | None = None
    speed: list[np.ndarray] = field(default_factory=list)

    @property
    def off(self) -> bool:
        """Tell if no drive is enabled any more."""
        return not any("operation enabled" in state for state in self.behind.emulator.states)


def moved_arm(folder: Path, tree: dict[str, Any], fault: str = "", stop_at: float | None = None) -> Moved:
    """A short motion of an arm over emulated drives in virtual time.

    Args:
        folder: for its description.
        tree: the description.
        fault: that strikes in the midst of it.
        stop_at: when a stop is asked for [s]; the motion begins after about two seconds.
    """
    tree["motions"] = {"identification": SHORT, "validation": SHORT}
    config = load_arm(write(folder, tree))
    behind, model = LockStepArm(config), arm_model(config)
    came = Moved(behind, Story())
    behind.emulator.observer = lambda seen: came.speed.append(np.abs(seen.velocity))
    cycles = 0

    def asked() -> bool:
        nonlocal cycles
        cycles += 1
        if cycles == round(MIDST * config.control.rate) and fault:
            behind.inject(parse_fault(fault, tuple(config.joints)))
        return stop_at is not None and cycles > stop_at * config.control.rate

    with CanopenArm(config, lambda _: [behind.link(0)]) as arm:
        try:
            motion = excitation(model, "identification")
            came.report = run(arm, model, motion, came.story, StopCondition(asked), hold_seconds=0.1)
        except ArmFault as error:
            came.fault = error
    return came
