"""A joint that its push should have moved has a frozen encoder; whole runs are `test_motion_owed_runs.py`."""

from __future__ import annotations

import numpy as np
import pytest
from guard_bench import HOME, LIMITS, PERIOD, Bench, is_fault, unit
from motion_bench import PRIOR, bench_model

from ident_service.model.pinocchio_models import InverseDynamics
from ident_service.motion.encoder_observer import (
    HIDDEN_SHARE,
    SLID,
    SLIDING,
    STANDING,
    STEPS,
    FrozenEncoderObserver,
    frozen_encoder_observer,
)
from ident_service.motion.safety_monitor import FROZEN_CYCLES, FROZEN_EFFORT

Array = np.ndarray
MODEL = bench_model()
assert MODEL.prior is not None
DYNAMICS = InverseDynamics(MODEL.chain, MODEL.layout, MODEL.prior)
INERTIA = np.diag(DYNAMICS.mass_matrix(HOME))
FRICTION, STEP = np.array([0.8, 0.3]), np.full(2, 1e-5)
HIDDEN = HIDDEN_SHARE * LIMITS.following_error + STEPS * STEP
NONE, STILL = np.zeros(2), np.zeros(2)


def observer() -> FrozenEncoderObserver:
    return FrozenEncoderObserver(DYNAMICS, LIMITS, PERIOD, FRICTION, STEP)


def shown(owed: FrozenEncoderObserver, direction: Array, correction: Array) -> Array:
    """Corrections that are each joint's own."""
    return owed.update(direction, correction, correction / INERTIA, HOME)


def cycles_until(owed: FrozenEncoderObserver, correction: Array, most: int = 3000) -> int | None:
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


def slid(owed: FrozenEncoderObserver, direction: float, apart: int, correction: Array = NONE) -> None:
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
    owed = frozen_encoder_observer(DYNAMICS, model, LIMITS, PERIOD, STEP)
    assert cycles_until(owed, 0.99 * STANDING * expected * unit(1)) is None
    assert cycles_until(owed, 1.2 * STANDING * expected * unit(1)) is not None
