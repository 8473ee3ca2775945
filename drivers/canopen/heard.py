"""Which frames a link wants to hear: everything of CANopen but what only drives are asked (CiA 301, 7.3.5).

The answers to SDO are among them: the drives are configured over the link that streams afterwards, which is read
meanwhile. All else matters, of foreign nodes too: a second master's SYNC or torque is a fault.

Boundary: identifiers only.
"""

from __future__ import annotations

from typing import Final

# Identifier and mask; a frame is heard when any fits. 600h to 67Fh, requests of SDO, is what is left out.
HEARD: Final = ((0x000, 0x400), (0x400, 0x600), (0x680, 0x780), (0x700, 0x700))

# Frames of one drain: a flood, which no bus but a local socket can bring, must not hold the loop.
MOST_AT_ONCE: Final = 4096


def is_heard(identifier: int, filters: tuple[tuple[int, int], ...] = HEARD) -> bool:
    """Whether any filter lets an 11-bit identifier pass; all do where there are none."""
    return not filters or any(identifier & mask == wanted & mask for wanted, mask in filters)
