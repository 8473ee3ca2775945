"""The example of docs/drivers.md as it stands there, against a controller in a thread; drivers that break promises."""

from __future__ import annotations

import json
import re
import socket
import struct
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from contract_bench import bench_config

from drivers.arm import StopKind
from drivers.axis_status import AxisStatus
from ident_service.cli import main
from ident_service.config.arm import ArmConfig
from ident_service.errors import DriverError
from ident_service.motion import arm_factory
from ident_service.motion.arm_factory import Outcome, try_driver

PAGE = Path(__file__).parents[2] / "docs" / "drivers.md"
WATCHDOG = 0.05

pytestmark = [pytest.mark.slow, pytest.mark.realtime]


def example() -> ModuleType:
    """The page's Python, as a module."""
    (text,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    module = ModuleType("udp_arm")
    exec(compile(text, str(PAGE), "exec"), module.__dict__)  # noqa: S102 - our own page
    return module


class Controller(threading.Thread):
    """Two free joints of 1 kg m^2, moved by the clock; gives up torque by itself after 50 ms without any."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.005)
        self.port = self._socket.getsockname()[1]
        self.status, self.torque = 0, [0.0, 0.0]
        self.position, self.velocity = [0.5, 0.1], [0.0, 0.0]
        self.mute = self.ended = False
        self._to, self._from = struct.Struct("<IB2i"), struct.Struct("<I2B2d")

    def run(self) -> None:
        heard = moved = time.monotonic()
        while not self.ended:
            try:
                packet, sender = self._socket.recvfrom(2048)
            except TimeoutError:
                packet, sender = b"", None
            now = time.monotonic()
            for k in range(2):
                self.velocity[k] += self.torque[k] * (now - moved)
                self.position[k] += self.velocity[k] * (now - moved)
            moved = now
            if self.status & AxisStatus.POWERED and now - heard > WATCHDOG:
                self._off(AxisStatus.WATCHDOG)
            if len(packet) != self._to.size:
                continue
            number, command, *steps = self._to.unpack(packet)
            if command == 1 and not self.status & AxisStatus.FAULT:
                heard, self.status, self.torque = now, int(AxisStatus.POWERED), [1e-3 * step for step in steps]
            elif command == 2:
                self._off(AxisStatus(self.status & AxisStatus.FAULT))
            elif command == 3:
                self._off(AxisStatus(0))
            if sender is not None and not self.mute:
                answer = self._from.pack(number, self.status, self.status, *self.position)
                self._socket.sendto(answer, sender)
        self._socket.close()

    def _off(self, status: AxisStatus) -> None:
        self.status, self.torque, self.velocity = int(status), [0.0, 0.0], [0.0, 0.0]


@pytest.fixture
def controller() -> Iterator[Controller]:
    controller = Controller()
    controller.start()
    yield controller
    controller.ended = True
    controller.join()


def config(port: int) -> ArmConfig:
    content = bench_config().model_dump(mode="json", exclude={"driver"})
    driver = {"kind": "udp", "host": "127.0.0.1", "port": port}
    return ArmConfig.model_validate(content | {"control": {"rate": 50.0}, "driver": driver})


def test_the_example_keeps_every_promise_and_moves_an_arm(controller: Controller) -> None:
    described = config(controller.port)
    arm = example().from_config(described)
    found = try_driver(described, lambda question: described.name, arm)
    assert [one for one in found if one.outcome is not Outcome.KEPT] == []
    assert len(found) == 14
    with arm:
        arm.enable()
        sent = arm.exchange(np.array([1.00049, 99.0])).torque
        np.testing.assert_allclose(sent, [1.0, 5.0])  # in whole steps, clipped
        for _ in range(10):
            sample = arm.exchange(np.array([1.0, 5.0]))
        assert sample.position[0] > 0.5
        arm.stop(StopKind.QUICK_STOP)
        still = arm.exchange(None).position
        np.testing.assert_array_equal(arm.exchange(None).position, still)


def test_the_examples_controller_lets_go_of_an_arm_whose_host_is_silent(controller: Controller) -> None:
    with example().from_config(config(controller.port)) as arm:
        arm.enable()
        arm.exchange(np.array([1.0, 1.0]))
        words = [arm.exchange(None).status[0] for _ in range(20)]  # without a torque, that is: in silence
        assert words[0] & AxisStatus.POWERED
        assert words[-1] == AxisStatus.WATCHDOG


def test_a_controller_that_falls_silent_ages_and_one_that_is_not_there_is_reported(controller: Controller) -> None:
    arm = example().from_config(config(controller.port))
    with arm:
        controller.mute = True
        ages = [int(arm.exchange(None).age[0]) for _ in range(4)]
        assert ages == [1, 2, 3, 4]
    with pytest.raises(DriverError, match=r"no answer from 127\.0\.0\.1"):
        arm.open()


def test_the_command_tries_a_driver_that_somebody_has_installed(
    controller: Controller, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    module = example()

    class Entry:
        name = "udp"

        def load(self) -> Any:
            return module.from_config

    monkeypatch.setattr(arm_factory, "entry_points", lambda **asked: [Entry()] if asked.get("name") == "udp" else [])
    path = tmp_path / "mine.yaml"
    path.write_text(config(controller.port).model_dump_json(by_alias=True, exclude_none=True), encoding="utf-8")
    assert main(["driver", "test", str(path), "--confirm", "bench", "--state", str(tmp_path)]) == 0
    assert "14 promises of the Arm contract, all kept" in capsys.readouterr().out
    assert main(["driver", "test", str(path), "--json", "--state", str(tmp_path)]) == 0  # nobody typed its name
    document = json.loads(capsys.readouterr().out)
    assert {one["outcome"] for one in document["promises"]} == {"kept", "not tried"}


class Careless:
    """Mistakes that drivers have, each of which breaks one promise."""

    def __init__(self, arm: Any) -> None:
        self.exchange, self.stop = arm.exchange, arm.stop

    def torque_without_enabling(self, arm: Any) -> None:
        arm.exchange = lambda torque: self.exchange(None)

    def stamps_of_another_clock(self, arm: Any) -> None:
        from dataclasses import replace

        arm.exchange = lambda torque: replace(s := self.exchange(torque), stamp_ns=s.stamp_ns - 10**12)

    def one_sample_for_all(self, arm: Any) -> None:
        kept: list[Any] = []

        def exchange(torque: Any) -> Any:
            sample = self.exchange(torque)
            kept[:] = kept or [sample.position]
            kept[0][:] = sample.position + 1e-3 * sample.cycle
            from dataclasses import replace

            return replace(sample, position=kept[0])

        arm.exchange = exchange

    def stop_that_is_deaf(self, arm: Any) -> None:
        arm.stop = lambda kind: None


@pytest.mark.parametrize(
    ("mistake", "words"),
    [
        ("torque_without_enabling", "a torque needs enabling"),
        ("stamps_of_another_clock", "a cycle takes the period"),
        ("one_sample_for_all", "samples stay what they were"),
        ("stop_that_is_deaf", "either stop takes the torque"),
    ],
)
def test_a_driver_that_breaks_a_promise_is_found_out(controller: Controller, mistake: str, words: str) -> None:
    described = config(controller.port)
    arm = example().from_config(described)
    getattr(Careless(arm), mistake)(arm)
    broken = [one for one in try_driver(described, lambda _: described.name, arm) if one.outcome is Outcome.BROKEN]
    assert any(one.words.startswith(words) for one in broken), broken
