"""The direction of friction is Dahl's law, sample by sample."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ident_service.model.friction_state import friction_direction

PERIOD = 0.004
RATES = arrays(np.float64, st.integers(1, 60), elements=st.sampled_from([-2.0, -0.3, -0.01, 0.0, 0.0, 0.02, 0.5, 3.0]))


def stepped(rate: np.ndarray, x0: float, start: float) -> np.ndarray:
    """ds/dx = (1 - s sign(v)) / x0 over the way of each sample, its velocity held: solved exactly, one at a time."""
    result, s = np.empty_like(rate), start
    for k, v in enumerate(rate):
        if v != 0.0:
            s = np.sign(v) + (s - np.sign(v)) * np.exp(-abs(v) * PERIOD / x0)
        result[k] = s
    return result


def first_sign(rate: np.ndarray) -> float:
    moving = np.flatnonzero(rate)
    return float(np.sign(rate[moving[0]])) if len(moving) else 0.0


@pytest.mark.slow
@given(rate=RATES, x0=st.floats(1e-3, 0.1), start=st.none() | st.floats(-1.0, 1.0))
def test_equals_the_recursion(rate: np.ndarray, x0: float, start: float | None) -> None:
    given_start = None if start is None else np.array([start])
    got = friction_direction(rate[:, None], PERIOD, np.array([x0]), given_start)[:, 0]
    wanted = stepped(rate, x0, first_sign(rate) if start is None else start)
    np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-12)
    assert np.all(np.abs(got) <= 1.0 + 1e-12)


@given(rate=RATES, cuts=st.lists(st.integers(1, 59), max_size=4), x0=st.floats(1e-3, 0.1))
def test_blocks_that_carry_the_state_equal_one_pass(rate: np.ndarray, cuts: list[int], x0: float) -> None:
    whole = friction_direction(rate[:, None], PERIOD, np.array([x0]))
    state, parts = np.array([first_sign(rate)]), []
    edges = sorted({0, *(cut for cut in cuts if cut < len(rate)), len(rate)})
    for begin, end in pairwise(edges):
        parts.append(friction_direction(rate[begin:end, None], PERIOD, np.array([x0]), state))
        state = parts[-1][-1]
    np.testing.assert_allclose(np.vstack(parts), whole, rtol=0, atol=1e-12)


@given(rate=RATES, start=st.floats(-1.0, 1.0))
def test_no_presliding_is_the_sign(rate: np.ndarray, start: float) -> None:
    for begin in (None, np.array([start])):
        np.testing.assert_array_equal(
            friction_direction(rate[:, None], PERIOD, np.zeros(1), begin)[:, 0], np.sign(rate)
        )


def test_each_drive_has_its_own_presliding_length() -> None:
    rate = np.random.default_rng(1).normal(size=(300, 3))
    x0 = np.array([0.0, 0.002, 0.02])
    got = friction_direction(rate, PERIOD, x0)
    np.testing.assert_array_equal(got[:, 0], np.sign(rate[:, 0]))
    for drive in (1, 2):
        np.testing.assert_allclose(
            got[:, drive], stepped(rate[:, drive], x0[drive], first_sign(rate[:, drive])), rtol=0, atol=1e-12
        )


def test_after_a_reversal_the_travel_decides_not_the_speed() -> None:
    # The same way at half the speed, so twice the time, gives the same direction.
    fast = np.concatenate([np.ones(50), -np.ones(50)])[:, None]
    slow = 0.5 * np.repeat(fast, 2, axis=0)
    x0 = np.array([0.03])
    np.testing.assert_allclose(
        friction_direction(slow, PERIOD, x0)[1::2], friction_direction(fast, PERIOD, x0), rtol=0, atol=1e-12
    )
    # After x0 of way, the direction has come 1 - 2 / e of the way from one side to the other.
    assert friction_direction(np.full((1, 1), -x0[0] / PERIOD), PERIOD, x0, np.ones(1))[0, 0] == pytest.approx(
        2 / np.e - 1
    )


def test_standing_still_keeps_the_direction() -> None:
    rate = np.concatenate([np.zeros(3), np.ones(5), np.zeros(4), -0.01 * np.ones(2), np.zeros(6)])[:, None]
    got = friction_direction(rate, PERIOD, np.array([0.01]))[:, 0]
    np.testing.assert_array_equal(got[:3], 1.0)
    np.testing.assert_array_equal(got[8:12], got[7])
    assert -1.0 < got[13] < got[12] < got[11]
    np.testing.assert_array_equal(got[14:], got[13])
    np.testing.assert_array_equal(friction_direction(np.zeros((4, 1)), PERIOD, np.array([0.01])), 0.0)


def test_a_long_travel_loses_no_digits() -> None:
    # An hour at one speed, then one turn: the exponent counts from the turn.
    rate = np.concatenate([np.full(200_000, 3.0), np.full(10, -0.5)])
    got = friction_direction(rate[:, None], PERIOD, np.array([1e-2]))[-10:, 0]
    np.testing.assert_allclose(got, stepped(rate[-10:], 1e-2, 1.0), rtol=0, atol=1e-8)
