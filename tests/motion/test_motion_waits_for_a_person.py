"""A run of an arm that a person enables: what is told, what if it is moved meanwhile, and how waiting ends."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from campaign_pucks import FOREIGN, bench_puck_config
from helpers.emulated_arms import Tapped
from helpers.local_commands import LocalCommands
from motion_bench import Story

from drivers.arm import Sample, Vector
from drivers.barrett.driver import BarrettArm
from ident_service.config.arm import ArmConfig
from ident_service.errors import ArmFault, MotionRefused
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import arm_model
from ident_service.motion.faults import ActiveFaults
from ident_service.motion.run import WAITS_FOR, run
from ident_service.motion.state_machine import State
from ident_service.motion.ticket import Verdict
from ident_service.preflight.preflight import preflight
from sim_backend.emulator.faults import DriveFault
from sim_backend.emulator.lock_step import LockStepArm


class LedArm(BarrettArm):
    """An arm that somebody leads away while it waits for Shift-Activate, some times."""

    def __init__(self, config: ArmConfig, times: int, way: float) -> None:
        self.behind, self.left, self.way = LockStepArm(config), times, way
        super().__init__(config, lambda _: [self.behind.link(0)])

    def enable(self) -> None:
        if self.left:
            self.left -= 1
            body = self.behind.emulator.body
            body.support(self.clock.now_ns())
            body.lead(body.plant.position + self.way, self.clock.now_ns())
        super().enable()


def moved(times: int, way: float, controls: Any = None, config: ArmConfig | None = None) -> tuple[Any, Story, Any]:
    config = config or bench_puck_config()
    model, story, latch = arm_model(config), Story(), ActiveFaults()
    with LedArm(config, times, way) as arm:
        before = arm.exchange(None).position
        try:
            report = run(arm, model, excitation(model, "identification"), story, controls, active_faults=latch)
        except (MotionRefused, ArmFault) as refused:
            return refused, story, latch
        finally:
            assert arm.still_wanted is BarrettArm.still_wanted  # nothing of a run outlives it in the arm
        assert np.abs(arm.exchange(None).position - before - times * way).max() < 0.02
    return report, story, latch


def waited(story: Story) -> int:
    return sum(message.startswith(WAITS_FOR) for _, _, message in story.events)


@pytest.mark.slow
def test_an_arm_that_was_moved_meanwhile_is_planned_again_from_where_it_is() -> None:
    report, story, _ = moved(1, 0.009)  # of this arm the guard believes 8 mrad in a cycle
    assert report.state is State.DONE
    assert waited(story) == 2
    assert "the arm was moved while a person was waited for; planned again" in story.states


@pytest.mark.slow
def test_an_arm_at_rest_is_waited_for_once() -> None:
    report, story, _ = moved(1, 0.002)
    assert report.state is State.DONE
    assert waited(story) == 1


@pytest.mark.slow
def test_an_arm_that_is_moved_each_time_is_refused() -> None:
    refused, story, latch = moved(9, 0.02)
    assert "moved each time" in str(refused)
    assert waited(story) == 3
    assert not latch.faults


@pytest.mark.slow
def test_nobody_at_the_pendant_is_no_fault_of_the_arm() -> None:
    document = bench_puck_config().model_dump(mode="json", by_alias=True)
    document["driver"]["emulation"]["operator"] = None
    document["driver"]["activate_within"] = 0.5
    refused, story, latch = moved(0, 0.0, None, ArmConfig.model_validate(document))
    assert "nobody pressed Shift-Activate for 0.5 s" in str(refused)
    assert "nothing has moved" in str(refused)
    assert waited(story) == 1
    assert not latch.faults


@pytest.mark.slow
def test_a_stop_ends_the_waiting_and_nothing_is_latched() -> None:
    document = bench_puck_config().model_dump(mode="json", by_alias=True)
    document["driver"]["emulation"]["operator"] = None
    commands, asked = LocalCommands(), [0]

    def lease_ok(now_ns: int) -> bool:
        asked[0] += 1
        commands.stop = asked[0] > 50
        return True

    commands.lease_ok = lease_ok  # type: ignore[method-assign]
    refused, story, latch = moved(0, 0.0, commands, ArmConfig.model_validate(document))
    assert "a stop was requested before the arm was energised" in str(refused)
    assert waited(story) == 1
    assert not latch.faults


class PressedArm(LedArm):
    """An arm whose emergency stop is pressed while it waits for Shift-Activate, which nobody presses."""

    @staticmethod
    def config() -> ArmConfig:
        document = bench_puck_config().model_dump(mode="json", by_alias=True)
        document["driver"]["emulation"]["operator"] = None
        document["joints"]["shoulder"]["torque"] = 30.0  # what its motor gives at most
        return ArmConfig.model_validate(document)

    def enable(self) -> None:
        wanted, asked = self.still_wanted, [0]

        def press() -> bool:
            asked[0] += 1
            if asked[0] == 20:
                self.behind.inject(DriveFault("emergency_stop"))
            return wanted()

        self.still_wanted = press
        super().enable()


def test_an_emergency_stop_that_is_pressed_while_a_person_is_waited_for_is_latched_as_one() -> None:
    config, story, latch = PressedArm.config(), Story(), ActiveFaults()
    model = arm_model(config)
    with (
        PressedArm(config, 0, 0.0) as arm,
        pytest.raises(ArmFault, match="release it, then press Shift-Idle") as stopped,
    ):
        run(arm, model, excitation(model, "identification"), story, active_faults=latch)
    assert stopped.value.code == "emergency_stop"
    assert [(fault.code, fault.cause) for fault in latch.faults] == [
        ("emergency_stop", "the emergency stop is pressed, or has been: release it, then press Shift-Idle")
    ]
    assert waited(story) == 1


def test_preflight_names_an_emergency_stop_that_is_pressed_while_a_person_is_waited_for() -> None:
    config = PressedArm.config()
    name, arm = config.name, PressedArm(config, 0, 0.0)
    ticket = preflight(arm, arm_model(config), None, confirm=lambda _: name, idle_seconds=0.2)
    (check,) = [one for one in ticket.checks if one.verdict is Verdict.FAILED]
    assert check.reason.startswith("the emergency stop is pressed, or has been: release it")
    assert "cables" not in check.remedy


class SharedArm(BarrettArm):
    """An arm that another host gives torques, too, from the first cycle on in which this one does."""

    def __init__(self, config: ArmConfig) -> None:
        self.behind, self.taps = LockStepArm(config), list[Tapped]()
        super().__init__(config, self._links)

    def _links(self, config: ArmConfig) -> list[Tapped]:
        self.taps = [Tapped(self.behind.link(0))]
        return self.taps

    def exchange(self, torque: Vector | None) -> Sample:
        if torque is not None:
            self.taps[-1].disturb([FOREIGN["foreign_torque"]])
        return super().exchange(torque)


def test_another_host_that_comes_with_the_person_is_heard_in_the_first_cycle() -> None:
    """It is told once, with the sample in which the arm is compared with where it stood."""
    config, story = bench_puck_config(), Story()
    model = arm_model(config)
    with SharedArm(config) as arm, pytest.raises(ArmFault, match="somebody else sends frames 401h") as stopped:
        run(arm, model, excitation(model, "identification"), story)
    assert stopped.value.code == "second_host"
    assert len(story.samples) == 1


def test_preflight_hears_another_host_that_comes_with_the_person() -> None:
    document = bench_puck_config().model_dump(mode="json", by_alias=True)
    document["joints"]["shoulder"]["torque"] = 30.0  # what its motor gives at most
    config = ArmConfig.model_validate(document)
    ticket = preflight(SharedArm(config), arm_model(config), None, confirm=lambda _: config.name, idle_seconds=0.2)
    (check,) = [one for one in ticket.checks if one.verdict is Verdict.FAILED]
    assert "somebody else sends frames 401h" in check.reason
