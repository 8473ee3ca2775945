"""What drives and buses tell beside their samples: every code is in the table, the most severe counts."""

from __future__ import annotations

import numpy as np
import pytest
from guard_bench import HOME, LIMITS, Bench, is_fault, unit

from drivers.axis_status import AxisEvent, AxisEventCode, AxisStatus
from ident_service.motion.faults import FAULTS, Reaction
from ident_service.motion.safety_monitor import VELOCITY_OFF

WARNED = AxisEvent(AxisEventCode.DRIVE_WARNING, 0, "node 1: warns")
BUS = AxisEvent(AxisEventCode.BUS_DEGRADED, None, "can0: error passive")
DIED = AxisEvent(AxisEventCode.EMERGENCY_MESSAGE, 1, "node 2: 5400h power section")


@pytest.mark.parametrize("code", list(AxisEventCode))
def test_every_event_is_a_fault_of_the_table(code: AxisEventCode) -> None:
    _, fault = Bench().see(HOME, events=(AxisEvent(code, 1, "node 2: words"),))
    assert fault is not None
    assert is_fault(fault, code.value, 1)
    assert fault.message == f"elbow: node 2: words: {FAULTS[code.value].means}"


def test_an_event_of_the_bus_names_no_joint() -> None:
    _, fault = Bench().see(HOME, events=(BUS,))
    assert fault is not None
    assert fault.message.startswith("can0: error passive: ")


def test_the_most_severe_event_counts_and_every_warning_is_counted() -> None:
    bench = Bench()
    for events in ((WARNED, BUS, DIED), (DIED, BUS, WARNED), (BUS, DIED, WARNED)):
        usable, fault = bench.see(HOME, events=events)
        assert is_fault(fault, "drive_emergency", 1)
        assert usable == [True, True]
    assert bench.guard.warnings["drive_warning"] == 3


def test_the_event_is_reported_before_the_status_word_it_explains_but_not_before_worse() -> None:
    bench = Bench()
    bench.see(HOME, status=(int(AxisStatus.POWERED),) * 2)
    tripped = (int(AxisStatus.POWERED), int(AxisStatus.FAULT))
    assert is_fault(bench.see(HOME, status=tripped, events=(DIED,))[1], "drive_emergency", 1)
    fast = 1.01 * VELOCITY_OFF * LIMITS.velocity * unit(0)
    fault = bench.see(HOME, velocity=fast, events=(DIED, BUS))[1]
    assert fault is not None
    assert fault.reaction is Reaction.TORQUE_OFF


def test_warnings_that_do_not_end_stop_the_arm() -> None:
    bench = Bench()
    found = [bench.see(HOME, events=(WARNED,))[1] for _ in range(FAULTS["drive_warning"].often + 1)]
    assert is_fault(found[-2], "drive_warning", 0)
    assert is_fault(found[-1], "repeated_warnings")


def test_what_cannot_be_believed_comes_before_what_is_reported() -> None:
    _, fault = Bench().see(np.array([np.nan, HOME[1]]), events=(DIED,))
    assert is_fault(fault, "feedback_not_finite", 0)


def test_warnings_of_one_cycle_count_as_one_cycle() -> None:
    bench, often = Bench(), FAULTS["strange_frame"].often
    late = tuple(AxisEvent(AxisEventCode.STRANGE_FRAME, k % 2, f"node {k}: came late") for k in range(7))
    found = [bench.see(HOME, events=late)[1] for _ in range(often + 1)]
    assert all(is_fault(one, "strange_frame", 0) for one in found[:-1])
    assert is_fault(found[-1], "repeated_warnings")
    assert bench.guard.warnings["strange_frame"] == 7 * (often + 1)
