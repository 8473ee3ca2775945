"""Tickets for tests of what comes after a preflight: each arm is checked once in a test process."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from ident_service.config.arm import ArmConfig
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import arm_model
from ident_service.motion.arm_factory import make_arm
from ident_service.motion.ticket import VALID, Ticket, Verdict
from ident_service.operations.arm_checks import write_ticket
from ident_service.preflight.preflight import preflight
from ident_service.registry.state_folder import ticket_path

_MADE: dict[str, Ticket] = {}


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
    ticket = _MADE.get(config.sha256)
    if ticket is None or ticket.expires - datetime.now(UTC) < VALID / 2:
        model = arm_model(config)
        motion = excitation(model, "identification")
        ticket = preflight(make_arm(_on_its_support(config)), model, motion, confirm=lambda _: config.name)
        assert ticket.verdict is Verdict.PASSED, ticket
        _MADE[config.sha256] = ticket
    path = ticket_path(state, config.name)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_ticket(path, ticket)
