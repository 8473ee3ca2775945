"""Joints, motors and their whole numbers: round trips, power, clipping that keeps a direction, rounding."""

from __future__ import annotations

import numpy as np
import pytest
from can_arms import COUPLING, MAX_TORQUE, RATED, RATIOS, wam_driver, wam_transmission
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from drivers.canopen.motor_units import coordinates, torque_limit_counts
from drivers.motor_units import Coordinates, unwrapped
from ident_service.config.recording import Transmission
from ident_service.errors import DriverError

Array = np.ndarray
WAM = coordinates(wam_driver(), wam_transmission())
# FIELDBUS.md 1.2, row by row: motor positions from joint positions.
MOTORS = np.array(
    [
        [-42, 0, 0, 0, 0, 0, 0],
        [0, 28.25, -16.8155, 0, 0, 0, 0],
        [0, -28.25, -16.8155, 0, 0, 0, 0],
        [0, 0, 0, -18, 0, 0, 0],
        [0, 0, 0, 0, 9.7, -9.7, 0],
        [0, 0, 0, 0, 9.7, 9.7, 0],
        [0, 0, 0, 0, 0, 0, -14.93],
    ]
)
MOTORS_EXACT = np.diag(RATIOS) @ np.array(COUPLING)
joints = arrays(float, 7, elements=st.floats(-3.0, 3.0))
torques = arrays(float, 7, elements=st.floats(-100.0, 100.0))


@st.composite
def gears(draw: st.DrawFn) -> tuple[Coordinates, Array]:
    """Any two coupled motors and one alone, with their motor positions per joint position."""
    number = st.floats(0.5, 60.0)
    sign = st.sampled_from((-1.0, 1.0))
    ratios = [draw(sign) * draw(number) for _ in range(3)]
    mixed = draw(sign) * draw(st.floats(0.1, 0.9))
    coupling = ((1.0, mixed, 0.0), (-mixed, 1.0, 0.0), (0.0, 0.0, 1.0))
    drives = [
        {
            "node": k + 1,
            "counts": draw(st.integers(100, 100_000)),
            "rated_torque": draw(st.integers(1, 5000)) / 1000.0,
            "max_torque": 0.0,
            "max_speed": 1000.0,
            "torque_scale": draw(st.floats(0.7, 1.4)),
        }
        for k in range(3)
    ]
    for drive in drives:
        drive["max_torque"] = drive["rated_torque"] * draw(st.floats(0.01, 30.0))
    transmission = Transmission(ratios=tuple(ratios), coupling=coupling, offsets=(0.3, -1.0, 2.0))
    return coordinates(wam_driver(drives=drives), transmission), np.diag(ratios) @ np.array(coupling)


def test_the_wam_is_as_barrett_has_it() -> None:
    radians = 2 * np.pi / 4096
    np.testing.assert_allclose(np.linalg.inv(WAM.joint_per_count) * radians, MOTORS, atol=4e-5)
    # Figures of FIELDBUS.md 1.1: peaks of one joint alone, and position steps of J1, J4 and J7.
    np.testing.assert_allclose(WAM.torque_limit, [75.6, 101.7, 60.5, 28.8, 11.6, 11.6, 1.37], rtol=5e-3)
    np.testing.assert_allclose(WAM.position_resolution[[0, 3, 6]], [3.65e-5, 8.5e-5, 1.03e-4], rtol=5e-3)
    # 0.2 mN m a count at the motor is finer than the puck's own 1/2700 N m.
    np.testing.assert_allclose(WAM.torque_resolution[:4], np.array([42, 28.25, 28.25 / 1.68, 18]) * 2e-4)
    assert WAM.groups == (((0,), (0,)), ((1, 2), (1, 2)), ((3,), (3,)), ((4, 5), (4, 5)), ((6,), (6,)))
    assert WAM.limit == (9000, 9000, 9000, 8000, 6000, 6000, 4580)


@given(joints)
def test_positions_come_back_within_a_count(position: Array) -> None:
    back = WAM.positions(WAM.counts_at(position))
    assert (np.abs(back - position) <= 0.5 * np.abs(WAM.joint_per_count).sum(axis=1) + 1e-12).all()


@given(gears(), arrays(float, 3, elements=st.floats(-3, 3)), arrays(float, 3, elements=st.floats(-0.2, 0.2)))
def test_any_gears_turn_as_they_say_and_can_be_zeroed(
    arm: tuple[Coordinates, Array], position: Array, zero: Array
) -> None:
    gear, motor_per_joint = arm
    back = gear.positions(gear.counts_at(position))
    assert (np.abs(back - position) <= 0.51 * np.abs(gear.joint_per_count).sum(axis=1)).all()
    again = gear.zeroed(gear.counts_at(zero), position)
    np.testing.assert_allclose(again.positions(gear.counts_at(zero)), position, atol=1e-12)
    # Motors turn as the gears say: their counts per turn are the same for every joint.
    counts = np.linalg.inv(gear.joint_per_count)
    per_radian = counts[np.abs(motor_per_joint) > 0.0] / motor_per_joint[np.abs(motor_per_joint) > 0.0]
    np.testing.assert_allclose(per_radian, np.repeat(per_radian[[0, 2, 4]], [2, 2, 1]), rtol=1e-9)


@given(gears(), arrays(float, 3, elements=st.floats(-1, 1)), arrays(float, 3, elements=st.floats(-2, 2)))
def test_power_is_the_same_on_both_sides(arm: tuple[Coordinates, Array], share: Array, rate: Array) -> None:
    gear, motor_per_joint = arm
    counts = [round(s * limit) for s, limit in zip(share.tolist(), gear.limit, strict=True)]
    joint = gear.joint_torque(counts)
    # What the motors really give, from the torque of each joint by virtual work.
    motor = np.linalg.solve(motor_per_joint.T, joint)
    np.testing.assert_allclose(motor @ (motor_per_joint @ rate), joint @ rate, atol=1e-9 * (1 + np.abs(joint).max()))
    # And each motor's torque depends on its own count alone.
    for k in range(3):
        only = [n if k == j else 0 for j, n in enumerate(counts)]
        np.testing.assert_allclose(
            np.linalg.solve(motor_per_joint.T, gear.joint_torque(only)),
            np.where(np.arange(3) == k, motor, 0.0),
            atol=1e-9 * (1.0 + np.abs(motor).max()),
        )


@pytest.mark.slow
@given(joints)
def test_a_torque_is_sent_within_half_a_count_of_each_motor(torque: Array) -> None:
    wanted = torque * [20, 15, 10, 5, 1, 1, 0.3]
    counts, clipped = WAM.torque_counts(wanted)
    assert not clipped or max(abs(n) / limit for n, limit in zip(counts, WAM.limit, strict=True)) == 1.0
    if not clipped:
        bound = 0.5 * np.abs(WAM.torque_per_count).sum(axis=1)
        assert (np.abs(WAM.joint_torque(counts) - wanted) <= bound + 1e-9).all()
        again, _ = WAM.torque_counts(WAM.joint_torque(counts))
        assert again == counts


@given(torques)
def test_clipping_keeps_every_motor_inside_and_every_group_in_its_direction(torque: Array) -> None:
    counts, clipped = WAM.torque_counts(torque)
    sent = WAM.joint_torque(counts)
    motors = np.linalg.solve(MOTORS_EXACT.T, torque)
    assert (np.abs(counts) <= WAM.limit).all()
    assert clipped == bool((np.abs(motors) > np.array(WAM.limit) * RATED / 1000 * (1 + 1e-12)).any())
    slack = 0.5 * np.abs(WAM.torque_per_count).sum(axis=1) + 1e-9
    for members in ([0], [1, 2], [3], [4, 5], [6]):
        room = [MAX_TORQUE[k] / abs(motors[k]) if abs(motors[k]) > 1e-6 else np.inf for k in members]
        share = min(1.0, *room)
        assert (np.abs(sent[members] - share * torque[members]) <= slack[members]).all()


def test_one_saturated_joint_leaves_the_others_alone() -> None:
    calm = np.array([10.0, 20.0, -5.0, 6.0, 1.0, -0.5, 0.2])
    wild = calm + np.array([0, 300.0, 0, 0, 0, 0, 0])
    few, clipped = WAM.torque_counts(wild)
    assert clipped
    sent = WAM.joint_torque(few)
    np.testing.assert_allclose(sent[[0, 3, 4, 5, 6]], calm[[0, 3, 4, 5, 6]], atol=0.005)
    assert sent[2] / sent[1] == pytest.approx(wild[2] / wild[1], rel=1e-3)


def test_the_scale_of_a_torque_is_what_the_motor_really_gives() -> None:
    drives = [drive.model_dump() for drive in wam_driver().drives]
    drives[0]["torque_scale"] = 0.8
    weak = coordinates(wam_driver(drives=drives), wam_transmission())
    counts, _ = weak.torque_counts(np.array([10.0, 0, 0, 0, 0, 0, 0]))
    assert counts[0] == round(10.0 / -42 / 0.2 * 1000 / 0.8)
    assert weak.joint_torque(counts)[0] == pytest.approx(10.0, abs=0.004)
    assert weak.torque_limit[0] == pytest.approx(0.8 * 75.6)


@given(st.integers(-(2**40), 2**40), st.integers(-(2**31) + 1, 2**31 - 1))
def test_positions_of_32_bits_come_round(before: int, step: int) -> None:
    now = before + step
    told = (now + 2**31) % 2**32 - 2**31
    assert unwrapped(before, told) == now


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300])
def test_torques_that_mean_nothing_are_refused(bad: float) -> None:
    with pytest.raises(DriverError, match="finite"):
        WAM.torque_counts(np.array([0, 0, 0, bad, 0, 0, 0]))
    with pytest.raises(DriverError, match="7 finite"):
        WAM.torque_counts(np.zeros(6))


def test_the_largest_torque_never_goes_above_what_was_given() -> None:
    assert torque_limit_counts(1.8, 0.2) == 9000
    assert torque_limit_counts(0.09159, 0.02) == 4579
    assert torque_limit_counts(100.0, 0.001) == 32_767


def test_as_many_drives_as_ratios_are_needed() -> None:
    with pytest.raises(DriverError, match="7 drives but 1 ratio"):
        coordinates(wam_driver(), Transmission(ratios=(2.0,)))
