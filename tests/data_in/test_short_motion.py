"""A stretch of motion that a fault cut short gives parameters, and no verdict of yes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from estimation.synthetic import SampledRecording, serial_chain, stamps, waves, with_options
from helpers.plain import plain_options, plain_smoothing
from helpers.random_arms import model_around, random_delta

from ident_service.cli import main
from ident_service.estimation.identify import Estimate, identify
from ident_service.estimation.plausibility import ENOUGH_MOTION, Objections, reasons_in_length
from ident_service.model.regressor import joint_regressor

RATE = 250.0
ARM = with_options(
    model_around(serial_chain(21, 2)), plain_options(smoothing=plain_smoothing(cutoff=20.0, filter_torque=True))
)


def moved(seconds: float, seed: int = 1) -> SampledRecording:
    """Record a motion with noise."""
    delta = random_delta(np.random.default_rng(5), ARM.layout)
    time = np.arange(round(seconds * RATE)) / RATE
    q, dq, ddq = (waves(seed, ARM.chain.joints).derivative(time, order) for order in range(3))
    torque = np.einsum("jps,p->sj", joint_regressor(ARM.chain, ARM.layout, q, dq, ddq), delta)
    torque += 0.5 * np.random.default_rng(seed).normal(size=torque.shape)
    return SampledRecording(stamps(len(time), RATE), q, torque, sha256=str(seed) * 64)


@pytest.fixture(scope="module")
def cut_short() -> Estimate:
    return identify(ARM, [moved(2.5)])


@pytest.mark.slow
def test_little_motion_that_leaves_much_unknown_is_no_yes(cut_short: Estimate) -> None:
    (reason,) = reasons_in_length(cut_short, 2.5)
    unknown = cut_short.verdicts.count("unidentified")
    assert unknown > 0.2 * cut_short.base.size
    assert f"s of motion, and {unknown} of its {cut_short.base.size} base parameters are unidentified" in reason
    assert f"record at least {ENOUGH_MOTION:g} s" in reason


def test_another_motion_mends_what_little_motion_alone_is_the_reason_of(cut_short: Estimate) -> None:
    reasons = reasons_in_length(cut_short, 2.5)
    assert Objections((), reasons).motion_mends
    assert not Objections(("a wrong sign",), reasons).motion_mends
    assert not Objections(()).motion_mends


def test_standstill_is_no_motion(cut_short: Estimate) -> None:
    """Of a long recording that hardly moves only the motion counts."""
    standing = moved(30.0)
    still = np.arange(len(standing.position)) > 2.5 * RATE
    position = np.where(still[:, None], standing.position[round(2.5 * RATE)], standing.position)
    torque = np.where(still[:, None], standing.torque[round(2.5 * RATE)], standing.torque)
    estimate = identify(ARM, [SampledRecording(standing.stamp_ns, position, torque, sha256="3" * 64)])
    assert reasons_in_length(estimate, 30.0) != ()


def test_enough_motion_is_not_objected_to() -> None:
    assert reasons_in_length(identify(ARM, [moved(20.0)]), 20.0) == ()


@pytest.mark.slow
def test_what_another_motion_validates_is_judged_there() -> None:
    estimate = identify(ARM, [moved(2.5)], [moved(20.0, seed=2)])
    assert reasons_in_length(estimate, 2.5) == ()


def test_the_command_says_no(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = moved(4.0)
    columns = np.column_stack([recording.stamp_ns * 1e-9, recording.position, recording.torque])
    path = tmp_path / "cut.csv"
    np.savetxt(path, columns, delimiter=",", header="t,q1,q2,tau1,tau2", comments="")
    code = main(["identify", str(path), "--arm", "planar2", "--out", str(tmp_path / "out"), "--json"])
    document = json.loads(capsys.readouterr().out)
    assert code == 3, document
    assert document["usable"] is False
    assert any("s of motion, and " in reason for reason in document["unusable"])
    # These are no body's parameters, which another motion does not mend.
    assert document["another_motion_mends"] is False
