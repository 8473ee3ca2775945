"""What the parts of one emulated node share: objects, frames to send, timers, the present time.

Boundary: no behaviour; every part keeps its own timers under its own names.
"""

from __future__ import annotations

from drivers.canopen.frame import Frame
from sim_backend.canopen.objects import Objects


class Node:
    """One node.

    Attributes:
        number: its node id.
        objects: its dictionary.
        now_ns: when what is being handled happens.
        out: frames to send, in order.
        timers: when what falls due [ns], by name.
    """

    def __init__(self, number: int, objects: Objects) -> None:
        """A node with nothing to do."""
        self.number, self.objects = number, objects
        self.now_ns = 0
        self.out: list[Frame] = []
        self.timers: dict[str, int] = {}

    def send(self, identifier: int, data: bytes = b"") -> None:
        """Have a frame sent."""
        self.out.append(Frame(identifier, data))

    def after(self, name: str, delay_ns: int) -> None:
        """Set a timer."""
        self.timers[name] = self.now_ns + delay_ns

    def stop(self, name: str) -> None:
        """Stop a timer; nothing when it does not run."""
        self.timers.pop(name, None)
