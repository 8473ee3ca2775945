"""Runs that are killed again and again on one arm, and everything that must be true after each."""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ident_service.cli import main
from ident_service.config.load import load_arm, shipped_arms
from ident_service.errors import DriverError, RecordingError
from ident_service.recordings.mcap_reader import McapRecording
from ident_service.recordings.open import open_recording
from ident_service.registry.state_folder import arm_fault_store
from sim_backend.plant_status import PlantStatus, read_status

PATIENCE = 90.0  # s of the machine's time; nothing is judged by it but what never happens
TAG = "IDENT_KILL_TAG"
VICTIMS = {"parent": "ident_service", "recorder": "recordings.recorder_main", "motion": "motion.process"}
# What the next run is told of a victim that was killed while the arm moved.
FAULT = {"parent": "lease_lost", "recorder": "recorder_behind", "motion": "motion_process"}
MOTION = "{kind: seeded, seed: 1, base_frequency: 0.2, harmonics: 5, periods: 2}"
# Drives that put up with a machine that stalls; what a watchdog does is tested in virtual time.
REAL = "time: real, watchdog: 0.5, watchdog_reason: a simulated arm on a busy machine, deadline: 2.0"
# A rate that a busy machine keeps, and gains that are stable at it.
_GAINS = "{kp: 100, kd: 16, following_error: 0.4}"
SLOW = f"control: {{rate: 50}}\njoints: {{shoulder: {_GAINS}, elbow: {_GAINS}}}\n"
# What a machine that stalls does to an arm in real time; a kill that this came before is played again.
STALLS = {"late_cycles", "repeated_warnings", "bus_silent", "clock_jump", "driver", "drive_watchdog", "lease_lost"}
TRIES = 6


def tagged(tag: str) -> dict[int, str]:
    """Command of each living process that has this tag in its environment, whoever its parent is now."""
    found = {}
    for entry in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if f"{TAG}={tag}".encode() in (entry / "environ").read_bytes().split(b"\0"):
                found[int(entry.name)] = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
    return found


def wait_for(what: Callable[[], Any], sentence: str) -> Any:
    """What it answers as soon as that is something."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        if answer := what():
            return answer
        time.sleep(0.02)
    raise AssertionError(sentence)


@dataclass(frozen=True)
class Kill:
    """One kill: who, when the run has said which word, and how long after that [s]; None for after its start."""

    victim: str
    word: str | None
    delay: float

    def __str__(self) -> str:
        return f"{self.victim}-{self.word}-{self.delay:.3f}"


def kills(seed: int, count: int, longest: float) -> list[Kill]:
    """As many of each victim; a third from the start on, the others while the arm moves."""
    draw = np.random.default_rng(seed)
    words = (None, "approaching", "exciting")
    found = []
    for index in range(count):
        word = words[index // len(VICTIMS) % len(words)]
        found.append(
            Kill(list(VICTIMS)[index % len(VICTIMS)], word, draw.random() * (4.0 if word is None else longest))
        )
    return found


class StalledError(Exception):
    """The machine was too busy for a run in real time."""


@dataclass(frozen=True)
class Outcome:
    """What came of a kill.

    Attributes:
        moved: whether the arm had been taken, so that a fault was latched.
        status: the plant's last words, None when there was none yet.
        samples: that can be read.
        unsaved: from the last of them to the kill [s], 0 without any and in virtual time.
    """

    moved: bool
    status: PlantStatus | None
    samples: int
    unsaved: float


class Lane:
    """One arm, checked once, and its runs one after the other."""

    def __init__(self, folder: Path, name: str, driver: str, more: str = "") -> None:
        folder.mkdir()
        self.folder, self.arm, self.state = folder, folder / "arm.yaml", folder / "state"
        self._status, self._count, self._expires = folder / "plant.status", 0, 0.0
        self.arm.write_text(
            f"extends: {shipped_arms()[name]}\n{more}motions: {{identification: {MOTION}, validation: {MOTION}}}\n"
            f"driver: {{process: separate, {driver}, status: {self._status}}}\n"
        )
        self.config = load_arm(self.arm)
        self._real = "time: real" in driver
        self.faults = arm_fault_store(self.state, self.config.name)

    def check(self) -> None:
        """Preflight, unless the last one still counts."""
        if time.monotonic() > self._expires:
            words = ["check", str(self.arm), "--confirm", self.config.name, "--state", str(self.state)]
            assert any(main(words) == 0 for _ in range(TRIES if self._real else 1))
            self._expires = time.monotonic() + 600.0

    @contextmanager
    def started(self) -> Iterator[tuple[subprocess.Popen[str], str, Path]]:
        """An `ident run` in the background: the process, its family's tag, its folder."""
        self.check()
        self._status.unlink(missing_ok=True)
        self._count += 1
        tag, run = secrets.token_hex(8), self.folder / f"run{self._count}"
        process = subprocess.Popen(
            [sys.executable, "-m", "ident_service", "run", self.arm, "--out", run, "--state", self.state],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, TAG: tag},
        )
        try:
            yield process, tag, run
        finally:
            for pid in tagged(tag):
                os.kill(pid, signal.SIGKILL)
            process.communicate()

    def runs(self) -> None:
        """The arm runs from beginning to end."""
        with self.started() as (process, _, run):
            _, err = process.communicate(timeout=PATIENCE)
            assert process.returncode == 0, err
            assert json.loads((run / "ended.json").read_text())["state"] == "done"
            _check_manifest(run)
            assert McapRecording(run / "run.mcap").metadata["complete"] == "true"

    def kill(self, kill: Kill, capsys: pytest.CaptureFixture[str]) -> Outcome:
        """Kill somebody, and see to it that all is as it must be."""
        for again in range(TRIES):
            try:
                return self._killed(kill, capsys)
            except StalledError:
                if not self._real or again + 1 == TRIES:
                    raise
        raise AssertionError

    def _killed(self, kill: Kill, capsys: pytest.CaptureFixture[str]) -> Outcome:
        with self.started() as (process, tag, run):
            if kill.word is not None:
                self._reach(process, kill)
            time.sleep(kill.delay)

            def doomed() -> int | None:
                if process.poll() is not None:
                    raise self._ended_first(process, kill)
                if kill.victim == "parent":
                    return process.pid
                return next((pid for pid, words in tagged(tag).items() if VICTIMS[kill.victim] in words), None)

            pid = wait_for(doomed, f"{kill}: there never was a victim")
            family, killed_ns = set(tagged(tag)), time.monotonic_ns()
            os.kill(pid, signal.SIGKILL)
            _, err = process.communicate(timeout=PATIENCE)
            wait_for(lambda: not tagged(tag), f"{kill}: left behind: {tagged(tag)}")
        sockets = Path("/proc/net/unix").read_text()
        assert not any(f"ident-plant-{os.getuid()}-{one}-" in sockets for one in family)
        assert not list(Path("/dev/shm").glob("*ident*"))  # noqa: S108 - looked at, not written
        if kill.victim == "parent":
            assert process.returncode == -signal.SIGKILL
        else:
            assert process.returncode != 0
            assert "Traceback" not in err
            assert err.startswith("ident: ")
        status = self._at_rest()
        moved = self._faults(kill, run)
        samples, last_ns = self._readable(kill, run, capsys)
        if kill.word is not None:
            assert moved
        if not run.exists():
            assert not moved
        elif kill.victim != "parent":
            assert "error" in json.loads((run / "ended.json").read_text())
            _check_manifest(run)
        return Outcome(moved, status, samples, (killed_ns - last_ns) * 1e-9 if self._real and samples else 0.0)

    def _reach(self, process: subprocess.Popen[str], kill: Kill) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            if line.strip() == kill.word:
                return
        raise self._ended_first(process, kill)

    def _ended_first(self, process: subprocess.Popen[str], kill: Kill) -> StalledError:
        latched, said = self.faults.latched(), process.communicate()
        for code in latched:
            self.faults.acknowledge(code)
        assert set(latched) & STALLS, f"{kill}: the run ended first: {said}"
        return StalledError(f"{kill}: {latched}")

    def _at_rest(self) -> PlantStatus | None:
        """The plant's last words; it was never too strong nor, with the usual watchdog, too fast."""
        try:
            status = read_status(self._status)
        except DriverError:  # killed before there was one
            return None
        limits = self.config.joints.values()
        assert status.ended, status
        if not self._real:  # the wide watchdog of real time lets the last torque act for half a second
            assert (np.abs(status.peak_velocity) < 1.3 * np.array([joint.velocity for joint in limits])).all(), status
        assert (np.abs(status.peak_torque) <= np.array([joint.torque for joint in limits]) + 1e-9).all()
        return status

    def _faults(self, kill: Kill, run: Path) -> bool:
        """What is latched says who was killed; a person acknowledges it. Whether there was something."""
        latched = self.faults.latched()
        if self._real and not set(latched) <= {FAULT[kill.victim]}:
            for code in latched:
                self.faults.acknowledge(code)
            assert set(latched) & STALLS, latched
            raise StalledError(f"{kill}: {latched}")
        assert set(latched) <= {FAULT[kill.victim]}, latched
        if latched and kill.victim == "parent":  # nobody but the motion process was there to write it
            assert json.loads((run / "ended.json").read_text())["error"].startswith("lease_lost: ")
        for code in latched:
            assert main(["ack", str(self.arm), code, "--state", str(self.state)]) == 0
        assert self.faults.latched() == {}
        return bool(latched)

    def _readable(self, kill: Kill, run: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, int]:
        """The recording is read as far as it goes and `identify` has an answer; samples, and the last stamp [ns]."""
        for path in run.glob("*.json"):
            json.loads(path.read_text())
        path = next(iter(run.glob("run.mcap*")), None)
        if path is None:
            return 0, 0
        assert (path.suffix == ".partial") == (kill.victim == "recorder")
        capsys.readouterr()
        words = ["identify", str(path), "--arm", str(self.arm), "--out", str(self.folder / f"found{self._count}")]
        code = main(words)
        out, err = capsys.readouterr()
        try:
            recording = open_recording(path, tuple(self.config.joints))
        except RecordingError as error:
            nothing = "no message on /joint_states" in str(error)
            assert (nothing, code, err.count("\n")) == (True, 2, 1), err
            return 0, 0
        stamps = np.concatenate([block.stamp_ns for block in recording.blocks()])
        if code == 0:
            assert ("torn" in err) == recording.torn, err
        elif code == 3:  # a verdict: so short a motion may say nothing that can be used
            assert out.startswith("DO NOT USE"), out
        else:
            assert err.startswith("ident: "), err
            assert len([line for line in err.splitlines() if line.startswith("ident: ")]) == 1
        return len(stamps), int(stamps[-1])


def _check_manifest(run: Path) -> None:
    files = json.loads((run / "manifest.json").read_text())["files"]
    assert files == {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in run.iterdir()
        if path.is_file() and path.name != "manifest.json" and not path.name.startswith(".")
    }
