"""Host wires (`ident_wire`) in the drives' process while the drives have power.

Hosting them here saves a hop: the drives' frames reach the host in one packet, without a third process. A wire keeps
the pace of its bit rates where the description says `options: {pace: true}`. Where it says `data_bitrate`, all data
frames of drives are CAN FD's.
"""

from __future__ import annotations

import select
import time
from collections import deque
from collections.abc import Iterable, Sequence

from drivers.can.can_frame import Frame
from ident_service.config.canopen import CanBus
from sim_backend.can_bus.host import LocalPort
from sim_backend.can_bus.hub import Wire

INTERFACE = "ident_wire"


class Wires:
    """Host the buses of one arm, all of them wires.

    Attributes:
        unsent: frames that a wire did not take.
    """

    def __init__(self, buses: Sequence[CanBus]) -> None:
        """Open all wires.

        Args:
            buses: as the arm's description names them.

        Raises:
            DriverError: a wire that another process runs, or that cannot be had; none stays then.
        """
        self.unsent = 0
        self._wires: list[Wire] = []
        self._ports: list[LocalPort] = []
        self._heard: deque[tuple[int, Frame]] = deque()
        try:
            for bus in buses:
                bitrate = bus.bitrate if bus.options.get("pace", False) else 0
                self._wires.append(Wire(bus.channel, bitrate, bus.data_bitrate).__enter__())
                self._ports.append(LocalPort(self._wires[-1], "drives"))
        except BaseException:
            self.close()
            raise

    def receive(self, timeout: float) -> tuple[int, Frame] | None:
        """Return the next frame with its bus, None when none comes in time.

        Args:
            timeout: how long to wait [s].

        Raises:
            DriverError: a wire is closed.
        """
        if not self._heard:
            self._listen(time.monotonic_ns() + round(timeout * 1e9))
        return self._heard.popleft() if self._heard else None

    def send(self, frames: Iterable[tuple[int, Frame]]) -> None:
        """Send frames, those of a bus in one packet; frames that a wire does not take count as `unsent`."""
        of: dict[int, list[Frame]] = {}
        for number, frame in frames:
            of.setdefault(number, []).append(frame)
        for number, some in of.items():
            self.unsent += len(some) - self._ports[number].offer(some)

    def close(self) -> None:
        """Close all wires and their connections; any number of times."""
        for wire in self._wires:
            wire.close()
        self._wires.clear()
        self._ports.clear()

    def _listen(self, deadline_ns: int) -> None:
        """Move all wires until a frame is received or the deadline has passed."""
        while True:
            if len(self._wires) > 1:
                self._wait(deadline_ns)
            for number, (wire, port) in enumerate(zip(self._wires, self._ports, strict=True)):
                wire.poll(deadline_ns if len(self._wires) == 1 else 0)
                self._heard.extend((number, frame) for frame, _ in port.port.take())
            if self._heard or time.monotonic_ns() >= deadline_ns:
                return

    def _wait(self, deadline_ns: int) -> None:
        """Wait until one of several wires has something to do."""
        watched: list[int] = []
        for wire in self._wires:
            descriptors, end_ns = wire.watched()
            watched += descriptors
            deadline_ns = deadline_ns if end_ns is None else min(deadline_ns, end_ns)
        select.select(watched, [], [], max(0, deadline_ns - time.monotonic_ns()) * 1e-9)
