"""Ask many nodes for one entry at a time, by SDO uploads that run in parallel (CiA 301, 7.2.4.3.5).

Each node serves its own requests, so that all of them may be asked before the first has answered. Only what one frame
holds is read, and nothing is ever written; texts, and what is written, go through `sdo.py`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

from drivers.can.can_frame import Frame
from drivers.can.can_link import Link
from drivers.canopen.object_dictionary import Entry
from drivers.canopen.pdo_mapping import SDO_REPLY, SDO_REQUEST

Place = tuple[int, int]
"""A node of an arm: number of its bus, and node number, which another bus may have too."""

BURST = 8  # requests that are sent at once; a CAN interface of Linux queues ten frames out of the box
_ABORT, _UPLOAD, _EXPEDITED, _SIZED = 0x80, 0x40, 0x02, 0x01


def upload_request(entry: Entry) -> bytes:
    """Return the eight bytes that ask for an entry."""
    return struct.pack("<BHB4x", _UPLOAD, entry.index, entry.sub)


@dataclass
class Answers:
    """Hold the answers of nodes to the upload of one entry.

    Attributes:
        values: by node.
        aborts: codes of those that answered without a value; 0 for an answer that is no value of this type.
    """

    values: dict[Place, int] = field(default_factory=dict)
    aborts: dict[Place, int] = field(default_factory=dict)

    def take(self, place: Place, entry: Entry, data: bytes) -> bool:
        """Store eight bytes of a node if they are its answer; returns whether they are."""
        first, index, sub = struct.unpack_from("<BHB", data)
        if (index, sub) != (entry.index, entry.sub):
            return False
        if first == _ABORT:
            (self.aborts[place],) = struct.unpack_from("<I", data, 4)
            return True
        if first & 0xE0 != _UPLOAD:
            return False
        length = 4 - (first >> 2 & 3) if first & _SIZED else entry.kind.size
        if first & _EXPEDITED and length == entry.kind.size:
            self.values[place] = entry.unpack(data[4 : 4 + length])
        else:
            self.aborts[place] = 0
        return True


def poll(
    links: Sequence[Link],
    places: Iterable[Place],
    entry: Entry,
    deadline_ns: int,
    others: Callable[[int, Frame], None] = lambda bus, frame: None,
) -> Answers:
    """Ask nodes for one entry.

    Args:
        links: of the arm's buses.
        places: nodes to ask; `BURST` of a bus at a time.
        entry: to upload.
        deadline_ns: when nodes that have not answered are given up [ns of the links' clock]; each burst has its share.
        others: takes the frames that are no answers, with the number of their bus.

    Raises:
        DriverError: a bus is gone.
    """
    found = Answers()
    waiting = [sorted(place for place in set(places) if place[0] == bus) for bus in range(len(links))]
    groups = -(-max(map(len, waiting)) // BURST)
    start_ns = links[0].clock.now_ns()
    for group in range(groups):
        asked = [places[BURST * group : BURST * (group + 1)] for places in waiting]
        _ask(links, asked, entry, start_ns + (deadline_ns - start_ns) * (group + 1) // groups, found, others)
    return found


def _ask(
    links: Sequence[Link],
    asked: Sequence[Sequence[Place]],
    entry: Entry,
    deadline_ns: int,
    found: Answers,
    others: Callable[[int, Frame], None],
) -> None:
    """Ask one burst of nodes on every bus."""
    for link, places in zip(links, asked, strict=True):
        for _, node in places:
            link.send(Frame(SDO_REQUEST + node, upload_request(entry)))
    for bus, (link, places) in enumerate(zip(links, asked, strict=True)):
        missing = set(places)
        while missing and (frame := link.receive(deadline_ns)) is not None:
            place = bus, frame.identifier - SDO_REPLY
            plain = not (frame.error or frame.remote or frame.extended) and len(frame.data) == 8
            if plain and place in missing and found.take(place, entry, frame.data):
                missing.discard(place)
            else:
                others(bus, frame)
