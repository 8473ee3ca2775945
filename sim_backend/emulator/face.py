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
        """Process a frame of another node and return the frames that follow; of a SYNC, only the answer to it."""

    def tick(self, now_ns: int) -> list[Frame]:
        """Process the timers that are due, and return the frames to send."""

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
        """Return whether the drive is off by its host's last command, not by a fault; pucks are so from power-up on."""

    @property
    def sync_identifier(self) -> int:
        """Return the identifier of the frames with which the host begins a cycle."""

    def finish_sync(self, now_ns: int) -> list[Frame]:
        """Do the rest of a SYNC after `receive` has answered it, and return the frames to send."""

    def watch(self, now_ns: int) -> None:
        """Sample the motor's position and speed during a long silence, and limit the torque by them."""

    def traffic_kind(self, frame: Frame) -> Traffic:
        """Return whether a frame that the drive has sent is position feedback, a heartbeat or another."""

    def evaluate(self, now_ns: int) -> None:
        """Evaluate the motor's torque and power again, after one of its defects has changed."""

    def fail(self, code: int, now_ns: int, *, lasting: bool = False) -> list[Frame]:
        """Begin a fault with this error code, lasting until `end_lasting_fault` or not; return the frames to send."""

    def end_lasting_fault(self) -> None:
        """End a lasting fault's cause; the fault itself may still have to be reset."""

    def ignore_watchdogs(self, ignored: bool) -> None:
        """Set whether the drive goes on although its host is gone."""

    def set_warning(self, active: bool, now_ns: int) -> list[Frame]:
        """Set or clear a warning of the drive, and return the frames to send."""

    def switch_supply(self, on: bool, now_ns: int) -> list[Frame]:
        """Switch the motor's power (a puck: release or press the whole arm's e-stop); return the frames to send."""

    def reboot(self, now_ns: int) -> list[Frame]:
        """Restart the firmware by itself, and return the frames to send."""
