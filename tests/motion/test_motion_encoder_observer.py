"""A joint that its push should have moved has a frozen encoder; whole runs: `test_motion_encoder_observer_runs.py`."""

from __future__ import annotations

import numpy as np
import pytest
from guard_bench import HOME, LIMITS, PERIOD, Bench, is_fault, unit
from motion_bench import PRIOR, bench_config, bench_model

from ident_service.model.pinocchio_models import InverseDynamics
from ident_service.motion.encoder_observer import (
    HIDDEN_SHARE,
    SLID,
    SLIDING,
    STANDING,
    STEPS,
    EncoderCoordinates,
    FrozenEncoderObserver,
    encoder_coupling,
    frozen_encoder_observer,
)
from ident_service.motion.safety_monitor import FROZEN_CYCLES, FROZEN_EFFORT, SUDDEN_CYCLES, SUDDEN_SPEED

Array = np.ndarray
MODEL = bench_model()
assert MODEL.prior is not None
DYNAMICS = InverseDynamics(MODEL.chain, MODEL.layout, MODEL.prior)
INERTIA = np.diag(DYNAMICS.mass_matrix(HOME))
FRICTION, STEP = np.array([0.8, 0.3]), np.full(2, 1e-5)
HIDDEN = HIDDEN_SHARE * LIMITS.following_error + STEPS * STEP
NONE, STILL = np.zeros(2), np.zeros(2)
LAST = 1e-7  # rad, a step within which a joint may have come to rest


def observer() -> FrozenEncoderObserver:
    return FrozenEncoderObserver(DYNAMICS, LIMITS, PERIOD, FRICTION, STEP)


def shown(owed: FrozenEncoderObserver, steps: Array, correction: Array) -> Array:
    """Corrections that are each joint's own."""
    return owed.update(steps, correction, correction / INERTIA, HOME)


def cycles_until(owed: FrozenEncoderObserver, correction: Array, most: int = 3000) -> int | None:
    """After how many cycles of standing still under a correction something is owed."""
    for cycle in range(1, most + 1):
        if shown(owed, STILL, correction).any():
            return cycle
    return None


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("excess", [0.3, 3.0])
def test_missing_motion_is_what_the_push_beyond_friction_would_have_moved(
    joint: int, side: float, excess: float
) -> None:
    push = side * unit(joint) * (STANDING * FRICTION + excess)
    expected = np.sqrt(2.0 * HIDDEN[joint] * INERTIA[joint] / excess) / PERIOD
    assert cycles_until(observer(), push) == pytest.approx(expected, abs=2.0)
    assert cycles_until(observer(), side * unit(joint) * STANDING * FRICTION) is None


def slid(owed: FrozenEncoderObserver, direction: float, apart: int, correction: Array = NONE) -> None:
    """Two steps of the elbow, so many cycles apart."""
    shown(owed, direction * unit(1), correction)
    for _ in range(apart - 1):
        shown(owed, STILL, correction)
    shown(owed, direction * unit(1), correction)


def test_a_joint_slides_at_the_same_speed_whatever_the_rate() -> None:
    # The WAM's wrist stood between steps 56 ms apart; its push then changed by less than friction holds.
    between = 0.5 * (SLIDING + STANDING) * FRICTION * unit(1)
    for apart, found in ((5, True), (14, False)):
        owed = FrozenEncoderObserver(DYNAMICS, LIMITS, 4e-3, FRICTION, STEP)
        slid(owed, 1.0, apart)
        assert (cycles_until(owed, between) is not None) == found


@pytest.mark.parametrize("direction", [-1.0, 1.0])
def test_a_joint_that_slid_is_held_by_less_on_its_way_and_by_as_much_back(direction: float) -> None:
    between = 0.5 * (SLIDING + STANDING) * FRICTION * unit(1)
    slow = round(SLID / PERIOD)
    for apart, way, found in ((1, 1.0, True), (slow, 1.0, True), (slow + 1, 1.0, False), (1, -1.0, False)):
        owed = observer()
        slid(owed, direction, apart)
        assert (cycles_until(owed, way * direction * between) is not None) == found, (apart, way)


def test_a_joint_that_was_too_fast_to_come_to_rest_within_a_cycle_has_not_been_braked_to_rest() -> None:
    friction = FRICTION[1]
    most = (1.0 + STANDING) * friction / INERTIA[1] * PERIOD**2  # the step within which it may have come to rest, twice
    for step, found in ((0.99 * most, False), (1.01 * most, True)):
        owed = observer()
        slid(owed, step, 1, -friction * unit(1))
        assert (cycles_until(owed, 0.5 * friction * unit(1)) is not None) == found


@pytest.mark.parametrize("direction", [-1.0, 1.0])
def test_the_end_of_braking_is_no_push(direction: float) -> None:
    way, friction = direction * unit(1), FRICTION[1]
    for braking, most in ((-0.5, 1.5), (-1.5, 2.5), (-9.0, STANDING), (0.5, SLIDING)):
        for excess, found in ((-0.05, False), (0.05, True)):
            owed = observer()
            slid(owed, direction * LAST, 1, braking * friction * way)
            assert (cycles_until(owed, (braking + most + excess) * friction * way) is not None) == found


def test_friction_fed_forward_against_the_motion_brakes() -> None:
    way, friction = unit(1), FRICTION[1]
    for excess, found in ((-0.05, False), (0.05, True)):
        owed = observer()
        for _ in range(2):
            owed.update(LAST * way, NONE, NONE, HOME, -friction * way)
        push = (SLIDING + excess) * friction * way
        seen = [bool(owed.update(STILL, push, push / INERTIA, HOME).any()) for _ in range(3000)]
        assert any(seen) == found


def test_a_joint_that_steps_to_and_fro_does_not_slide() -> None:
    owed = observer()
    for side in (1.0, -1.0, 1.0, -1.0):
        shown(owed, side * unit(1), NONE)
    assert cycles_until(owed, 0.5 * (SLIDING + STANDING) * FRICTION) is None


def test_only_the_change_since_the_last_step_counts() -> None:
    owed, needed = observer(), 10.0 * FRICTION  # what gravity that the model does not know takes
    shown(owed, np.ones(2), needed)
    assert cycles_until(owed, needed + 0.99 * STANDING * FRICTION) is None
    assert cycles_until(owed, needed - 1.5 * STANDING * FRICTION) is not None


def test_a_step_and_less_push_forgive_missing_motion() -> None:
    push = 1.5 * STANDING * FRICTION * unit(1)
    alone = cycles_until(observer(), push)
    assert alone is not None
    for forgive in (unit(1), STILL):
        owed = observer()
        for _ in range(5):
            assert cycles_until(owed, push, alone - 1) is None
            shown(owed, forgive, NONE)


def test_without_a_commanded_motion_none_is_missing() -> None:
    owed = observer()
    shown(owed, np.ones(2), 5.0 * STANDING * FRICTION)
    assert cycles_until(owed, NONE) is None


@pytest.mark.slow
def test_what_only_balances_another_joint_is_no_missing_motion() -> None:
    push = 3.0 * STANDING * FRICTION * unit(1)
    for own, found in ((0.0, False), (-1.0, False), (0.3, False), (0.5, True)):
        owed = observer()
        seen = [bool(owed.update(STILL, push, own * push / INERTIA, HOME).any()) for _ in range(3000)]
        assert any(seen) == found, own


def test_losing_an_axis_excuses_nothing() -> None:
    push = 1.2 * STANDING * FRICTION * unit(1)
    assert (np.abs(push) < FROZEN_EFFORT * LIMITS.torque).all()
    alone = cycles_until(observer(), push)
    assert alone is not None
    assert alone > FROZEN_CYCLES
    bench = Bench(encoder_observer=observer())
    bench.see(HOME, answer=NONE)
    for cycle in range(alone - 1):
        fault = bench.see(HOME, correction=push, answer=push / INERTIA, valid=(True, cycle % 6 != 0))[1]
        assert fault is None or fault.code == "lost_feedback"
    is_fault(bench.see(HOME, correction=push, answer=push / INERTIA)[1], "frozen_encoder", 1)


@pytest.mark.parametrize(("known", "expected"), [(None, 0.3), (0.1, 0.3), (0.7, 0.7)])
def test_friction_is_the_guess_or_more_if_the_prior_has_more(known: float | None, expected: float) -> None:
    model = bench_model(prior=PRIOR if known is None else PRIOR | {"fc2": known})
    owed = frozen_encoder_observer(DYNAMICS, model, LIMITS, PERIOD, STEP)
    assert cycles_until(owed, 0.99 * STANDING * expected * unit(1)) is None
    assert cycles_until(owed, 1.2 * STANDING * expected * unit(1)) is not None


# Two drives that move both joints: d = C q, and what they give for the joints' torques.
COUPLING = np.array([[1.0, -0.6], [1.0, 0.6]])
TO_JOINTS, TO_DRIVES = np.linalg.inv(COUPLING), np.linalg.inv(COUPLING).T
MOVES = np.abs(COUPLING)


def drive(which: int) -> Array:
    """How joints move when one drive does."""
    return TO_JOINTS[:, which]


@pytest.mark.parametrize("stuck", [0, 1])
@pytest.mark.parametrize("share", [0.9, 1.1])
def test_a_drive_that_stands_still_in_full_motion_is_found_although_no_joint_stands(stuck: int, share: float) -> None:
    bench, other = Bench(coupling=COUPLING), drive(1 - stuck)
    fast = share * SUDDEN_SPEED * MOVES[stuck] @ LIMITS.velocity * drive(stuck)
    faults = [
        bench.see(HOME + 1e-4 * cycle * other, velocity=fast + 1e-3 * other)[1] for cycle in range(SUDDEN_CYCLES + 5)
    ]
    found = [fault for fault in faults if fault is not None]
    if share > 1.0:
        is_fault(found[0], "frozen_encoder")
        assert found[0].message.startswith("shoulder, elbow: ")
    else:
        assert found == []


def test_drives_that_both_move_are_not_frozen_and_neither_are_joints_that_stand_for_one_another() -> None:
    for way in (drive(0) + 0.01 * drive(1), np.array([1.0, 0.0]), np.array([0.0, 1.0])):
        bench = Bench(coupling=COUPLING)
        for cycle in range(3 * FROZEN_CYCLES):
            push = 0.9 * FROZEN_EFFORT * LIMITS.torque * (way != 0.0)
            assert bench.see(HOME + 1e-4 * cycle * way, velocity=0.1 * way, correction=push)[1] is None


@pytest.mark.parametrize("stuck", [0, 1])
def test_a_drive_that_is_pushed_hard_and_stands_is_found_although_its_joints_move_by_the_other(stuck: int) -> None:
    hard = FROZEN_EFFORT * (np.abs(TO_DRIVES) * LIMITS.torque).max(axis=1)[stuck]
    for share, cycles in ((0.9, None), (1.1, FROZEN_CYCLES)):
        # The torque of the joints that is this drive's alone: tau = C^T f.
        push = share * hard * COUPLING.T[:, stuck]
        bench = Bench(coupling=COUPLING)
        found = [bench.see(HOME + 1e-4 * k * drive(1 - stuck), correction=push)[1] for k in range(2 * FROZEN_CYCLES)]
        first = next((k + 1 for k, fault in enumerate(found) if fault is not None), None)
        assert first == cycles
        if cycles is not None:
            is_fault(found[cycles - 1], "frozen_encoder")


@pytest.mark.parametrize("stuck", [0, 1])
def test_the_missing_motion_of_a_drive_is_what_the_push_beyond_its_friction_would_have_moved(stuck: int) -> None:
    friction = np.append(FRICTION, (np.abs(TO_DRIVES) * FRICTION).max(axis=1))
    inertia = (TO_DRIVES @ DYNAMICS.mass_matrix(HOME) @ TO_DRIVES.T)[stuck, stuck]
    hidden = (MOVES @ HIDDEN)[stuck]
    moving = np.append(np.ones(2), np.where(np.arange(2) == stuck, 0.0, 1.0))
    for excess, found in ((-0.1, False), (0.5, True), (2.0, True)):
        owed = FrozenEncoderObserver(DYNAMICS, LIMITS, PERIOD, friction, STEP, coupling=COUPLING)
        push = (STANDING * friction[2 + stuck] + excess) * COUPLING.T[:, stuck]
        answer = np.linalg.solve(DYNAMICS.mass_matrix(HOME), push)
        cycles = next((k for k in range(1, 3000) if owed.update(moving, push, answer, HOME)[2 + stuck]), None)
        assert (cycles is not None) == found
        if cycles is not None:
            # Its joints give way to the push as well, so that it would have moved at least as far.
            assert cycles <= np.sqrt(2.0 * hidden * inertia / excess) / PERIOD + 2.0


def test_a_drive_is_unknown_while_one_of_its_joints_is() -> None:
    coordinates = EncoderCoordinates.of(np.array([[1.0, 0.0, 0.0], [0.0, 1.0, -0.6], [0.0, 1.0, 0.6]]), 3)
    assert coordinates.valid(np.array([True, True, True])).tolist() == [True] * 5
    assert coordinates.valid(np.array([False, True, True])).tolist() == [False, True, True, True, True]
    assert coordinates.valid(np.array([True, True, False])).tolist() == [True, True, False, False, False]
    assert coordinates.at_joints(np.array([False, False, False, True, False])).tolist() == [False, True, True]
    assert not coordinates.steps(np.array([0.0, np.nan, 0.1]), np.zeros(3))[3:].any()


def test_positions_that_are_computed_back_from_a_drive_that_stands_show_that_it_stands() -> None:
    rng = np.random.default_rng(4)
    coordinates = EncoderCoordinates.of(COUPLING, 2)
    drives = rng.uniform(-3.0, 3.0, size=(200, 2))
    drives[:, 0] = drives[0, 0]
    positions = np.linalg.solve(COUPLING, drives.T).T
    steps = np.array([coordinates.steps(*pair) for pair in zip(positions[1:], positions[:-1], strict=True)])
    assert not steps[:, 2].any()
    assert steps[:, 3].all()


@pytest.mark.parametrize("drive_terms", ["joints", "motors"])
def test_encoders_at_shared_drives_count_the_drives_whatever_the_parameters_are_of(drive_terms: str) -> None:
    gears = {"ratios": (20.0, -30.0), "coupling": COUPLING.tolist(), "drive_terms": drive_terms}
    coupling = encoder_coupling(bench_config(transmission=gears))
    assert coupling is not None
    np.testing.assert_array_equal(coupling, COUPLING)
    assert encoder_coupling(bench_config()) is None
    assert encoder_coupling(bench_config(transmission={"ratios": (20.0, 30.0)})) is None
