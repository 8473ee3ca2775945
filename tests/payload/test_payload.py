"""Payloads with known truth: errors are as large as their deviations say, and each verdict is earned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy  # its statistics load for a second where they are used
from payload.known_arms import (
    ARM,
    BASE,
    DELTA,
    LAST,
    NOISE,
    blocks_of,
    body,
    known,
    planar_arm,
    planar_blocks,
    with_body,
)

from ident_service.errors import ParameterError
from ident_service.estimation.feasible.feasible_set import feasible_set, symmetric
from ident_service.estimation.payload import (
    FAR,
    KnownArm,
    Payload,
    body_words,
    center_of_mass,
    identify_payload,
    loaded_covariance,
)
from ident_service.results.payload_file import payload_text

TOOL = body(1.3, (0.05, -0.02, 0.12))
NAMES = ARM.layout.names[LAST]


def pseudo_inertia(delta: np.ndarray) -> np.ndarray:
    """Eigenvalues of the 4x4 matrix of a body."""
    (block,) = feasible_set("pseudo_inertia", NAMES).blocks
    return np.linalg.eigvalsh(symmetric(block.F @ delta[:10], 4))


def deviations_off(payload: Payload, truth: np.ndarray) -> np.ndarray:
    return (payload.fit.beta - payload.base.K[:, :10] @ truth) / payload.standard_deviations


@pytest.mark.slow
@pytest.mark.parametrize(
    "scale",
    [
        pytest.param(0.3, id="arm well known", marks=pytest.mark.campaign),
        pytest.param(3.0, id="arm badly known"),
    ],
)
def test_errors_are_as_large_as_their_deviations(scale: float) -> None:
    rng = np.random.default_rng(1)
    found, noise_alone = [], []
    for _ in range(40):
        arm = known(rng, scale=scale)
        payload = identify_payload(arm, blocks_of(with_body(TOOL), rng))
        assert payload.verdict == "added"
        found.append(deviations_off(payload, TOOL))
        noise_alone.append((payload.fit.beta - payload.base.K @ TOOL) / np.sqrt(np.diag(payload.noise)))
    z = np.array(found)
    # Deviations from 40 blocks have Student's tails.
    assert np.abs(z).max() < 4.5
    np.testing.assert_allclose(np.sqrt(np.mean(z**2, axis=0)), 1.0, atol=0.4)
    if scale > 1.0:
        assert (np.sqrt(np.mean(np.square(noise_alone), axis=0)) > 1.5).all()


@pytest.mark.campaign
@pytest.mark.slow
def test_no_payload_has_uniform_p_and_no_false_alarms() -> None:
    rng = np.random.default_rng(2)
    found = [identify_payload(known(rng), blocks_of(DELTA, rng)) for _ in range(80)]
    assert scipy.stats.kstest([one.test.p for one in found], "uniform").pvalue > 0.01
    assert [one.verdict for one in found].count("none") == 80
    assert all(one.body is None and one.fitted.rms == one.without.rms for one in found)


def test_an_added_body_is_a_real_one_near_the_truth() -> None:
    rng = np.random.default_rng(3)
    payload = identify_payload(known(rng), blocks_of(with_body(TOOL), rng))
    assert payload.verdict == "added"
    assert payload.body is not None
    assert pseudo_inertia(payload.body.delta)[0] > 0.0
    assert payload.body.delta[9] == pytest.approx(1.3, abs=0.05)
    center = center_of_mass(payload)
    assert center is not None
    assert (np.abs(center[0] - (0.05, -0.02, 0.12)) < 4.0 * center[1]).all()
    assert payload.fitted.rms < payload.without.rms
    words = dict(zip([payload.base.names[k] for k in payload.base.base], payload.verdicts, strict=True))
    assert {words[name] for name in ("lx4", "ly4", "lz4", "m4")} == {"identified"}
    assert payload.torque_share.max() > 0.01


def test_a_body_that_was_taken_off_is_a_removal_and_not_infeasible() -> None:
    rng = np.random.default_rng(4)
    arm = known(rng, with_body(TOOL))
    payload = identify_payload(arm, blocks_of(DELTA, rng))
    assert payload.verdict == "removed"
    assert payload.body is not None
    assert payload.body.delta[9] == pytest.approx(1.3, abs=0.05)
    assert pseudo_inertia(payload.body.delta)[0] > 0.0
    np.testing.assert_allclose(payload.body.b, -payload.base.K @ payload.body.delta, atol=1e-9)
    assert np.abs(deviations_off(payload, -TOOL)).max() < 4.5
    center = center_of_mass(payload)
    assert center is not None
    assert (np.abs(center[0] - (0.05, -0.02, 0.12)) < 4.0 * center[1]).all()


def test_one_tool_for_another_is_neither() -> None:
    rng = np.random.default_rng(5)
    arm = known(rng, with_body(body(2.0, (0.3, 0.0, 0.0))))
    payload = identify_payload(arm, blocks_of(with_body(body(2.0, (0.0, 0.3, 0.0))), rng))
    assert payload.verdict == "infeasible"
    assert payload.body is None


def test_refitted_offsets_keep_a_new_zero_out_of_the_body() -> None:
    rng = np.random.default_rng(6)
    delta = with_body(TOOL)
    offsets = ARM.layout.term_columns("offset")
    delta[offsets] += [2.0, -1.0, 0.7, -0.4]
    arm, recorded = known(rng), blocks_of(delta, rng)
    assert np.abs(deviations_off(identify_payload(arm, recorded), TOOL)).max() > 6.0
    payload = identify_payload(arm, recorded, refit_offsets=True)
    truth = payload.base.K @ np.concatenate([TOOL, [2.0, -1.0, 0.7, -0.4]])
    assert payload.verdict == "added"
    assert np.abs((payload.fit.beta - truth) / payload.standard_deviations).max() < 4.5
    assert payload.test.directions + payload.test.left_out == 10
    # New zeros alone are no payload.
    bare = DELTA.copy()
    bare[offsets] += [2.0, -1.0, 0.7, -0.4]
    assert identify_payload(arm, blocks_of(bare, rng), refit_offsets=True).verdict == "none"


def test_no_payload_is_not_reported_where_much_is_left_unexplained() -> None:
    rng = np.random.default_rng(21)
    arm = replace(known(rng), residual=NOISE)
    quiet = identify_payload(arm, blocks_of(DELTA, rng))
    assert (quiet.verdict, quiet.far()) == ("none", ())
    assert quiet.excess == pytest.approx(1.0, abs=0.1)
    # The same motion with noise on one joint 18 times as large, as from a brake that drags now and then.
    loud = identify_payload(arm, blocks_of(DELTA, rng, noise=NOISE * [1.0, 18.0, 1.0, 1.0]))
    assert identify_payload(replace(arm, residual=None), blocks_of(DELTA, rng, noise=18.0 * NOISE)).verdict == "none"
    assert (loud.verdict, loud.far(), loud.body) == ("infeasible", (1,), None)
    assert loud.excess is not None
    assert loud.excess[1] == pytest.approx(18.0, rel=0.1)
    text = payload_text(loud, arm)
    assert "moves as it was identified" not in text
    assert f"the residual is 18 times as large at joint {ARM.chain.names[1]} as when the arm was identified" in text


def test_a_residual_that_does_not_matter_beside_the_torque_is_no_change() -> None:
    rng = np.random.default_rng(22)
    arm = replace(known(rng), residual=0.01 * NOISE)
    payload = identify_payload(arm, blocks_of(DELTA, rng, noise=0.1 * NOISE))
    assert payload.excess is not None
    assert (payload.excess > FAR).all()
    assert (payload.fitted.joint_relative_percent < 1.0).all()
    assert payload.verdict == "none"


def test_a_value_within_its_deviation_is_not_identified() -> None:
    # A small tool on a slow motion: its moments of inertia are smaller than what is known of them.
    rng = np.random.default_rng(23)
    tool, share = body(0.1, (0.01, 0.0, 0.02), 0.02), 0.05
    payload = identify_payload(
        known(rng, scale=share), blocks_of(with_body(tool), rng, speed=0.35, noise=share * NOISE)
    )
    rows = zip(payload.base.expressions, payload.fit.beta, payload.standard_deviations, strict=True)
    within = [k for k, (name, value, deviation) in enumerate(rows) if abs(value) < deviation and name[0] == "L"]
    assert len(within) > 1
    assert {payload.verdicts[k] for k in within} <= {"weak", "unidentified"}
    words = dict(zip(payload.base.expressions, payload.verdicts, strict=True))
    assert {words[name] for name in ("lx4", "ly4", "lz4", "m4")} == {"identified"}
    # Where motion shows it well, what is as good as zero is identified.
    fast = identify_payload(known(rng, scale=1e-3), blocks_of(with_body(tool), rng, noise=1e-3 * NOISE))
    assert set(fast.verdicts) == {"identified"}


def test_at_rest_nobody_sees_an_inertia() -> None:
    rng = np.random.default_rng(7)
    payload = identify_payload(known(rng), blocks_of(with_body(TOOL), rng, speed=0.0))
    words = dict(zip([payload.base.names[k][:-1] for k in payload.base.base], payload.verdicts, strict=True))
    assert {words[symbol] for symbol in ("Lxx", "Lxy", "Lxz", "Lyy", "Lyz", "Lzz")} == {"unidentified"}
    assert {words[symbol] for symbol in ("lx", "ly", "lz", "m")} == {"identified"}
    assert payload.test.left_out == 6
    assert payload.verdict == "added"
    assert payload.body is not None
    assert pseudo_inertia(payload.body.delta)[0] > 0.0
    assert payload.body.delta[9] == pytest.approx(1.3, abs=0.2)
    assert np.abs(payload.body.delta[:6]).max() < 0.1  # of a load of 1.3 kg, where its inertia shows in nothing
    assert set(body_words(payload)[:6]) == {"chosen"}
    covariance = loaded_covariance(known(rng), payload)
    assert np.isinf(np.diag(covariance)).any()


def test_what_the_arm_did_not_know_the_payload_does_not_know() -> None:
    rng = np.random.default_rng(8)
    arm = known(rng)
    place = BASE.expressions.index("fv4")
    covariance = arm.covariance.copy()
    covariance[place, :] = covariance[:, place] = 0.0
    covariance[place, place] = np.inf
    beta = arm.beta.copy()
    beta[place] = 0.0
    payload = identify_payload(KnownArm(ARM, BASE, beta, covariance), blocks_of(with_body(TOOL), rng))
    assert np.isinf(payload.standard_deviations).any()
    assert not np.isnan(payload.standard_deviations).any()


@pytest.mark.parametrize("size", [0.0, 0.03], ids=["a point", "a ball"])
def test_what_no_motion_shows_of_a_load_is_small_and_reported_as_chosen(size: float) -> None:
    # A planar arm shows four of the ten; nearly a point has no room inside the usual inset.
    arm, truth = planar_arm(), body(0.3, (0.0, 0.0, 0.0), size)
    payload = identify_payload(arm, planar_blocks(arm, truth))
    assert payload.verdict == "added"
    assert payload.body is not None
    names, words = payload.base.names, body_words(payload)
    chosen = {name for name, word in zip(names, words, strict=True) if word == "chosen"}
    assert chosen == {"Lxx2", "Lxy2", "Lxz2", "Lyy2", "Lyz2", "lz2"}
    found = dict(zip(names, payload.body.delta, strict=True))
    assert found["m2"] == pytest.approx(0.3, abs=0.01)
    assert 0.0 < found["Lxx2"] < 1e-3
    assert 0.0 < found["Lyy2"] < 1e-3
    (line,) = (line for line in payload_text(payload, arm).splitlines() if "not identified, chosen" in line)
    assert all(f"{name} " in line for name in chosen)


@pytest.mark.campaign
@pytest.mark.slow
def test_the_loaded_arm_s_covariance_is_that_of_its_estimate() -> None:
    rng = np.random.default_rng(9)
    delta, off = with_body(TOOL), []
    for _ in range(60):
        arm = known(rng)
        payload = identify_payload(arm, blocks_of(delta, rng))
        error = arm.beta + payload.T @ payload.fit.beta - BASE.K @ delta
        off.append(error / np.sqrt(np.diag(loaded_covariance(arm, payload))))
    spread = np.sqrt(np.mean(np.square(off), axis=0))
    assert (spread > 0.65).all()
    assert (spread < 1.35).all()


def test_what_does_not_belong_together_is_refused() -> None:
    arm = known(np.random.default_rng(10))
    with pytest.raises(ParameterError, match=r"beta\.shape"):
        KnownArm(ARM, BASE, arm.beta[1:], arm.covariance)
    without = replace(ARM, layout=replace(ARM.layout, terms=("viscous",)))
    with pytest.raises(ParameterError, match="other links or joint terms"):
        KnownArm(without, BASE, arm.beta, arm.covariance)
