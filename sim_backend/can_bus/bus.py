"""Make the wire an interface of python-can: `can.Bus(interface="ident_wire", channel=NAME)`.

For the configuration plane and for python-can's tools: `python -m can.logger -i ident_wire -c NAME`. Registered in the
entry-point group `can.interface`.
"""

from __future__ import annotations

import errno
import time
from collections import deque
from typing import Any

import can

from drivers.can.bus_state import BusError
from drivers.can.can_frame import Frame
from ident_service.errors import DriverError
from sim_backend.can_bus.host import WireThread
from sim_backend.can_bus.hub import CanBusServer
from sim_backend.can_bus.link import Connection
from sim_backend.can_bus.packets import Hello

_CODES = {"absent": errno.ENODEV, "down": errno.ENETDOWN, "off": errno.ENETDOWN, "full": errno.ENOBUFS}


class IdentWireBus(can.BusABC):
    """Implement an end of the wire for python-can; one thread may receive while another one sends."""

    def __init__(
        self,
        channel: str = "can0",
        can_filters: Any = None,
        receive_own_messages: bool = False,
        host: bool = False,
        pace: bool = False,
        bitrate: int = 1_000_000,
        fd: bool = False,
        data_bitrate: int | None = None,
        **kwargs: Any,
    ) -> None:
        """Connect to the wire, and host it if asked to.

        Args:
            channel: name or path of the wire.
            can_filters: filters as python-can's.
            receive_own_messages: whether to hear what is sent here.
            host: run the wire in a thread of this process, for experiments and tests.
            pace: whether a wire that is hosted here keeps `bitrate`.
            bitrate: bit rate of a wire that is hosted here [bit/s].
            fd: whether a wire that is hosted here carries CAN FD.
            data_bitrate: bit rate of CAN FD's data on a wire that is hosted here [bit/s].
            kwargs: ignored, as python-can's own interfaces do.

        Raises:
            can.CanInitializationError: no process runs the wire, or it cannot be run here.
        """
        self._thread: WireThread | None = None
        self.channel, self.channel_info = channel, f"ident_wire channel {channel!r}"
        try:
            if host:
                rates = (bitrate, data_bitrate if fd else None) if pace else (0, None)
                thread = WireThread(CanBusServer(channel, *rates, fd=fd))
                self._thread = thread.__enter__()
            self._connection = Connection(channel, Hello("python-can", own=receive_own_messages))
        except DriverError as error:
            if self._thread is not None:
                self._thread.close()
            code = _CODES.get(error.kind) if isinstance(error, BusError) else None
            raise can.CanInitializationError(str(error), code) from error
        self._waiting: deque[tuple[Frame, bool]] = deque()
        self._can_protocol = can.CanProtocol.CAN_FD if self._connection.welcome.fd else can.CanProtocol.CAN_20
        super().__init__(channel=channel, can_filters=can_filters, **kwargs)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a message at once; CanOperationError where the simulated bus takes no more, whatever the timeout.

        Raises:
            can.CanOperationError: the wire is gone, or takes no more.
        """
        data = b"" if msg.is_remote_frame else bytes(msg.data)
        if msg.is_error_frame or (msg.is_fd and self._can_protocol is not can.CanProtocol.CAN_FD):
            raise can.CanOperationError(f"a frame that this wire does not carry: {msg}")
        frame = Frame(msg.arbitration_id, data, msg.is_remote_frame, extended=msg.is_extended_id, fd=msg.is_fd)
        try:
            self._connection.send((frame,))
        except BusError as error:
            raise can.CanOperationError(str(error), _CODES.get(error.kind)) from error

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self._waiting:
            seconds = 3600.0 if timeout is None else max(0.0, timeout)
            try:
                self._waiting.extend(self._connection.take(time.monotonic_ns() + round(seconds * 1e9)))
            except DriverError as error:
                raise can.CanOperationError(str(error)) from error
            if not self._waiting:
                return None, False
        frame, own = self._waiting.popleft()
        message = can.Message(
            # python-can counts in seconds since 1970.
            timestamp=time.time() - (time.monotonic_ns() - frame.stamp_ns) * 1e-9,
            arbitration_id=frame.identifier,
            is_extended_id=frame.extended,
            is_remote_frame=frame.remote,
            is_error_frame=frame.error,
            is_fd=frame.fd,
            bitrate_switch=frame.fd,
            data=None if frame.remote else frame.data,
            channel=self.channel,
            is_rx=not own,
        )
        return message, False

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self._connection.fileno()

    def shutdown(self) -> None:
        """Disconnect from the simulated bus, and end the bus if it is hosted here."""
        super().shutdown()
        self._connection.close()
        if self._thread is not None:
            self._thread.close()
