"""What drives and buses tell beside their samples, as faults of the table; the most severe of a cycle counts.

Boundary: from events to one fault; what events there are is `drivers/status.py`, what follows is `faults.py`.
"""

from __future__ import annotations

from collections.abc import Sequence

from drivers.status import AxisEvent
from ident_service.motion.faults import Fault, Findings


def told(events: Sequence[AxisEvent], names: Sequence[str], findings: Findings) -> Fault | None:
    """Judge the events of one sample.

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
