"""Implement a Link on any interface of python-can, and even out the differences between its interfaces.

Stamps of python-can are seconds since 1970, of a controller's own clock, or missing; they are turned into monotonic
time by their age, and replaced by the time of reception where that age cannot be. Its `udp_multicast` always hears its
own frames: the link's carry a mark that it passes on, which distinguishes them from a foreign frame of the same
content.
"""

from __future__ import annotations

import errno
import logging
import secrets
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import can

from drivers.can.bus_state import BusError, BusOffWatch, Kind, kind_of
from drivers.can.can_frame import MOST_AT_ONCE, RECEIVE_FILTER, Frame, check_sendable
from drivers.can.socketcan_link import check_interface, controller_state_frame
from drivers.clock import RealClock
from ident_service.config.arm import ArmConfig
from ident_service.config.can_bus import CanBus
from ident_service.errors import DriverError

_OURS = ("interface", "channel", "bitrate", "data_bitrate", "fd", "receive_own_messages", "can_filters")
_HEARS_ITSELF, _KERNELS = "udp_multicast", "socketcan"
_PLAUSIBLE_S = 1.0


def from_config(config: ArmConfig, bus_number: int) -> PythonCanLink:
    """Open and return the link of one bus of an arm; entry point `python_can`.

    Raises:
        BusError: no such interface, it is down or without the CAN FD asked for, or it cannot be opened.
        DriverError: the driver section has no CAN bus, or it sets an option that is the link's.
    """
    if not config.can_buses:
        raise DriverError(f"{config.name}: the driver has no CAN bus")
    bus = config.can_buses[bus_number]
    if taken := [name for name in _OURS if name in bus.options]:
        raise DriverError(f"driver.buses.{bus_number}.options: {', '.join(taken)} cannot be set here")
    if bus.interface == _KERNELS:
        check_interface(bus)
    link = PythonCanLink(open_bus(bus, can_filters=_filters()), bus)
    try:
        # The kernel's error of an interface that is down waits, and so do frames that came before the filters.
        link.drain()
        if bus.interface == _KERNELS and (state := controller_state_frame(bus.channel)) is not None:
            link.hear(state)
    except BaseException:
        link.close()
        raise
    return link


def open_bus(bus: CanBus, **more: Any) -> can.BusABC:
    """Open an interface with the options of `bus` and `more` only; python-can's configuration files are not read.

    Args:
        bus: the configured one.
        more: further options for python-can, besides those of the bus.

    Raises:
        BusError: no such interface, or it cannot be opened.
    """
    options: dict[str, Any] = {**bus.options, **more}
    if bus.data_bitrate is not None:
        options |= {"fd": True, "data_bitrate": bus.data_bitrate}
    if bus.interface not in can.VALID_INTERFACES:
        raise BusError("refused", bus.channel, bus.bitrate, f"python-can knows no interface {bus.interface!r}")
    # Some interfaces log what they raise as well; once is enough.
    quiet = logging.getLogger(f"can.interfaces.{bus.interface}")
    level, before = logging.CRITICAL, quiet.level
    quiet.setLevel(level)
    try:
        return can.Bus(channel=bus.channel, interface=bus.interface, ignore_config=True, bitrate=bus.bitrate, **options)
    except (can.CanError, OSError, ValueError, TypeError, ImportError, AttributeError) as error:
        raise bus_error(error, bus, "refused") from error
    finally:
        quiet.setLevel(before)


def bus_error(error: Exception, bus: CanBus, default: Kind = "gone") -> BusError:
    """Convert an error of python-can or of the system to a BusError with a remedy."""
    code = getattr(error, "error_code", None) or getattr(error, "errno", None)
    if code is None and isinstance(error.__cause__, OSError):
        code = error.__cause__.errno
    if code is None and "Transmit buffer full" in str(error):  # socketcan's, which carries no number
        code = errno.ENOBUFS
    kind = default if isinstance(error, can.CanInterfaceNotImplementedError) else kind_of(code, default)
    return BusError(kind, bus.channel, bus.bitrate, f"{bus.interface}: {error}")


def _filters() -> list[dict[str, Any]]:
    return [{"can_id": wanted, "can_mask": mask, "extended": False} for wanted, mask in RECEIVE_FILTER]


class PythonCanLink:
    """Implement a Link on a bus of python-can; the thread that opened it is its only user."""

    def __init__(self, bus: can.BusABC, config: CanBus) -> None:
        """Use an open bus, and close it with the link.

        Args:
            bus: bus that `open_bus` opened; shut down with the link.
            config: configuration that the bus was opened from.
        """
        self.clock = RealClock()
        self._bus, self._config = bus, config
        self._fd = config.data_bitrate is not None
        self._mark = f"ident-{secrets.token_hex(8)}" if config.interface == _HEARS_ITSELF else None
        self._waiting: deque[Frame] = deque()
        self._watch = BusOffWatch()
        self._closed = False

    def send(self, frame: Frame) -> None:
        """Hand one frame to the interface and return at once; BusError where it is off, gone or full.

        Raises:
            BusError: bus-off, interface down or gone, queue full.
            DriverError: a frame that cannot exist.
        """
        check_sendable(frame, fd=self._fd)
        if self._watch.off:
            raise BusError("off", self._config.channel, self._config.bitrate)
        message = can.Message(
            arbitration_id=frame.identifier,
            is_extended_id=frame.extended,
            is_remote_frame=frame.remote,
            data=None if frame.remote else frame.data,
            channel=self._mark,
            is_fd=self._fd and not frame.remote,
            bitrate_switch=self._fd and not frame.remote,
        )
        try:
            self._bus.send(message, timeout=0)
        except (can.CanError, OSError, ValueError) as error:
            raise self._failure(error) from error

    def receive(self, deadline_ns: int) -> Frame | None:
        """Return the next frame, None when there is none until the deadline [ns of the clock].

        Raises:
            BusError: interface down or gone.
        """
        if self._waiting:
            return self._waiting.popleft()
        while True:
            remaining = deadline_ns - time.monotonic_ns()
            frame = self._take(max(0.0, remaining * 1e-9))
            if frame is not None or remaining <= 0:
                return frame

    def drain(self) -> Sequence[Frame]:
        """Return all frames that wait, at most `MOST_AT_ONCE`; does not wait.

        Raises:
            BusError: interface down or gone.
        """
        frames = list(self._waiting)
        self._waiting.clear()
        while len(frames) < MOST_AT_ONCE and (message := self._message(0.0)) is not None:
            if (frame := self._frame(message)) is not None:
                frames.append(frame)
        return frames

    def hear(self, frame: Frame) -> None:
        """Queue a frame of the controller's state, stamped now, to be returned by a later `receive` or `drain`."""
        self._watch.observe(frame)
        self._waiting.append(frame._replace(stamp_ns=time.monotonic_ns()))

    def close(self) -> None:
        """Shut the bus down."""
        if not self._closed:
            self._closed = True
            with suppress(can.CanError, OSError):
                self._bus.shutdown()

    def _take(self, timeout: float) -> Frame | None:
        message = self._message(timeout)
        return None if message is None else self._frame(message)

    def _message(self, timeout: float) -> can.Message | None:
        if self._closed:
            raise BusError("gone", self._config.channel, self._config.bitrate, "closed")
        try:
            return self._bus.recv(timeout)
        except (can.CanError, OSError, ValueError) as error:
            if self._mark is not None and "unpack" in str(error):  # anybody may send anything to a multicast group
                return None
            raise self._failure(error) from error

    def _frame(self, message: can.Message) -> Frame | None:
        """Convert a message to a frame; None for the link's own frames."""
        if self._mark is not None and message.channel == self._mark:
            return None
        now, age = time.monotonic_ns(), time.time() - message.timestamp
        frame = Frame(
            message.arbitration_id,
            b"" if message.is_remote_frame else bytes(message.data),
            message.is_remote_frame,
            message.is_error_frame,
            message.is_extended_id and not message.is_error_frame,
            now - round(age * 1e9) if 0.0 <= age < _PLAUSIBLE_S else now,
            message.is_fd,
        )
        self._watch.observe(frame)
        return frame

    def _failure(self, error: Exception) -> BusError:
        return bus_error(error, self._config)
