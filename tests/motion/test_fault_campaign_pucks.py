"""Every fault that emulated pucks can have, in every moving state, on the driver that moves a real WAM.

Two joints behind two pucks, and the WAM with its differentials. Beside what every arm of the campaign is held to
(`campaign_checks.py`), an arm that is left alone afterwards must be without torque. `make campaign` runs all; a seeded
sample runs always.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import pytest
from campaign_bench import PAUSED, Case, Outcome
from campaign_checks import in_runs, keep_their_promises, together
from campaign_pucks import PUCK_PROMISES, WIRE, PuckArm, of_joint
from test_fault_campaign import STATES

from ident_service.motion.faults import FAULTS
from sim_backend.emulator.faults import DRIVE_FAULTS
from sim_backend.emulator.motor import Power

SEED = 12
PUCKS = {"bench pucks": 2, "wam pucks": 7}


def cases(arm: str, times: int, pucks: int) -> Iterator[Case]:
    """All kinds in all states, at some random times, on some random pucks."""
    rng = random.Random(f"{SEED} {arm}")  # noqa: S311 - not for secrets
    for kind, state, _ in product(PUCK_PROMISES, STATES, range(times)):
        chosen: list[int | None] = [*rng.sample(range(PUCKS[arm]), pucks)] if of_joint(kind) else [None]
        for puck in chosen:
            yield Case(arm, kind, state, rng.random(), puck)


def sample() -> list[Case]:
    """One of each kind about a pause of the small arm; emulated drives have one of a differential."""
    rng = random.Random(SEED)  # noqa: S311 - not for secrets
    small = [case for case in cases("bench pucks", 1, 1) if case.state in PAUSED]
    return [rng.choice([case for case in small if case.kind == kind]) for kind in PUCK_PROMISES]


def test_every_kind_of_fault_has_its_promise() -> None:
    # Pucks send no heartbeats; what shows without a host only is in tests/barrett.
    assert set(PUCK_PROMISES) == (set(DRIVE_FAULTS) | set(WIRE)) - {"watchdog_ignored", "heartbeat_lost"}
    for promise in PUCK_PROMISES.values():
        assert promise.codes <= set(FAULTS)


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("some", together(sample()))
def test_a_sample_of_the_campaign(some: list[Case], tmp_path: Path) -> None:
    keep_their_promises(some, tmp_path, let_go)


@pytest.mark.campaign
@pytest.mark.parametrize("some", in_runs([*cases("bench pucks", 2, 2), *cases("wam pucks", 1, 2)]))
def test_the_campaign(some: list[Case], tmp_path: Path) -> None:
    keep_their_promises(some, tmp_path, let_go)


def let_go(case: Case, outcome: Outcome) -> None:
    arm = outcome.arm
    assert isinstance(arm, PuckArm)
    stuck = case.joint if case.kind == "stuck_torque" else None
    motors = arm.behind.emulator.body.motors
    assert not [k for k, motor in enumerate(motors) if motor.power is Power.TORQUE and k != stuck]
    assert "ACTIVE" not in arm.behind.emulator.states[-1]
