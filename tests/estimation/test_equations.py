"""From recordings to information: block size, merging and order make no difference to what is known."""

from __future__ import annotations

import numpy as np
import pytest
from estimation.synthetic import SampledRecording, recorded, serial_chain, smoothed_samples, stamps, waves, with_options
from helpers.plain import plain_options, plain_smoothing
from helpers.random_arms import model_around, random_delta

from ident_service.config.arm import Reversal
from ident_service.errors import RecordingError
from ident_service.estimation import equations as module
from ident_service.estimation import signal_processing as smoothing
from ident_service.estimation.equations import Equations, equations
from ident_service.model.arm_model import ArmModel
from ident_service.model.base_parameters import BaseParameters, base_parameters
from ident_service.model.regressor import joint_regressor
from ident_service.recordings.cached_recording import CachedRecording

OPTIONS = plain_options(smoothing=plain_smoothing(cutoff=40.0))


@pytest.fixture(scope="module")
def arm() -> ArmModel:
    return with_options(model_around(serial_chain(11, 2)), OPTIONS)


@pytest.fixture(scope="module")
def base(arm: ArmModel) -> BaseParameters:
    return base_parameters(arm.chain, arm.layout)


@pytest.fixture(scope="module")
def recording(arm: ArmModel) -> SampledRecording:
    return recorded(arm, random_delta(np.random.default_rng(11), arm.layout), waves(11, 2))


def normal_matrix(gathered: Equations) -> np.ndarray:
    """`[W omega]^T [W omega]`, which does not depend on the signs that a QR leaves."""
    R = gathered.total.stacked()
    return R.T @ R


def assert_same_knowledge(one: Equations, other: Equations) -> None:
    wanted = normal_matrix(other)
    scale = np.sqrt(np.outer(np.diag(wanted), np.diag(wanted))) + 1e-12 * wanted.max()
    np.testing.assert_allclose(normal_matrix(one) / scale, wanted / scale, rtol=0, atol=1e-10)
    np.testing.assert_array_equal(one.total.rows, other.total.rows)
    assert one.samples == other.samples


def test_equations_are_those_of_the_smoothed_samples(
    arm: ArmModel, base: BaseParameters, recording: SampledRecording
) -> None:
    motion = smoothed_samples(recording, OPTIONS)
    H = joint_regressor(arm.chain, arm.layout, motion.position, motion.velocity, motion.acceleration)
    rows = [
        np.column_stack([H[joint].T[:, base.base], motion.torque[:, joint]])[motion.keep[:, joint]]
        for joint in range(arm.chain.joints)
    ]
    stacked = np.vstack(rows)
    got = equations(recording, arm, base)
    wanted = stacked.T @ stacked
    np.testing.assert_allclose(normal_matrix(got), wanted, rtol=0, atol=1e-10 * wanted.max())
    np.testing.assert_array_equal(got.total.rows, [len(part) for part in rows])
    assert got.samples == len(motion.time)


@pytest.mark.parametrize("block", [0.01, 0.37, 5.0, 1000.0])
def test_block_length_makes_no_difference_to_the_total(
    arm: ArmModel, base: BaseParameters, recording: SampledRecording, block: float
) -> None:
    other = with_options(arm, OPTIONS.model_copy(update={"block": block}))
    got = equations(recording, other, base)
    assert_same_knowledge(got, equations(recording, arm, base))
    # 19 s of samples; the recording's own edges may leave half a block at either end. Few long blocks are made shorter.
    most = min(max(19.0 / block, module.LEAST_BLOCKS) + 2, module.MAX_BLOCKS)
    assert min(max(0.9 * 19.0 / block, module.LEAST_BLOCKS), 0.5 * module.MAX_BLOCKS) <= len(got.blocks) <= most


@pytest.mark.parametrize("window", [1000, 2100])
def test_windows_make_no_difference_to_the_total(
    monkeypatch: pytest.MonkeyPatch, arm: ArmModel, base: BaseParameters, recording: SampledRecording, window: int
) -> None:
    whole = equations(recording, arm, base)
    monkeypatch.setattr(smoothing, "_WINDOW", window)
    assert_same_knowledge(equations(recording, arm, base), whole)


@pytest.mark.parametrize("most", [1, 3, 8])
def test_merging_keeps_totals_and_bounds_the_number_of_blocks(
    monkeypatch: pytest.MonkeyPatch, arm: ArmModel, base: BaseParameters, recording: SampledRecording, most: int
) -> None:
    whole = equations(recording, arm, base)
    assert len(whole.blocks) > 15
    monkeypatch.setattr(module, "MAX_BLOCKS", most)
    merged = equations(recording, arm, base)
    assert most / 2 <= len(merged.blocks) <= most
    assert_same_knowledge(merged, whole)
    twice = equations([recording, recording], arm, base)
    assert len(twice.blocks) <= most
    np.testing.assert_array_equal(twice.total.rows, 2 * whole.total.rows)
    assert twice.samples == 2 * whole.samples


def test_blocks_stay_in_order_of_time(
    monkeypatch: pytest.MonkeyPatch, arm: ArmModel, base: BaseParameters, recording: SampledRecording
) -> None:
    whole = equations(recording, arm, base)
    monkeypatch.setattr(module, "MAX_BLOCKS", 10)
    monkeypatch.setattr(module, "_CHUNK", 10**6)
    merged = equations(recording, arm, base)
    # Every block of the shorter list ends where one of the longer list does.
    fine = np.cumsum([block.rows for block in whole.blocks], axis=0).tolist()
    coarse = np.cumsum([block.rows for block in merged.blocks], axis=0).tolist()
    assert len(coarse) <= 10
    assert all(end in fine for end in coarse)


def test_wrong_joint_count_is_refused(arm: ArmModel, base: BaseParameters) -> None:
    three = SampledRecording(stamps(4000, 250.0), np.zeros((4000, 3)), np.zeros((4000, 3)))
    with pytest.raises(RecordingError, match=r"synthetic\.csv: has 3 joints but the arm random has 2"):
        equations(three, arm, base)


def test_a_joint_that_never_moves_is_named(arm: ArmModel, base: BaseParameters, recording: SampledRecording) -> None:
    position = recording.position.copy()
    position[:, 1] = 0.3
    with pytest.raises(RecordingError, match=r"joint_1: never faster than identification\.reversal\.speed"):
        equations(SampledRecording(recording.stamp_ns, position, recording.torque), arm, base)


def test_reversals_without_window_or_speed_keep_all_rows(
    arm: ArmModel, base: BaseParameters, recording: SampledRecording
) -> None:
    everything = with_options(arm, OPTIONS.model_copy(update={"reversal": Reversal(speed=0.0, window=0.0)}))
    got = equations(recording, everything, base)
    turns = np.sum(np.diff(np.signbit(smoothed_samples(recording, OPTIONS).velocity), axis=0), axis=0)
    np.testing.assert_array_equal(got.samples - got.total.rows, turns)


def test_the_rows_of_a_model_are_made_once(
    arm: ArmModel, base: BaseParameters, recording: SampledRecording, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = list[int]()

    def counted(*given: object) -> np.ndarray:
        made.append(1)
        return joint_regressor(*given)  # type: ignore[arg-type]

    monkeypatch.setattr(module, "joint_regressor", counted)
    kept = CachedRecording(recording)
    first = equations(kept, arm, base)
    once = len(made)
    assert_same_knowledge(equations(kept, arm, base), first)
    assert len(made) == once
    # Another model has other rows, and recordings beyond the bound are read again.
    equations(kept, with_options(arm, OPTIONS), base)
    assert len(made) == 2 * once
    monkeypatch.setattr(module, "_KEPT_BYTES", 1)
    large = CachedRecording(recording)
    assert_same_knowledge(equations(large, arm, base), first)
    assert_same_knowledge(equations(large, arm, base), first)
    assert len(made) == 4 * once
