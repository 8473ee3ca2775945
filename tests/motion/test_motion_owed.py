"""A frozen encoder is told before its joint is fast, however slowly it begins; a joint that sticks is not one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from branches import endings
from campaign_bench import Subject, play, subject
from guard_bench import HOME, LIMITS, PERIOD, Bench, is_fault, unit
from motion_bench import PRIOR, TRUTH, bench_config, bench_model

from ident_service.config.schema import ArmConfig
from ident_service.model.rigid_body import InverseDynamics
from ident_service.motion.checks import FROZEN_CYCLES, FROZEN_EFFORT, VELOCITY_OFF
from ident_service.motion.owed import OWED, SLID, SLIDING, STANDING, STEPS, Owed, owed_ways
from ident_service.motion.states import State
from sim_backend.faults import Fault, FaultKind

Array = np.ndarray
MODEL = bench_model()
assert MODEL.prior is not None
DYNAMICS = InverseDynamics(MODEL.chain, MODEL.layout, MODEL.prior)
INERTIA = np.diag(DYNAMICS.mass_matrix(HOME))
FRICTION, STEP = np.array([0.8, 0.3]), np.full(2, 1e-5)
HIDDEN = OWED * LIMITS.following_error + STEPS * STEP
NONE, STILL = np.zeros(2), np.zeros(2)


def observer() -> Owed:
    return Owed(DYNAMICS, LIMITS, PERIOD, FRICTION, STEP)


def shown(owed: Owed, direction: Array, correction: Array) -> Array:
    """Corrections that are each joint's own."""
    return owed.update(direction, correction, correction / INERTIA, HOME)


def cycles_until(owed: Owed, correction: Array, most: int = 3000) -> int | None:
    """After how many cycles of standing still under a correction something is owed."""
    for cycle in range(1, most + 1):
        if shown(owed, STILL, correction).any():
            return cycle
    return None


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("excess", [0.3, 3.0])
def test_what_is_owed_is_what_the_push_beyond_friction_would_have_moved(joint: int, side: float, excess: float) -> None:
    push = side * unit(joint) * (STANDING * FRICTION + excess)
    expected = np.sqrt(2.0 * HIDDEN[joint] * INERTIA[joint] / excess) / PERIOD
    assert cycles_until(observer(), push) == pytest.approx(expected, abs=2.0)
    assert cycles_until(observer(), side * unit(joint) * STANDING * FRICTION) is None


def slid(owed: Owed, direction: float, apart: int, correction: Array = NONE) -> None:
    """Two steps of the elbow, so many cycles apart."""
    shown(owed, direction * unit(1), correction)
    for _ in range(apart - 1):
        shown(owed, STILL, correction)
    shown(owed, direction * unit(1), correction)


@pytest.mark.parametrize("direction", [-1.0, 1.0])
def test_a_joint_that_slid_is_held_by_less_on_its_way_and_by_as_much_back(direction: float) -> None:
    between = 0.5 * (SLIDING + STANDING) * FRICTION * unit(1)
    for apart, way, found in ((1, 1.0, True), (SLID, 1.0, True), (SLID + 1, 1.0, False), (1, -1.0, False)):
        owed = observer()
        slid(owed, direction, apart)
        assert (cycles_until(owed, way * direction * between) is not None) == found, (apart, way)


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


def test_a_step_and_less_push_forgive_what_is_owed() -> None:
    push = 1.5 * STANDING * FRICTION * unit(1)
    alone = cycles_until(observer(), push)
    assert alone is not None
    for forgive in (unit(1), STILL):
        owed = observer()
        for _ in range(5):
            assert cycles_until(owed, push, alone - 1) is None
            shown(owed, forgive, NONE)


def test_of_an_arm_that_is_asked_for_no_position_nothing_is_owed() -> None:
    owed = observer()
    shown(owed, np.ones(2), 5.0 * STANDING * FRICTION)
    assert cycles_until(owed, NONE) is None


def test_what_only_balances_another_joint_is_not_owed() -> None:
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
    bench = Bench(owed=observer())
    bench.see(HOME, answer=NONE)
    for cycle in range(alone - 1):
        fault = bench.see(HOME, correction=push, answer=push / INERTIA, valid=(True, cycle % 6 != 0))[1]
        assert fault is None or fault.code == "lost_feedback"
    is_fault(bench.see(HOME, correction=push, answer=push / INERTIA)[1], "frozen_encoder", 1)


@pytest.mark.parametrize(("known", "expected"), [(None, 0.3), (0.1, 0.3), (0.7, 0.7)])
def test_friction_is_the_guess_or_more_if_the_prior_has_more(known: float | None, expected: float) -> None:
    model = bench_model(prior=PRIOR if known is None else PRIOR | {"fc2": known})
    owed = owed_ways(DYNAMICS, model, LIMITS, PERIOD, STEP)
    assert cycles_until(owed, 0.99 * STANDING * expected * unit(1)) is None
    assert cycles_until(owed, 1.2 * STANDING * expected * unit(1)) is not None


def slow(which: Subject, joint: int, speed: float, first: int) -> list[Fault]:
    """Freezes of a joint while it is slow: just after it turned round, first and last, and two others.

    Args:
        which: the arm.
        joint: its index.
        speed: of the run.
        first: cycle of the motion.
    """
    times = np.arange(first, first + int(which.motion.duration / speed / PERIOD) - 1)
    velocity = speed * which.motion.path.at((times - first) * PERIOD * speed)[1][:, joint]
    turning = np.flatnonzero(np.diff(np.sign(velocity)))[[0, -1]] + 5
    below = np.flatnonzero(np.abs(velocity) < 0.1 * which.limits.velocity[joint])
    chosen = times[np.concatenate([turning, below[[len(below) // 5, len(below) // 2]]])]
    return [Fault(int(cycle), FaultKind.FROZEN_ENCODER, joint, 10**6) for cycle in chosen]


@pytest.mark.slow
@pytest.mark.timeout(600)  # 15 s of computing, which a machine with much else to do takes its time for
@pytest.mark.parametrize(("arm", "joints"), [("bench", 2), ("wam", 7)])
@pytest.mark.parametrize("speed", [1.0, 0.2])
def test_slowly_begun_freezes_of_all_joints_are_found(arm: str, joints: int, speed: float) -> None:
    """All are harmless; not found are only those of which nothing comes before the motion ends."""
    which = subject(arm)
    ends = endings(which, lambda first: [f for k in range(joints) for f in slow(which, k, speed, first)], speed)
    assert len(ends) == 4 * joints
    for number, end in enumerate(ends):
        assert (end.torque <= which.limits.torque * (1.0 + 1e-9)).all()
        assert (end.velocity <= VELOCITY_OFF * which.limits.velocity).all(), (number, end)
        assert end.code in (None, "frozen_encoder")
    for joint in range(joints):
        assert sum(end.code is not None for end in ends[4 * joint : 4 * joint + 4]) >= 2, joint


def test_a_branch_of_a_run_is_the_run_with_its_fault_from_the_start() -> None:
    which = subject("bench")
    faults: list[Fault] = []
    ends = endings(which, lambda first: faults.extend(slow(which, 1, 1.0, first)[:2]) or faults)
    for fault, end in zip(faults, ends, strict=True):
        whole = play(which, State.EXCITING, (fault,), None)
        assert end.code == (None if whole.fault is None else whole.fault.code)
        assert end.cycles == whole.arm.cycle
        np.testing.assert_array_equal(end.torque, np.abs([moment.torque for moment in whole.truth]).max(axis=0))
        np.testing.assert_array_equal(end.velocity, np.abs([moment.velocity for moment in whole.truth]).max(axis=0))


def sticks_and_is_not_taken_for_frozen(which: Subject, speed: float, share: float, stop: int | None = None) -> None:
    """Run it.

    Args:
        which: the arm.
        speed: of the run.
        share: of the time that a joint stands still, at least.
        stop: cycle of the run at full speed at which somebody stops it; None for a whole run.
    """
    if stop is not None:
        which = replace(which, stop=stop)
    outcome = play(which, State.EXCITING if stop is None else State.STOPPING, (), None, speed)
    assert outcome.fault is None
    assert ("returning" in outcome.story.states) == (stop is None)
    assert "exciting" in outcome.story.states
    velocity = np.array([moment.velocity for moment in outcome.truth])
    assert float((velocity == 0.0).mean()) > share


def sticky_bench(times: float) -> Subject:
    """Dry friction of so many times the guess, and coarse encoders."""
    truth = TRUTH | {"fc1": times * FRICTION[0], "fc2": times * FRICTION[1]}
    driver = {"kind": "simulated", "truth": truth, "encoder_resolution": 1e-4, "torque_resolution": 0.01}
    return replace(subject("bench"), config=bench_config(driver=driver))


def sticky_wam(times: float) -> Subject:
    """Dry friction of all joints of so many times the guess."""
    which = subject("wam")
    document = which.config.model_dump(mode="json", by_alias=True)
    truth = document["driver"]["truth"]
    dry = times * which.config.design.friction_guess[0] * which.limits.torque
    for k, value in enumerate(dry.tolist(), start=1):
        truth["values"][truth["names"].index(f"fc{k}")] = value
    return replace(which, config=ArmConfig.model_validate(document))


@pytest.mark.slow
@pytest.mark.parametrize("times", [1.0, 1.4])
def test_a_slow_joint_that_sticks_is_not_taken_for_a_frozen_one(times: float) -> None:
    """Dry friction of more than the guess, at a twentieth of the speed, on the way there and far into the motion."""
    sticks_and_is_not_taken_for_frozen(sticky_bench(times), 0.05, 0.05, stop=1100)


@pytest.mark.campaign
@pytest.mark.parametrize("times", [1.0, 1.4])
def test_a_slow_joint_that_sticks_is_not_taken_for_a_frozen_one_in_a_whole_run(times: float) -> None:
    sticks_and_is_not_taken_for_frozen(sticky_bench(times), 0.05, 0.05)


@pytest.mark.slow
@pytest.mark.parametrize("speed", [1.0, 0.2])
def test_the_large_arm_with_a_quarter_more_friction_is_not_taken_for_frozen(speed: float) -> None:
    sticks_and_is_not_taken_for_frozen(sticky_wam(1.25), speed, 0.02)


@pytest.mark.slow
def test_the_large_arm_sticks_at_a_crawl_and_is_not_taken_for_frozen() -> None:
    """With its own friction, some of it a third above the guess."""
    sticks_and_is_not_taken_for_frozen(subject("wam"), 0.05, 0.02, stop=1200)


@pytest.mark.campaign
def test_the_large_arm_sticks_at_a_crawl_and_is_not_taken_for_frozen_in_a_whole_run() -> None:
    sticks_and_is_not_taken_for_frozen(subject("wam"), 0.05, 0.02)
