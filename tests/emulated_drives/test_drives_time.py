"""Emulated drives act when a frame was sent, however long the frames before it take this process."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable
from pathlib import Path
from typing import Any, ClassVar

import pytest
from drives_bench import drives_config

from drivers.can.can_frame import Frame
from sim_backend.emulator import process
from sim_backend.emulator.emulator import Emulator

TORQUE, SYNC = 0x401, 0x80


class Wire:
    """A wire whose host sends a SYNC while its drives are busy with the torque frame before."""

    waits, unsent, cycles = False, 0, 0
    sent: ClassVar[deque[Frame]] = deque()

    def __init__(self, buses: object) -> None:
        Wire.cycles = 0
        Wire.sent.clear()

    def receive(self, timeout: float) -> tuple[int, Frame] | None:
        if not self.sent and timeout > 0.0:
            time.sleep(1e-4)
            Wire.cycles += 1
            self.send_now(TORQUE, b"\0\0")
        return (0, self.sent.popleft()) if self.sent else None

    @classmethod
    def send_now(cls, identifier: int, data: bytes = b"") -> None:
        cls.sent.append(Frame(identifier, data, stamp_ns=time.monotonic_ns()))

    def send(self, frames: Iterable[tuple[int, Frame]]) -> None:
        """Nobody hears the drives."""

    def close(self) -> None:
        """Nothing is open."""


def test_no_time_passes_for_drives_before_what_was_sent_until_then(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    reached, early = [0], list[int]()
    receive, tick = Emulator.receive, Emulator.tick

    def receiving(self: Emulator, bus: int, frame: Frame, now_ns: int, **more: Any) -> object:
        if frame.identifier == SYNC:
            early.append(reached[0] - now_ns)
        answer = receive(self, bus, frame, now_ns, **more)
        if frame.identifier == TORQUE:
            Wire.send_now(SYNC)
            time.sleep(1e-4)
        return answer

    def ticking(self: Emulator, now_ns: int) -> object:
        reached[0] = now_ns
        return tick(self, now_ns)

    monkeypatch.setattr(process, "HostedBuses", Wire)
    monkeypatch.setattr(Emulator, "receive", receiving)
    monkeypatch.setattr(Emulator, "tick", ticking)
    config = drives_config(tmp_path, buses=[{"interface": "ident_wire", "channel": "busy"}])
    process.emulate(config, stop_requested=lambda: Wire.cycles >= 50)
    assert len(early) >= 49
    assert max(early) <= 0
