"""Tickets for tests of what comes after a preflight: each arm is checked once, for all workers."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest
from helpers.once import made_once

from ident_service.config.arm import ArmConfig
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import arm_model
from ident_service.motion.arm_factory import make_arm
from ident_service.motion.ticket import VALID, Ticket, Verdict, ticket_from_json
from ident_service.operations.arm_checks import write_ticket
from ident_service.preflight.preflight import preflight
from ident_service.registry.state_folder import ticket_path

# It makes the folder that the workers share; `tests/conftest.py` sets it.
factory: pytest.TempPathFactory | None = None


def _on_its_support(config: ArmConfig) -> ArmConfig:
    """Hold a simulated arm without brakes like one with brakes whenever its drives have no power.

    Preflight falls silent only after a person has typed that the arm is supported.
    """
    joints = {name: joint.model_copy(update={"brake": True}) for name, joint in config.joints.items()}
    return config.model_copy(update={"joints": joints})


def write_checked_ticket(config: ArmConfig, state: Path) -> None:
    """Write the ticket that `ident preflight` writes for the identification motion of an arm in virtual time.

    Args:
        config: of an arm without a plant that outlives it, so that one preflight speaks for all tests.
        state: folder of the state, made where it is missing.
    """
    assert factory is not None
    folder = made_once(factory, f"ticket-{config.sha256}", lambda place: write_ticket(place / "ticket", _made(config)))
    ticket = ticket_from_json((folder / "ticket").read_text(encoding="utf-8"))
    if ticket.expires - datetime.now(UTC) < VALID / 2:
        ticket = _made(config)
    path = ticket_path(state, config.name)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_ticket(path, ticket)


def _made(config: ArmConfig) -> Ticket:
    model = arm_model(config)
    motion = excitation(model, "identification")
    ticket = preflight(make_arm(_on_its_support(config)), model, motion, confirm=lambda _: config.name)
    assert ticket.verdict is Verdict.PASSED, ticket
    return ticket
