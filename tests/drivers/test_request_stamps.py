"""When a cycle's request was on the bus, however long sending it took, on either fieldbus."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from contract_bench import PERIOD_NS, canopen_config, pucks_config

from drivers.barrett.driver import BarrettArm
from drivers.barrett.protocol import Group, get
from drivers.can.can_frame import Frame
from drivers.canopen.driver import CanopenArm
from drivers.clock import Clock
from sim_backend.emulator.lock_step import LockStepArm, LockStepLink

NONE = np.zeros(2)
REQUESTS = (0x80, get(Group.ARM, 48, group=True).identifier)  # SYNC, and the question for positions


class SlowLink:
    """A bus on which the system call that sends a request goes on for a while after the frame has left.

    Attributes:
        took_ns: how long [ns].
    """

    def __init__(self, inner: LockStepLink) -> None:
        self._inner, self.took_ns = inner, 0

    @property
    def clock(self) -> Clock:
        return self._inner.clock

    def send(self, frame: Frame) -> None:
        self._inner.send(frame)
        if frame.identifier in REQUESTS:
            self.clock.sleep_until_ns(self.clock.now_ns() + self.took_ns)

    def receive(self, deadline_ns: int) -> Frame | None:
        return self._inner.receive(deadline_ns)

    def drain(self) -> Sequence[Frame]:
        return self._inner.drain()

    def close(self) -> None:
        self._inner.close()


@pytest.mark.parametrize("kind", ["canopen", "pucks"])
def test_what_sending_takes_beyond_the_frame_is_no_part_of_a_velocity(kind: str) -> None:
    config = canopen_config() if kind == "canopen" else pucks_config(emulation={"zeroed": True})
    behind = LockStepArm(config)
    link = SlowLink(behind.link(0))
    with (CanopenArm if kind == "canopen" else BarrettArm)(config, lambda _: [link]) as arm:
        arm.enable()
        for _ in range(100):
            arm.exchange(np.array([5.0, 0.0]))
        arm.exchange(NONE)
        samples = []
        for cycle in range(20):
            link.took_ns = (0, PERIOD_NS // 5)[cycle % 2]
            samples.append(arm.exchange(NONE))
        link.took_ns = PERIOD_NS // 2
        stalled = arm.exchange(NONE)
    time = np.array([sample.stamp_ns for sample in samples]) * 1e-9
    velocity = np.diff([sample.position[0] for sample in samples]) / np.diff(time)
    assert abs(velocity[0]) > 0.3
    assert velocity == pytest.approx(
        np.full(19, velocity.mean()), rel=0.06
    )  # steps of the encoder; the call alone, 0.2
    assert [sample.stamp_doubt_ns for sample in samples] == [0] * 20
    assert stalled.stamp_doubt_ns == pytest.approx(PERIOD_NS / 2, abs=1000)
