"""What becomes of an arm without brakes after a stop: held until a person says so, lowered, or what drives do."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.local_commands import LocalCommands
from motion_bench import JOINTS, LOOKED, Story, WatchedArm, bench_config

from drivers.arm import StopKind
from ident_service.config.load import load_arm
from ident_service.config.motion_limits import motion_limits
from ident_service.errors import ArmFault, MotionRefused, UsageError
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import arm_model
from ident_service.model.collision import lowest_point
from ident_service.model.kinematics import link_poses
from ident_service.motion.after_stop import SPEED, StopSecuring, after_stop, joints_with_weight
from ident_service.motion.command_channel import ControlFile, Homing, SupervisedCommands
from ident_service.motion.control_loop import LEADS, LOWERS, WAITS
from ident_service.motion.faults import ActiveFaults
from ident_service.motion.run import RunReport, follow, run
from ident_service.motion.run_plan import Destination, PointToPointPlan
from ident_service.motion.state_machine import State
from sim_backend.arm import Truth, from_config
from sim_backend.faults import Fault, FaultKind

Array = np.ndarray
PERIOD = 2e-3  # s; half the cycles of other benches, as the arms here sink and wait for seconds
HOLD = 0.1  # s
STOP = 450  # a cycle in the middle of the excitation
LOOSE = {name: joint | {"brake": False} for name, joint in JOINTS.items()}
NEARLY_HANGING = {**LOOSE, "shoulder": LOOSE["shoulder"] | {"home": -1.2}}  # which does not sink for long


def loose(after: str | None, **changes: Any) -> Any:
    """The bench's arm without brakes; its drives leave their windings open."""
    control = {"rate": 1.0 / PERIOD} | ({} if after is None else {"after_stop": after}) | changes.pop("control", {})
    return bench_config(**{"joints": LOOSE, "control": control, **changes})


def on_a_table() -> Any:
    """The arm held above a table that carries it at once, where what is looked at is over before it sinks."""
    return loose("hold", control={"floor": 2.0})


class Person(LocalCommands):
    """Stops in one cycle, and confirms some cycles after the arm has begun to wait for it."""

    def __init__(self, arm: WatchedArm, *, stop: int = STOP, confirm: int | None = None) -> None:
        super().__init__()
        self._arm, self._stop, self._confirm = arm, stop, confirm
        self._since = 10**9

    def lease_ok(self, now_ns: int) -> bool:
        self.stop = self._arm.cycle > self._stop
        self.supported = self._confirm is not None and self._arm.cycle > self._since + self._confirm
        return True

    def announce_hold(self) -> None:
        super().announce_hold()
        self._since = self._arm.cycle


class Rig:
    """An open arm, what it really does, and what is told of it."""

    def __init__(self, config: Any, *faults: Fault) -> None:
        self.config, self.model = config, arm_model(config)
        self.limits = motion_limits(config)
        self.truth: list[Truth] = []
        self.arm = WatchedArm(from_config(config, faults=faults, observer=self.truth.append))
        self.story, self.latch = Story(), ActiveFaults()

    def run(self, **person: Any) -> RunReport:
        self.arm.open()
        motion = excitation(self.model, "identification")
        return run(
            self.arm,
            self.model,
            motion,
            self.story,
            Person(self.arm, **person),
            active_faults=self.latch,
            hold_seconds=HOLD,
        )

    def told(self, message: str) -> int:
        """The cycle in which something was told."""
        stamp = next(stamp for stamp, _, words in self.story.events if words == message)
        return round(stamp * 1e-9 / PERIOD)

    def column(self, name: str, since: int, until: int | None = None) -> Array:
        """Of the truth, by cycle."""
        return np.array([getattr(moment, name) for moment in self.truth[since:until]])

    def moves_when_left(self, seconds: float = 1.0) -> Array:
        """How far each joint goes in that time after everything has ended [rad]."""
        before = self.truth[-1].position
        for _ in range(round(seconds / PERIOD)):
            self.arm.inner.exchange(None)
        return np.abs(self.truth[-1].position - before)


def test_an_arm_that_would_fall_must_say_what_holds_it() -> None:
    with pytest.raises(MotionRefused, match=r"shoulder, elbow would fall after a stop.*hold or lower.*brake to true"):
        resolved(loose(None))
    with pytest.raises(MotionRefused, match="elbow would fall"):  # a wish is no brake
        resolved(bench_config(joints={**JOINTS, "elbow": LOOSE["elbow"]}, control={"after_stop": "brake"}))
    assert resolved(bench_config()) is StopSecuring.BRAKE
    assert resolved(loose("hold")) is StopSecuring.HOLD
    assert resolved(loose("lower")) is StopSecuring.LOWER


def test_a_simulated_drive_has_a_brake_by_default_and_a_real_one_has_none() -> None:
    silent = {name: {key: value for key, value in joint.items() if key != "brake"} for name, joint in JOINTS.items()}
    config = bench_config(joints=silent)
    assert resolved(config) is StopSecuring.BRAKE
    assert [config.has_brake(name) for name in silent] == [True, True]
    real = config.model_copy(update={"driver": load_arm("wam7_canopen").driver})
    with pytest.raises(MotionRefused, match=r"shoulder, elbow would fall after a stop"):
        resolved(real)


def test_an_arm_that_does_not_fall_need_not_say_anything() -> None:
    assert resolved(loose(None, gravity=(0.0, 0.0, 0.0))) is StopSecuring.BRAKE
    assert resolved(loose(None, gravity=(0.0, 0.0, -9.81))) is StopSecuring.BRAKE  # turns about a vertical axis
    slide = {"position": (-0.3, 0.3), "velocity": 0.5, "acceleration": 4.0, "jerk": 40.0, "torque": 30.0}
    joints = {name: {**LOOSE[name], **slide, "following_error": 0.05} for name in ("shoulder", "elbow")}
    rows = {"shoulder": {"type": "prismatic", "alpha": np.pi / 2}, "elbow": {"type": "prismatic"}}
    sliders = {"dh": {"convention": "standard", "joints": rows}}
    level = loose(None, kinematics=sliders, joints=joints, gravity=(-9.81, 0.0, 0.0))
    assert joints_with_weight(arm_model(level), motion_limits(level)) == ()
    steep = loose(None, kinematics=sliders, joints=joints, gravity=(0.0, 0.0, -9.81))
    assert joints_with_weight(arm_model(steep), motion_limits(steep)) == ("shoulder",)


def resolved(config: Any) -> StopSecuring:
    return after_stop(arm_model(config), motion_limits(config))


def test_nothing_moves_where_nothing_would_hold_the_arm() -> None:
    rig = Rig(loose(None))
    with pytest.raises(MotionRefused, match="would fall"):
        rig.run()
    assert rig.arm.enabled == 0


@pytest.fixture(scope="module")
def held() -> Rig:
    """Stopped, held for three seconds, confirmed."""
    rig = Rig(loose("hold", joints=NEARLY_HANGING))
    assert rig.run(confirm=1500).state is State.STOPPED
    return rig


@pytest.mark.slow
def test_a_held_arm_stands_until_a_person_confirms(held: Rig) -> None:
    waits, lowers = held.told(WAITS), held.told(LOWERS)
    assert lowers - waits >= 1500
    position = held.column("position", waits, lowers)
    assert (np.ptp(position, axis=0) < 0.01).all(), np.ptp(position, axis=0)
    assert held.arm.stops == [StopKind.TORQUE_OFF]
    assert held.story.states[-2:] == ["stopping", "stopped"]


@pytest.mark.slow
def test_what_is_let_go_of_sinks_slowly_and_needs_no_torque_at_the_end(held: Rig) -> None:
    lowers = held.told(LOWERS)
    speed = np.abs(held.column("velocity", lowers, -1))
    assert (speed.max(axis=0) > 0.5 * SPEED * held.limits.velocity).any()  # nobody carries it
    assert (speed.max(axis=0) < 2.0 * SPEED * held.limits.velocity).all()
    assert (np.abs(held.arm.torques[-1]) < 0.02 * held.limits.torque).all()
    assert (held.moves_when_left() < 0.02).all()


@pytest.mark.slow
def test_a_long_hold_is_not_recorded(held: Rig) -> None:
    stamps = held.story.column("stamp_ns") * 1e-9 / PERIOD
    assert stamps[-1] <= held.told(WAITS) + HOLD / PERIOD + 2
    assert (np.diff(stamps) < 1.5).all()


@pytest.mark.slow
def test_a_word_that_was_given_too_early_does_not_count() -> None:
    rig = Rig(on_a_table())
    rig.arm.open()
    switches = LocalCommands()
    switches.supported = True
    ended = 0

    def watch(cycle: int) -> None:
        nonlocal ended
        switches.stop = cycle > STOP
        ended += switches.waiting
        if ended == 250:
            switches.supported = True

    rig.arm.before_exchange = watch
    run(rig.arm, rig.model, excitation(rig.model, "identification"), rig.story, switches, hold_seconds=HOLD)
    assert rig.told(LOWERS) - rig.told(WAITS) >= 248


@pytest.mark.campaign
def test_an_arm_is_lowered_without_a_word_where_its_description_says_so() -> None:
    rig = Rig(loose("lower", joints=NEARLY_HANGING))
    assert rig.run().state is State.STOPPED
    assert WAITS not in [words for _, _, words in rig.story.events]
    assert rig.arm.stops == [StopKind.TORQUE_OFF]
    assert (rig.moves_when_left() < 0.02).all()


@pytest.mark.slow
def test_the_floor_ends_a_lowering() -> None:
    low = -0.1
    rig = Rig(loose("lower", control={"floor": low}))
    assert rig.run().state is State.STOPPED
    assert WAITS not in [words for _, _, words in rig.story.events]
    assert rig.arm.stops == [StopKind.TORQUE_OFF]
    height = lowest_point(rig.model)
    heights = [height(moment.position) for moment in rig.truth[rig.told(LOWERS) :]]
    assert min(heights[:-3]) > low
    assert heights[-1] == pytest.approx(low, abs=2e-3)


def test_the_height_of_the_lowest_point_is_that_of_bodies_or_frames() -> None:
    bare = lowest_point(arm_model(loose("lower")))
    assert bare(np.array([-np.pi / 2, 0.0])) == pytest.approx(-1.0)
    assert bare(np.array([np.pi / 2, -np.pi])) == pytest.approx(0.0)
    geometry = {"elbow": [{"from": (-0.5, 0.0, 0.0), "to": (0.1, 0.0, 0.0), "radius": 0.03}]}
    thick = lowest_point(arm_model(loose("lower", geometry=geometry)))
    assert thick(np.array([-np.pi / 2, 0.0])) == pytest.approx(-1.13)
    # Frames that are turned in their joints, and capsules of every link.
    large = arm_model(load_arm("wam7_sim"))
    for position in np.random.default_rng(1).uniform(-2.0, 2.0, (5, 7)):
        (turns,), (places,) = link_poses(large.chain, position[None])
        ends = [
            (places[link] + turns[link] @ end)[2] - capsule.radius
            for link, name in enumerate(large.chain.names)
            for capsule in large.config.geometry.get(name, ())
            for end in (capsule.start, capsule.end)
        ]
        assert lowest_point(large)(position) == pytest.approx(min([*ends, *places[:, 2]]))


@pytest.mark.slow
def test_a_joint_at_the_end_of_its_range_rests_there() -> None:
    """Hanging straight down is outside the limits of both joints of this arm."""
    joints = {"shoulder": LOOSE["shoulder"] | {"position": (-0.6, 1.8)}, "elbow": LOOSE["elbow"]}
    rig = Rig(loose("lower", joints=joints))
    assert rig.run().state is State.STOPPED
    shoulder = rig.truth[-1].position[0]
    assert -0.6 - rig.limits.following_error[0] < shoulder < -0.55
    assert rig.latch.faults == ()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "code"), [(FaultKind.DRIVE_FAULT, "drive_fault"), (FaultKind.NODE_SILENT, "feedback_gone")]
)
def test_drives_and_their_own_reaction_come_before_any_holding(kind: FaultKind, code: str) -> None:
    rig = Rig(loose("hold"), Fault(STOP + 1250, kind, 1))
    with pytest.raises(ArmFault, match=code):
        rig.run()
    assert rig.told(WAITS) < STOP + 1250
    assert rig.arm.stops == [StopKind.QUICK_STOP]
    assert rig.story.states[-1] == "faulted"


@pytest.mark.slow
def test_a_controlled_stop_after_a_fault_is_held_too() -> None:
    rig = Rig(on_a_table(), Fault(STOP, FaultKind.LATE_CYCLE, None, 1, 12e-3))
    with pytest.raises(ArmFault, match="late_cycles"):
        rig.run(stop=10**9, confirm=750)
    assert rig.told(LOWERS) - rig.told(WAITS) >= 750
    assert rig.arm.stops == [StopKind.TORQUE_OFF]
    assert [fault.code for fault in rig.latch.faults] == ["late_cycles"]


@pytest.mark.slow
@pytest.mark.parametrize("after", [pytest.param("hold", marks=pytest.mark.campaign), "lower"])
def test_an_arm_that_does_not_follow_is_lowered_until_it_rests(after: str) -> None:
    rig = Rig(loose(after), Fault(200, FaultKind.LOAD_ATTACHED, size=4.0))
    with pytest.raises(ArmFault) as caught:
        rig.run(stop=10**9, confirm=0)
    assert caught.value.code == "following_lost"
    assert rig.arm.stops == [StopKind.TORQUE_OFF]
    rig.arm.inner.faults = ()
    assert (rig.moves_when_left() < 0.05).all()


@pytest.mark.slow
def test_a_path_home_ends_held() -> None:
    rig = Rig(on_a_table())
    rig.arm.open()
    controls = Person(rig.arm, stop=10**9, confirm=500)
    report = follow(rig.arm, rig.model, PointToPointPlan(Destination.HOME), rig.story, controls, hold_seconds=HOLD)
    assert report.state is State.DONE
    assert rig.told(LOWERS) - rig.told(WAITS) >= 500


class Leader(Person):
    """Has the held arm led home some cycles after it began to wait, and confirms when it waits again."""

    def __init__(self, arm: WatchedArm, *, stop_again: int | None = None, lease_lost: bool = False) -> None:
        super().__init__(arm)
        self.stages: list[Homing] = []
        self._went: int | None = None
        self._stop_again, self._lease_lost = stop_again, lease_lost

    def lease_ok(self, now_ns: int) -> bool:
        cycle = self._arm.cycle
        if cycle == STOP:
            self.stop = not self._lease_lost
            return not self._lease_lost
        if self.homing is Homing.NONE and cycle > self._since + 100:
            self.homing = Homing.ASKED
        if self._went is not None and self._stop_again is not None and cycle == self._went + self._stop_again:
            self.stop = True
        if self.stages and self.stages[-1] is not Homing.GOING and cycle > self._since + 100:
            self.supported = True
        return True

    def tell_homing(self, stage: Homing) -> None:
        super().tell_homing(stage)
        self.stages.append(stage)
        if stage is Homing.GOING:
            self._went = self._arm.cycle


def led(rig: Rig, **leader: Any) -> Leader:
    rig.arm.open()
    controls = Leader(rig.arm, **leader)
    motion = excitation(rig.model, "identification")
    run(rig.arm, rig.model, motion, rig.story, controls, active_faults=rig.latch, hold_seconds=HOLD)
    return controls


@pytest.mark.slow
def test_a_held_arm_is_led_home_and_held_there() -> None:
    rig = Rig(on_a_table())
    assert led(rig).stages == [Homing.GOING, Homing.ENDED]
    begin, lowers = rig.told(LEADS), rig.told(LOWERS)
    speed = np.abs(rig.column("velocity", begin, lowers))
    assert (speed.max(axis=0) < 0.15 * rig.limits.velocity).all()
    at_end = rig.column("position", lowers - 50, lowers)
    assert (np.abs(at_end - rig.limits.home) < 0.02).all(), at_end[-1]
    assert (np.abs(np.diff(rig.arm.torques[begin - 25 : begin + 25], axis=0)) < 0.02 * rig.limits.torque).all()
    assert rig.story.states[-5:] == ["stopping", "stopped", "returning", "stopping", "stopped"]
    assert rig.arm.stops == [StopKind.TORQUE_OFF]


def test_the_path_home_of_a_held_arm_can_be_stopped_and_is_held_again() -> None:
    rig = Rig(on_a_table())
    assert led(rig, stop_again=100).stages == [Homing.GOING, Homing.ENDED]
    assert (np.abs(rig.column("position", rig.told(LOWERS) - 5, rig.told(LOWERS)) - rig.limits.home) > 0.025).any()
    assert rig.arm.stops == [StopKind.TORQUE_OFF]


@pytest.mark.slow
def test_an_arm_that_was_stopped_for_a_lost_lease_is_led_home_and_the_fault_stays() -> None:
    rig = Rig(on_a_table())
    with pytest.raises(ArmFault, match="lease_lost"):
        led(rig, lease_lost=True)
    assert rig.told(LEADS)
    assert [fault.code for fault in rig.latch.faults] == ["lease_lost"]


def test_an_arm_with_a_fault_of_its_own_is_not_led_home() -> None:
    rig = Rig(on_a_table(), *(Fault(STOP - 200 + 3 * k, FaultKind.LOST_FEEDBACK, 1) for k in range(40)))
    with pytest.raises(ArmFault, match="repeated_warnings"):
        led(rig)
    assert LEADS not in [words for _, _, words in rig.story.events]
    assert any(words.startswith("not moved home: it was stopped by") for _, _, words in rig.story.events)


def test_whoever_leads_an_arm_home_keeps_its_lease_and_takes_no_other_stop_back(tmp_path: Path) -> None:
    """The run's own parent is gone; a stop of a third person counts."""
    now = 10**9
    ours, theirs = os.pipe()
    with ControlFile.take(tmp_path / "controls", 0.5, lambda: now) as controls:
        lifeline = SupervisedCommands(controls, ours, lock_step=False)
        person = ControlFile.reach(tmp_path / "controls", lambda: now)
        with pytest.raises(UsageError, match="not held"):
            person.request_home()
        os.close(theirs)
        lifeline.announce_hold()
        controls.request_stop()
        now += 10**10
        assert not lifeline.lease_ok(now)
        person.request_home()
        assert (lifeline.homing, lifeline.stop) == (Homing.ASKED, False)
        lifeline.tell_homing(Homing.GOING)
        assert lifeline.lease_ok(now)
        with pytest.raises(UsageError, match="nothing to confirm"):
            person.confirm_support()
        now += 3 * 10**9
        assert not lifeline.lease_ok(now)
        person.renew_home()
        assert lifeline.lease_ok(now)
        assert ControlFile.stop_motions(tmp_path / "controls", lambda: now) is not None
        assert lifeline.stop
        person.close()
    os.close(ours)


@pytest.mark.slow
def test_a_run_ends_where_it_was_supported() -> None:
    rig = Rig(loose("hold"))
    assert rig.run(stop=10**9).state is State.DONE
    assert rig.arm.stops == [StopKind.TORQUE_OFF]
    assert (np.abs(rig.truth[-1].position - rig.truth[LOOKED].position) < 0.05).all()


@pytest.mark.slow
def test_controls_that_fail_do_not_let_a_held_arm_fall() -> None:
    rig = Rig(on_a_table())
    rig.arm.open()
    failures = 0

    class Failing(Person):
        @property  # type: ignore[override]
        def supported(self) -> bool:
            nonlocal failures
            if self.waiting and failures < 100:
                failures += 1
                raise OSError("gone")
            return failures >= 100

        @supported.setter
        def supported(self, wanted: bool) -> None:
            pass

    with pytest.raises(ArmFault, match="controls_failed"):
        run(
            rig.arm,
            rig.model,
            excitation(rig.model, "identification"),
            rig.story,
            Failing(rig.arm),
            active_faults=rig.latch,
            hold_seconds=HOLD,
        )
    assert rig.arm.stops == [StopKind.TORQUE_OFF]
    assert rig.told(LOWERS) - rig.told(WAITS) >= 100
