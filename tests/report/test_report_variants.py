"""Evidence of recordings that are smoothed, filtered, scaled or torn in other ways."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from estimation.synthetic import SampledRecording, stamps, waves, with_options
from helpers.plain import plain_options, plain_smoothing
from helpers.random_arms import model_around, random_chain, random_delta
from report.conftest import Made, made, recording
from report.pages import sections

from ident_service.config.arm import Identification
from ident_service.estimation.identify import identify
from ident_service.model.regressor import joint_regressor
from ident_service.results.evidence.gathering import gather_evidence, timing
from ident_service.results.report_files import write_report
from ident_service.results.run_folder import write_results


@pytest.mark.parametrize(
    "options",
    [
        plain_options(smoothing=plain_smoothing(cutoff=40.0, regressor_cutoff=20.0)),
        plain_options(smoothing=plain_smoothing(cutoff=40.0, decimate=10, filter_torque=True)),
        plain_options(smoothing=plain_smoothing(method="savitzky_golay", cutoff=40.0)),
        plain_options(smoothing=plain_smoothing(cutoff=40.0), method="huber"),
        plain_options(smoothing=plain_smoothing(cutoff=40.0), method="wls"),
    ],
    ids=["filtered_regressor", "decimated", "savitzky_golay", "huber", "wls"],
)
def test_every_method_to_smooth_and_fit_has_a_report(tmp_path: Path, options: Identification) -> None:
    one = made(tmp_path / "results", options=options)
    expected = one.estimate.candidates[one.estimate.chosen].identification.joint_rms
    for joint, rms in zip(one.evidence.recordings[0].joints, expected, strict=True):
        # Of a stretch both extremes are kept, so their rms is the residual's or a little more.
        assert 0.99 * rms < np.sqrt(np.mean(joint.residual**2)) < 1.5 * rms
    assert len(sections(one.page)["torque"].all("figure")) == 4


def test_a_stretch_that_is_missing_is_a_gap(good: Made) -> None:
    whole = recording(good.folder.parent, good.model, good.delta, 1, 0.02)
    kept = np.r_[0:2000, 2600:5000]
    torn = SampledRecording(whole.stamp_ns[kept], whole.position[kept], whole.torque[kept], whole.path, sha256="c" * 64)
    evidence = gather_evidence(good.estimate, [torn], [], "0" * 64)
    (seen,) = evidence.timing
    assert seen.gap_count == 1
    assert seen.gaps[0] == pytest.approx((1999 / 250.0, 601 / 250.0), abs=1e-6)
    steps = np.diff(evidence.recordings[0].time)
    assert (steps > 2.0).sum() == 1


def test_uneven_stamps_are_counted(good: Made) -> None:
    whole = recording(good.folder.parent, good.model, good.delta, 1)
    late = whole.stamp_ns.copy()
    late[1000] += 1_500_000
    seen = timing(replace(whole, stamp_ns=late))
    assert seen.largest == pytest.approx(1.5e-3, rel=1e-3)
    assert seen.counts[0] == 4999 - 2
    assert seen.counts[-3:].sum() == 2


def test_friction_of_coupled_drives_is_shown_per_drive(tmp_path: Path) -> None:
    # d = C q: the second motor turns with the first joint too.
    coupling = np.array([[1.0, 0.0], [0.5, 1.0]])
    good = made(tmp_path / "results", noise=0.0)
    model = replace(good.model, chain=replace(good.model.chain, coupling=coupling))
    time = np.arange(5000) / 250.0
    q, dq, ddq = (waves(1, 2).derivative(time, order) for order in range(3))
    torque = np.einsum("jps,p->sj", joint_regressor(model.chain, model.layout, q, dq, ddq), good.delta)
    path = tmp_path / "coupled.csv"
    path.touch()
    coupled = SampledRecording(stamps(5000, 250.0), q, torque, path, sha256="d" * 64)
    estimate = identify(model, [coupled])
    evidence = gather_evidence(estimate, [coupled], [], "0" * 64)
    layout = model.layout
    fv, fc, fo = (layout.term_values(term, good.delta) for term in ("viscous", "coulomb", "offset"))
    for drive, friction in enumerate(evidence.friction):
        moving = np.abs(friction.velocity) > 0.1
        v = friction.velocity[moving]
        true = fv[drive] * v + fc[drive] * np.sign(v) + fo[drive]
        np.testing.assert_allclose(friction.torque[moving], true, atol=0.05)


@pytest.mark.parametrize("seed", range(4))
def test_any_arm_has_a_report(tmp_path: Path, seed: int) -> None:
    # From one joint to four, in branches, some that slide.
    chain = random_chain(np.random.default_rng(seed), seed + 1)
    arm = with_options(model_around(chain), plain_options(smoothing=plain_smoothing(cutoff=40.0)))
    fitted = recording(tmp_path, arm, random_delta(np.random.default_rng(seed), arm.layout), 1, 0.01)
    estimate = identify(arm, [fitted])
    folder = tmp_path / "results"
    folder.mkdir()
    write_results(folder, estimate)
    write_report(folder, estimate, [fitted], [], [])
    page = (folder / "report.html").read_text(encoding="utf-8")
    found = sections(page)
    assert len(found["torque"].all("figure")) == len(found["friction"].all("figure")) == seed + 1
    assert len(found["bodies"].all("figure")) == 2
    if not all(chain.revolute):
        assert "torque [N]" in found["torque"].words
