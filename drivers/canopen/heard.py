"""Which frames a link hears: every one of CANopen, whose identifiers have 11 bits (CiA 301, 7.3.5).

SDO is among them, since drives are configured over the same link before anything streams. All else matters, of foreign
nodes too: a second master's SYNC or torque is a fault.

Boundary: identifiers only.
"""

from __future__ import annotations

from typing import Final

# Identifier and mask; a frame with 11 bits of identifier is heard when any fits.
HEARD: Final = ((0x000, 0x000),)


# Frames of one drain: a flood, which no bus but a local socket can bring, must not hold the loop.
MOST_AT_ONCE: Final = 4096
