"""`ident bus load`, `ident config check` and preflight on the shipped CANopen arms and on spoiled ones."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from can_arms import MAX_TORQUE, RATED

from drivers.canopen.motor_units import coordinates
from ident_service.cli import DONE, USAGE, VERDICT_NO, main
from ident_service.config.canopen import CanopenDriver, disagreements
from ident_service.config.load import load_arm
from ident_service.config.motion_limits import motion_limits
from ident_service.errors import ConfigError
from ident_service.model.arm_model import arm_model
from ident_service.motion.arm_factory import make_arm
from ident_service.motion.ticket import Verdict
from ident_service.preflight.static_checks import configuration_check, stability_check

ARMS = ("wam7_canopen", "wam7_canopen_500hz")


def extended(folder: Path, driver: str, base: str = "wam7_canopen") -> Path:
    """A shipped arm with other keys in its driver."""
    path = folder / "mine.yaml"
    path.write_text(f"extends: {base}.yaml\nname: mine\ndriver: {{kind: canopen, {driver}}}\n", encoding="utf-8")
    return path


def answered(capsys: pytest.CaptureFixture[str], *words: object) -> dict[str, Any]:
    code = main([str(word) for word in (*words, "--json")])
    document: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert document["exit_code"] == code
    return document


@pytest.mark.parametrize(
    ("arm", "worst", "typical"), [("wam7_canopen", 98.9, 87.6), ("wam7_canopen_500hz", 50.4, 44.7)]
)
def test_shipped_arms_fit(
    arms: Path, capsys: pytest.CaptureFixture[str], arm: str, worst: float, typical: float
) -> None:
    document = answered(capsys, "bus", "load", arms / f"{arm}.yaml")
    (bus,) = document["buses"]
    assert document["exit_code"] == DONE
    assert document["fits"]
    assert bus["load_percent"]["worst"] == pytest.approx(worst, abs=0.06)
    assert bus["load_percent"]["typical"] == pytest.approx(typical, abs=0.3)
    assert bus["cycle_us"]["worst"] == 970.0
    cyclic = [frame for frame in bus["frames"] if frame["cyclic"]]
    assert sum(len(frame["cob_ids"]) * frame["us"]["worst"] for frame in cyclic) == 970.0
    assert sorted(i for frame in cyclic for i in frame["cob_ids"]) == [0x080, *range(0x181, 0x188), 0x201, 0x205]


def test_a_person_sees_every_frame(arms: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bus", "load", str(arms / "wam7_canopen.yaml")]) == DONE
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "wam7_canopen at 1000 Hz: fits"
    row = next(line for line in lines if line.startswith("  torques of nodes 1, 2, 3, 4"))
    assert row.split()[-9:] == ["201", "8", "1000", "111.0", "119.4", "135.0", "11.1", "11.9", "13.5"]
    assert "  highest rate: 1010 Hz" in lines


def test_over_budget_is_a_verdict_with_remedies(arms: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = extended(arms, "torque_frames: single")
    document = answered(capsys, "bus", "load", path)
    assert document["exit_code"] == VERDICT_NO
    assert not document["fits"]
    assert len(document["remedies"]) == 4
    assert main(["bus", "load", str(path)]) == VERDICT_NO
    words = capsys.readouterr().out
    assert "DOES NOT FIT" in words
    assert all(f"  - {remedy}\n" in words for remedy in document["remedies"])
    assert answered(capsys, "bus", "load", path, "--rate", "500")["exit_code"] == DONE


def test_another_rate_can_be_requested(arms: Path, capsys: pytest.CaptureFixture[str]) -> None:
    document = answered(capsys, "bus", "load", arms / "wam7_canopen_500hz.yaml", "--rate", "1100")
    assert (document["exit_code"], document["rate"], document["highest_rate"]) == (VERDICT_NO, 1100.0, 1010)


def test_arms_without_a_bus_have_no_load(capsys: pytest.CaptureFixture[str]) -> None:
    document = answered(capsys, "bus", "load", "wam7_sim")
    assert document["exit_code"] == USAGE
    assert "driver 'simulated'" in document["error"]["message"]


def test_config_check_says_the_load_or_refuses_it(arms: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", "check", str(arms / "wam7_canopen.yaml")]) == DONE
    assert "\nbus 0 (can0): 98.9 % worst, 87.6 % typical at 1000 Hz; up to 1010 Hz\n" in capsys.readouterr().out
    path = extended(arms, "torque_frames: single")
    document = answered(capsys, "config", "check", path)
    assert document["exit_code"] == USAGE
    assert document["error"]["message"].startswith(f"{path}:3:1: driver: bus 0 (can0) is over budget at 1000 Hz")
    assert "torque_frames: shared" in document["error"]["message"]


def test_preflight_refuses_what_is_over_budget(arms: Path) -> None:
    fits, over = load_arm(arms / "wam7_canopen.yaml"), load_arm(extended(arms, "torque_frames: single"))
    good = configuration_check(arm_model(fits), make_arm(fits).bus_budget())
    assert good.verdict is Verdict.PASSED
    bad = configuration_check(arm_model(over), make_arm(over).bus_budget())
    assert bad.verdict is Verdict.FAILED
    assert "over budget" in bad.reason
    assert "500 Hz" in bad.remedy


@pytest.mark.parametrize("arm", ARMS)
def test_shipped_arms_are_stable_and_their_drives_give_what_their_joints_may(arms: Path, arm: str) -> None:
    config = load_arm(arms / f"{arm}.yaml")
    model, limits = arm_model(config), motion_limits(config)
    assert stability_check(model, limits, None).verdict is Verdict.PASSED
    assert isinstance(config.driver, CanopenDriver)
    assert config.transmission is not None
    gears = coordinates(config.driver, config.transmission)
    assert (gears.torque_limit >= limits.torque).all()
    # Drives must not limit a speed that the joints may have, both of a differential at once.
    counts = np.abs(np.linalg.inv(gears.joint_per_count)) @ limits.velocity
    turns = counts / [drive.counts for drive in config.driver.drives] * 60.0
    speeds = np.array([drive.max_speed for drive in config.driver.drives])
    assert (speeds >= 1.2 * turns).all()
    assert (speeds <= 1.3 * turns).all()
    assert [drive.max_torque for drive in config.driver.drives] == list(MAX_TORQUE)
    assert [drive.rated_torque for drive in config.driver.drives] == list(RATED)


def test_a_drive_that_would_take_its_torque_back_below_a_joints_velocity_limit_is_a_mistake(arms: Path) -> None:
    config = load_arm(arms / "wam7_canopen.yaml")
    assert isinstance(config.driver, CanopenDriver)
    names, rate = list(config.joints), config.control.rate

    def told(j4: float) -> list[str]:
        velocities = [j4 if name == "j4" else joint.velocity for name, joint in config.joints.items()]
        return [
            what
            for _, what in disagreements(config.driver, config.transmission, names, rate, velocities=velocities)  # type: ignore[arg-type]
        ]

    # 18 turns of motor 4 a turn of j4, and 430 turns a minute: 2.502 rad/s.
    assert told(2.5) == []
    (what,) = told(2.51)
    assert "node 4 would give no torque above max_speed 430" in what
    assert "its motor turns at 431" in what


def test_a_joints_torque_limit_and_what_its_gears_give_are_not_units_apart() -> None:
    """Before anything is energised: N m m for N m, or a gear left out, is a factor of 10 or 1000 somewhere."""
    config = load_arm("wam7_canopen")
    driver, names = config.driver, list(config.joints)
    limits = [joint.torque for joint in config.joints.values()]

    def told(factor: float) -> list[str]:
        torques = [None if limit is None else factor * limit for limit in limits]
        return [what for _, what in disagreements(driver, config.transmission, names, 500.0, torques=torques)]  # type: ignore[arg-type]

    assert told(1.0) == []
    for factor in (1e3, 1e-3):
        assert len(told(factor)) == len(names)
        assert "which is another unit or gear" in told(factor)[0]


def test_the_identified_parameters_are_those_of_the_simulated_wam(arms: Path) -> None:
    real, simulated = (arm_model(load_arm(arms / f"{name}.yaml")) for name in ("wam7_canopen", "wam7_sim"))
    np.testing.assert_array_equal(real.chain.coupling, simulated.chain.coupling)
    assert real.config.driver is not None
    assert real.config.driver.emulation.truth == simulated.config.driver.truth  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("driver", "complaint"),
    [
        ("eds: bare.eds", "bare.eds has no Dummy0003=1 under [DummyUsage]"),
        ("buses: [{}, {channel: can1}]", "no drive is on bus 1"),
        ("buses: [{}, {}]", "two buses are socketcan can0"),
        ("buses: [{bitrate: 2000000}]", "at most 1000000"),
        ("buses: [{data_bitrate: 500000}]", "data_bitrate 500000 is below bitrate 1000000"),
        ("torque_deadline: 0.001", "at least 2 cycles are needed, 0.002 s"),
        ("heartbeats: {timeout: 0.05}", "not longer than the heartbeats' periods"),
        ("torque_deadline: 0.0001", "at least 0.001"),
        ("status: {inhibit: 7.0}", "at most 6.5"),
        ("drives: [{node: 1, rated_torque: 0.0000005, max_torque: 0.01, max_speed: 1}]", "not whole uN m"),
        ("drives: [{node: 1, rated_torque: 0.01, max_torque: 0.5, max_speed: 1}]", "50 times rated_torque"),
    ],
)
def test_mistakes_are_reported_with_their_place(arms: Path, driver: str, complaint: str) -> None:
    (arms / "bare.eds").write_text("[DeviceInfo]\n[DummyUsage]\nDummy0003=0\n", encoding="utf-8")
    path = extended(arms, driver)
    with pytest.raises(ConfigError) as caught:
        load_arm(path)
    first = caught.value.problems[0]
    assert complaint in first.message
    assert (first.path, first.line) == (path, 3)


@pytest.mark.parametrize("eds", ["", "[DummyUsage]\nDummy0003=x\n", "[FileInfo]\nA=1\n"])
def test_drives_share_frames_only_where_their_eds_says_so(arms: Path, eds: str) -> None:
    (arms / "bare.eds").write_text(f"[DeviceInfo]\n{eds}", encoding="utf-8")
    with pytest.raises(ConfigError, match="Dummy0003=1"):
        load_arm(extended(arms, "eds: bare.eds"))
    assert load_arm(extended(arms, "eds: bare.eds, torque_frames: single")).name == "mine"


@pytest.mark.parametrize("frames", ["shared", "single"])
@pytest.mark.parametrize(
    ("eds", "why"),
    [
        ("", "it lists no object"),
        ("no EDS at all", "it lists no object"),
        ("\x00\x01", "it lists no object"),
        ("[FileInfo]\nA=1\n", "it lists no object"),
    ],
)
def test_what_is_no_eds_is_refused_however_torques_are_sent(arms: Path, eds: str, why: str, frames: str) -> None:
    (arms / "junk.eds").write_text(eds, encoding="utf-8")
    with pytest.raises(ConfigError, match=rf"driver\.eds: junk\.eds is not an EDS \(CiA 306\): {why}"):
        load_arm(extended(arms, f"eds: junk.eds, torque_frames: {frames}"))


@pytest.mark.parametrize(
    "eds", ["[DeviceInfo]\n[DummyUsage]\nDummy0003=0x1\n", "[deviceinfo]\n[dummyusage]\nDUMMY0003 = 1\n"]
)
def test_edss_are_read_as_their_standard_writes_them(arms: Path, eds: str) -> None:
    (arms / "other.eds").write_text(eds, encoding="utf-8")
    assert load_arm(extended(arms, "eds: other.eds")).name == "mine"
