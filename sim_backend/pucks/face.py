"""What an emulated motor controller is to the emulator, whatever protocol it speaks: its face on the bus.

Sans-I/O: frames and times in, frames out. A face owns its motor's power stage; the arm is the emulator's.
"""

from __future__ import annotations

from enum import Enum
from typing import Protocol

from drivers.canopen.frame import Frame
from sim_backend.pucks.motor import Motor


class Traffic(Enum):
    """What a frame of a drive's own is, for faults that take away or falsify only that."""

    FEEDBACK = "feedback"  # tells where the motor is, in a cycle
    HEARTBEAT = "heartbeat"
    OTHER = "other"


class Face(Protocol):
    """One motor controller. No call goes back in time; each returns the frames that follow from it, in order."""

    motor: Motor

    @property
    def number(self) -> int:
        """On its bus."""

    @property
    def next_deadline_ns(self) -> int | None:
        """When `tick` has something to do; None for never."""

    @property
    def state(self) -> str:
        """In words, for people."""

    @property
    def released(self) -> bool:
        """Whether a host has led it, has switched it off and has left, all in order."""

    @property
    def sync_identifier(self) -> int:
        """Of the frames with which the host begins a cycle."""

    def power_up(self, now_ns: int) -> None:
        """The firmware starts."""

    def receive(self, frame: Frame, now_ns: int) -> list[Frame]:
        """A frame of another node."""

    def tick(self, now_ns: int) -> list[Frame]:
        """Time has passed."""

    def watch(self, now_ns: int) -> None:
        """Limit the torque by where the motor is and how fast, in a longer silence."""

    def listens(self, identifier: int) -> bool:
        """Whether a frame of this identifier means anything to it."""

    def traffic(self, frame: Frame) -> Traffic:
        """What kind of frame of its own this is."""

    def evaluate(self, now_ns: int) -> None:
        """A defect of the motor has changed."""

    def fail(self, code: int, now_ns: int, *, lasting: bool = False) -> list[Frame]:
        """A fault, told with this code; a lasting one is of the power stage and stays until `repaired`."""

    def repaired(self) -> None:
        """A lasting fault is gone."""

    def ignore_watchdogs(self, deaf: bool) -> None:
        """It goes on although its host is gone, or does not any more."""

    def warn(self, warned: bool, now_ns: int) -> list[Frame]:
        """A warning comes or goes."""

    def supply(self, on: bool, now_ns: int) -> list[Frame]:
        """The motors' power comes or goes (emergency stop)."""

    def reboot(self, now_ns: int) -> list[Frame]:
        """The firmware starts again by itself."""
