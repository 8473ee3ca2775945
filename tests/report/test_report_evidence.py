"""evidence.json: what was gathered comes back, and what is torn, foreign or does not belong together is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from estimation.synthetic import waves
from report.conftest import Made
from results.svg import Svg

from ident_service.errors import ParameterError, UsageError
from ident_service.results.evidence.evidence import Evidence
from ident_service.results.evidence.file import (
    evidence_document,
    packed,
    packed_mask,
    read_evidence,
    unpacked,
    unpacked_mask,
    write_evidence,
)
from ident_service.results.posture_figure import spike_figure
from ident_service.results.report_files import read_evidence_of
from ident_service.results.run_folder import read_results, write_manifest


def test_packing_is_off_by_half_a_step_at_most() -> None:
    values = np.random.default_rng(1).normal(size=(2, 500))
    text = json.loads(json.dumps(packed(values)))
    back = unpacked(text, (2, None))
    assert np.abs(back - values).max() <= 0.5001 * np.ptp(values) / 65535
    assert (back.min(), back.max()) == pytest.approx((values.min(), values.max()), rel=1e-12)
    np.testing.assert_array_equal(unpacked(packed(np.full(3, 7.5)), (3,)), 7.5)
    assert unpacked(packed(np.zeros(0)), (0,)).shape == (0,)
    mask = np.random.default_rng(2).random(77) < 0.3
    np.testing.assert_array_equal(unpacked_mask(packed_mask(mask), 77), mask)


def test_packed_integers_are_little_endian() -> None:
    # What JavaScript reads with `DataView.getInt16(2 * k, true)`.
    import base64

    content = packed(np.array([0.0, 1.0, 65535.0]))
    assert np.frombuffer(base64.b64decode(content["data"]), "<i2").tolist() == [-32768, -32767, 32767]


def test_evidence_comes_back(good: Made, tmp_path: Path) -> None:
    path = tmp_path / "evidence.json"
    write_evidence(path, good.evidence)
    again = read_evidence(path)
    assert evidence_document(again)["conditions"] == evidence_document(good.evidence)["conditions"]
    for name in ("parameters_sha256", "joints", "bounds", "chosen", "warnings", "revolute"):
        assert getattr(again, name) == getattr(good.evidence, name)
    for one, other in zip(again.recordings, good.evidence.recordings, strict=True):
        np.testing.assert_allclose(one.time, other.time, rtol=0, atol=1e-9)
        for a, b in zip(one.joints, other.joints, strict=True):
            np.testing.assert_allclose(a.torque, b.torque, atol=2e-5 * np.ptp(b.torque))
            np.testing.assert_array_equal(a.standstill, b.standstill)
        for s, t in zip(one.spectra, other.spectra, strict=True):
            np.testing.assert_allclose(s.density, t.density, rtol=1e-3)


def test_spikes_are_the_largest_residuals_of_joints_in_motion(alone: Made, tmp_path: Path) -> None:
    (fitted,) = alone.evidence.recordings
    for k, (joint, spike) in enumerate(zip(fitted.joints, fitted.spikes, strict=True)):
        assert spike is not None
        residual = np.where(joint.standstill, 0.0, joint.residual[0])
        at = int(np.argmax(np.abs(residual)))
        assert spike.residual == pytest.approx(residual[at], rel=1e-3)
        assert spike.time == pytest.approx(fitted.time[at], abs=fitted.width)
        text = spike_figure(alone.model.chain, k, spike.time, spike.residual, spike.position)
        assert len(text) < 20_000  # so that a report has room for one of each joint
        drawn = Svg.of(text)
        drawn.require_sound()
        assert drawn.title.startswith(f"{alone.model.chain.names[k]}: residual of ")
        assert len(drawn.all("circle", "dot")) == 3  # the joint, in both views and in the legend
        # The posture is that of the motion then.
        expected = waves(1, alone.model.chain.joints).derivative(np.array([spike.time]), 0)[0]
        np.testing.assert_allclose(spike.position, expected, atol=1e-3)
    # Files of earlier versions have none.
    document = evidence_document(alone.evidence)
    for one in document["recordings"]:
        del one["spikes"]
    path = tmp_path / "earlier.json"
    path.write_text(json.dumps(document))
    assert read_evidence(path).recordings[0].spikes == ()


def test_traces_are_the_recording_and_the_estimate(alone: Made) -> None:
    (fitted,) = alone.evidence.recordings
    assert fitted.sha256 == alone.estimate.recordings[0][1]
    rms = alone.estimate.candidates[alone.estimate.chosen].identification.joint_rms
    for joint, expected in zip(fitted.joints, rms, strict=True):
        # All samples of one recording fit into its stretches one by one, so nothing was merged.
        assert np.abs(np.diff(joint.torque, axis=0)).max() == 0.0
        left = joint.torque[0] - joint.predicted[0]
        np.testing.assert_allclose(left, joint.residual[0], atol=1e-4 * np.ptp(joint.torque))
        assert np.sqrt(np.mean(joint.residual[0] ** 2)) == pytest.approx(expected, rel=0.01)


def test_recordings_keep_their_roles(good: Made) -> None:
    assert [one.role for one in good.evidence.recordings] == ["identification", "validation"]
    assert [one.name for one in good.evidence.recordings] == ["motion_1.csv", "motion_2.csv"]


def test_the_residual_s_spectrum_is_that_of_the_noise(good: Made) -> None:
    for spectrum in good.evidence.recordings[1].spectra:
        assert np.median(spectrum.density) == pytest.approx(0.02**2 / 125.0, rel=0.2)
        assert abs(spectrum.correlation[3:]).max() < 0.25


def test_estimates_stand_side_by_side(good: Made, bare: Made) -> None:
    names = [one.name for one in good.evidence.estimates]
    assert names[0] == "CAD"
    np.testing.assert_allclose(good.evidence.estimates[0].values, good.estimate.base.K @ (1.1 * good.delta), rtol=1e-12)
    assert names[good.evidence.unconstrained] == "OLS"
    assert names[good.evidence.constrained] == names[good.evidence.chosen] == "FBPE-OLS pseudo_inertia"
    np.testing.assert_array_equal(good.evidence.estimates[good.evidence.chosen].values, good.parameters.values)
    assert [one.name for one in bare.evidence.estimates][bare.evidence.chosen] == "OLS"
    assert bare.evidence.posed is None
    assert bare.evidence.conditions == ()


def test_timing_from_stamps_says_that_it_is(good: Made) -> None:
    timing = good.evidence.timing[0]
    assert (timing.source, timing.lost, timing.invalid) == ("stamps", None, ())
    assert timing.rate == pytest.approx(250.0)
    assert timing.counts.sum() == timing.samples - 1 == 4999
    assert timing.largest == 0.0


Change = Callable[[dict[str, Any]], object]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda c: c.update(format="other"), "not evidence of an identification"),
        (lambda c: c.update(version=2), "evidence of version 2, but this software reads version 1"),
        (lambda c: c.pop("timing"), '"timing" is a required property'),
        (lambda c: c["timing"].pop(), "not one timing per recording"),
        (lambda c: c["estimates"][0]["values"].pop(), "do not belong together: estimate 'CAD' has"),
        (lambda c: c.update(chosen=99), "chosen is estimate 99 of"),
        (lambda c: c["recordings"][0]["joints"].pop(), "has 1 joints, not 2"),
        (lambda c: c["recordings"][0]["joints"][0]["torque"].update(data="AAAA"), "in 3 bytes"),
        (lambda c: c["recordings"][0]["joints"][0]["torque"].update(data="?"), "not base64"),
        (lambda c: c["recordings"][0]["joints"][0]["standstill"].update(bits=3), "a mask of 3 bits"),
        (lambda c: c["recordings"][0].update(runs=[[0, 10**9]]), "1000000000 stretches"),
        (lambda c: c["recordings"][0].update(runs=[[5, 1], [0, len_of(c) - 1]]), "does not increase"),
        (lambda c: c["friction"].pop(), "not one friction per drive"),
        (lambda c: c["posed"]["branches"][0].append(99), "the arm's branches"),
        (lambda c: c["recordings"][0].update(sha256="x"), "does not match"),
        (lambda c: c["recordings"][0]["joints"][0]["torque"].update(step=1e300), "an array of numbers up to"),
        (lambda c: c["friction"][0]["curve_torque"].__setitem__(0, 1e13), "a number of 1e\\+13"),
        (lambda c: c["recordings"][0]["spectra"][0]["log_density"].update(low=1e9), "a density beyond any"),
        (lambda c: c["recordings"][0]["spikes"].pop(), "has 1 spikes, not 2"),
        (lambda c: c["recordings"][0]["spikes"][0]["position"].pop(), "is not of 2 joints"),
        (lambda c: c["timing"][0].update(rate=0.0), "rate"),
    ],
)
def test_what_does_not_belong_together_is_refused(good: Made, tmp_path: Path, change: Change, reason: str) -> None:
    path = tmp_path / "evidence.json"
    content = json.loads((good.folder / "evidence.json").read_text())
    change(content)
    path.write_text(json.dumps(content))
    with pytest.raises(ParameterError, match=reason) as found:
        read_evidence(path)
    assert str(found.value).startswith(f"{path}: ")
    assert "\n" not in str(found.value)


def len_of(content: dict[str, Any]) -> int:
    return sum(length for _, length in content["recordings"][0]["runs"])


@pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
def test_torn_evidence_is_refused(good: Made, tmp_path: Path, share: float) -> None:
    path = tmp_path / "evidence.json"
    whole = (good.folder / "evidence.json").read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(ParameterError, match="torn, or not JSON"):
        read_evidence(path)
    path.write_text("[" * 100_000)
    with pytest.raises(ParameterError, match="torn, or not JSON"):
        read_evidence(path)
    path.write_text(whole.decode().replace('"version":1', '"version":NaN'))
    with pytest.raises(ParameterError, match="NaN is not a number that JSON knows"):
        read_evidence(path)
    path.write_text("[]")
    with pytest.raises(ParameterError, match="not evidence"):
        read_evidence(path)
    with pytest.raises(UsageError, match="no such file"):
        read_evidence(tmp_path / "none.json")


def test_evidence_of_other_parameters_is_refused(good: Made, bare: Made, tmp_path: Path) -> None:
    import shutil

    folder = tmp_path / "mixed"
    shutil.copytree(good.folder, folder)
    shutil.copy(bare.folder / "evidence.json", folder)
    write_manifest(folder)
    with pytest.raises(ParameterError, match=r"belongs to another parameters\.json"):
        read_evidence_of(read_results(folder))


def test_evidence_is_plain_data(good: Made) -> None:
    assert isinstance(good.evidence, Evidence)
    assert (good.folder / "evidence.json").stat().st_size < 2e6
