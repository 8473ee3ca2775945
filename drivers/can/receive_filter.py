"""Define the receive filter of a link: all CANopen frames, whose identifiers have 11 bits (CiA 301, 7.3.5).

SDO is among them, since drives are configured over the same link before anything streams. Frames of foreign nodes are
received too: a second master's SYNC or torque is a fault.
"""

from __future__ import annotations

from typing import Final

# Identifier and mask; a frame with 11 bits of identifier is received when any pair fits.
HEARD: Final = ((0x000, 0x000),)


# Frames of one drain: a flood, which no bus but a local socket can bring, must not hold the loop.
MOST_AT_ONCE: Final = 4096
