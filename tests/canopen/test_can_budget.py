"""What a bus carries: the published figures of every map, the rule, highest rates, and remedies that are true."""

from __future__ import annotations

import re
from typing import Any

import pytest
from can_arms import EDS, wam_driver

from drivers.can.bus_load import Budget, most_bits, unstuffed_bits
from drivers.canopen import object_dictionary as od
from drivers.canopen.bus_load import EMERGENCY_SLOTS, HEARTBEAT_STATE, budget, frame_line
from drivers.canopen.object_dictionary import Entry
from drivers.canopen.pdo_mapping import HEARTBEAT, RPDO1, SYNC, TPDO1
from ident_service.config.can_bus import CanBus

Frames = list[tuple[int, tuple[Entry, ...]]]
BUS = CanBus()
TORQUE, POSITION, STATUS, ACTUAL = od.TARGET_TORQUE, od.POSITION, od.STATUS_WORD, od.TORQUE_ACTUAL
NODES = range(1, 8)


def answers(*slots: Entry) -> Frames:
    return [(SYNC, ()), *((TPDO1 + node, slots) for node in NODES)]


FULL: Frames = [(0x201, (TORQUE,) * 4), (0x205, (TORQUE,) * 4)]
SINGLE: Frames = [(RPDO1 + node, (TORQUE,)) for node in NODES]
# FIELDBUS.md 2.2: frames of a cycle, bits without stuffing, typical, worst.
MAPS: list[tuple[Frames, int, int, int]] = [
    ([*answers(POSITION), FULL[0], (0x205, (TORQUE,) * 3)], 806, 860, 970),
    (answers(POSITION) + FULL, 822, 877, 990),
    (answers(POSITION, STATUS) + FULL, 934, 989, 1130),
    (answers(POSITION, STATUS, ACTUAL) + FULL, 1046, 1111, 1270),
    (answers(POSITION) + SINGLE, 1041, 1108, 1245),
    (answers(POSITION, STATUS) + SINGLE, 1153, 1219, 1385),
]


@pytest.mark.parametrize(("frames", "least", "typical", "most"), MAPS)
def test_the_published_maps_cost_what_was_published(frames: Frames, least: int, typical: int, most: int) -> None:
    costs = [frame_line("", (cob_id,), tuple(slots), 1.0, BUS).each for cob_id, slots in frames]
    assert sum(cost.unstuffed for cost in costs) == pytest.approx(least * 1e-6)
    assert sum(cost.worst for cost in costs) == pytest.approx(most * 1e-6)
    # Means depend on which values are typical; a third of a per cent of the bus at 1 kHz.
    assert sum(cost.typical for cost in costs) == pytest.approx(typical * 1e-6, abs=3.5e-6)


@pytest.mark.parametrize(
    ("lengths", "least", "most"),
    [([1] + [3] * 7 + [8] * 2, 774, 930), ([1] + [6] * 4 + [3] * 3 + [8] * 2, 870, 1050)],
)
def test_pucks_cost_what_was_published(lengths: list[int], least: int, most: int) -> None:
    assert sum(unstuffed_bits(length).nominal for length in lengths) == least
    assert sum(most_bits(length).nominal for length in lengths) == most


@pytest.mark.parametrize(
    ("frames", "mean"),
    [
        ([(SYNC, ())], 51.0),
        ([(HEARTBEAT + node, (HEARTBEAT_STATE,)) for node in NODES], 58.3),
        (SINGLE, 67.0),
        ([(TPDO1 + node, (POSITION,)) for node in NODES], 84.0),
        ([(TPDO1 + node, (POSITION, STATUS)) for node in NODES], 99.9),
        ([(0x205, (TORQUE,) * 3)], 101.3),
        ([(TPDO1 + node, (POSITION, STATUS, ACTUAL)) for node in NODES], 117.4),
        ([(0x201, (TORQUE,) * 4)], 119.2),
        ([(0x080 + node, EMERGENCY_SLOTS) for node in NODES], 120.9),
    ],
)
def test_mean_lengths_are_near_the_published_ones(frames: Frames, mean: float) -> None:
    costs = [frame_line("", (cob_id,), tuple(slots), 1.0, BUS).each.typical for cob_id, slots in frames]
    assert 1e6 * sum(costs) / len(costs) == pytest.approx(mean, abs=1.5)


def test_the_wam_fits_one_bus_at_1_khz() -> None:
    wam = budget(wam_driver(), 1000.0)
    (bus,) = wam.buses
    assert bus.cycle.worst == pytest.approx(970e-6)
    assert bus.cycle.unstuffed == pytest.approx(806e-6)
    share = {line.name: round(100 * line.load.worst, 2) for line in bus.lines if not line.cyclic}
    assert share["status reports"] == 1.33
    assert round(share["heartbeats of the drives"] + share["heartbeat of the host"], 1) == 0.5
    assert round(100 * bus.load.worst, 1) == 98.9
    assert 87.0 < 100 * bus.load.typical < 88.5
    assert wam.fits
    assert (wam.reason, wam.remedy) == ("", "")


def test_half_the_rate_costs_half() -> None:
    (fast,), (slow,) = budget(wam_driver(), 1000.0).buses, budget(wam_driver(), 500.0).buses
    assert slow.load.worst - slow.background.worst == pytest.approx(0.485)
    assert slow.background == fast.background


@pytest.mark.parametrize("changes", [{}, {"torque_frames": "single"}, {"status": {"period": 0.1, "inhibit": 0.01}}])
def test_the_highest_rate_fits_and_one_more_does_not(changes: dict[str, Any]) -> None:
    driver = wam_driver(**changes)
    highest = budget(driver, 100.0).highest_rate
    assert budget(driver, float(highest)).fits
    assert not budget(driver, highest + 1.0).fits


def test_the_typical_load_counts_too() -> None:
    # With CAN FD less is stuffed in the worst case than the tenth that the rule keeps free of the typical one.
    driver = wam_driver(buses=[{"data_bitrate": 2_000_000}])
    rate = budget(driver, 1000.0).highest_rate + 1.0
    (bus,) = budget(driver, rate).buses
    assert bus.load.worst <= 1.0
    assert bus.load.typical > 0.9
    assert not bus.fits


def test_over_budget_is_reported_with_remedies_that_hold() -> None:
    driver = wam_driver(torque_frames="single")
    over = budget(driver, 1000.0)
    assert not over.fits
    assert over.reason.startswith("bus 0 (can0) is over budget at 1000 Hz: 126.4 % worst, 112.")
    keys = ("control.rate", "driver.torque_frames: shared", "bus of each drive", "data_bitrate")
    assert [key for key in keys if any(key in remedy for remedy in over.remedies)] == list(keys)
    assert "run at 500 Hz" in over.remedy
    drives = [{**d.model_dump(), "bus": int(k > 3)} for k, d in enumerate(driver.drives)]
    done = {
        "run at": budget(driver, 500.0),
        "let up": budget(wam_driver(), 1000.0),
        "give the": budget(wam_driver(torque_frames="single", buses=[{}, {"channel": "can1"}], drives=drives), 1000.0),
        "use CAN": budget(wam_driver(torque_frames="single", buses=[{"data_bitrate": 4_000_000}]), 1000.0),
    }
    for remedy in over.remedies:
        after = next(other for words, other in done.items() if remedy.startswith(words))
        assert after.fits
        assert worst_of(after) == pytest.approx(float(re.findall(r"([\d.]+) % worst", remedy)[0]), abs=0.06)


def worst_of(other: Budget) -> float:
    return 100 * max(bus.load.worst for bus in other.buses)


def test_frames_are_not_shared_where_drives_have_no_dummies() -> None:
    bare = {"name": "bare.eds", "text": EDS.replace("Dummy0003=1", "Dummy0003=0")}
    over = budget(wam_driver(torque_frames="single", eds=bare), 1000.0)
    assert not any("shared" in remedy for remedy in over.remedies)
    assert over.remedies


def test_can_fd_costs_less() -> None:
    (plain,), (fd,) = (
        budget(wam_driver(buses=[bus]), 1000.0).buses for bus in ({}, {"bitrate": 1_000_000, "data_bitrate": 4_000_000})
    )
    assert fd.cycle.worst < 0.6 * plain.cycle.worst
    assert fd.cycle.unstuffed < fd.cycle.typical < fd.cycle.worst


def test_a_slow_bus_carries_less() -> None:
    half = budget(wam_driver(buses=[{"bitrate": 500_000}]), 500.0)
    assert half.buses[0].cycle.worst == pytest.approx(2 * 970e-6)
    assert budget(wam_driver(buses=[{"bitrate": 10_000}]), 500.0).highest_rate == 0
