"""Read and write object dictionaries over SDO (CiA 301), and poll many nodes beside a running loop.

The library listens in a thread and waits in real time. Here its client is given a network that hands each request to
the link and receives until the reply has come, so that the same code configures drives over every link, in virtual
time too, and no thread is left when streaming begins. Other frames received meanwhile go to a given function.

Each node serves its own requests, so that all of them may be asked before the first has answered. Only what one frame
holds is read so, and nothing is written; texts, and what is written, take the library's client.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

from canopen.objectdictionary import ObjectDictionary
from canopen.sdo import SdoAbortedError, SdoClient, SdoCommunicationError

from drivers.can.can_frame import Frame
from drivers.can.can_link import Link
from drivers.canopen.cia402 import abort_words
from drivers.canopen.object_dictionary import Entry
from drivers.canopen.pdo_mapping import SDO_REPLY, SDO_REQUEST, Write
from drivers.clock import Clock
from ident_service.errors import DriverError

TIMEOUT = 0.3  # s for one reply
# What the library logs as an error is in the errors raised here, or was tried again.
logging.getLogger("canopen.sdo").setLevel(logging.CRITICAL)
_ABORT = 0x80
T = TypeVar("T")
DOES_NOT_EXIST = (0x06020000, 0x06090011)
READ_ONLY = (0x06010000, 0x06010002)
WRONG_VALUE = (0x06090030, 0x06090031, 0x06090032)
WRITE_ONLY = (0x06010001,)


class SdoRefused(DriverError):
    """Report that a drive answered with an abort; `code` is that of CiA 301, table 22."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


class WriteNotVerified(DriverError):
    """Report that an entry was set without an abort, but holds something else."""


def none_if_missing(read: Callable[[Any], T], argument: Any) -> T | None:
    """Return `read(argument)`; None where it raises SdoRefused because the drive has no such entry."""
    try:
        return read(argument)
    except SdoRefused as refused:
        if refused.code not in DOES_NOT_EXIST:
            raise
        return None


class ReplyLink(Protocol):
    """Define what a conversation with one node needs of a link; see `Link`."""

    @property
    def clock(self) -> Clock:
        """Return the clock of deadlines."""

    def send(self, frame: Frame) -> None:
        """Queue one frame for transmission."""

    def receive(self, deadline_ns: int) -> Frame | None:
        """Return the next received frame, None when there is none until the deadline [ns of the clock]."""


class Objects:
    """Access the object dictionary of one node, while nothing streams.

    Attributes:
        dry: whether nothing is really written.
        patience: how long a reply is waited for [s]; storing in flash memory takes longer than reading.
    """

    dry = False
    patience = TIMEOUT

    def __init__(self, link: ReplyLink, node: int, others: Callable[[Frame], None] = lambda frame: None) -> None:
        """Use the given link, which stays the caller's.

        Args:
            link: link of the node's bus.
            node: node number.
            others: called with the frames that are not replies of this node.
        """
        self.node = node
        self._link, self._others = link, others
        self._client = SdoClient(SDO_REQUEST + node, SDO_REPLY + node, ObjectDictionary())
        self._client.network = self
        self._client.RESPONSE_TIMEOUT = 0.0  # what has not come while we received will not come any more

    @property
    def clock(self) -> Clock:
        """Return the clock of the link."""
        return self._link.clock

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Send a request and hand the reply to the client (the library calls this)."""
        self._link.send(Frame(can_id, bytes(data), remote=remote))
        if data[0] == _ABORT:  # is not replied to
            return
        deadline = self._link.clock.now_ns() + round(self.patience * 1e9)
        while (frame := self._link.receive(deadline)) is not None:
            if frame.identifier == SDO_REPLY + self.node and len(frame.data) == 8 and not frame.error:
                self._client.on_response(frame.identifier, frame.data, 0.0)
                return
            self._others(frame)

    def discard_answers(self) -> None:
        """Discard answers to earlier requests for as long as one may take to come; DriverError when the bus is gone."""
        deadline = self._link.clock.now_ns() + round(self.patience * 1e9)
        while (frame := self._link.receive(deadline)) is not None:
            self._others(frame)

    def read_bytes(self, index: int, sub: int, name: str) -> bytes:
        """Return the value of an entry as bytes; SdoRefused where the drive aborts, DriverError without an answer.

        Raises:
            SdoRefused: the drive aborts the upload.
            DriverError: it does not answer, or the bus is gone.
        """
        return bytes(self._request(f"reading {index:04X}h:{sub:02X} {name}", self._client.upload, index, sub))

    def read(self, entry: Entry) -> int:
        """Return the value of an entry; SdoRefused where the drive aborts, DriverError without a proper answer."""
        data = self.read_bytes(entry.index, entry.sub, entry.name)
        try:
            return entry.unpack(data)
        except ValueError as error:
            raise DriverError(f"node {self.node}: {error}") from None

    def write(self, write: Write) -> None:
        """Set an entry without reading it back; SdoRefused where the drive aborts, DriverError without an answer."""
        entry = write.entry
        what = f"setting {entry} to {write.value}"
        self._request(what, self._client.download, entry.index, entry.sub, write.data)

    def holds(self, write: Write) -> bool:
        """Return whether an entry holds a value already; one that can only be written does not. Raises as `read`."""
        try:
            return write.is_held_by(self.read(write.entry))
        except SdoRefused as refused:
            if refused.code not in WRITE_ONLY:
                raise
            return False

    def ensure(self, write: Write) -> None:
        """Write an entry unless it holds the value, and read it back; SdoRefused or WriteNotVerified if that fails."""
        if not none_if_missing(self.holds, write):  # setting a missing entry raises the error
            self.write_verified(write)

    def write_if_present(self, write: Write) -> None:
        """Write an entry where it holds another value, and read it back; do nothing where the drive has none."""
        if none_if_missing(self.holds, write) is False:
            self.write_verified(write)

    def write_verified(self, write: Write) -> None:
        """Set an entry and read it back; WriteNotVerified if it holds something else, SdoRefused if aborted."""
        self.write(write)
        held = self.read(write.entry)
        if not write.is_held_by(held):
            raise WriteNotVerified(f"node {self.node}: {write.entry} was set to {write.value} but holds {held}")

    def _request(self, what: str, ask: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return ask(*arguments)
        except SdoAbortedError as error:
            raise SdoRefused(f"node {self.node}: {what}: {abort_words(error.code)}", error.code) from None
        except SdoCommunicationError as error:
            raise DriverError(f"node {self.node}: {what}: no proper answer ({error})") from None


@dataclass(frozen=True)
class Change:
    """Represent one value that a drive would be given: its entry, and what it holds; None where that cannot be read."""

    entry: Entry
    before: int | None
    after: int


class DryRunObjects(Objects):
    """Read the object dictionary of one node, and note what would be written instead of writing it.

    Attributes:
        changes: changes noted so far, in order; an entry that is written twice is there twice.
    """

    dry = True

    def __init__(
        self, link: Link, node: int, others: Callable[[Frame], None], fixed: Collection[int] = frozenset()
    ) -> None:
        """Begin without changes.

        Args:
            link: link of the node's bus.
            node: node number.
            others: called with the frames that are not replies of this node.
            fixed: keys of the entries that cannot be written, which no upload tells.
        """
        super().__init__(link, node, others)
        self.changes: list[Change] = []
        self._fixed = fixed
        self._written: dict[int, int] = {}

    def read(self, entry: Entry) -> int:
        """Return what an entry would hold: the value noted last, else the node's own; raises as `Objects.read`."""
        written = self._written.get(entry.key)
        return super().read(entry) if written is None else written

    def write(self, write: Write) -> None:
        """Note a change instead of writing it; SdoRefused where the node has no such entry, or it is fixed."""
        try:
            before: int | None = self.read(write.entry)
        except SdoRefused as refused:
            if refused.code not in WRITE_ONLY:
                raise
            before = None
        if write.entry.key in self._fixed:
            raise SdoRefused(f"node {self.node}: {write.entry} is fixed by its data sheet", READ_ONLY[-1])
        self.changes.append(Change(write.entry, before, write.value))
        self._written[write.entry.key] = write.value


Place = tuple[int, int]
"""A node of an arm: number of its bus, and node number, which another bus may have too."""

BURST = 8  # requests that are sent at once; a CAN interface of Linux queues ten frames out of the box
_ABORT_FRAME, _UPLOAD, _EXPEDITED, _SIZED = 0x80, 0x40, 0x02, 0x01


def upload_request(entry: Entry) -> bytes:
    """Return the eight bytes of the SDO request to upload an entry."""
    return struct.pack("<BHB4x", _UPLOAD, entry.index, entry.sub)


@dataclass
class Answers:
    """Hold the answers of nodes to the upload of one entry.

    Attributes:
        values: values by node.
        aborts: abort codes of nodes that answered without a value; 0 for an answer that is no value of this type.
    """

    values: dict[Place, int] = field(default_factory=dict)
    aborts: dict[Place, int] = field(default_factory=dict)

    def take(self, place: Place, entry: Entry, data: bytes) -> bool:
        """Store eight SDO bytes of a node, as value or abort, if they answer for this entry; return whether they do."""
        first, index, sub = struct.unpack_from("<BHB", data)
        if (index, sub) != (entry.index, entry.sub):
            return False
        if first == _ABORT_FRAME:
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
    nodes: Iterable[Place],
    entry: Entry,
    deadline_ns: int,
    on_other_frame: Callable[[int, Frame], None] = lambda bus, frame: None,
) -> Answers:
    """Ask nodes once for one entry by SDO, in bursts until a deadline; return the values and aborts that came.

    Args:
        links: of the arm's buses.
        nodes: nodes to ask; `BURST` of a bus at a time.
        entry: entry to upload.
        deadline_ns: time when nodes that have not answered are given up [ns of the links' clock]; each burst has its
            share.
        on_other_frame: called with the frames that are no answers, and the number of their bus.

    Raises:
        DriverError: a bus is gone.
    """
    found = Answers()
    waiting = [sorted(place for place in set(nodes) if place[0] == bus) for bus in range(len(links))]
    groups = -(-max(map(len, waiting)) // BURST)
    start_ns = links[0].clock.now_ns()
    for group in range(groups):
        bursts = [nodes[BURST * group : BURST * (group + 1)] for nodes in waiting]
        _ask(links, bursts, entry, start_ns + (deadline_ns - start_ns) * (group + 1) // groups, found, on_other_frame)
    return found


def _ask(
    links: Sequence[Link],
    bursts: Sequence[Sequence[Place]],
    entry: Entry,
    deadline_ns: int,
    found: Answers,
    others: Callable[[int, Frame], None],
) -> None:
    """Ask one burst of nodes on every bus."""
    for link, places in zip(links, bursts, strict=True):
        for _, node in places:
            link.send(Frame(SDO_REQUEST + node, upload_request(entry)))
    for bus, (link, places) in enumerate(zip(links, bursts, strict=True)):
        missing = set(places)
        while missing and (frame := link.receive(deadline_ns)) is not None:
            place = bus, frame.identifier - SDO_REPLY
            plain = not (frame.error or frame.remote or frame.extended) and len(frame.data) == 8
            if plain and place in missing and found.take(place, entry, frame.data):
                missing.discard(place)
            else:
                others(bus, frame)
