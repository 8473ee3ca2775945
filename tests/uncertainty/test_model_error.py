"""Deviations are true where the model is not: an error of the model that repeats with the motion of the paper's WAM."""

from __future__ import annotations

import json
import re
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from estimation.synthetic import SampledRecording, exact_torque, stamps, with_options

from ident_service.config.arm import FrictionShape, Identification, Smoothing
from ident_service.config.load import load_arm
from ident_service.estimation.feasible.feasible_set import feasible_set
from ident_service.estimation.fit import Fit, prepare, unconstrained
from ident_service.estimation.uncertainty import negligible, verdicts
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.base_parameters import BaseParameters, base_parameters
from ident_service.operations.commissioning import true_parameters
from ident_service.results.summary import noise_and_model

CONFIGS = Path(__file__).parents[2] / "configs"
RATE = 100.0
NOISE = 0.1  # N m
WAVES = 3.0  # of the model's error per radian


@cache
def arm() -> tuple[ArmModel, np.ndarray, BaseParameters]:
    model = arm_model(load_arm(CONFIGS / "wam7_sim.yaml"))
    truth = true_parameters(model.config, model)
    options = Identification(
        method="wls",
        smoothing=Smoothing(cutoff=8.0, decimate=2),
        friction=FrictionShape(presliding=0.0, stribeck_velocity=0.1),
        edge=0.25,
    )
    return with_options(model, options), truth, base_parameters(model.chain, model.layout)


def made(folder: Path, motion: str, periods: int, error: float, seed: int) -> SampledRecording:
    """A published motion, with noise and an error `error sin(3 q + phase)` of the model [N m], another phase a seed."""
    model, truth, _ = arm()
    rng = np.random.default_rng(seed)
    series = json.loads((folder / f"{motion}_fourier.json").read_text())
    a, b, q0 = (np.array(series[key]) for key in ("a", "b", "q0"))
    w = series["wf_rad_s"] * np.arange(1, series["L"] + 1)
    phase = np.arange(round(series["period_s"] * periods * RATE))[:, None] / RATE * w
    sine, cosine = np.sin(phase), np.cos(phase)
    q = (sine / w) @ a.T - (cosine / w) @ b.T + q0
    torque = exact_torque(model, truth, q, cosine @ a.T + sine @ b.T, -(sine * w) @ a.T + (cosine * w) @ b.T)
    torque += error * np.sin(WAVES * q + rng.uniform(0.0, 2.0 * np.pi, 7)) + NOISE * rng.normal(size=q.shape)
    return SampledRecording(stamps(len(q), RATE), q, torque, sha256=f"{seed:064d}")


def fitted(recording: SampledRecording) -> Fit:
    model, _, base = arm()
    conditions = feasible_set("inertia", base.names, model.config)
    return unconstrained("wls", [recording], prepare([recording], model, base, conditions), base, conditions)


def judged(fit: Fit) -> np.ndarray:
    """Errors of the parameters that are called identified, in deviations."""
    _, truth, base = arm()
    words = verdicts(fit.fit.beta, fit.deviations, negligible(fit.equations.total))
    identified = np.array([word == "identified" for word in words])
    return np.asarray(((fit.fit.beta - base.K @ truth) / fit.deviations)[identified])


def noise_share(fit: Fit) -> float:
    """Read from the words beside a result how much of the variances is noise."""
    assert fit.noise is not None
    words = noise_and_model(np.sqrt(fit.noise), np.diag(fit.covariance))
    found = re.match(
        r"The motion is repeated: (\d+)% of a parameter's variance is noise .* the rest is model error", words
    )
    assert found is not None
    return float(found[1]) / 100.0


@pytest.mark.slow
def test_more_periods_do_not_make_an_error_of_the_model_smaller(wam7_data: Path) -> None:
    one, nine = (fitted(made(wam7_data, "traj1", periods, error=0.1, seed=0)) for periods in (1, 9))
    assert one.noise is None
    assert nine.noise is not None
    known = np.isfinite(one.deviations) & np.isfinite(nine.deviations)
    assert np.median(nine.deviations[known] / one.deviations[known]) == pytest.approx(1.0, abs=0.15)
    assert np.median(np.sqrt(nine.noise[known]) / nine.deviations[known]) < 0.1
    assert len(nine.equations.clusters) == len(one.equations.clusters)
    # The report says so: of one period nothing can be told, of nine nearly all is model error.
    assert "cannot be separated" in noise_and_model(None, np.diag(one.covariance))
    assert noise_share(nine) < 0.01
    for fit in (one, nine):
        errors = judged(fit)
        assert len(errors) > 20
        assert np.sqrt(np.mean(errors**2)) < 1.3
        assert np.sum(np.abs(errors) > 3.0) <= 1


@pytest.mark.slow
def test_more_periods_make_noise_smaller(wam7_data: Path) -> None:
    one, nine = (fitted(made(wam7_data, "traj1", periods, error=0.0, seed=0)) for periods in (1, 9))
    known = np.isfinite(one.deviations) & np.isfinite(nine.deviations)
    assert np.median(nine.deviations[known] / one.deviations[known]) == pytest.approx(1.0 / 3.0, abs=0.1)
    assert len(judged(nine)) > len(judged(one))
    assert noise_share(nine) > 0.3


@pytest.mark.campaign
@pytest.mark.parametrize("error", [0.0, 0.02, 0.1])
def test_of_what_is_called_identified_hardly_anything_is_far_off(wam7_data: Path, error: float) -> None:
    every = []
    for motion, periods in product(("traj1", "traj2"), (1, 3)):
        errors = np.concatenate([judged(fitted(made(wam7_data, motion, periods, error, seed))) for seed in range(40)])
        share = float(np.mean(np.abs(errors) > 3.0))
        print(
            f"{motion}, {periods} periods, {error:g} N m: {len(errors)} identified, {share:.2%} beyond three deviations"
        )
        assert share <= 0.025
        every.append(errors)
    assert np.mean(np.abs(np.concatenate(every)) > 3.0) <= 0.02
