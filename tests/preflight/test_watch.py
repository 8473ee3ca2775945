"""Watching: only looks, says what it saw, and closes."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from flight_bench import FOREVER, flight_config

from drivers.arm import Arm, ArmDescription, Sample, StopKind
from drivers.clock import VirtualClock
from ident_service.errors import DriverError, UsageError
from ident_service.motion.read_only_monitor import watch
from ident_service.operations.arm_checks import watch_document, watch_text
from sim_backend.arm import from_config
from sim_backend.faults import Fault, FaultKind

Array = np.ndarray


class OnlyLooked(Arm):
    """An arm that fails a test which does anything but look; joint one moves at 0.3 rad/s, joint two is noisy."""

    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.calls: list[str] = []
        self.cycle = 0
        self.breaks_at: int | None = None
        self._rng = np.random.default_rng(1)

    def open(self) -> None:
        self.calls.append("open")

    def describe(self) -> ArmDescription:
        nothing = np.zeros(2)
        return ArmDescription(("one", "two"), 1000.0, nothing, nothing, nothing, ("", ""), "double")

    def enable(self) -> None:
        pytest.fail("watching energised the arm")

    def reset(self) -> None:
        pytest.fail("watching reset the drives")

    def stop(self, kind: StopKind) -> None:
        pytest.fail("watching sent a stop, which changes the drives' state")

    def exchange(self, torque: Array | None) -> Sample:
        if torque is not None:
            pytest.fail("watching sent a torque")
        if self.cycle == self.breaks_at:
            raise DriverError("gone")
        k = self.cycle
        self.cycle += 1
        position = np.array([1000.0 + 0.3e-3 * k, 2.0 + 1e-3 * self._rng.standard_normal()])
        valid = np.array([True, k % 10 != 9])
        return Sample(k, k * 10**6, position, None, np.zeros(2), valid, np.where(valid, 0, 1), lost=k // 10)

    def close(self) -> None:
        self.calls.append("close")


def test_watching_only_looks() -> None:
    arm = OnlyLooked()
    seen = watch(arm, 2.0)
    assert arm.calls == ["open", "close"]
    assert seen.cycles == arm.cycle == 2000


def test_the_arm_itself_is_not_even_opened_where_a_monitoring_arm_is_offered() -> None:
    class Harmful(OnlyLooked):
        def look(self) -> Arm:
            return harmless

    arm, harmless = Harmful(), OnlyLooked()
    assert watch(arm, cycles=3).cycles == harmless.cycle == 3
    assert (arm.calls, harmless.calls) == ([], ["open", "close"])


def test_it_says_what_it_saw() -> None:
    seen = watch(OnlyLooked(), cycles=1000)
    np.testing.assert_allclose(seen.position, [1000.2997, 2.0], atol=5e-3)
    np.testing.assert_allclose(seen.velocity, [0.3, 0.0], atol=1e-3)
    np.testing.assert_allclose(seen.noise, [0.0, 1e-3], atol=6e-5)
    assert seen.missing.tolist() == [0, 100]
    assert seen.oldest.tolist() == [0, 1]
    assert seen.lowest[0] == 1000.0
    assert seen.lost == 99


def test_every_sample_is_reported_and_watching_ends_when_asked() -> None:
    told: list[int] = []
    seen = watch(OnlyLooked(), 60.0, lambda _, sample: told.append(sample.cycle), stop_requested=lambda: len(told) == 7)
    assert told == list(range(7))
    assert seen.cycles == 7


def test_the_arm_is_closed_when_it_falls_silent() -> None:
    arm = OnlyLooked()
    arm.breaks_at = 5
    with pytest.raises(DriverError, match="gone"):
        watch(arm, 1.0)
    assert arm.calls == ["open", "close"]


@pytest.mark.parametrize(("seconds", "cycles"), [(0.0, None), (float("nan"), None), (1e9, None), (1.0, 0)])
def test_no_time_to_look_in_is_refused_before_anything_is_opened(seconds: float, cycles: int | None) -> None:
    arm = OnlyLooked()
    with pytest.raises(UsageError, match="at least one cycle"):
        watch(arm, seconds, cycles=cycles)
    assert arm.calls == []


def test_an_axis_that_never_answers_is_shown_as_such() -> None:
    arm = from_config(flight_config(), faults=(Fault(0, FaultKind.LOST_FEEDBACK, 1, FOREVER),))
    seen = watch(arm, 0.2)
    assert np.isnan(seen.position[1])
    assert seen.missing.tolist() == [0, 100]
    document = watch_document(seen)
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    assert document["joints"][1]["position"] is None
    assert document["joints"][1]["noise"] is None


def test_the_text_names_joints_and_drives() -> None:
    seen = replace(watch(OnlyLooked(), cycles=10), status=(1, 12))
    lines = watch_text(seen).splitlines()
    assert lines[0] == "10 cycles, 0 frames lost"
    assert lines[2].split()[0] == "one"
    assert lines[2].endswith("powered")
    assert lines[3].endswith("emergency stop, watchdog")
    assert watch_document(replace(seen, status=(0, 0)))["joints"][0]["drive"] == "off"
    told = replace(seen, drives=("node 1: fault, operational", "node 2: quick stop, stopped"))
    assert watch_text(told).splitlines()[4:] == ["  node 1: fault, operational", "  node 2: quick stop, stopped"]
    assert watch_document(told)["drives"] == list(told.drives)
