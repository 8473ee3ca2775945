"""Turn the events that drives and buses report with a sample into the most severe fault of the table."""

from __future__ import annotations

from collections.abc import Sequence

from drivers.axis_status import AxisEvent
from ident_service.motion.faults import Fault, Findings


def told(events: Sequence[AxisEvent], names: Sequence[str], findings: Findings) -> Fault | None:
    """Return the most severe fault among the events of one sample.

    Args:
        events: of the sample.
        names: of the joints.
        findings: makes the faults; every warning is counted.

    Returns:
        The most severe fault, the first of equals; None without events.
    """
    worst: Fault | None = None
    for event in events:
        whose = "" if event.axis is None else f"{names[event.axis]}: "
        found = findings.found(event.code.value, f"{whose}{event.words}")
        if worst is None or found.reaction > worst.reaction:
            worst = found
    return worst
