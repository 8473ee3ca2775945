"""Define the interface between an emulated motor controller and the emulator, whatever its protocol.

Sans-I/O: frames and times in, frames out. A face owns its motor's power stage; the arm is the emulator's.
"""

from __future__ import annotations

from enum import Enum
from typing import Protocol

from drivers.can.can_frame import Frame
from sim_backend.emulator.motor import Motor


class Traffic(Enum):
    """Name the kinds of frames of a drive, for faults that remove or falsify only one kind."""

    FEEDBACK = "feedback"  # has the motor's position, in a cycle
    HEARTBEAT = "heartbeat"
    OTHER = "other"


class BusDevice(Protocol):
    """Define a device on the bus; no call goes back in time, each returns the frames that follow in order."""

    @property
    def number(self) -> int:
        """Return the device's number on its bus."""

    @property
    def next_deadline_ns(self) -> int | None:
        """Return when `tick` has something to do [ns]; None for never."""

    @property
    def state(self) -> str:
        """Describe the state in words, for people."""

    def power_up(self, now_ns: int) -> None:
        """Start the firmware."""

    def receive(self, frame: Frame, now_ns: int) -> list[Frame]:
        """Process a frame of another node; of a SYNC, what its answer needs."""

    def tick(self, now_ns: int) -> list[Frame]:
        """Process the timers that are due."""

    def listens(self, identifier: int) -> bool:
        """Return whether a frame of this identifier means anything to the device."""


class Companion(BusDevice, Protocol):
    """Define a device that moves no motor: a safety controller, with the pendant that belongs to it."""

    def press(self, key: str, now_ns: int) -> None:
        """Press a key of its pendant: `activate` or `idle`."""


class EmulatedDevice(BusDevice, Protocol):
    """Define one emulated motor controller."""

    motor: Motor

    @property
    def released(self) -> bool:
        """Return whether a host has led the drive, has switched it off and has left, all in order."""

    @property
    def sync_identifier(self) -> int:
        """Return the identifier of the frames with which the host begins a cycle."""

    def finish_sync(self, now_ns: int) -> list[Frame]:
        """Do what else a SYNC asks for, when its answer is on its way; called after each `receive` of one."""

    def watch(self, now_ns: int) -> None:
        """Limit the torque by position and speed of the motor, during a longer silence."""

    def traffic_kind(self, frame: Frame) -> Traffic:
        """Return the kind of a frame that the drive has sent."""

    def evaluate(self, now_ns: int) -> None:
        """Evaluate the motor anew after one of its defects has changed."""

    def fail(self, code: int, now_ns: int, *, lasting: bool = False) -> list[Frame]:
        """Begin a fault with this error code; a lasting one is of the power stage and stays until `repaired`."""

    def repaired(self) -> None:
        """End a lasting fault."""

    def ignore_watchdogs(self, deaf: bool) -> None:
        """Set whether the drive goes on although its host is gone."""

    def warn(self, warned: bool, now_ns: int) -> list[Frame]:
        """Set or clear a warning."""

    def supply(self, on: bool, now_ns: int) -> list[Frame]:
        """Switch the motors' power on or off (emergency stop)."""

    def reboot(self, now_ns: int) -> list[Frame]:
        """Restart the firmware by itself."""
