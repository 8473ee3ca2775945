"""Read and write one node's object dictionary over SDO, with the client of the canopen library.

The library listens in a thread and waits in real time. Here its client is given a network that hands each request to
the link and receives until the reply has come, so that the same code configures drives over every link, in virtual
time too, and no thread is left when streaming begins. Other frames received meanwhile go to a given function.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, TypeVar

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
WRITE_ONLY = (0x06010001,)


class SdoRefused(DriverError):
    """Report that a drive answered with an abort; `code` is that of CiA 301, table 22."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


class NotHeld(DriverError):
    """Report that an entry was set without an abort, but holds something else."""


def optional(do: Callable[[Any], T], what: Any) -> T | None:
    """Return the result of an action on an entry; None where the drive has no such entry."""
    try:
        return do(what)
    except SdoRefused as refused:
        if refused.code not in DOES_NOT_EXIST:
            raise
        return None


class Objects:
    """Access the object dictionary of one node, while nothing streams."""

    def __init__(self, link: Link, node: int, others: Callable[[Frame], None] = lambda frame: None) -> None:
        """Use the given link, which stays the caller's.

        Args:
            link: of the node's bus.
            node: its number.
            others: takes the frames that are not replies of this node.
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
        deadline = self._link.clock.now_ns() + round(TIMEOUT * 1e9)
        while (frame := self._link.receive(deadline)) is not None:
            if frame.identifier == SDO_REPLY + self.node and len(frame.data) == 8 and not frame.error:
                self._client.on_response(frame.identifier, frame.data, 0.0)
                return
            self._others(frame)

    def read_bytes(self, index: int, sub: int, name: str) -> bytes:
        """Return the value of an entry as bytes.

        Raises:
            SdoRefused: the drive aborts the upload.
            DriverError: it does not answer, or the bus is gone.
        """
        return bytes(self._asked(f"reading {index:04X}h:{sub:02X} {name}", self._client.upload, index, sub))

    def read(self, entry: Entry) -> int:
        """Return the value of an entry; raises as `read_bytes`, and DriverError for a value of another length."""
        data = self.read_bytes(entry.index, entry.sub, entry.name)
        try:
            return entry.unpack(data)
        except ValueError as error:
            raise DriverError(f"node {self.node}: {error}") from None

    def write(self, write: Write) -> None:
        """Set an entry; raises as `read_bytes`."""
        entry = write.entry
        what = f"setting {entry} to {write.value}"
        self._asked(what, self._client.download, entry.index, entry.sub, write.data)

    def holds(self, write: Write) -> bool:
        """Return whether an entry holds a value already; one that can only be written does not. Raises as `read`."""
        try:
            return write.same(self.read(write.entry))
        except SdoRefused as refused:
            if refused.code not in WRITE_ONLY:
                raise
            return False

    def ensure(self, write: Write) -> None:
        """Compare an entry with a value, write it where it differs, and read it back; raises as `set`."""
        if not optional(self.holds, write):  # setting a missing entry raises the error
            self.set(write)

    def ensure_if_there(self, write: Write) -> None:
        """Do what `ensure` does, and nothing where the drive has no such entry."""
        if optional(self.holds, write) is False:
            self.set(write)

    def set(self, write: Write) -> None:
        """Set an entry and read it back; raises as `read`, and NotHeld when it holds something else."""
        self.write(write)
        held = self.read(write.entry)
        if not write.same(held):
            raise NotHeld(f"node {self.node}: {write.entry} was set to {write.value} but holds {held}")

    def _asked(self, what: str, ask: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return ask(*arguments)
        except SdoAbortedError as error:
            raise SdoRefused(f"node {self.node}: {what}: {abort_words(error.code)}", error.code) from None
        except SdoCommunicationError as error:
            raise DriverError(f"node {self.node}: {what}: no proper answer ({error})") from None
