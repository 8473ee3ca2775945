"""A paused motion stands within its limits and comes back onto itself without a step."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from helpers.examples import some
from hypothesis import given
from hypothesis import strategies as st
from motion_bench import bench_excitation, bench_limits
from reachable import close, keeps_to, random_limits, random_path, sampled

from ident_service.errors import MotionRefused
from ident_service.motion.sequencer import Paused, Resumed
from ident_service.motion.speed_scaling import ScaledMotion, slowed_limits
from ident_service.motion.trajectory import PathReference, Setpoint, rest

Array = np.ndarray
LIMITS = bench_limits()
MOTION = PathReference(bench_excitation().path)
SHARES = st.floats(0.0, 1.0)


@pytest.mark.slow
@some(15)
@given(st.integers(0, 2**32 - 1), SHARES)
def test_pause_and_resume_keep_to_all_limits_and_have_no_step(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    limits = random_limits(rng, int(rng.integers(1, 4)))
    motion = PathReference(random_path(rng, limits))
    left = share * motion.duration
    paused = Paused(motion, left, limits)
    close(paused.at(0.0), motion.at(left))
    keeps_to(limits, paused)
    standing = paused.at(paused.duration)
    close(standing, rest(standing.position))
    close(paused.at(paused.duration + 100.0), standing)
    try:
        resumed = paused.resume()
    except MotionRefused:
        return  # refusing is lawful, though the next test finds none that has to
    close(resumed.at(0.0), standing)
    close(resumed.at(resumed.back - 1e-12), motion.at(resumed.joined))
    close(resumed.at(resumed.back), motion.at(resumed.joined))
    close(resumed.at(resumed.duration), motion.at(motion.duration))
    # What a way may leave a position limit by, unseen: see RuckigReference.extent.
    keeps_to(limits, resumed, 5e-6, 600)


@some(25)
@given(SHARES)
def test_the_motion_goes_on_where_it_was_left(share: float) -> None:
    left = share * MOTION.duration
    resumed = Paused(MOTION, left, LIMITS).resume()
    assert left - 0.5 <= resumed.joined <= left
    assert resumed.duration == pytest.approx(resumed.back + MOTION.duration - resumed.joined)
    for later in np.linspace(0.0, MOTION.duration - resumed.joined, 7):
        close(resumed.at(resumed.back + later), MOTION.at(resumed.joined + later))


@pytest.mark.parametrize("seed", range(30))
def test_motions_are_resumed_where_they_were_left_though_they_use_their_limits_in_full(seed: int) -> None:
    rng = np.random.default_rng(seed)
    limits = random_limits(rng, 3)
    motion = PathReference(random_path(rng, limits))
    left = float(rng.uniform(0.0, motion.duration))
    assert Paused(motion, left, limits).resume().joined == left


@dataclass
class Awkward:
    """A motion that no way leads onto at some of its times."""

    barred: tuple[tuple[float, float], ...]
    duration: float = 10.0

    def at(self, time: float) -> Setpoint:
        """Far beyond every velocity where it is barred."""
        barred = any(begin <= time <= end for begin, end in self.barred)
        return replace(rest(np.array([0.1, 0.01 * time])), velocity=np.full(2, 99.0 if barred else 0.0))


@pytest.mark.parametrize(
    ("barred", "joined"),
    [
        ((), 5.0),
        (((4.75, 5.5),), 4.7),
        (((3.05, 6.0),), 3.0),
        (((2.9, 5.0),), 5.1),
        (((2.9, 6.05),), 6.1),
        (((2.9, 7.05),), 0.0),
    ],
)
def test_it_joins_a_little_earlier_else_a_little_later_else_at_the_beginning(
    barred: tuple[tuple[float, float], ...], joined: float
) -> None:
    motion = Awkward(())
    paused = Paused(motion, 5.0, LIMITS)
    motion.barred = barred
    assert paused.resume().joined == pytest.approx(joined, abs=1e-9)


def test_nothing_is_joined_before_its_beginning_or_after_its_end() -> None:
    for left, barred, joined in ((0.05, (0.04, 0.16), 0.25), (9.95, (7.9, 9.99), 0.0)):
        motion = Awkward(())
        paused = Paused(motion, left, LIMITS)
        motion.barred = (barred,)
        assert paused.resume().joined == pytest.approx(joined)


def test_when_nothing_leads_back_that_is_reported_and_the_arm_stands_on() -> None:
    motion = Awkward(())
    paused = Paused(motion, 5.0, LIMITS)
    motion.barred = ((0.0, 10.0),)
    with pytest.raises(
        MotionRefused, match="no trajectory leads from here back to the motion: no jerk-limited trajectory"
    ):
        paused.resume()
    close(paused.at(1e6), rest(np.array([0.1, 0.05])))


@pytest.mark.parametrize("left", [0.0, MOTION.duration, MOTION.duration + 3.0])
def test_the_ends_of_a_motion_are_paused_too(left: float) -> None:
    paused = Paused(MOTION, left, LIMITS)
    assert paused.time == min(left, MOTION.duration)
    resumed = paused.resume()
    close(resumed.at(resumed.duration), MOTION.at(MOTION.duration))


def test_a_resumed_motion_can_be_paused_again() -> None:
    motion: PathReference | Resumed = MOTION
    for share in (0.2, 0.4, 0.05, 0.6):
        paused = Paused(motion, share * motion.duration, LIMITS)
        keeps_to(LIMITS, paused)
        motion = paused.resume()
        keeps_to(LIMITS, motion, 5e-6, 1000)
    close(motion.at(motion.duration), MOTION.at(MOTION.duration))


def test_a_rehearsal_is_resumed_as_slowly_as_it_goes() -> None:
    slow = ScaledMotion(MOTION, 0.2)
    limits = slowed_limits(LIMITS, 0.2)
    resumed = Paused(slow, 0.4 * slow.duration, LIMITS).resume(limits)
    keeps_to(limits, resumed, 1e-5, 1000)
    _, _, velocity, _ = sampled(resumed)
    assert (np.abs(velocity) <= 0.2 * LIMITS.velocity * (1 + 1e-6)).all()
