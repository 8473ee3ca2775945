"""The driver over emulated drives in virtual time, with somebody between it and its bus."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from drivers.can.bus_state import BusError
from drivers.can.can_frame import Frame
from drivers.canopen.pdo_mapping import SYNC
from drivers.clock import Clock
from ident_service.config.arm import ArmConfig
from ident_service.config.canopen import CanopenDriver
from sim_backend.emulator.lock_step import LockStepArm, LockStepLink

EDS = (Path(__file__).parents[2] / "configs" / "emulated_drive.eds").read_text(encoding="utf-8")


class Tapped:
    """A link whose host may lose frames that it sends, and hear frames that a third party sends.

    Attributes:
        sent: by the host.
        loses: which frames get lost.
        misses: which frames of the drives the host does not hear.
        full_until_ns: before it the transmit queue is full, so that no frame can be sent.
    """

    def __init__(self, link: LockStepLink) -> None:
        self._link = link
        self._foreign: list[Frame] = []
        self._in_cycle: list[Frame] = []
        self.sent: list[Frame] = []
        self.loses: Callable[[Frame], bool] = lambda frame: False
        self.misses: Callable[[Frame], bool] = lambda frame: False
        self.full_until_ns = 0

    @property
    def clock(self) -> Clock:
        return self._link.clock

    def disturb(self, frames: Sequence[Frame], *, drives_hear: bool = True) -> None:
        """Somebody else sends frames, which the host hears next, and the drives now."""
        for frame in frames:
            if drives_hear:
                self._link.send(frame)
            self._foreign.append(frame._replace(stamp_ns=self.clock.now_ns()))

    def after_sync(self, frames: Sequence[Frame]) -> None:
        """Somebody else sends frames behind the host's next SYNC, which the host alone hears."""
        self._in_cycle = list(frames)

    def send(self, frame: Frame) -> None:
        if self.clock.now_ns() < self.full_until_ns:
            raise BusError("full", "tapped")
        self.sent.append(frame)
        if frame.identifier == SYNC:
            self._foreign, self._in_cycle = [*self._foreign, *self._in_cycle], []
        if not self.loses(frame):
            self._link.send(frame)

    def receive(self, deadline_ns: int) -> Frame | None:
        if self._foreign:
            return self._foreign.pop(0)
        while (frame := self._link.receive(deadline_ns)) is not None and self.misses(frame):
            pass
        return frame

    def drain(self) -> Sequence[Frame]:
        heard, self._foreign = self._foreign, []
        return [*heard, *(frame for frame in self._link.drain() if not self.misses(frame))]

    def close(self) -> None:
        self._link.close()


def tapped(behind: LockStepArm, config: ArmConfig) -> list[Tapped]:
    """Taps on all buses of an arm, as the driver opens them."""
    assert isinstance(config.driver, CanopenDriver)
    return [Tapped(behind.link(number)) for number in range(len(config.driver.buses))]


def weightless_config(**driver: Any) -> ArmConfig:
    """A joint that turns and one that slides along its axis, of 1 kg m^2 and 1 kg, at 500 Hz; gears of 1.

    A thousandth of the rated torques is 1 mN m and 1 mN; keys of the section `driver` may be changed.
    """
    drive = {"counts": 65536, "rated_torque": 1.0, "max_speed": 6000.0}
    section = {
        "kind": "canopen",
        "eds": {"name": "emulated_drive.eds", "text": EDS},
        "buses": [{"interface": "lock_step", "channel": "bench"}],
        "drives": [drive | {"node": 1, "max_torque": 10.0}, drive | {"node": 2, "max_torque": 5.0}],
        "emulation": {"truth": {"m1": 0.5, "Lxx1": 0.1, "Lyy1": 0.1, "Lzz1": 1.0, "m2": 1.0}},
    }
    return ArmConfig.model_validate(
        {
            "format": "ident-arm",
            "version": 1,
            "name": "weightless",
            "kinematics": {"dh": {"convention": "standard", "joints": {"turn": {}, "slide": {"type": "prismatic"}}}},
            "gravity": (0.0, 0.0, 0.0),
            "joints": {"turn": {"torque": 10.0, "home": 0.5}, "slide": {"torque": 5.0, "position": (0.1, 1.0)}},
            "control": {"rate": 500.0},
            "transmission": {"ratios": [1.0, 1.0], "drive_terms": "joints"},
            "driver": section | driver,
        }
    )
