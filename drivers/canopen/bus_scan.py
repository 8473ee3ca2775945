"""Scan the buses of an arm for nodes: heartbeats, then SDO uploads from every node number; nothing else is sent.

No NMT command, no write: a scan changes nothing. It takes the buses for itself, and asks no node while another host
streams, whose frames it would delay. Whether the nodes are the configured ones is judged elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import TypeVar

from drivers.can.bus_load import most_bits
from drivers.can.bus_state import BusError
from drivers.can.can_frame import Frame
from drivers.can.can_link import BusLock, Link, open_links
from drivers.canopen import object_dictionary as od
from drivers.canopen.bus_monitor import BusListener
from drivers.canopen.capabilities import DRIVE_PROFILE
from drivers.canopen.drive_setup import IDENTITY
from drivers.canopen.sdo import BURST, DOES_NOT_EXIST, TIMEOUT, Objects, Place, SdoRefused, poll
from ident_service.config.arm import ArmConfig
from ident_service.config.canopen import CanopenDriver
from ident_service.errors import DriverError

T = TypeVar("T")
NODES = range(1, 128)
LISTEN = 1.0  # s: longest period of a heartbeat that is received for sure
PATIENCE = 0.05  # s for an answer, besides the time on the wire; late nodes are asked again with `TIMEOUT`
_HISTORY = 8  # entries of 1003h that are read
_SDO_BYTES = 8


@dataclass
class FoundNode:
    """Describe one node by its heartbeat and uploads; None for what it does not have.

    Attributes:
        bus: number of its bus, from 0.
        node: node number.
        nmt: state in words, from its heartbeat.
        answers: whether it answers SDO requests, without which nothing below is known.
        device_type: 1000h.
        identity: 1018h, by the keys of `setup.IDENTITY`.
        name: manufacturer's device name (1008h).
        firmware: manufacturer's software version (100Ah).
        error_register: 1001h.
        history: 1003h, the latest first; the error code is in the lower 16 bits.
        status: 6041h, of drives.
        last_error: 603Fh, of drives.
        unread: entries that could not be read, and why, in words.
    """

    bus: int
    node: int
    nmt: str
    answers: bool
    device_type: int | None = None
    identity: dict[str, int] = field(default_factory=dict)
    name: str | None = None
    firmware: str | None = None
    error_register: int | None = None
    history: tuple[int, ...] = ()
    status: int | None = None
    last_error: int | None = None
    unread: list[str] = field(default_factory=list)

    @property
    def is_drive(self) -> bool:
        """Return whether the node says by its device type (1000h) that it is a drive of CiA 402."""
        return self.device_type is not None and self.device_type & 0xFFFF == DRIVE_PROFILE


def scan(config: ArmConfig, open_bus: Callable[[ArmConfig], list[Link]] = open_links) -> list[FoundNode]:
    """Listen on an arm's buses, ask every node number by SDO, and return the nodes found, by bus and number.

    Args:
        config: configuration with a CANopen driver.
        open_bus: function that opens the links, in the order of the buses.

    Raises:
        DriverError: another driver, a bus that is in use, by another host too, or that cannot be had.
    """
    with buses_to_ask(config, open_bus) as (driver, links, listener):
        return _found(driver, links, listener)


@contextmanager
def buses_to_ask(
    config: ArmConfig, open_bus: Callable[[ArmConfig], list[Link]] = open_links
) -> Iterator[tuple[CanopenDriver, list[Link], BusListener]]:
    """Open the buses of an arm exclusively, listen for a second, and yield driver section, links and listener.

    Args:
        config: configuration with a CANopen driver.
        open_bus: function that opens the links, in the order of the buses.

    Raises:
        DriverError: another driver, a bus that is in use, by another host too, or that cannot be had.
    """
    driver = config.driver
    if not isinstance(driver, CanopenDriver):
        raise DriverError(f"{config.name}: the driver is not CANopen's")
    locks: list[BusLock] = []
    links: list[Link] = []
    try:
        if all(bus.interface != "lock_step" for bus in driver.buses):
            locks += [BusLock(bus) for bus in driver.buses]
        links += open_bus(config)
        listener = BusListener()
        listener.listen(links, LISTEN)
        if listener.streaming:
            buses = ", ".join(driver.buses[bus].channel for bus in sorted(listener.streaming))
            raise DriverError(f"another host sends SYNC on {buses}; a scan would delay its frames: stop it first")
        yield driver, links, listener
    finally:
        for link in links:
            with suppress(Exception):
                link.close()
        for lock in locks:
            lock.close()


def _found(driver: CanopenDriver, links: list[Link], listener: BusListener) -> list[FoundNode]:
    clock = links[0].clock

    def answering(places: set[Place], patience: float) -> dict[Place, int | None]:
        answers = poll(links, places, od.DEVICE_TYPE, clock.now_ns() + round(patience * 1e9), listener.take)
        return answers.values | dict.fromkeys(answers.aborts)

    everybody = {(bus, node) for bus in range(len(links)) for node in NODES}
    bursts = -(-len(NODES) // BURST)
    wire = 2 * BURST * sum(most_bits(_SDO_BYTES)) / min(bus.bitrate for bus in driver.buses)
    kinds = answering(everybody, bursts * (PATIENCE + wire))
    doubtful = {*listener.nmt, *listener.answered, *((drive.bus, drive.node) for drive in driver.drives)} - kinds.keys()
    if doubtful:
        kinds |= answering(doubtful, -(-len(doubtful) // BURST) * TIMEOUT)
    patience_ns = round(LISTEN * 1e9)
    found = []
    for place in sorted({*kinds, *listener.nmt}):
        bus, number = place
        words = listener.nmt_words(place, clock.now_ns(), patience_ns)
        node = FoundNode(bus, number, words, place in kinds, kinds.get(place))
        if node.answers:
            _read(node, Objects(links[bus], number, hearing(listener, bus)))
        found.append(node)
    return found


def hearing(listener: BusListener, bus: int) -> Callable[[Frame], None]:
    """Return a function that passes the frames of this bus to the listener."""
    return lambda frame: listener.take(bus, frame)


def _read(node: FoundNode, objects: Objects) -> None:
    """Read identity, names and errors of a node; one that falls silent in the middle keeps what was read."""

    def tried(read: Callable[[], T]) -> T | None:
        try:
            return read()
        except BusError:
            raise
        except SdoRefused as refused:
            if refused.code not in DOES_NOT_EXIST:
                node.unread.append(str(refused))
        except DriverError as error:
            node.unread.append(str(error))
        return None

    def number(entry: od.Entry) -> int | None:
        return tried(lambda: objects.read(entry))

    def text(index: int, name: str) -> str | None:
        data = tried(lambda: objects.read_bytes(index, 0, name))
        return None if data is None else data.decode("ascii", "replace").strip("\0 ")

    for name, entry in IDENTITY.items():
        if (value := number(entry)) is not None:
            node.identity[name] = value
    node.name, node.firmware = text(od.DEVICE_NAME_INDEX, "device name"), text(od.FIRMWARE_INDEX, "software version")
    node.error_register = number(od.ERROR_REGISTER)
    count = number(od.ERROR_COUNT) or 0
    latest = (number(od.LAST_ERROR.at_sub_index(sub)) for sub in range(1, min(count, _HISTORY) + 1))
    node.history = tuple(entry for entry in latest if entry is not None)
    if node.is_drive:
        node.status, node.last_error = number(od.STATUS_WORD), number(od.LAST_EMERGENCY)
