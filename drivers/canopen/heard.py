"""Which frames the cyclic plane wants to hear: everything of CANopen but SDO (CiA 301, 7.3.5).

A link is not read while the configuration plane talks to the drives; seven drives answer with more SDO frames than a
socket's queue holds. All else matters, of foreign nodes too: a second master's SYNC or torque is a fault.

Boundary: identifiers only.
"""

from __future__ import annotations

from typing import Final

# Identifier and mask; a frame is heard when any fits. 580h to 67Fh, SDO, is what is left out.
HEARD: Final = ((0x000, 0x400), (0x400, 0x700), (0x500, 0x780), (0x680, 0x780), (0x700, 0x700))


# Frames of one drain: a flood, which no bus but a local socket can bring, must not hold the loop.
MOST_AT_ONCE: Final = 4096


def is_heard(identifier: int, filters: tuple[tuple[int, int], ...] = HEARD) -> bool:
    """Whether any filter lets an 11-bit identifier pass; all do where there are none."""
    return not filters or any(identifier & mask == wanted & mask for wanted, mask in filters)
