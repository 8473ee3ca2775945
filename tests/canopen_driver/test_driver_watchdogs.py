"""Each kind of watchdog: what keeps it quiet, what it does when that is withheld, and that preflight sees whether."""

from __future__ import annotations

import struct
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.emulated_arms import EDS, Tapped, tapped, weightless_config

from drivers.arm import StopKind
from drivers.can.can_frame import Frame
from drivers.canopen import object_dictionary as od
from drivers.canopen.bus_load import budget
from drivers.canopen.driver import CanopenArm
from drivers.canopen.object_dictionary import Entry, Kind
from drivers.canopen.pdo_mapping import HEARTBEAT, Write
from ident_service.config.arm import ArmConfig
from ident_service.config.canopen import CanopenDrive, CanopenDriver, disagreements, quick_stop_decelerations
from ident_service.config.motion_limits import motion_limits
from ident_service.errors import DriverError
from ident_service.model.arm_model import arm_model
from ident_service.model.expected_friction import expected_friction
from ident_service.motion.ticket import Verdict
from ident_service.motion.trajectory import hold
from ident_service.preflight.session import Session
from ident_service.preflight.watchdog import watchdog_check
from sim_backend.emulator.faults import parse_fault
from sim_backend.emulator.lock_step import LockStepArm

DRIVE = {"counts": 65536, "rated_torque": 1.0, "max_speed": 6000.0}
PERIOD = 2e-3
KINDS: dict[str, dict[str, Any]] = {
    "rpdo_timer": {},
    "heartbeat": {},
    "node_guarding": {},
    "sync_loss": {"watchdog_time": 0.02, "watchdog_entry": {"index": 0x2F70, "type": "u8", "value": 10}},
    "vendor": {"watchdog_time": 0.03, "watchdog_entry": {"index": 0x2F75, "type": "u16", "value": 30}},
}
TIMES = {"rpdo_timer": 0.01, "heartbeat": 0.06, "node_guarding": 0.06, "sync_loss": 0.02, "vendor": 0.03}
BEATS = {"period": 0.02, "host_timeout": 0.06}
ZERO = np.zeros(2)


def arm_of(first: str, second: str, **driver: Any) -> ArmConfig:
    drives = [
        DRIVE | {"node": number, "max_torque": 5.0, "watchdog": kind} | KINDS[kind]
        for number, kind in ((1, first), (2, second))
    ]
    status = {"period": 0.1, "inhibit": 0.005}
    return weightless_config(drives=drives, **{"heartbeats": BEATS, "status": status} | driver)


def limited(config: ArmConfig) -> ArmConfig:
    """The same with limits and gains for every joint, so that a loop may hold it."""
    rest = {"velocity": 2.0, "acceleration": 5.0, "jerk": 50.0, "following_error": 0.2, "kp": 100.0, "kd": 16.0}
    joints = {
        name: joint.model_copy(update={**rest, "position": (-3.0, 3.0), "home": joint.home or 0.5})
        for name, joint in config.joints.items()
    }
    return config.model_copy(update={"joints": joints})


class Bench:
    """An open, enabled arm over a tapped bus."""

    def __init__(self, config: ArmConfig, *faults: str) -> None:
        self.config, self.behind = config, LockStepArm(config)
        self.taps: list[Tapped] = []
        self.arm = CanopenArm(config, self._links)
        self.arm.open()
        self.arm.enable()
        for fault in faults:
            self.behind.inject(parse_fault(fault, tuple(config.joints)))

    def _links(self, config: ArmConfig) -> list[Tapped]:
        self.taps = tapped(self.behind, config)
        return self.taps

    def check(self) -> Any:
        model = arm_model(limited(self.config))
        model = replace(model, prior=model.layout.vector(self.config.driver.emulation.truth))
        limits, described = motion_limits(model.config), self.arm.describe()
        home = self.arm.exchange(ZERO).position
        friction = expected_friction(model, limits, self.config.design.friction_guess)
        session = Session(self.arm, model, limits, described, home, friction)
        session.follow(hold(home), 0.02)
        return watchdog_check(self.arm, model, session, hold(home).at)


@pytest.mark.parametrize("kind", KINDS)
def test_a_fed_watchdog_is_quiet_and_an_unfed_one_stops_the_drive(kind: str) -> None:
    bench = Bench(arm_of(kind, kind))
    for _ in range(200):
        bench.arm.exchange(ZERO)
    assert all("operation enabled" in state for state in bench.behind.emulator.states)
    check = bench.check()
    assert check.verdict is Verdict.PASSED, check.reason
    assert [one.joint for one in check.measures] == ["turn: drive 1", "slide: drive 2"]
    for one in check.measures:
        assert "quick stop after" in one.what or "torque off after" in one.what
        assert one.value == pytest.approx(TIMES[kind], abs=0.02)
    bench.arm.close()


@pytest.mark.parametrize("kind", KINDS)
def test_a_drive_that_ignores_its_watchdog_is_seen_and_the_other_is_not(kind: str) -> None:
    bench = Bench(arm_of(kind, kind), "watchdog_ignored joint=slide")
    for _ in range(20):
        bench.arm.exchange(ZERO)
    check = bench.check()
    assert check.verdict is Verdict.FAILED
    turn, slide = check.measures
    assert turn.within_limits
    assert (slide.value, slide.within_limits) == (None, False)
    assert "goes on after" in slide.what
    assert "slide: drive 2" in check.reason
    bench.arm.close()


@pytest.mark.parametrize(("first", "second"), [("heartbeat", "rpdo_timer"), ("vendor", "node_guarding")])
def test_drives_of_several_kinds_are_each_proven_by_their_own(first: str, second: str) -> None:
    bench = Bench(arm_of(first, second))
    for _ in range(50):
        bench.arm.exchange(ZERO)
    check = bench.check()
    assert check.verdict is Verdict.PASSED, check.reason
    for one, kind in zip(check.measures, (first, second), strict=True):
        assert one.value == pytest.approx(TIMES[kind], abs=0.02)
    bench.arm.close()


def download(node: int, index: int, sub: int, size: int, value: int) -> Frame:
    """A write of somebody else into a drive: its watchdog is another than what was read back when it was opened."""
    head = {1: 0x2F, 2: 0x2B, 4: 0x23}[size]
    return Frame(0x600 + node, struct.pack("<BHB", head, index, sub) + value.to_bytes(4, "little"))


def slowed(kind: str, node: int, milliseconds: int) -> Frame:
    """Return the frame that sets the time of a drive's watchdog."""
    return {
        "rpdo_timer": download(node, 0x1400, 5, 2, milliseconds),
        "heartbeat": download(node, 0x1016, 1, 4, 127 << 16 | milliseconds),
        "node_guarding": download(node, 0x100C, 0, 2, round(milliseconds / 3)),
        "sync_loss": download(node, 0x2F70, 0, 1, round(milliseconds / 2)),
        "vendor": download(node, 0x2F75, 0, 2, milliseconds),
    }[kind]


@pytest.mark.parametrize("kind", KINDS)
def test_a_watchdog_that_acts_later_than_described_gives_no_ticket(kind: str) -> None:
    """Thrice the time, and a little: twice it and ten cycles are within what a report may take."""
    bench = Bench(arm_of(kind, kind))
    bench.taps[0].disturb([slowed(kind, 2, round(3000 * TIMES[kind]) + 30)])
    for _ in range(20):
        bench.arm.exchange(ZERO)
    check = bench.check()
    assert check.verdict is Verdict.FAILED
    turn, slide = check.measures
    assert turn.within_limits
    assert not slide.within_limits
    assert slide.most == pytest.approx(2.0 * TIMES[kind] + 10 * PERIOD + 0.005)
    assert "slide: drive 2" in check.reason
    bench.arm.close()


LONGEST = 0.1  # s, for what can fall
SLOW: dict[str, dict[str, Any]] = {
    "rpdo_timer": {"torque_deadline": LONGEST},
    "heartbeat": {"heartbeats": BEATS | {"host_timeout": LONGEST}},
    "node_guarding": {"guarding": {"period": 0.033, "factor": 3}},
    "sync_loss": {},
    "vendor": {},
}


def heavy(kind: str, reason: str = "") -> ArmConfig:
    """An arm whose first joint gravity moves, and whose drives act as late as such an arm's may."""
    config = arm_of(kind, kind, watchdog_reason=reason, **SLOW[kind]).model_dump(mode="json", by_alias=True)
    config["gravity"] = (0.0, -9.81, 0.0)
    config["driver"]["emulation"]["truth"] = {"m1": 0.5, "lx1": 0.1, "Lxx1": 0.1, "Lyy1": 0.1, "Lzz1": 1.0, "m2": 1.0}
    for drive in config["driver"]["drives"]:
        if kind in ("sync_loss", "vendor"):
            drive["watchdog_time"] = LONGEST
            drive["watchdog_entry"]["value"] = round(1e3 * LONGEST / (2.0 if kind == "sync_loss" else 1.0))
    return ArmConfig.model_validate(config)


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("reason", ["", "it hangs from a spring"])
@pytest.mark.parametrize("kind", KINDS)
def test_what_can_fall_is_given_no_ticket_where_a_watchdog_acts_after_more_than_a_tenth_of_a_second(
    kind: str, reason: str, late: bool
) -> None:
    """0.18 s are within twice the described time, which is enough for an arm that cannot fall."""
    bench = Bench(heavy(kind, reason))
    bench.taps[0].disturb([slowed(kind, node, 180) for node in (1, 2)] if late else [])
    check = bench.check()
    bench.arm.close()
    assert [one.value for one in check.measures] == pytest.approx([0.18 if late else LONGEST] * 2, abs=0.03)
    allowed = 2.0 * LONGEST if reason else LONGEST
    assert [one.most for one in check.measures] == pytest.approx([allowed + 10 * PERIOD + 0.005] * 2, abs=0.003)
    assert check.verdict is (Verdict.FAILED if late and not reason else Verdict.PASSED), check.reason


def test_one_of_a_differential_that_ignores_its_watchdog_does_not_hide_behind_the_other() -> None:
    coupled = {"ratios": [2.0, -2.0], "coupling": [[1.0, -0.5], [1.0, 0.5]], "drive_terms": "joints"}
    plain = arm_of("rpdo_timer", "rpdo_timer").model_dump(mode="json", by_alias=True)
    bench = Bench(ArmConfig.model_validate(plain | {"transmission": coupled}), "watchdog_ignored joint=slide")
    for _ in range(20):
        bench.arm.exchange(ZERO)
    check = bench.check()
    assert check.verdict is Verdict.FAILED
    assert [one.value is None for one in check.measures] == [False, True]
    bench.arm.close()


def test_after_a_proof_the_arm_is_enabled_and_fed_again() -> None:
    bench = Bench(arm_of("heartbeat", "node_guarding"))
    bench.check()
    for _ in range(50):
        bench.arm.exchange(None)
    bench.arm.enable()
    for _ in range(100):
        sample = bench.arm.exchange(ZERO)
    assert all("operation enabled" in state for state in bench.behind.emulator.states)
    assert sample.valid.all()
    bench.arm.close()
    bench.behind.settle(bench.arm.clock.now_ns() + 10**9)
    assert all("error" not in state for state in bench.behind.emulator.states)


def test_a_host_that_dies_is_missed_by_guarded_drives() -> None:
    bench = Bench(arm_of("node_guarding", "node_guarding"))
    for _ in range(20):
        bench.arm.exchange(ZERO)
    bench.behind.settle(bench.arm.clock.now_ns() + 200_000_000)
    assert not any("operation enabled" in state for state in bench.behind.emulator.states)
    assert any(frame.remote and frame.identifier == HEARTBEAT + 2 for frame in bench.taps[0].sent)


def test_a_makers_entry_is_read_back() -> None:
    fixed = {"name": "other.eds", "text": EDS.replace("[2F75]\nParameterName=Longest time without a target torque\n"
             "ObjectType=0x7\nDataType=0x0006\nAccessType=rw", "[2F75]\nParameterName=Fixed\n"
             "ObjectType=0x7\nDataType=0x0006\nAccessType=ro")}  # fmt: skip
    bench = LockStepArm(arm_of("vendor", "vendor", eds=fixed))
    arm = CanopenArm(arm_of("vendor", "vendor"), lambda _: [bench.link(0)])
    with pytest.raises(DriverError, match="2F75h:00 watchdog of the drive's maker"):
        arm.open()


def test_the_deceleration_of_quick_stops_is_that_of_the_joints_and_is_read_back() -> None:
    config = arm_of("rpdo_timer", "rpdo_timer")
    joints = {name: one.model_dump(mode="json") | {"acceleration": 8.0} for name, one in config.joints.items()}
    gears = {"ratios": [50.0, 20.0], "drive_terms": "joints"}
    changed = {"joints": joints, "transmission": gears}
    config = ArmConfig.model_validate(config.model_dump(mode="json", by_alias=True) | changed)
    bench = Bench(config)
    bench.arm.stop(StopKind.TORQUE_OFF)
    assert isinstance(config.driver, CanopenDriver)
    assert config.transmission is not None
    wanted = quick_stop_decelerations(config.driver, config.transmission, [8.0, 8.0])
    assert wanted == [round(8.0 * ratio * 65536 / (2.0 * np.pi)) for ratio in (50.0, 20.0)]
    held = [face.objects.number(0x6085) for face in bench.behind.emulator.faces]  # type: ignore[attr-defined]
    assert held == wanted
    bench.arm.close()
    gentle = EDS.replace(
        "[6085]\nParameterName=Quick stop deceleration\nObjectType=0x7\nDataType=0x0007\nAccessType=rw",
        "[6085]\nParameterName=Quick stop deceleration\nObjectType=0x7\nDataType=0x0007\nAccessType=ro",
    )
    assert gentle != EDS
    own = config.model_copy(update={"driver": config.driver.model_copy(update={"drives": tuple(
        drive.model_copy(update={"quick_stop_deceleration": 2**31}) for drive in config.driver.drives)})})  # fmt: skip
    behind = LockStepArm(arm_of("rpdo_timer", "rpdo_timer", eds={"name": "g.eds", "text": gentle}))
    with pytest.raises(DriverError, match=r"brakes by \d+ in a quick stop"):
        CanopenArm(own, lambda _: [behind.link(0)]).open()


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"watchdog": "sync_loss"}, "needs watchdog_time"),
        ({"watchdog": "vendor", "watchdog_time": 0.02}, "needs watchdog_entry"),
        ({"watchdog": "heartbeat", "watchdog_time": 0.02}, "has its own key"),
        ({"watchdog_entry": {"index": 0x2000, "type": "u8", "value": 256}}, "256 is no u8"),
        ({"watchdog_entry": {"index": 0x6007, "type": "u8", "value": 2}}, "less than 24576"),
    ],
)
def test_a_watchdog_that_is_half_described_is_a_mistake(keys: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        CanopenDrive.model_validate(DRIVE | {"node": 1, "max_torque": 5.0} | keys)


def told(config: ArmConfig, rate: float = 500.0) -> list[str]:
    assert isinstance(config.driver, CanopenDriver)
    return [what for _, what in disagreements(config.driver, config.transmission, list(config.joints), rate)]


def test_drives_that_would_do_nothing_are_refused_unless_the_maker_has_a_reaction_of_its_own() -> None:
    nothing = {"reactions": {"abort_connection": 0}}
    assert any("abort_connection: 0" in what for what in told(arm_of("rpdo_timer", "vendor", **nothing)))
    assert told(arm_of("vendor", "vendor", **nothing)) == []
    assert any("too short to ask 2 drives" in what for what in told(arm_of("node_guarding", "node_guarding"), 100.0))


def test_node_guarding_is_in_the_budget_and_heartbeats_of_guarded_drives_are_not() -> None:
    config = arm_of("node_guarding", "rpdo_timer")
    assert isinstance(config.driver, CanopenDriver)
    lines = {line.name: line for line in budget(config.driver, 500.0).buses[0].lines}
    assert lines["requests of node guarding"].cob_ids == (0x701,)
    assert lines["heartbeats of the drives"].cob_ids == (0x702,)
    assert lines["answers to them"].per_second == pytest.approx(1.0 / 0.014)
    assert Write(Entry(0x100C, 0, Kind.U16, "x", "ms"), 20).data == Write(od.GUARD_TIME, 20).data
