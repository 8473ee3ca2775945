"""Frames of any kind on the bus while the driver runs its cycles: nothing escapes, and no torque changes.

The same cycles are run undisturbed and disturbed, and what the host sent is compared byte by byte. Where only the host
hears the disturbance, positions must be those of the undisturbed run too, bit by bit; where the drives hear it as well,
they may do what they like, and the torques that leave must still be those that were asked for.
"""

from __future__ import annotations

import random
import struct
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from helpers.emulated_arms import Tapped, tapped, weightless_config

from drivers.arm import Sample
from drivers.axis_status import AxisEventCode
from drivers.can.can_frame import Frame
from drivers.canopen.driver import CanopenArm
from sim_backend.emulator.lock_step import LockStepArm

Array = np.ndarray
EACH = 10  # frames a cycle, of which a bus of 1 Mbit/s has room for about as many
CYCLES = 250
BASES = (0x000, 0x080, 0x180, 0x200, 0x280, 0x300, 0x580, 0x600, 0x700)
POSITIONS = (0x181, 0x182)


def any_frame(rng: random.Random) -> Frame:
    """Ours, of foreign nodes, torn, too long, remote, error and extended ones."""
    near = rng.choice(BASES) + rng.choice((0, 1, 2, 3, 5, 0x7F))
    identifier = near if rng.random() < 0.8 else rng.randrange(0x800)
    error, extended = rng.random() < 0.1, rng.random() < 0.1
    if error or extended:
        identifier = rng.choice((identifier, 1 << rng.randrange(9), rng.randrange(1 << 29)))
    length = rng.choice((0, 1, 2, 3, 4, 5, 6, 7, 8, 8, 8, 64))
    return Frame(identifier, rng.randbytes(length), rng.random() < 0.1, error, extended)


def is_position(frame: Frame) -> bool:
    """Whether no host could tell it from a drive's answer."""
    plain = not (frame.remote or frame.error or frame.extended)
    return plain and frame.identifier in POSITIONS and len(frame.data) == 4


@contextmanager
def running() -> Iterator[tuple[CanopenArm, Tapped]]:
    config = weightless_config()
    behind = LockStepArm(config)
    taps: list[Tapped] = []

    def links(_: object) -> list[Tapped]:
        taps[:] = tapped(behind, config)
        return taps

    with CanopenArm(config, links) as arm:
        arm.enable()
        taps[0].sent.clear()
        yield arm, taps[0]


def torque(cycle: int) -> Array:
    return np.array([np.sin(0.1 * cycle), -np.cos(0.07 * cycle)])


def cycles(frames: list[list[Frame]], *, drives_hear: bool) -> tuple[list[Sample], list[Frame]]:
    """What the driver says and sends while these frames come, those of a cycle before it or in it."""
    samples = []
    with running() as (arm, tap):
        for cycle, heard in enumerate(frames):
            tap.disturb(heard, drives_hear=drives_hear)
            tap.after_sync(heard[: len(heard) // 2] if cycle % 2 and not drives_hear else [])
            samples.append(arm.exchange(torque(cycle)))
        return samples, list(tap.sent)


def quantised(cycle: int) -> bytes:
    """As a thousandth of a newton metre, and of a newton."""
    return struct.pack("<2h", *(round(float(one) * 1000) for one in torque(cycle)))


def check_torques(sent: list[Frame]) -> None:
    torques = [frame.data for frame in sent if 0x200 <= frame.identifier < 0x280]
    assert torques == [quantised(cycle) for cycle in range(len(torques))]


def storm(seed: int, number: int = CYCLES) -> list[list[Frame]]:
    rng = random.Random(seed)  # noqa: S311 - not for secrets
    return [[any_frame(rng) for _ in range(EACH)] for _ in range(number)]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_what_only_the_host_hears_changes_neither_torques_nor_positions(seed: int) -> None:
    unseen_by_the_host_alone(seed, CYCLES)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_what_everybody_hears_changes_no_torque_that_leaves(seed: int) -> None:
    heard_by_everybody(seed, CYCLES)


@pytest.mark.campaign
@pytest.mark.parametrize("seed", range(100, 120))
def test_a_long_storm(seed: int) -> None:
    unseen_by_the_host_alone(seed, 10 * CYCLES)
    heard_by_everybody(seed, 10 * CYCLES)


def unseen_by_the_host_alone(seed: int, number: int) -> None:
    calm, sent_calmly = cycles([[]] * number, drives_hear=False)
    frames = [[frame for frame in group if not is_position(frame)] for group in storm(seed, number)]
    disturbed, sent = cycles(frames, drives_hear=False)
    assert sent == sent_calmly
    check_torques(sent)
    for one, other in zip(calm, disturbed, strict=True):
        np.testing.assert_array_equal(one.position, other.position)
        np.testing.assert_array_equal(one.torque, other.torque)
        assert other.valid.all()
        assert (one.cycle, one.stamp_ns, one.lost) == (other.cycle, other.stamp_ns, other.lost)
    codes = {event.code for sample in disturbed for event in sample.events}
    assert {AxisEventCode.SECOND_HOST, AxisEventCode.STRANGE_FRAME, AxisEventCode.EMERGENCY_MESSAGE} <= codes
    assert all(event.words for sample in disturbed for event in sample.events)


def heard_by_everybody(seed: int, number: int) -> None:
    samples, sent = cycles(storm(seed, number), drives_hear=True)
    assert len(samples) == number
    check_torques(sent)
    assert all(np.isfinite(sample.position).all() for sample in samples)


def test_a_position_is_one_that_was_sent() -> None:
    """Which of two is right nobody can tell, but nothing else is ever shown, and the second one is told of."""
    claims = [struct.pack("<i", counts) for counts in (-(2**31), -1, 0, 12345, 2**31 - 1)]
    with running() as (arm, tap):
        before = arm.exchange(torque(0))
        for data in claims:
            tap.disturb([Frame(0x181, data)], drives_hear=False)
            tap.after_sync([Frame(0x181, data)])
            sample = arm.exchange(torque(0))
            counts = round(float(sample.position[0]) * 65536 / (2 * np.pi)) % 2**32
            true = round(float(before.position[0]) * 65536 / (2 * np.pi))
            (said,) = struct.unpack("<i", data)
            assert min(abs(counts - said % 2**32), abs(counts - true)) <= 200
            assert AxisEventCode.STRANGE_FRAME in {event.code for event in sample.events}
            np.testing.assert_array_equal(sample.position[1], before.position[1])


@pytest.mark.parametrize(
    "frame",
    [Frame(0x080), Frame(0x201, bytes(4)), Frame(0x302, bytes(3)), Frame(0x000, b"\x80\x00"), Frame(0x77F, b"\x05")],
    ids=["SYNC", "torque", "control word", "NMT", "heartbeat"],
)
def test_a_second_host_is_reported_at_once_and_again_after_enabling(frame: Frame) -> None:
    with running() as (arm, tap):
        for _ in range(2):
            tap.disturb([frame], drives_hear=False)
            events = arm.exchange(torque(0)).events
            assert [event.code for event in events] == [AxisEventCode.SECOND_HOST]
            assert f"{frame.identifier:03X}h" in events[0].words
            tap.disturb([frame], drives_hear=False)
            assert arm.exchange(torque(0)).events == ()
            arm.enable()
