"""Condition number of the WAM's base regressor along the published motions, against independently computed figures."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import numpy as np
import pytest
import scipy  # its parts load for a second where they are used

from ident_service.model.arm_model import ArmModel
from ident_service.model.base_parameters import base_parameters
from ident_service.model.regressor import joint_regressor

Array = np.ndarray
_RATE = 1000.0
_SAMPLES_BEFORE_TRIMMING = 57_656 + 3_000 + 1_000


def condition(model: ArmModel, position: Array, velocity: Array, acceleration: Array) -> float:
    """2-norm condition number of the unscaled base regressor of all joints and samples."""
    base = base_parameters(model.chain, model.layout)
    H_b = joint_regressor(model.chain, model.layout, position, velocity, acceleration, base.base)
    W = H_b.transpose(0, 2, 1).reshape(-1, base.size)
    return float(np.linalg.cond(np.linalg.qr(W, mode="r")))


def target(folder: Path, figure: str, motion: str) -> float:
    """A published figure."""
    targets = json.loads((folder / "reproduction_targets.json").read_text())
    return float(targets["our_check_on_the_reference_trajectories"][figure][motion])


@pytest.mark.slow
@pytest.mark.parametrize("motion", ["traj1", "traj2"])
def test_along_one_period_of_the_series(wam7: ArmModel, wam7_data: Path, motion: str) -> None:
    series = json.loads((wam7_data / f"{motion}_fourier.json").read_text())
    a, b, q0 = (np.array(series[key]) for key in ("a", "b", "q0"))
    w = series["wf_rad_s"] * np.arange(1, series["L"] + 1)
    phase = np.arange(0.0, series["period_s"], 1.0 / _RATE)[:, None] * w
    sine, cosine = np.sin(phase), np.cos(phase)
    position = (sine / w) @ a.T - (cosine / w) @ b.T + q0
    velocity = cosine @ a.T + sine @ b.T
    acceleration = -(sine * w) @ a.T + (cosine * w) @ b.T
    expected = target(wam7_data, "condition_number_first_period_analytic", motion)
    assert condition(wam7, position, velocity, acceleration) == pytest.approx(expected, rel=0.002)


def five_point_difference(values: Array) -> Array:
    """Central difference of fourth order; the two samples at either end take their neighbour's."""
    inner = (values[:-4] - 8.0 * values[1:-3] + 8.0 * values[3:-1] - values[4:]) * _RATE / 12.0
    return np.pad(inner, ((2, 2), (0, 0)), mode="edge")


@pytest.mark.slow
@pytest.mark.parametrize("motion", ["traj1", pytest.param("traj2", marks=pytest.mark.campaign)])
def test_along_the_reference_processed_as_the_authors_did(wam7: ArmModel, wam7_data: Path, motion: str) -> None:
    with gzip.open(wam7_data / f"{motion}_reference.csv.gz", "rt") as stream:
        reference = np.loadtxt(stream, delimiter=",", skiprows=1)
    # The recordings were longer than the reference; the arm stood at its ends.
    missing = _SAMPLES_BEFORE_TRIMMING - len(reference)
    position = np.pad(reference, ((missing // 2, missing - missing // 2), (0, 0)), mode="edge")
    velocity = five_point_difference(position)
    acceleration = five_point_difference(velocity)
    low_pass = scipy.signal.butter(3, 2.0 * np.pi * 2.5 / _RATE)
    states = (
        scipy.signal.filtfilt(*low_pass, values, axis=0)[3000:-1000] for values in (position, velocity, acceleration)
    )
    expected = target(wam7_data, "condition_number_traj_dat_padded_and_processed_like_the_code", motion)
    assert condition(wam7, *states) == pytest.approx(expected, rel=0.01)
