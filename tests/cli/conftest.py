"""The command run inside this process, on a small simulated arm that has been commissioned once."""

from __future__ import annotations

import contextlib
import io
import json
import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.once import made_once

from ident_service.cli import main
from ident_service.config.load import shipped_arms
from ident_service.recordings.open import open_recording


@dataclass(frozen=True)
class Ended:
    """What a command left behind: exit code, stdout, stderr."""

    code: int
    out: str
    err: str

    @property
    def next(self) -> list[str]:
        """The words after `ident` of the command that its last line names."""
        (line,) = [line for line in (self.out + self.err).splitlines() if line.startswith("next: ")]
        assert (self.out or self.err).endswith(f"{line}\n")
        words = shlex.split(line.removeprefix("next: "))
        assert words[0] == "ident"
        return words[1:]

    @property
    def json(self) -> dict[str, Any]:
        """The one object on stdout; anything beside it fails."""
        document = json.loads(self.out)
        assert isinstance(document, dict)
        assert document["exit_code"] == self.code
        return document


Ident = Callable[..., Ended]


def run_main(*words: object) -> int:
    """The exit code that a shell would see."""
    try:
        return main([str(word) for word in words])
    except SystemExit as end:
        return int(end.code or 0)


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """No test writes below the home folder."""
    folder = tmp_path / "state"
    monkeypatch.setenv("IDENT_STATE", str(folder))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "xdg"))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    return folder


@pytest.fixture
def ident(capsys: pytest.CaptureFixture[str]) -> Ident:
    """Run the command."""

    def run(*words: object) -> Ended:
        capsys.readouterr()
        code = run_main(*words)
        captured = capsys.readouterr()
        return Ended(code, captured.out, captured.err)

    return run


def left_over(folder: Path) -> list[str]:
    """All names below a folder, hidden ones too."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


# An eighth of the cycles of a real arm, with gains that are stable at this rate and the two cycles that a watchdog must
# last.
COARSE = (
    ("gravity: [0", "control: {rate: 125}\ngravity: [0"),
    ("  delay_cycles: 1\n", "  delay_cycles: 1\n  watchdog: 0.016\n"),
    ("following_error: 0.2, home: 0, kp: 400, kd: 40", "following_error: 0.4, home: 0, kp: 225, kd: 30"),
)


def quick_arm(folder: Path, *changes: tuple[str, str]) -> Path:
    """The shipped planar arm with motions of ten seconds, and other changes to its text."""
    text = shipped_arms()["planar2"].read_text()
    for old, new in (("base_frequency: 0.1", "base_frequency: 0.2"), *changes):
        assert old in text
        text = text.replace(old, new)
    path = folder / "quick.yaml"
    path.write_text(text)
    return path


@dataclass(frozen=True)
class Commissioned:
    """A finished `ident simulate`: the arm's description, its run folder, what was printed."""

    arm: Path
    folder: Path
    out: str


@pytest.fixture(scope="session")
def quick(tmp_path_factory: pytest.TempPathFactory) -> Commissioned:
    """The small arm, commissioned by the command; not to be changed."""

    def make(folder: Path) -> None:
        arm = quick_arm(folder, *COARSE)
        out = io.StringIO()
        with contextlib.redirect_stdout(out):
            code = run_main("simulate", arm, "--out", folder / "run")
        assert code == 0, out.getvalue()
        (folder / "out").write_text(out.getvalue())

    folder = made_once(tmp_path_factory, "quick", make)
    return Commissioned(folder / "quick.yaml", folder / "run", (folder / "out").read_text())


@dataclass(frozen=True)
class Samples:
    """A recording as arrays, to be written as CSV after something was done to it."""

    time: np.ndarray
    position: np.ndarray
    torque: np.ndarray

    def write(self, path: Path) -> Path:
        joints = range(1, self.position.shape[1] + 1)
        header = ",".join(["t", *(f"q{k}" for k in joints), *(f"tau{k}" for k in joints)])
        rows = np.column_stack([self.time, self.position, self.torque])
        np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.9g")
        return path


@pytest.fixture(scope="session")
def samples(quick: Commissioned) -> Samples:
    """The small arm's identification motion."""
    blocks = list(open_recording(quick.folder / "identification.mcap").blocks())
    stamps, position, torque = (
        np.concatenate([getattr(block, name) for block in blocks]) for name in ("stamp_ns", "position", "torque")
    )
    return Samples((stamps - stamps[0]) * 1e-9, position, torque)
