"""Runs of an arm whose drives are given positions: the whole job, and how each fault ends it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from canopen_run_bench import MIDST, Moved, canopen, checked, described, moved_arm, truth, write

from drivers.canopen.driver import CanopenArm
from ident_service.cli import main
from ident_service.config.load import load_arm
from ident_service.config.motion_limits import motion_limits
from ident_service.errors import ConfigError, DriverError
from ident_service.model.arm_model import arm_model
from ident_service.model.base_parameters import base_parameters
from ident_service.model.expected_friction import expected_friction
from ident_service.motion.ticket import Check, Verdict
from ident_service.motion.trajectory import hold
from ident_service.preflight.active_checks import DWELL, plan_strokes
from ident_service.preflight.session import Session
from ident_service.preflight.watchdog import watchdog_check
from ident_service.recordings.open import open_recording
from sim_backend.emulator.faults import parse_fault
from sim_backend.emulator.lock_step import LockStepArm

pytestmark = pytest.mark.slow  # whole runs

RATE = 250.0
SHEETS = Path(__file__).parents[3] / "shared" / "data" / "eds"


def positions(name: str, **driver: Any) -> dict[str, Any]:
    """The small arm behind drives that close the position loop by themselves."""
    tree = canopen(
        described(name, RATE, 225.0, 30.0), {"interface": "lock_step"}, 2, **{"streams": "position"} | driver
    )
    for drive in tree["driver"]["drives"]:
        drive["rated_torque"] = 1.0
    return tree


def of_makers(name: str) -> dict[str, Any]:
    """The same behind drives of two makers, by their files."""
    files = [str(SHEETS / one) for one in ("maxon_epos4_50-5_0170h.eds", "e35.eds")]
    dogs = ("heartbeat", "node_guarding")
    # No more than the rated torque, to which the second one's 6073h limits it.
    drive = {"counts": 65536, "rated_torque": 1.2, "max_torque": 1.2, "max_speed": 6000.0}
    drives = [drive | {"node": k, "eds": file, "watchdog": dogs[k - 1]} for k, file in enumerate(files, 1)]
    beats = {"period": 0.02, "timeout": 0.11, "host_timeout": 0.06}
    section = {"eds": files[0], "drives": drives, "heartbeats": beats, "status": {"period": 0.1, "inhibit": 0.01}}
    tree = canopen(described(name, RATE, 225.0, 30.0), {"interface": "lock_step"}, 2, **section, streams="position")
    tree["driver"]["emulation"]["eds"] = files
    return tree


@pytest.mark.campaign
@pytest.mark.parametrize("make", [positions, of_makers])
def test_an_arm_is_checked_moved_and_identified_from_the_torque_that_its_drives_measure(
    make: Any, tmp_path: Path
) -> None:
    if make is of_makers and not SHEETS.is_dir():
        pytest.skip("the makers' data sheets are not beside this checkout")
    arm = write(tmp_path, make("positions"))
    state, folder, out = tmp_path / "state", tmp_path / "run", tmp_path / "out"
    assert checked(arm, "positions", state)
    ticket = json.loads((state / "arms" / "positions" / "ticket.json").read_text())
    verdicts = {check["code"]: check["verdict"] for check in ticket["checks"]}
    assert {code: verdicts[code] for code in ("gravity", "direction", "watchdog")} == {
        "gravity": "passed",
        "direction": "passed",
        "watchdog": "passed",
    }
    assert main(["run", str(arm), "--out", str(folder), "--state", str(state)]) == 0
    recording = open_recording(folder / "run.mcap", ("shoulder", "elbow"))
    stamps = np.concatenate([block.stamp_ns for block in recording.blocks()])
    np.testing.assert_array_equal(np.diff(stamps), round(1e9 / RATE))
    assert (
        main(["identify", str(folder / "run.mcap"), "--arm", str(arm), "--out", str(out), "--state", str(state)]) == 0
    )
    document = json.loads((out / "parameters.json").read_text())
    assert document["torque"] == "measured"
    model = arm_model(load_arm(arm))
    base = base_parameters(model.chain, model.layout)
    expected = base.K @ np.array([truth().get(name, 0.0) for name in model.layout.names])
    found = document["base_parameters"]
    z = (np.array(found["values"]) - expected) / np.array(found["standard_deviations"])
    # 13 figures: none beyond what one in ten thousand is, nor all of them together.
    assert np.abs(z).max() < 4.0, dict(zip(base.expressions, z, strict=True))
    assert z @ z < 35.0, dict(zip(base.expressions, z, strict=True))


def silent_in_motion(folder: Path, share: float, counts: int = 65536, fault: str = "") -> tuple[Check, float]:
    """The watchdog's check of the arm behind two plain gears, at a share of the way that its shoulder goes.

    Returns:
        The check, and the shoulder's largest true speed [rad/s].
    """
    tree = positions("silent", torque_deadline=0.05) | {"transmission": {"ratios": [20.0, 20.0]}}
    for drive in tree["driver"]["drives"]:
        drive["counts"] = counts
    config = load_arm(write(folder, tree))
    behind, model, speeds = LockStepArm(config), arm_model(config), list[float]()
    behind.emulator.observer = lambda seen: speeds.append(abs(seen.velocity[0]))
    with CanopenArm(config, lambda _: [behind.link(0)]) as arm:
        limits, home = motion_limits(config), arm.exchange(None).position
        friction = expected_friction(model, limits, config.design.friction_guess)
        session = Session(arm, model, limits, arm.describe(), home, friction)
        stroke = plan_strokes(session, model, limits, only_joint=0)[0]
        begin = DWELL + share * stroke.there.duration
        session.energise()
        session.follow(hold(home), 0.2)
        session.follow(stroke, begin)
        if fault:
            behind.inject(parse_fault(fault, tuple(config.joints)))
        return watchdog_check(arm, model, session, lambda time: stroke.at(begin + time), 0), max(speeds)


# Their reports come 0.09 s after the silence began, so that the arm sinks unseen; and the joint stands between counts.
@pytest.mark.parametrize(("share", "counts"), [(0.5, 65536), (0.61, 1000)])
def test_drives_that_are_given_no_more_positions_may_stand(share: float, counts: int, tmp_path: Path) -> None:
    check, _ = silent_in_motion(tmp_path, share, counts)
    assert check.verdict is Verdict.PASSED, check.reason


@pytest.mark.parametrize("share", [0.2, 0.55])
def test_an_encoder_that_freezes_when_no_more_positions_are_given_is_found(share: float, tmp_path: Path) -> None:
    """By the drive's push, or by what it says when the drive has stopped; the arm goes no faster than it sinks."""
    check, speed = silent_in_motion(tmp_path, share, fault="frozen_encoder joint=shoulder duration=5")
    assert check.verdict is Verdict.FAILED
    assert check.reason is not None
    assert "shoulder: position unchanged to the last bit" in check.reason
    assert speed < 0.9


def moved(folder: Path, fault: str = "", stop_at: float | None = None, **driver: Any) -> Moved:
    """A short motion of it, with a fault in its midst."""
    return moved_arm(folder, positions("faulty", **driver), fault, stop_at)


def test_a_run_ends_where_it_began_and_a_stop_is_a_stop(tmp_path: Path) -> None:
    done = moved(tmp_path)
    assert done.report is not None
    assert done.report.state.value == "done"
    assert done.report.warnings == {}
    assert done.off
    stopped = moved(tmp_path, stop_at=MIDST)
    assert stopped.report is not None
    assert stopped.story.states[-2:] == ["stopping", "stopped"]
    assert stopped.off


@pytest.mark.parametrize(
    ("fault", "codes"),
    [
        ("frozen_encoder joint=elbow duration=5", ("frozen_encoder", "torque_unexplained")),
        ("lost_feedback joint=elbow duration=1", ("feedback_gone",)),
        ("encoder_jump joint=elbow duration=1 size=0.1", ("encoder_jumps", "feedback_gone", "following_error")),
        ("drive_fault joint=elbow", ("drive_emergency", "drive_fault")),
        ("emergency joint=elbow size=0x4310", ("drive_emergency", "drive_fault")),
        ("node_silent joint=elbow", ("feedback_gone",)),
        ("bus_gone", ("driver", "feedback_gone", "bus_silent", "bus_off")),
        (
            "torque_sign joint=elbow",
            ("runaway", "following_error", "following_lost", "over_velocity", "torque_exceeded"),
        ),
        ("load_attached size=6", ("torque_unexplained",)),
        ("watchdog_ignored joint=elbow", ()),
    ],
)
def test_each_fault_ends_the_motion_by_its_name_and_leaves_no_drive_enabled(
    fault: str, codes: tuple[str, ...], tmp_path: Path
) -> None:
    came = moved(tmp_path, fault)
    if codes:
        assert came.fault is not None, came.report
        assert came.fault.code in codes, came.fault
    else:
        assert came.fault is None
    assert came.off
    # However it ended, no joint was ever much faster than it may be.
    assert (np.max(came.speed, axis=0) < 2.5 * np.array([2.0, 3.0])).all()


def test_a_joint_that_is_lost_is_stopped_by_its_drive_and_not_lowered(tmp_path: Path) -> None:
    """No torque of ours can lower it."""
    came = moved(tmp_path, "torque_saturation joint=shoulder size=0.02")
    assert came.fault is not None
    assert came.fault.code in ("following_error", "following_lost", "repeated_warnings", "over_velocity", "runaway")
    assert "stopping" not in came.story.states or came.story.states[-1] in ("faulted", "stopped")
    assert came.off


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"control": {"rate": 1000.0}}, r"driver.streams: positions are streamed at 100 to 500 Hz"),
        ({"control": {"rate": 50.0}}, r"driver.streams: positions are streamed at 100 to 500 Hz"),
        ({"control": {"rate": RATE, "after_stop": "lower"}}, r"control.after_stop: .* cannot lower an arm by torque"),
        ({"identification": {"torque": "commanded"}}, r"identification.torque: .* no torque is commanded"),
    ],
)
def test_what_does_not_go_with_positions_is_a_mistake_of_the_description(
    changes: dict[str, Any], words: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=words):
        load_arm(write(tmp_path, positions("wrong") | changes))


def test_drives_that_tell_no_torque_cannot_be_given_positions(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"driver.measured_torque: .* must tell their torque in every cycle"):
        load_arm(write(tmp_path, positions("wrong", measured_torque="none")))


def test_a_drive_that_does_not_take_the_period_is_refused(tmp_path: Path) -> None:
    config = load_arm(write(tmp_path, positions("period")))
    behind = LockStepArm(config)
    objects = behind.emulator.faces[0].objects  # type: ignore[attr-defined]
    key = 0x60C201
    objects.entries[key] = objects.entries[key].__class__(**{**objects.entries[key].__dict__, "high": 1})
    with pytest.raises(DriverError, match="60C2h"):
        CanopenArm(config, lambda _: [behind.link(0)]).open()
