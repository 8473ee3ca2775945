"""Every fault of the table is found, with its reaction and its joint."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from guard_bench import HOME, LIMITS, OFF, STOP, WARN, WINDOW, Bench, is_fault, unit

from ident_service.motion.guard import (
    ABSURD,
    FROZEN_CYCLES,
    FROZEN_EFFORT,
    MAX_AGE,
    REACTIONS,
    VELOCITY_OFF,
    VELOCITY_STOP,
    Fault,
    Reaction,
)


def torque_saturated(joint: int) -> Fault | None:
    return Bench().guard.torque(1.01 * LIMITS.torque * unit(joint))[1]


def torque_absurd(joint: int) -> Fault | None:
    return Bench().guard.torque(-1.01 * ABSURD * LIMITS.torque * unit(joint))[1]


def torque_not_finite(joint: int) -> Fault | None:
    return Bench().guard.torque(np.where(unit(joint) > 0.0, np.nan, 0.0))[1]


def encoder_jump(joint: int) -> Fault | None:
    return Bench().see(HOME + 1.01 * WINDOW * unit(joint), HOME)[1]


def encoder_jumps(joint: int) -> Fault | None:
    bench = Bench()
    bench.see(HOME + 0.5 * unit(joint), HOME)
    return bench.see(HOME + 0.5 * unit(joint), HOME)[1]


def lost_feedback(joint: int) -> Fault | None:
    return Bench().see(HOME, valid=(joint != 0, joint != 1))[1]


def feedback_gone(joint: int) -> Fault | None:
    bench = Bench()
    faults = [bench.see(HOME, valid=(joint != 0, joint != 1))[1] for _ in range(MAX_AGE)]
    return faults[-1]


def feedback_not_finite(joint: int) -> Fault | None:
    return Bench().see(np.where(unit(joint) > 0.0, np.nan, HOME), HOME)[1]


def position_limit(joint: int) -> Fault | None:
    edge = np.where(unit(joint) > 0.0, LIMITS.upper + 1e-9, HOME)
    return Bench(edge).see(edge)[1]


def far_outside(joint: int) -> Fault | None:
    far = np.where(unit(joint) > 0.0, LIMITS.lower - 1.01 * LIMITS.following_error, HOME)
    return Bench(far).see(far)[1]


def over_velocity(joint: int) -> Fault | None:
    return Bench().see(HOME, velocity=-1.01 * VELOCITY_STOP * LIMITS.velocity * unit(joint))[1]


def runaway(joint: int) -> Fault | None:
    return Bench().see(HOME, velocity=1.01 * VELOCITY_OFF * LIMITS.velocity * unit(joint))[1]


def following_error(joint: int) -> Fault | None:
    return Bench().see(HOME, HOME + 1.01 * LIMITS.following_error * unit(joint))[1]


def frozen_encoder(joint: int) -> Fault | None:
    bench, push = Bench(), -1.01 * FROZEN_EFFORT * LIMITS.torque * unit(joint)
    return [bench.see(HOME, correction=push)[1] for _ in range(FROZEN_CYCLES)][-1]


TRIGGERS: dict[str, Callable[[int], Fault | None]] = {
    trigger.__name__: trigger
    for trigger in (
        torque_saturated,
        torque_absurd,
        torque_not_finite,
        encoder_jump,
        encoder_jumps,
        lost_feedback,
        feedback_gone,
        feedback_not_finite,
        position_limit,
        far_outside,
        over_velocity,
        runaway,
        following_error,
        frozen_encoder,
    )
}
# These two are found by the loop, not by the guard: test_motion_run_arm_faults.py, test_motion_run_other_faults.py.
FOUND_BY_THE_LOOP = {"driver", "recorder_behind"}


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("code", sorted(TRIGGERS))
def test_a_fault_is_found_and_names_its_joint(code: str, joint: int) -> None:
    is_fault(TRIGGERS[code](joint), code, joint)


def test_every_fault_of_the_table_is_triggered() -> None:
    assert set(TRIGGERS) | FOUND_BY_THE_LOOP == set(REACTIONS)


def test_the_reactions_are_those_of_the_fault_table() -> None:
    by_reaction = {reaction: {code for code in REACTIONS if REACTIONS[code] is reaction} for reaction in Reaction}
    assert by_reaction[WARN] == {"torque_saturated", "encoder_jump", "lost_feedback"}
    controlled = {"encoder_jumps", "position_limit", "over_velocity", "following_error", "recorder_behind"}
    assert by_reaction[STOP] == controlled
    assert WARN < STOP < OFF
