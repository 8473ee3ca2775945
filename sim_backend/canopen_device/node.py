"""Hold what the parts of one emulated node share: objects, frames to send, timers, the present time.

Every part has its own timers under its own names.
"""

from __future__ import annotations

from drivers.can.can_frame import Frame
from sim_backend.canopen_device.objects import Objects


class Node:
    """Hold the shared state of one node.

    Attributes:
        number: node number.
        objects: object dictionary of the node.
        now_ns: time of the event that is being handled [ns].
        out: frames to send, in order.
        timers: due times [ns], by name.
    """

    def __init__(self, number: int, objects: Objects) -> None:
        """Create a node without frames and timers."""
        self.number, self.objects = number, objects
        self.now_ns = 0
        self.out: list[Frame] = []
        self.timers: dict[str, int] = {}

    def send(self, identifier: int, data: bytes = b"") -> None:
        """Queue a frame to send."""
        self.out.append(Frame(identifier, data))

    def start_timer(self, timer: str, delay_ns: int) -> None:
        """Set the timer of this name to run out `delay_ns` from now; a running one starts again."""
        self.timers[timer] = self.now_ns + delay_ns

    def stop_timer(self, timer: str) -> None:
        """Stop the timer of this name; do nothing when it does not run."""
        self.timers.pop(timer, None)
