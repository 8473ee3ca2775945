"""Controls in this process, and the leases of whoever asked for motion."""

from __future__ import annotations

import pytest
from helpers.local_commands import LocalCommands

from ident_service.motion.command_channel import HOLD_TO_RUN_SECONDS, LEASE_SECONDS, StopCondition


def test_a_function_can_stop_a_run() -> None:
    asked = iter([False, True])
    controls = StopCondition(lambda: next(asked))
    assert not controls.stop
    assert controls.stop
    assert not controls.pause
    assert not controls.finish
    assert controls.lease_ok(10**18)
    assert not StopCondition().stop


@pytest.mark.parametrize("seconds", [HOLD_TO_RUN_SECONDS, LEASE_SECONDS])
def test_a_lease_lasts_as_long_as_it_is_renewed(seconds: float) -> None:
    controls, length = LocalCommands(seconds), round(seconds * 1e9)
    assert controls.lease_ok(1000)  # begins with the first question
    assert controls.lease_ok(1000 + length)
    assert not controls.lease_ok(1001 + length)
    controls.renew(5 * length)
    assert controls.lease_ok(6 * length)
    assert not controls.lease_ok(6 * length + 1)


def test_without_a_lease_nothing_lapses() -> None:
    controls = LocalCommands()
    assert controls.lease_ok(0)
    assert controls.lease_ok(10**18)
    assert (controls.stop, controls.pause) == (False, False)
