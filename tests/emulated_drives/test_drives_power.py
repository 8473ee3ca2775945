"""States of an emulated drive, its reactions and its torque loop (CiA 402-2)."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from drives_bench import MS, Host, drives_config

from sim_backend.canopen_device.drive import TRANSITIONS, Command, PowerState, command_of
from sim_backend.emulator.faults import parse_fault
from sim_backend.emulator.motor import Power

# How each state is reached from power-up, and the controlword of each command.
WAYS = {0x40: (), 0x21: (0x06,), 0x23: (0x06, 0x07), 0x27: (0x06, 0x07, 0x0F), 0x07: (0x06, 0x07, 0x0F, 0x02)}
WORDS = {"disable voltage": 0x00, "quick stop": 0x02, "shutdown": 0x06, "switch on": 0x07, "enable": 0x0F}
# FIELDBUS.md 2.4 and the standard's figure of states: from, command, to; what is not here leaves the state as it is.
FIGURE = {
    (0x40, "shutdown"): 0x21,
    (0x21, "switch on"): 0x23,
    (0x21, "enable"): 0x27,
    (0x23, "enable"): 0x27,
    (0x27, "switch on"): 0x23,
    (0x23, "shutdown"): 0x21,
    (0x21, "quick stop"): 0x40,
    (0x21, "disable voltage"): 0x40,
    (0x27, "shutdown"): 0x21,
    (0x27, "disable voltage"): 0x40,
    (0x23, "disable voltage"): 0x40,
    (0x23, "quick stop"): 0x40,
    (0x27, "quick stop"): 0x07,
    (0x07, "disable voltage"): 0x40,
    (0x07, "enable"): 0x27,
}


PLAIN = {"ratios": [1.0, 1.0], "drive_terms": "joints"}


def word_of(host: Host, node: int = 1) -> int:
    word = host.read(node, 0x6041, 0, "H")
    return word & (0x6F if word & 0x20 or not word & 0x48 else 0x4F)


@pytest.mark.parametrize("state", WAYS)
@pytest.mark.parametrize("command", WORDS)
def test_every_state_obeys_every_command_as_the_figure_says(host: Host, state: int, command: str) -> None:
    assert host.write(1, 0x605A, 0, "h", 6) == 0  # stay in quick stop
    for word in WAYS[state]:
        assert host.write(1, 0x6040, 0, "H", word) == 0
    assert word_of(host) == state
    assert host.write(1, 0x6040, 0, "H", WORDS[command]) == 0
    assert word_of(host) == FIGURE.get((state, command), state)


def test_the_table_is_the_figure_and_no_more() -> None:
    names = {command_of(word): name for name, word in WORDS.items()}
    assert set(names) == set(Command)
    assert {(int(s), names[c]): int(t) for (s, c), t in TRANSITIONS.items()} == FIGURE


@pytest.mark.slow
@pytest.mark.parametrize(("option", "end"), [(0, 0x40), (2, 0x40), (6, 0x07)])
def test_where_a_quick_stop_ends(enabled: Host, option: int, end: int) -> None:
    for node in (1, 2):
        assert enabled.write(node, 0x605A, 0, "h", option) == 0
        assert enabled.write(node, 0x6085, 0, "I", 20000) == 0
    for _ in range(100):
        enabled.cycle(300, 100)
    speeds = enabled.arm.emulator.body.gears.motor_velocity(enabled.arm.emulator.body.plant.velocity)
    ramp = abs(speeds[0]) * 4096 / (2 * math.pi) / 20000
    begun = enabled.now
    enabled.control(0x02)
    assert enabled.arm.emulator.faces[0].state.endswith("switch on disabled" if option == 0 else "quick stop active")
    power = enabled.arm.emulator.body.motors[0].power
    assert power is (Power.COAST if option == 0 else Power.BRAKE)
    while option == 2 and "quick stop" in enabled.arm.emulator.states[0]:
        enabled.listen(0.2)
    if option == 2:
        assert (enabled.now - begun) * 1e-9 == pytest.approx(ramp, rel=0.1, abs=2e-3)
    enabled.listen(2000)
    assert word_of(enabled) == end


@pytest.mark.slow
@pytest.mark.parametrize(("option", "state", "power"), [(0, 0x08, Power.COAST), (2, 0x0F, Power.BRAKE)])
def test_a_fault_its_reaction_and_its_reset(enabled: Host, option: int, state: int, power: Power) -> None:
    assert enabled.write(1, 0x605E, 0, "h", option) == 0
    assert enabled.write(1, 0x6085, 0, "I", 100000) == 0
    for _ in range(100):
        enabled.cycle(300, 100)
    enabled.arm.inject(parse_fault("emergency joint=shoulder size=0x4310", ("shoulder", "elbow")))
    enabled.cycle(300, 100)
    assert enabled.emergencies() == [(1, 0x4310)]
    assert [enabled.read(1, 0x603F, 0, "H"), enabled.read(1, 0x1001, 0, "B")] == [0x4310, 0x09]
    assert word_of(enabled) == state
    assert enabled.arm.emulator.body.motors[0].power is power
    for _ in range(5000):
        enabled.cycle(0, 0)
    assert word_of(enabled) == 0x08
    enabled.control(0x0F, (1,))
    assert word_of(enabled) == 0x08
    enabled.control(0x8F, (1,))  # the edge of bit 7
    assert word_of(enabled) == 0x40
    enabled.listen(1)
    assert enabled.read(1, 0x1001, 0, "B") == 0


def test_a_reset_needs_an_edge(enabled: Host) -> None:
    enabled.control(0x8F)
    enabled.arm.inject(parse_fault("emergency size=0x2310", ()))
    for _ in range(3000):
        enabled.cycle(0, 0)
    enabled.control(0x8F)
    assert word_of(enabled) == 0x08
    enabled.control(0x00)
    enabled.control(0x80)
    assert word_of(enabled) == 0x40


def test_a_mode_that_the_drive_does_not_have_is_not_taken(host: Host) -> None:
    host.configure()
    host.enable()
    host.cycle(200, 200)
    assert host.write(1, 0x6060, 0, "b", 2) == 0
    assert host.read(1, 0x6061, 0, "b") == 10
    assert host.write(1, 0x6060, 0, "b", 10) == 0
    assert host.read(1, 0x6041, 0, "H") & 0x1000


def test_without_a_mode_no_torque_acts(host: Host) -> None:
    host.configure()
    for word in (0x06, 0x07, 0x0F):
        for node in host.nodes:
            assert host.write(node, 0x6040, 0, "H", word) == 0
    host.cycle(500, 500)
    host.cycle()
    assert host.arm.emulator.body.motors[0].torque == 0.0
    assert not host.read(1, 0x6041, 0, "H") & 0x1000


def test_torque_counts_are_thousandths_of_the_rated_torque(enabled: Host) -> None:
    truths = enabled.truths()
    enabled.cycle(2, -3)
    motors = np.array([0.002, -0.003])
    assert truths[-1].torque == pytest.approx(enabled.arm.emulator.body.gears.joint_torque(motors), rel=1e-12)


@pytest.mark.parametrize(("index", "form"), [(0x6072, "H"), (0x6073, "H")])
def test_torque_is_cut_off_at_its_limits_and_the_drive_says_so(enabled: Host, index: int, form: str) -> None:
    assert enabled.write(1, index, 0, form, 150) == 0
    enabled.cycle(150, 0)
    enabled.cycle(150, 0)
    assert enabled.read(1, 0x6041, 0, "H") & 0x1800 == 0x1000
    for asked, acts in ((151, 150), (-30000, -150)):
        enabled.cycle(asked, 0)
        assert enabled.read(1, 0x6077, 0, "h") == enabled.read(1, 0x6074, 0, "h") == acts
        assert enabled.read(1, 0x6041, 0, "H") & 0x1800 == 0x1800  # follows, within an internal limit


def test_an_offset_is_added(enabled: Host) -> None:
    assert enabled.write(1, 0x60B2, 0, "h", -40) == 0
    enabled.cycle(100, 0)
    assert enabled.read(1, 0x6077, 0, "h") == 60


def test_above_the_speed_limit_no_torque_leads_faster(enabled: Host) -> None:
    for node in (1, 2):
        assert enabled.write(node, 0x6080, 0, "I", 60) == 0  # one turn a second
    body, truths = enabled.arm.emulator.body, enabled.truths()
    held = free = 0
    for cycle in range(600):
        asked = (150, -400) if cycle < 400 else (-150, 400)
        enabled.cycle(*asked)
        for motor, speed, torque in zip(
            body.motors, body.gears.motor_velocity(truths[-1].velocity), asked, strict=True
        ):
            too_fast = speed * torque > 0 and abs(speed) > 2 * math.pi
            assert motor.torque == pytest.approx(0.0 if too_fast else 1e-3 * torque, abs=1e-12)
            held, free = held + too_fast, free + (abs(speed) > 2 * math.pi and not too_fast)
    assert held > 20
    assert free > 20  # against the motion it acts, however fast the motor is


def test_torque_acts_beyond_a_software_limit_which_is_of_the_position_modes(enabled: Host) -> None:
    position = enabled.cycle(0, 0)[1]
    assert enabled.write(1, 0x607D, 2, "i", position - 100) == 0
    for asked in (200, -200):
        enabled.cycle(asked, 0)
        assert enabled.read(1, 0x6077, 0, "h") == asked
        assert enabled.read(1, 0x6041, 0, "H") & 0x1800 == 0x1000


@pytest.mark.parametrize(
    ("windings_off", "brake", "power"),
    [("open", False, Power.COAST), ("shorted", False, Power.BRAKE), ("open", True, Power.HELD)],
)
@pytest.mark.parametrize("off", [(0x00,), (0x02,), (0x06,)])
def test_without_power_the_motor_is_left_as_the_description_says(
    tmp_path: Path, windings_off: str, brake: bool, power: Power, off: tuple[int, ...]
) -> None:
    host = Host.on(drives_config(tmp_path, brake=brake, emulation={"windings_off": windings_off}))
    motor = host.arm.emulator.body.motors[0]
    assert motor.power is power
    host.configure()
    host.enable()
    host.cycle(0, 0)
    assert motor.power is Power.TORQUE
    for word in off:
        host.control(word)
    host.listen(200)  # longer than the ramp of a quick stop
    assert host.arm.emulator.faces[0].power.state in (PowerState.SWITCH_ON_DISABLED, PowerState.READY_TO_SWITCH_ON)
    assert motor.power is (Power.BRAKE if off == (0x06,) and host.read(1, 0x605B, 0, "h") else power)
    host.send(0x000, b"\x81\x01")
    assert motor.power is power
    assert host.arm.emulator.faces[0].power.state is PowerState.NOT_READY


# How far the shoulder sinks in 0.6 s after a quick stop from where it lay level [rad].
@pytest.mark.parametrize(
    ("windings_off", "brake", "least", "most"),
    [("open", False, 1.5, 2.5), ("shorted", False, 0.1, 0.8), ("open", True, 0.0, 0.01)],
)
def test_how_far_an_arm_falls_after_its_host_has_died(
    tmp_path: Path, windings_off: str, brake: bool, least: float, most: float
) -> None:
    host = Host.on(drives_config(tmp_path, brake=brake, gears=PLAIN, emulation={"windings_off": windings_off}))
    host.configure(deadline=10)
    host.enable()
    for _ in range(5):
        host.cycle(22000, 2500)  # about what it weighs, N m in thousandths
    body = host.arm.emulator.body
    before = body.plant.position[0]
    host.arm.settle(host.now + 600 * MS)
    assert all("switch on disabled" in state for state in host.arm.emulator.states)
    assert least <= abs(before - body.plant.position[0]) <= most


@pytest.mark.slow
def test_a_drive_that_nobody_asks_stops_an_arm_by_itself(tmp_path: Path) -> None:
    """The host dies: torques stop, and the arm sinks and comes to rest."""
    enabled = Host.on(drives_config(tmp_path, emulation={"windings_off": "shorted"}))
    enabled.configure(deadline=10)
    enabled.enable()
    for _ in range(200):
        enabled.cycle(300, 100)
    body = enabled.arm.emulator.body
    assert np.abs(body.plant.velocity).max() > 1.0
    enabled.arm.settle(enabled.now + 15 * MS)
    assert all("quick stop" in state or "disabled" in state for state in enabled.arm.emulator.states)
    enabled.arm.settle(enabled.now + 30_000 * MS)
    assert np.abs(body.plant.velocity).max() < 0.02
    assert all("switch on disabled" in state for state in enabled.arm.emulator.states)
