"""Faults from a file: each by name, time, duration and size; mistakes at their line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ident_service.config.load import load_arm
from ident_service.config.simulation import FAULT_RULES, FaultKind, SimulatedDriver, disagreements
from ident_service.errors import ConfigError, DriverError
from sim_backend.arm import from_config
from sim_backend.faults import Fault

TEXT = """format: ident-arm
version: 1
name: two
kinematics: {dh: {convention: standard, joints: {one: {a: 0.5}, two: {a: 0.5}}}}
gravity: [0, -9.81, 0]
joints:
  one: {torque: 40, velocity: 2}
  two: {torque: 15, velocity: 3}
control: {rate: 500}
driver:
  kind: simulated
  truth: {m1: 1, Lzz1: 0.3, m2: 1, Lzz2: 0.3}
  faults:
"""


def loaded(tmp_path: Path, *lines: str):
    path = tmp_path / "two.yaml"
    path.write_text(TEXT + "".join(f"    - {line}\n" for line in lines))
    return load_arm(path)


def mistakes(tmp_path: Path, line: str) -> list[tuple[int, int, str]]:
    with pytest.raises(ConfigError) as caught:
        loaded(tmp_path, "{kind: nan_position, at: 1}", line)
    return [(problem.line, problem.column, problem.message) for problem in caught.value.problems]


def test_names_and_seconds_become_numbers_and_cycles(tmp_path):
    config = loaded(
        tmp_path,
        "{kind: frozen_encoder, joint: two, at: 12.5, duration: 0.2}",
        "{kind: encoder_offset, joint: one, cycle: 7, size: -0.25}",
        "{kind: load_attached, at: 0, size: 2.5, offset: [0, 0, 0.1]}",
        "{kind: emergency_stop, at: 0.001}",
    )
    assert from_config(config).faults == (
        Fault(6250, FaultKind.FROZEN_ENCODER, 1, 100),
        Fault(7, FaultKind.ENCODER_OFFSET, 0, None, -0.25),
        Fault(0, FaultKind.LOAD_ATTACHED, None, None, 2.5, (0.0, 0.0, 0.1)),
        Fault(0, FaultKind.EMERGENCY_STOP),
    )


def test_configured_faults_strike_beside_others(tmp_path):
    config = loaded(tmp_path, "{kind: encoder_offset, joint: two, at: 0.006, size: 1}")
    arm = from_config(config, faults=[Fault(2, FaultKind.LOST_FEEDBACK, 0)])
    with arm:
        samples = [arm.exchange(None) for _ in range(5)]
    assert [s.position[1] for s in samples] == [0.0, 0.0, 0.0, 1.0, 1.0]
    assert [bool(s.valid[0]) for s in samples] == [True, True, False, True, True]


@pytest.mark.parametrize("kind", list(FaultKind))
def test_every_kind_can_be_described(tmp_path, kind):
    rule = FAULT_RULES[kind]
    size = ", size: 0.01" if rule.size else ""
    joint = ", joint: one" if rule.of_joint else ""
    (fault,) = from_config(loaded(tmp_path, f"{{kind: {kind.value}, at: 1, duration: 0.5{size}{joint}}}")).faults
    assert (fault.at_cycle, fault.kind, fault.duration) == (500, kind, 250)
    assert fault.strikes(500)
    assert fault.strikes(749)
    assert not fault.strikes(499)
    assert not fault.strikes(750)


@pytest.mark.parametrize(
    ("line", "mark", "message"),
    [
        pytest.param("{kind: sunspots, at: 1}", "kind", "'lost_feedback'", id="kind"),
        pytest.param("{kind: lost_feedback, at: -1}", "at:", "must be at least 0 [s], not -1", id="time"),
        pytest.param("{kind: lost_feedback, at: 1, duration: 0}", "duration", "greater than 0", id="duration"),
        pytest.param("{kind: lost_feedback, at: 1, force: 3}", "force", "unknown key 'force'", id="key"),
        pytest.param("{kind: lost_feedback}", "{", "exactly one of at and cycle", id="no time"),
        pytest.param("{kind: lost_feedback, at: 1, cycle: 2}", "{", "exactly one of at and cycle", id="two times"),
        pytest.param("{kind: encoder_jump, at: 1}", "{", "needs a size: [rad or m]", id="no size"),
        pytest.param("{kind: lost_feedback, at: 1, size: 2}", "{", "has no size", id="size"),
        pytest.param("{kind: hidden_delay, at: 1, size: -2}", "{", "negative", id="negative delay"),
        pytest.param("{kind: torque_saturation, at: 1, size: 2}", "{", "above 1", id="share"),
        pytest.param("{kind: emergency_stop, at: 1, joint: one}", "{", "whole arm", id="joint"),
        pytest.param("{kind: nan_position, at: 1, offset: [0, 0, 0]}", "{", "has no offset", id="offset"),
    ],
)
def test_a_mistake_is_reported_where_it_stands(tmp_path, line, mark, message):
    ((row, column, text),) = mistakes(tmp_path, line)
    assert (row, column) == (15, 7 + line.index(mark))
    assert message in text


def test_an_unknown_joint_is_reported_by_name():
    driver = SimulatedDriver.model_validate(
        {
            "kind": "simulated",
            "braking": (1.0,),
            "faults": ({"kind": "nan_position", "at": 0.0}, {"kind": "nan_position", "at": 0.0, "joint": "six"}),
        }
    )
    assert list(disagreements(driver, ("one", "two"), 500.0)) == [
        (("driver", "braking"), "driver.braking: 1 values for 2 joints"),
        (("driver", "faults", 1, "joint"), "driver.faults.1.joint: 'six' is none of one, two"),
    ]
    assert list(disagreements(driver, (), 500.0)) == []


def test_an_unknown_joint_is_refused(tmp_path):
    with pytest.raises((DriverError, ConfigError), match="'six' is none of one, two"):
        from_config(loaded(tmp_path, "{kind: nan_position, joint: six, at: 1}"))


def test_a_load_is_a_point_mass_in_the_frame_of_the_last_link(tmp_path):
    loaded_arm = from_config(loaded(tmp_path, "{kind: load_attached, at: 0, size: 2, offset: [-0.1, 0.2, 0.3]}"))
    with loaded_arm as arm:
        arm.exchange(None)
    x, y, z, m = -0.1, 0.2, 0.3, 2.0
    point = {"Lxx2": y * y + z * z, "Lxy2": -x * y, "Lxz2": -x * z, "Lyy2": x * x + z * z, "Lyz2": -y * z}
    text = {name: m * value for name, value in point.items()}
    text |= {"lx2": m * x, "ly2": m * y, "lz2": m * z, "m2": 1.0 + m, "Lzz2": 0.3 + m * (x * x + y * y)}
    text |= {"m1": 1.0, "Lzz1": 0.3}
    base = loaded(tmp_path, "{kind: nan_position, at: 1}")
    driver = SimulatedDriver.model_validate({"kind": "simulated", "truth": text})
    heavy = from_config(base.model_copy(update={"driver": driver})).plant
    rng = np.random.default_rng(1)
    for _ in range(5):
        q, dq, ddq = rng.normal(size=(3, 2))
        np.testing.assert_allclose(
            loaded_arm.plant.inverse_dynamics(q, dq, ddq), heavy.inverse_dynamics(q, dq, ddq), rtol=1e-12
        )


def test_faults_must_be_a_list(tmp_path):
    path = tmp_path / "two.yaml"
    path.write_text(TEXT.replace("  faults:\n", "  faults: {kind: nan_position, at: 1}\n"))
    with pytest.raises(ConfigError) as caught:
        load_arm(path)
    assert [problem.message for problem in caught.value.problems] == ["driver.faults: must be a list, not a mapping"]


def test_a_watchdog_without_room_for_a_late_frame_is_refused_in_its_place(tmp_path):
    path = tmp_path / "two.yaml"
    text = TEXT.replace("  faults:\n", "").replace("rate: 500", "rate: 70")
    path.write_text(text + "  watchdog: 0.0285\n")
    with pytest.raises(ConfigError) as caught:
        load_arm(path)
    ((line, message),) = [(problem.line, problem.message) for problem in caught.value.problems]
    assert line == text.count("\n") + 1
    assert message == (
        "driver.watchdog: 0.0285 s at 70 Hz has no room for a late torque frame; at least 2 cycles are needed: "
        "set driver.watchdog to 0.0285714 s or more, or raise control.rate"
    )
    path.write_text(text)  # the default of 10 ms
    with pytest.raises(ConfigError, match=r"driver.watchdog: 0.01 s at 70 Hz"):
        load_arm(path)
    path.write_text(text + "  watchdog: 0.0285714\n")
    load_arm(path)
