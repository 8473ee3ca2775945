"""Runs that end early: `ident run --until`, whatever becomes of the process that looks, and what is learned by then."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.tickets import write_checked_ticket
from runs.conftest import written

from ident_service.cli import main
from ident_service.cli.motion_commands import _report_text
from ident_service.config.load import load_arm, shipped_arms
from ident_service.errors import UsageError
from ident_service.estimation.online import ParameterUncertainty
from ident_service.estimation.target import LEAST_BLOCKS, Target, worst_relative_deviation
from ident_service.estimation.uncertainty import relative_deviations
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.base_parameters import base_parameters
from ident_service.operations.motion_run import TargetMonitor, least_seconds, require_target
from ident_service.operations.target_process import missed as not_known
from ident_service.recordings.mcap_reader import McapRecording
from ident_service.recordings.open import open_recording

PERIOD = 10.0  # s, of the shipped planar arm's motion
SHARE = 0.06


@pytest.fixture
def long_arm(tmp_path: Path) -> Path:
    """The planar arm in virtual time with a motion far longer than it needs, and than this machine takes to look."""
    motion = "{kind: seeded, seed: 1, base_frequency: 0.1, harmonics: 5, periods: 240}"
    return written(tmp_path / "long.yaml", motion)


@pytest.fixture(scope="module")
def model() -> ArmModel:
    return arm_model(load_arm(shipped_arms()["planar2"]))


def ran(arm: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    """The answer of a checked run."""
    state = ["--state", str(tmp_path / "state")]
    write_checked_ticket(load_arm(arm), tmp_path / "state")
    assert main(["run", str(arm), "--out", str(tmp_path / "run"), "--json", *words, *state]) == 0
    return dict(json.loads(capsys.readouterr().out))


@pytest.mark.slow
def test_a_run_ends_early_with_what_it_is_for(
    long_arm: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = ran(long_arm, tmp_path, capsys, "--until", str(SHARE))["report"]
    assert (report["state"], report["finished"]) == ("done", "early")
    reached = report["until"]["reached"]
    assert 0.0 < reached["share"] <= SHARE
    assert report["until"]["missed"] == []
    assert PERIOD <= reached["seconds"] <= report["motion_seconds"] < 240.0 * PERIOD
    ended = json.loads((tmp_path / "run" / "ended.json").read_text())
    assert (ended["state"], ended["finished"]) == ("done", "early")
    recording = open_recording(tmp_path / "run" / "run.mcap")
    assert isinstance(recording, McapRecording)
    assert recording.metadata["complete"] == "true"
    words = ["identify", str(tmp_path / "run" / "run.mcap"), "--arm", str(long_arm), "--out", str(tmp_path / "result")]
    assert main(words) == 0
    content = json.loads((tmp_path / "result" / "parameters.json").read_text())
    table = content["base_parameters"]
    found = relative_deviations(*(np.array(table[key]) for key in ("values", "standard_deviations", "negligible")))
    # Deviations from 40 blocks are known to 11 % themselves, and the result smooths otherwise than what is watched.
    assert (found <= 1.35 * SHARE).all(), found
    assert content["feasibility"]["feasible"]


@pytest.mark.campaign
@pytest.mark.slow
def test_a_target_that_is_not_reached_lets_the_run_go_on_to_its_end(
    virtual_arm: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = ran(virtual_arm, tmp_path, capsys, "--until", "0.0001", "--parameter", "fv1")["report"]
    assert (report["state"], report.get("finished")) == ("done", None)
    ((missed),) = report["until"].pop("missed")
    assert report["until"] == {"share": 0.0001, "parameters": ["fv1"], "reached": None}
    assert missed["parameter"] == "fv1"
    assert 0.0001 < missed["share"] < 1.0
    # Of all parameters of the same recording, those that are known as well as asked are left out, the worst come first.
    every = [one["share"] for one in not_known(tmp_path / "run", Target(1e-6), PERIOD)]
    some = not_known(tmp_path / "run", Target(float(np.median(every))), PERIOD)
    assert [one["share"] for one in some] == [share for share in every if share > np.median(every)]
    assert every == sorted(every, reverse=True)
    text = _report_text(report | {"until": {**report["until"], "missed": [missed, {"parameter": "m2", "share": None}]}})
    assert "target of 0.01%: missed by 2 parameters" in text
    assert f"\n  fv1: known to {missed['share']:.2%}\n  m2: not excited\n" in text
    assert report["cycles"] > 1_250  # ten seconds of motion at 125 Hz


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--until", "0.1", "--parameter", "nonsense"], "nonsense: not among the base parameters"),
        (["--until", "0"], "a target of 0 of a parameter"),
        (["--parameter", "fv1"], "--parameter needs --until SHARE"),
    ],
)
def test_a_target_that_is_none_is_refused_before_anything_moves(
    virtual_arm: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], said: str
) -> None:
    state = ["--state", str(tmp_path / "state")]
    write_checked_ticket(load_arm(virtual_arm), tmp_path / "state")
    assert main(["run", str(virtual_arm), "--out", str(tmp_path / "run"), *words, *state]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_finish_is_refused_where_nobody_moves(virtual_arm: Path, tmp_path: Path, capsys: Any) -> None:
    assert main(["finish", str(virtual_arm), "--state", str(tmp_path / "state")]) == 2
    assert "the arm is not moving" in capsys.readouterr().err


_AS_ZERO = 0.01


def doubt(model: ArmModel, values: float, deviation: float, blocks: int = LEAST_BLOCKS) -> ParameterUncertainty:
    size = base_parameters(model.chain, model.layout).size
    return ParameterUncertainty(
        20.0, np.full(size, values), np.full(size, deviation), _AS_ZERO * np.arange(1.0, size + 1), (), blocks
    )


def test_the_rule(model: ArmModel) -> None:
    base = base_parameters(model.chain, model.layout)
    everything = Target(0.1).base_indices(base, "planar2")
    assert everything.tolist() == list(range(base.size))
    assert worst_relative_deviation(doubt(model, 2.0, 0.1), everything) == pytest.approx(0.05)
    # As good as zero: a share of what is, the smallest of which counts.
    assert worst_relative_deviation(doubt(model, 0.0, 1e-3), everything) == pytest.approx(1e-3 / _AS_ZERO)
    assert worst_relative_deviation(doubt(model, 2.0, 0.1, LEAST_BLOCKS - 1), everything) == np.inf
    for unknown in (np.inf, np.nan):
        assert worst_relative_deviation(doubt(model, 2.0, unknown), everything) == np.inf
    mixed = doubt(model, 2.0, 0.1)
    mixed.deviations[:3] = 1.0, 0.02, np.inf
    (second,) = chosen = Target(0.1, (base.expressions[1].replace(" ", ""),)).base_indices(base, "planar2")
    assert second == 1
    assert worst_relative_deviation(mixed, chosen) == pytest.approx(0.01)
    assert worst_relative_deviation(mixed, everything) == np.inf
    for share in (0.0, 1.0, -1.0, float("nan")):
        with pytest.raises(UsageError, match="above 0 and below 1"):
            require_target(Target(share), model)


def test_nothing_counts_before_the_first_period(model: ArmModel) -> None:
    motion = excitation(model, "identification")
    assert least_seconds(motion, 1.0) == pytest.approx(PERIOD)
    assert least_seconds(motion, 0.5) == pytest.approx(2.0 * PERIOD)


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_one_that_looks_may_die_or_hang(tmp_path: Path, how: signal.Signals) -> None:
    told: list[str] = []
    with TargetMonitor(tmp_path, Target(0.1), 0.0, told.append) as reaching:
        assert not reaching.reached()
        os.kill(reaching._process.pid, how)
        if how is signal.SIGKILL:
            end = time.monotonic() + 60.0
            while not told:
                assert not reaching.reached()
                assert time.monotonic() < end
                time.sleep(0.01)
        assert not reaching.reached()
    assert reaching._process.returncode is not None
    died = ["the target is no longer monitored; the motion continues to its end"]
    assert told == (died if how is signal.SIGKILL else [])
