"""Connect the emulator to python-can interfaces: frames in, frames out, and errors of interfaces."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterable, Sequence
from typing import Any

import can

from drivers.can.can_frame import Frame
from ident_service.config.canopen import CanBus
from ident_service.errors import DriverError

# Names that python-can has for interfaces of a driver.
_NAMES = {"raw": "socketcan"}


class Station:
    """Connect to the buses of one arm."""

    def __init__(self, buses: Sequence[CanBus]) -> None:
        """Open all buses.

        Args:
            buses: as the arm's description names them.

        Raises:
            DriverError: an interface that cannot be had; none stays open then.
        """
        self._buses: list[can.BusABC] = []
        self._fd = [bus.data_bitrate is not None for bus in buses]
        self._heard: queue.SimpleQueue[tuple[int, can.Message]] = queue.SimpleQueue()
        self._closing = False
        self.unsent = 0
        for number, bus in enumerate(buses):
            try:
                self._buses.append(_opened(bus))
            except BaseException as error:
                self.close()
                if isinstance(error, (can.CanError, OSError, ValueError, ImportError, NotImplementedError)):
                    raise DriverError(f"bus {number}: {bus.interface} {bus.channel}: {error}") from None
                raise
        # One bus is waited for here, several are by a thread each.
        self._threads = [
            threading.Thread(target=self._listen, args=(number,), daemon=True)
            for number in (range(len(self._buses)) if len(self._buses) > 1 else ())
        ]
        for thread in self._threads:
            thread.start()

    def receive(self, timeout: float) -> tuple[int, Frame] | None:
        """Return the next frame with its bus, None when none comes in time.

        Args:
            timeout: how long to wait [s].

        Raises:
            DriverError: an interface is gone.
        """
        item = self._take(timeout)
        return None if item is None else (item[0], _frame(item[1]))

    def send(self, frames: Iterable[tuple[int, Frame]]) -> None:
        """Send frames; one that an interface does not take counts as `unsent`, as on a bus that is off."""
        for number, frame in frames:
            try:
                self._buses[number].send(
                    can.Message(
                        arbitration_id=frame.identifier,
                        data=frame.data,
                        is_extended_id=frame.extended,
                        is_remote_frame=frame.remote,
                        is_error_frame=frame.error,
                        is_fd=self._fd[number] and not frame.remote,
                        bitrate_switch=self._fd[number] and not frame.remote,
                    )
                )
            except (can.CanError, OSError):
                self.unsent += 1

    def close(self) -> None:
        """Close all buses; any number of times."""
        self._closing = True
        for thread in getattr(self, "_threads", ()):
            thread.join()
        for bus in self._buses:
            bus.shutdown()
        self._buses.clear()

    def _take(self, timeout: float) -> tuple[int, can.Message] | None:
        if self._threads:
            try:
                number, message = self._heard.get(timeout > 0.0, timeout or None)
            except queue.Empty:
                return None
        else:
            number, message = 0, self._received(0, timeout)
        return None if message is None else (number, message)

    def _received(self, number: int, timeout: float) -> Any:
        try:
            return self._buses[number].recv(timeout)
        except (can.CanError, OSError) as error:
            raise DriverError(f"bus {number} is gone: {error}") from None

    def _listen(self, number: int) -> None:
        while not self._closing:
            try:
                message = self._received(number, 0.05)
            except DriverError:
                return
            if message is not None:
                self._heard.put((number, message))


def _opened(bus: CanBus) -> can.BusABC:
    options: dict[str, Any] = dict(bus.options)
    if bus.data_bitrate is not None:
        options |= {"fd": True, "data_bitrate": bus.data_bitrate}
    name = _NAMES.get(bus.interface, bus.interface)
    return can.Bus(interface=name, channel=bus.channel, bitrate=bus.bitrate, **options)


def _frame(message: can.Message) -> Frame:
    return Frame(
        message.arbitration_id,
        bytes(message.data),
        message.is_remote_frame,
        message.is_error_frame,
        message.is_extended_id,
        fd=message.is_fd,
    )
