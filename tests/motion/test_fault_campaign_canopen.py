"""Every fault that emulated drives on a bus can have, in every moving state, on the driver that moves real ones.

Two joints behind two drives, the WAM with its differentials on one bus, and on two. Beside what every arm of the
campaign is held to (`campaign_checks.py`), drives that are left alone afterwards must have let go by themselves, and
what a drive tells is told with its node or its joint. `make campaign` runs all; a seeded sample runs always.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from campaign_bench import Case, Outcome, Strike, play, script_of, subject, windows
from campaign_canopen import CANOPEN_PROMISES, FOREIGN, WIRE, EmulatedArm, of_joint
from campaign_checks import in_runs, keep_their_promises, together
from test_fault_campaign import STATES

from ident_service.motion.faults import FAULTS
from ident_service.motion.state_machine import State
from sim_backend.emulator.faults import DRIVE_FAULTS
from sim_backend.emulator.motor import Power

SEED = 11
DRIVES = {
    "bench canopen": 2,
    "bench positions": 2,
    "loose canopen": 2,
    "floored canopen": 2,
    "wam canopen": 7,
    "wam two buses": 7,
}
# Codes of faults that a drive, not the bus or the loop, tells.
TOLD = {"drive_fault", "drive_emergency", "drive_silent", "drive_restarted", "drive_left", "feedback_gone"}


def cases(arm: str, times: int, drives: int) -> Iterator[Case]:
    """All kinds in all states, at some random times, on some random drives."""
    rng = random.Random(f"{SEED} {arm}")  # noqa: S311 - not for secrets
    for kind, state, _ in product(CANOPEN_PROMISES, STATES, range(times)):
        chosen: list[int | None] = [*rng.sample(range(DRIVES[arm]), drives)] if of_joint(kind) else [None]
        for drive in chosen:
            yield Case(arm, kind, state, rng.random(), drive)


def sample() -> list[Case]:
    """One of each kind on the small arm while it moves.

    Pauses and stops are the same for all arms: samples of the simulated arm and of pucks have them.
    """
    rng = random.Random(SEED)  # noqa: S311 - not for secrets
    small = [case for case in cases("bench canopen", 1, 1) if script_of(case.state) is State.EXCITING]
    chosen = [rng.choice([case for case in small if case.kind == kind]) for kind in CANOPEN_PROMISES]
    # While it moves, drives that are given positions react in their own way.
    moving = [case for case in cases("bench positions", 1, 1) if case.state is State.EXCITING]
    chosen += rng.sample([case for case in moving if case.kind not in FOREIGN], 5)
    return chosen


def two_buses() -> Iterator[Case]:
    """What one of two buses, or drives on either, can have."""
    kinds = {"drive_fault", "node_silent", "reboot", "lost_feedback", "lost_torques", "bus_off", "heartbeat_lost"}
    return (case for case in cases("wam two buses", 1, 2) if case.kind in kinds | {"foreign_sync", "emergency"})


# What ends a motion of an arm without brakes, by who can still hold it: its drives, nobody, or nobody needs to.
DRIVES_HOLD = ("bus_gone", "lost_torques", "full_queue", "heartbeat_lost", "lost_feedback", "foreign_torque")
NOBODY_HOLDS = ("drive_fault", "node_silent", "emergency_stop")
LOWERED = ("lost_status",)


def loose(arm: str = "loose canopen") -> Iterator[Case]:
    """Ends of motions of an arm without brakes, while it moves, stops, and is held."""
    kinds = (*DRIVES_HOLD, *NOBODY_HOLDS, *LOWERED)
    states = (State.EXCITING, State.STOPPING, State.STOPPED)
    return (case for case in cases(arm, 1, 1) if case.kind in kinds and case.state in states)


def some_loose() -> list[Case]:
    """One of each sort, two of what nobody holds: while it moves, and while it is held; it does not sink for long."""
    wanted = {("bus_gone", State.STOPPED), ("lost_status", State.EXCITING), ("node_silent", State.EXCITING)}
    return [
        case
        for case in loose("floored canopen")
        if (case.kind, case.state) in wanted | {("drive_fault", State.STOPPED)}
    ]


def ends_as_it_can(case: Case, outcome: Outcome) -> None:
    """Hold the end of an arm without brakes to what `docs/fieldbus.md` says of it."""
    let_go(case, outcome)
    arm = outcome.arm
    assert isinstance(arm, EmulatedArm)
    motors = arm.behind.emulator.body.motors
    for number, motor in enumerate(motors):
        ill = case.kind in NOBODY_HOLDS and case.joint in (None, number)
        if outcome.fault is None or case.kind in LOWERED or ill:
            assert motor.power is Power.COAST, case
        else:
            assert motor.power in (Power.HELD, Power.BRAKE), case
    if case.kind in NOBODY_HOLDS or outcome.fault is None or case.kind in LOWERED:
        return
    before = arm.behind.emulator.body.plant.position
    arm.behind.settle(arm.clock.now_ns() + 2_000_000_000)
    assert np.abs(arm.behind.emulator.body.plant.position - before).max() < 0.1  # a ramp may not be over yet


def test_every_kind_of_fault_has_its_promise() -> None:
    shows_without_a_host_only = {"watchdog_ignored"}  # canopen_driver/test_driver_watchdogs.py
    assert set(CANOPEN_PROMISES) == (set(DRIVE_FAULTS) | set(WIRE)) - shows_without_a_host_only
    for promise in CANOPEN_PROMISES.values():
        assert promise.codes
        assert promise.codes <= set(FAULTS)


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("some", together(sample()))
def test_a_sample_of_the_campaign(some: list[Case], tmp_path: Path) -> None:
    keep_their_promises(some, tmp_path, let_go)


@pytest.mark.slow
def test_a_drive_that_applies_a_share_of_its_torque_is_named() -> None:
    begin, _ = windows("bench canopen", State.EXCITING)[State.EXCITING.value]
    outcome = play(
        subject("bench canopen"), State.EXCITING, (Strike(begin + 100, "torque_fraction", 0, None, 0.5),), None
    )
    assert outcome.fault is not None
    warned = [words for _, _, words in outcome.story.events if words.startswith("torque_not_applied: shoulder: ")]
    assert warned
    assert "more than commanded" in warned[0]


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("some", together(some_loose()))
def test_ends_of_an_arm_without_brakes(some: list[Case], tmp_path: Path) -> None:
    keep_their_promises(some, tmp_path, ends_as_it_can)


@pytest.mark.campaign
@pytest.mark.parametrize("some", in_runs([*loose()]))
def test_all_ends_of_an_arm_without_brakes(some: list[Case], tmp_path: Path) -> None:
    keep_their_promises(some, tmp_path, ends_as_it_can)


def campaign() -> list[Case]:
    """All cases."""
    return [*cases("bench canopen", 2, 2), *cases("bench positions", 2, 2), *cases("wam canopen", 1, 2), *two_buses()]


@pytest.mark.campaign
@pytest.mark.parametrize("some", in_runs(campaign()))
def test_the_campaign(some: list[Case], tmp_path: Path) -> None:
    keep_their_promises(some, tmp_path, let_go)


def let_go(case: Case, outcome: Outcome) -> None:
    arm = outcome.arm
    assert isinstance(arm, EmulatedArm)
    assert not [state for state in arm.states if "operation enabled" in state]
    stuck = case.joint if case.kind == "stuck_torque" else None
    motors = arm.behind.emulator.body.motors
    assert not [k for k, motor in enumerate(motors) if motor.power is Power.TORQUE and k != stuck]
    if outcome.fault is not None and case.kind == "full_queue":
        assert arm.told_to_brake == DRIVES[case.arm]
    if outcome.fault is not None and outcome.fault.code in TOLD and case.joint is not None:
        assert f"node {case.joint + 1}:" in str(outcome.fault) or any(
            subject(case.arm).model.chain.names[k] in str(outcome.fault)
            for k in arm.inner._joints_of[case.joint]  # type: ignore[attr-defined]
        )
