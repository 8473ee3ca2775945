"""A frozen encoder is told before its joint is fast, however slowly it begins; a joint that sticks is not one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from branches import endings
from campaign_bench import Subject, play, subject
from guard_bench import PERIOD
from motion_bench import TRUTH, Story, WatchedArm, bench_config

from ident_service.config.arm import ArmConfig
from ident_service.config.load import load_arm, shipped_arms
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import arm_model
from ident_service.motion.command_channel import StopCondition
from ident_service.motion.run import run
from ident_service.motion.safety_monitor import VELOCITY_OFF
from ident_service.motion.state_machine import State
from sim_backend.arm import from_config
from sim_backend.faults import Fault, FaultKind

Array = np.ndarray
FRICTION = np.array([0.8, 0.3])


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
@pytest.mark.parametrize(
    ("arm", "joints", "speed"),
    [
        ("bench", 2, 0.2),
        pytest.param("bench", 2, 1.0, marks=pytest.mark.campaign),
        *(pytest.param("wam", 7, speed, marks=pytest.mark.campaign) for speed in (1.0, 0.2)),
    ],
)
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


@pytest.mark.slow
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


def braked(config: ArmConfig) -> ArmConfig:
    """The arm with brakes: what holds it when it has stopped; to let it sink takes a minute of its time."""
    document = config.model_dump(mode="json", by_alias=True)
    joints = {name: joint | {"brake": True} for name, joint in document["joints"].items()}
    control = document["control"] | {"after_stop": "brake"}
    return ArmConfig.model_validate(document | {"joints": joints, "control": control})


def sticks_and_is_not_taken_for_frozen(which: Subject, speed: float, share: float, stop: int | None = None) -> None:
    """Run it.

    Args:
        which: the arm.
        speed: of the run.
        share: of the time that a joint stands still, at least.
        stop: cycle of the run at full speed at which somebody stops it; None for a whole run.
    """
    if stop is not None:
        config = braked(which.config)
        model = arm_model(config)
        which = replace(which, stop=stop, config=config, model=model, motion=excitation(model, "identification"))
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
@pytest.mark.parametrize("times", [pytest.param(1.0, marks=pytest.mark.campaign), 1.4])
def test_a_slow_joint_that_sticks_is_not_taken_for_a_frozen_one(times: float) -> None:
    """Dry friction of more than the guess, at a twentieth of the speed, on the way there and far into the motion."""
    sticks_and_is_not_taken_for_frozen(sticky_bench(times), 0.05, 0.05, stop=700)


@pytest.mark.campaign
@pytest.mark.parametrize("times", [1.0, 1.4])
def test_a_slow_joint_that_sticks_is_not_taken_for_a_frozen_one_in_a_whole_run(times: float) -> None:
    sticks_and_is_not_taken_for_frozen(sticky_bench(times), 0.05, 0.05)


@pytest.mark.slow
@pytest.mark.parametrize("speed", [1.0, pytest.param(0.2, marks=pytest.mark.campaign)])
def test_the_large_arm_with_a_quarter_more_friction_is_not_taken_for_frozen(speed: float) -> None:
    sticks_and_is_not_taken_for_frozen(sticky_wam(1.25), speed, 0.02)


@pytest.mark.campaign
def test_the_large_arm_sticks_at_a_crawl_and_is_not_taken_for_frozen() -> None:
    """With its own friction, some of it a third above the guess."""
    sticks_and_is_not_taken_for_frozen(subject("wam"), 0.05, 0.02, stop=900)


@pytest.mark.campaign
def test_the_large_arm_sticks_at_a_crawl_and_is_not_taken_for_frozen_in_a_whole_run() -> None:
    sticks_and_is_not_taken_for_frozen(subject("wam"), 0.05, 0.02)


# Cycles in which the elbow comes to rest within one cycle and stays there, while it is braked.
@pytest.mark.parametrize("cycle", [98, 162, 184, 348, 354, 434, 508, 548])
def test_a_stop_of_a_slow_loop_is_a_stop(cycle: int) -> None:
    stiffness = {"kp": 100.0, "kd": 16.0, "following_error": 0.4}
    motion = {"kind": "seeded", "seed": 1, "base_frequency": 0.2, "harmonics": 5, "periods": 2}
    document = load_arm(shipped_arms()["planar2"]).model_dump(mode="json", by_alias=True)
    document["control"]["rate"] = 50.0
    document["driver"] |= {"watchdog": 0.5, "watchdog_reason": "longer than the cycles", "deadline": 2.0}
    document["motions"] = {"identification": motion}
    for joint in document["joints"].values():
        joint |= stiffness
    model = arm_model(ArmConfig.model_validate(document))
    arm, story = WatchedArm(from_config(model.config)), Story()
    arm.open()
    stop = StopCondition(lambda: arm.cycle > cycle)
    report = run(arm, model, excitation(model, "identification"), story, stop, hold_seconds=0.1)
    assert report.state is State.STOPPED
