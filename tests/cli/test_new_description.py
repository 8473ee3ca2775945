"""`ident new`: a URDF becomes a description that simulates, says what it guessed, and leaves nothing half-written."""

from __future__ import annotations

import json
import math
import re
import struct
from collections.abc import Callable
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import yaml
from documents.walk import blocks
from helpers.examples import NIGHT
from hypothesis import given, settings
from hypothesis import strategies as st
from model.test_locked_joints import PANDA, joint, link

from ident_service.cli import main
from ident_service.config.arm import ArmConfig
from ident_service.config.kinematics import angles_barely_rounded
from ident_service.config.load import load_arm
from ident_service.config.motion_limits import motion_limits
from ident_service.config.simulation import SimulatedDriver
from ident_service.errors import ModelError, UsageError
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import arm_model, control_model
from ident_service.model.base_parameters import base_parameters
from ident_service.model.likely_bodies import perturbed_body
from ident_service.model.outline import (
    _DH,
    _LIMITS,
    _OFFSET,
    _SCALES,
    Outline,
    arm_part,
    capsule_around,
    capsules_around,
    read_source,
    urdf_outline,
)
from ident_service.model.pinocchio_models import InverseDynamics, inertia_from_delta
from ident_service.motion.controller import ComputedTorque
from ident_service.motion.trajectory import rest

LONG = pytest.mark.campaign
CONFIGS = Path(__file__).parents[2] / "configs"


def box_stl(x: float, y: float, z: float) -> bytes:
    """A binary STL of a box about the origin with these half edges [m]."""
    corners = np.array([[i, j, k] for i in (-x, x) for j in (-y, y) for k in (-z, z)])
    faces = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)]
    faces += [(2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]
    rows = [struct.pack("<12fH", 0, 0, 0, *corners[list(face)].ravel(), 0) for face in faces]
    return b"\0" * 80 + struct.pack("<I", len(faces)) + b"".join(rows)


MESH = (
    '<collision><origin xyz="0.15 0 0"/><geometry><mesh filename="package://boxes/bar.stl" scale="2 1 1"/></geometry>'
    "</collision></link>"
)
BARS = (
    '<?xml version="1.0"?><robot name="bars">'
    + '<link name="base_link"/>'
    + link("upper", 2.0).replace("</link>", MESH)
    + link("lower", 1.0).replace("</link>", MESH)
    + joint("shoulder", "revolute", "base_link", "upper", "0 0 0.3 1.5708 0 0")
    + joint("elbow", "revolute", "upper", "lower", "0.4 0 0 0 0 0")
    + "</robot>"
)


@pytest.mark.slow
def test_of_a_stock_urdf_come_limits_and_another_truth_than_the_prior(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "stock").mkdir()
    (tmp_path / "stock" / "panda.urdf").write_text(PANDA)
    assert main(["new", "stock/panda.urdf", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["description"] == "panda.yaml"
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "ident-arm.schema.json",
        "panda.urdf",
        "panda.yaml",
        "stock",
    ]
    config = load_arm(tmp_path / "panda.yaml")
    # The hand's fingers are held; the limits are the file's.
    assert len(config.joints) == 7
    assert all(one.position == (-2.9, 2.9) and one.torque == 87.0 for one in config.joints.values())
    assert main(["config", "check", "panda.yaml"]) == 0
    # The truth is another arm than the prior.
    driver = config.driver
    assert isinstance(driver, SimulatedDriver)
    assert driver.truth is not None
    model = arm_model(config)
    assert model.prior is not None
    truth = model.layout.vector(driver.truth)
    masses = [model.layout.inertial(k).stop - 1 for k in range(7)]
    shares = truth[masses] / model.prior[masses]
    assert (shares > 0.8).all()
    assert (shares < 1.25).all()
    assert np.abs(shares - 1.0).max() > 0.01


MJCF = """<mujoco model="bench">
  <compiler angle="degree" autolimits="true"/>
  <default>
    <default class="strong"><general forcerange="-60 60"/><joint armature="0.4"/></default>
    <geom type="capsule" size="0.04"/>
  </default>
  <asset><mesh name="bar" file="bar.stl" scale="2 1 1"/></asset>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1"/>
    <body name="stand">
      <geom type="box" size="0.1 0.1 0.05" pos="0 0 0.05"/>
      <body name="upper" pos="0 0 0.3">
        <joint name="shoulder" class="strong" axis="0 1 0" range="-100 100"/>
        <inertial pos="0.15 0 0" mass="3" diaginertia="0.01 0.05 0.05"/>
        <geom type="mesh" mesh="bar" pos="0.15 0 0"/>
        <body name="lower" pos="0.4 0 0">
          <joint name="elbow" axis="0 1 0" range="-120 120"/>
          <inertial pos="0.15 0 0" mass="2" diaginertia="0.005 0.02 0.02"/>
          <geom fromto="0.1 0 0 0.25 0 0"/>
          <body name="wrist" pos="0.3 0 0">
            <joint name="roll" axis="1 0 0" range="-170 170"/>
            <inertial pos="0.02 0 0" mass="0.5" diaginertia="0.001 0.001 0.001"/>
            <body name="left" pos="0.05 0.02 0"><joint name="left" type="slide" axis="0 1 0" range="0 0.03"/>
              <inertial pos="0 0 0" mass="0.05" diaginertia="1e-5 1e-5 1e-5"/></body>
            <body name="right" pos="0.05 -0.02 0"><joint name="right" type="slide" axis="0 1 0" range="-0.03 0"/>
              <inertial pos="0 0 0" mass="0.05" diaginertia="1e-5 1e-5 1e-5"/></body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="right" joint2="left" polycoef="0 -1 0 0 0"/></equality>
  <actuator>
    <general class="strong" joint="shoulder"/>
    <motor joint="elbow" gear="20" ctrlrange="-1.5 1.5"/>
    <position joint="roll" forcerange="-6 6"/>
  </actuator>
</mujoco>
"""
TABLE = """# A table arm of a data sheet. convention: standard
# convention: standard
joint, d [mm], a [mm], alpha [deg], lower [deg], upper [deg], velocity [deg/s], torque
waist, 300, 0, 90, -170, 170, 150, 40
shoulder, 0, 350, 0, -100, 100, 150, 60
elbow, 0, 300, 0, -140, 140, , 25
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Return the description that `ident new` makes of a mechanism, each made once."""
    found: dict[str, Path] = {}

    def make(name: str) -> Path:
        if name not in found:
            folder = tmp_path_factory.mktemp(name)
            source = CONFIGS / f"{name}.urdf"
            if name == "mjcf":
                (folder / "bar.stl").write_bytes(box_stl(0.06, 0.03, 0.02))
                (source := folder / "bench.xml").write_text(MJCF)
            if name == "table":
                (source := folder / "table.csv").write_text(TABLE)
            assert main(["new", str(source), "--out", str(folder / "arm.yaml")]) == 0
            found[name] = folder / "arm.yaml"
        return found[name]

    return make


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("arm", ["table", *(pytest.param(one, marks=LONG) for one in ("threelink", "ur10", "mjcf"))])
def test_urdf_mjcf_and_table_simulate_without_an_edit(
    arm: str,
    made: Callable[[str], Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A slide of 0.3 m, joints so heavy that an encoder's count is a jump, an MJCF, and a table without masses."""
    if arm == "table" and not NIGHT:
        monkeypatch.setattr("ident_service.operations.new_description.RATE", 250.0)  # half as many cycles
    path = str(made(arm))
    capsys.readouterr()
    assert main(["config", "check", path]) == 0
    assert capsys.readouterr().out.splitlines()[0].endswith(": good")
    assert main(["simulate", path, "--out", str(tmp_path / "run"), "--state", str(tmp_path / "state")]) == 0
    scored = json.loads((tmp_path / "run" / "score.json").read_text())
    # Not a perfect model, and found all the same.
    assert 1e-6 < scored["noise_free_torque_error_percent"] < 1.0


@pytest.mark.slow
def test_of_an_mjcf_come_limits_of_joints_and_actuators_bodies_and_meshes(made: Callable[[str], Path]) -> None:
    config = load_arm(made("mjcf"))
    assert (config.kinematics.tip, list(config.joints)) == ("wrist", ["shoulder", "elbow", "roll"])
    assert [one.torque for one in config.joints.values()] == [60.0, 30.0, 6.0]
    assert config.joints["elbow"].position == pytest.approx(np.radians([-120.0, 120.0]))
    assert config.joints["shoulder"].drive_inertia == pytest.approx(0.4)
    (bar,) = config.geometry["shoulder"]
    assert sorted((bar.start[0], bar.end[0])) == pytest.approx([0.03, 0.27], abs=0.002)
    assert config.geometry["elbow"][0].radius == pytest.approx(0.04, abs=1e-4)
    assert "base" in config.geometry
    prior = arm_model(config).prior
    assert prior is not None
    assert [prior[arm_model(config).layout.inertial(k)][-1] for k in range(3)] == pytest.approx([3.0, 2.0, 0.6])


@pytest.mark.slow
def test_of_a_table_come_limits_and_units_and_the_rest_is_guessed(made: Callable[[str], Path]) -> None:
    text = made("table").read_text()
    config = load_arm(made("table"))
    assert config.kinematics.dh is not None
    shoulder = config.kinematics.dh.joints["shoulder"]
    assert (shoulder.a, config.kinematics.dh.joints["waist"].alpha) == pytest.approx((0.35, np.pi / 2))
    assert config.joints["waist"].velocity == pytest.approx(np.radians(150.0))
    assert [one.torque for one in config.joints.values()] == [40.0, 60.0, 25.0]
    assert config.prior is not None
    assert "bodies of waist, shoulder, elbow: rods; a DH table has none" in text
    assert "elbow: velocity limit guessed" in text
    # Each value says its unit, and where it is from.
    assert "torque: 40.0 # N m; of table.csv\n" in text
    assert "velocity: 2.0 # rad/s; guessed: the file has none\n" in text
    # Editors find the schema beside it.
    assert text.startswith("# yaml-language-server: $schema=ident-arm.schema.json\n")
    schema = json.loads((made("table").parent / "ident-arm.schema.json").read_text())
    assert list(jsonschema.Draft7Validator(schema).iter_errors(yaml.safe_load(text))) == []


def test_a_table_in_yaml_is_the_same_table(tmp_path: Path) -> None:
    (tmp_path / "table.csv").write_text(TABLE)
    (tmp_path / "table.yaml").write_text(
        "convention: standard\njoints:\n"
        "  waist: {d: 0.3, alpha: 90 deg, lower: -170 deg, upper: 170 deg, velocity: 150 deg, torque: 40}\n"
        "  shoulder: {a: 0.35, lower: -100 deg, upper: 100 deg, velocity: 150 deg, torque: 60}\n"
        "  elbow: {a: 0.3, lower: -140 deg, upper: 140 deg, torque: 25}\n"
    )
    csv, yml = (read_source(tmp_path / f"table.{suffix}") for suffix in ("csv", "yaml"))
    assert csv.table is not None
    assert yml.table is not None
    for name, row in csv.table.joints.items():
        assert row.model_dump() == pytest.approx(yml.table.joints[name].model_dump())
        assert csv.limits[name].position == pytest.approx(yml.limits[name].position)
        assert (csv.limits[name].velocity or 0.0) == pytest.approx(yml.limits[name].velocity or 0.0)


def test_the_table_of_the_documents_is_read(tmp_path: Path) -> None:
    page = (CONFIGS.parent / "docs" / "your-own-arm.md").read_text(encoding="utf-8")
    (table,) = (block for block in blocks(page) if block.file == "table.csv")
    (tmp_path / "table.csv").write_text(table.text)
    read = read_source(tmp_path / "table.csv")
    assert read.table is not None
    assert read.table.convention == "standard"
    assert read.table.joints["shoulder"].model_dump() == pytest.approx(
        {"type": "revolute", "theta": math.pi / 2, "d": 0.0, "a": 0.35, "alpha": 0.0}
    )
    assert read.limits["waist"].position == pytest.approx((-math.radians(170), math.radians(170)))
    assert (read.limits["waist"].effort, read.limits["elbow"].velocity) == (40.0, None)
    # Its page names every column and unit.
    (_, part) = page.split("## From a DH table")
    for word in (*_DH, *_LIMITS, "joint", _OFFSET, *filter(None, _SCALES)):
        assert f"`{word}`" in part.partition("## ")[0]


def test_an_offset_is_theta_or_the_d_of_a_slide(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("# convention: modified\ntype, offset, d\n, 90 deg, 0.1\nprismatic, 0.2,\n")
    (tmp_path / "t.yaml").write_text(
        "convention: modified\njoints: {j1: {d: 0.1, offset: 90 deg}, j2: {type: prismatic, offset: 0.2}}\n"
    )
    for name in ("t.csv", "t.yaml"):
        table = read_source(tmp_path / name).table
        assert table is not None
        assert (table.joints["j1"].theta, table.joints["j1"].d) == pytest.approx((math.pi / 2, 0.1))
        assert (table.joints["j2"].theta, table.joints["j2"].d) == (0.0, 0.2)


@pytest.mark.parametrize("text", ["# convention: standard\na\n1\n", "convention: standard\njoints: {j1: {a: 1}}\n"])
def test_a_table_is_not_read_in_another_convention_than_it_names(text: str, tmp_path: Path) -> None:
    table = tmp_path / f"t.{'csv' if text.startswith('#') else 'yaml'}"
    table.write_text(text)
    assert read_source(table, "standard") == read_source(table)
    with pytest.raises(UsageError, match="names the convention standard, but --convention says modified"):
        read_source(table, "modified")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        (
            "t.csv",
            "# convention: standard\na, theta, offset\n0.5, 0, 1\n",
            "3:1: j1: offset: is another name of its theta",
        ),
        ("t.csv", "a, alpha\n0.5, 0\n", "which convention is it? Give --convention standard"),
        ("t.csv", "# convention: standard\na, aplha\n0.5, 0\n", "t.csv:2:1: column 2: 'aplha' is none of joint, type"),
        ("t.csv", "# convention: standard\na [inch]\n5\n", "t.csv:2:1: column 1: unit 'inch' is none of rad, m"),
        ("t.csv", "# convention: standard\na, d\n0.5\n", "t.csv:3:1: 1 values for 2 columns"),
        ("t.csv", "# convention: standard\na\n0.5\nlong\n", "t.csv:4:1: j2: a: Input should be a valid number"),
        ("t.csv", "# convention: standard\na\n500\n", "t.csv:3:1: j1: a: 500 m is longer than the link of any arm"),
        ("t.yaml", "convention: odd\njoints: {j: {a: 1}}\n", "which convention is it?"),
        ("t.yaml", "convention: standard\njoints: {j: {b: 1}}\n", "t.yaml:2:10: j: b: Extra inputs"),
        ("t.yaml", "joints: [1]\n", "a DH table has `convention`, and under `joints` a row by joint name"),
        ("t.yaml", "format: ident-arm\n", "is a description already; `ident config check"),
        ("t.urdf.xacro", "<robot/>", "xacro t.urdf.xacro > t.urdf.urdf"),
        ("t.txt", "", "give a URDF (.urdf), an MJCF (.xml) or a DH table (.csv, .yaml)"),
        ("t.xml", "<mujoco><worldbody><body><joint type='odd'/></body></worldbody></mujoco>", "t.xml: not an MJCF"),
    ],
)
def test_a_source_with_a_mistake_is_reported_and_leaves_nothing(
    name: str, text: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_text(text)
    assert main(["new", str(tmp_path / name), "--out", str(tmp_path / "out" / "arm.yaml")]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_motions_are_faster_where_a_joint_would_stand_still(made: Callable[[str], Path]) -> None:
    config = load_arm(made("threelink"))
    model = arm_model(config)
    for which in ("identification", "validation"):
        path = excitation(model, which).path
        pace = np.abs(path.at(np.linspace(0.0, path.duration, 2000))[1])
        assert ((pace > config.identification.reversal.speed).mean(axis=0) >= 0.3).all()
    assert config.joints["slide"].home == pytest.approx(0.15)  # its middle: zero is the end of its range
    assert "torque: " in made("threelink").read_text()
    assert " # N; of threelink.urdf" in made("threelink").read_text()  # a slide has a force


@pytest.mark.slow
def test_one_count_of_the_encoder_is_no_jump_of_the_torque(made: Callable[[str], Path]) -> None:
    config = load_arm(made("ur10"))
    model, limits, period = control_model(arm_model(config)), motion_limits(config), 1.0 / config.control.rate
    assert model.prior is not None
    assert isinstance(config.driver, SimulatedDriver)
    dynamics = InverseDynamics(model.chain, model.layout, model.prior)
    count = np.broadcast_to(np.asarray(config.driver.encoder_resolution), (6,))
    for k in range(6):
        control = ComputedTorque(dynamics, limits, period, config.control.velocity_cutoff, limits.home)
        step = np.where(np.arange(6) == k, count, 0.0)
        every = np.ones(6, dtype=bool)
        before = control.torque(limits.home, every, rest(limits.home))
        after = control.torque(limits.home + step, every, rest(limits.home))
        assert np.abs(after - before)[k] < 0.5 * min(1000.0, 100.0 * limits.torque[k]) * period


@pytest.mark.slow
def test_meshes_become_capsules_around_them(tmp_path: Path) -> None:
    folder = tmp_path / "boxes" / "urdf"
    folder.mkdir(parents=True)
    (tmp_path / "boxes" / "bar.stl").write_bytes(box_stl(0.06, 0.03, 0.02))
    (folder / "bars.urdf").write_text(BARS)
    assert main(["new", str(folder / "bars.urdf"), "--out", str(tmp_path / "arm" / "bars.yaml")]) == 0
    geometry = load_arm(tmp_path / "arm" / "bars.yaml").geometry
    for owner in ("shoulder", "elbow"):
        (capsule,) = geometry[owner]
        # The scale makes it 0.12 m either way along x, about 0.15 m.
        assert sorted((capsule.start[0], capsule.end[0])) == pytest.approx([0.03, 0.27], abs=0.002)
        assert capsule.radius == pytest.approx(np.hypot(0.03, 0.02), abs=0.002)


BOUNDS = 'lower="-2.9" upper="2.9"'


def described(tmp_path: Path, urdf: str, capsys: pytest.CaptureFixture[str]) -> tuple[ArmConfig, str]:
    """What `ident new` makes of a URDF, and what it says was guessed."""
    (tmp_path / "bars.urdf").write_text(urdf)
    capsys.readouterr()
    assert main(["new", str(tmp_path / "bars.urdf"), "--out", str(tmp_path / "bars.yaml"), "--json"]) == 0
    return load_arm(tmp_path / "bars.yaml"), "\n".join(json.loads(capsys.readouterr().out)["guessed"])


def described_anew(tmp_path: Path, urdf: str, capsys: pytest.CaptureFixture[str]) -> tuple[ArmConfig, str]:
    """The same in a folder of its own."""
    (tmp_path / "anew").mkdir()
    return described(tmp_path / "anew", urdf, capsys)


@pytest.mark.slow
def test_limits_are_the_files_to_the_digit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config, said = described(tmp_path, BARS.replace(BOUNDS, 'lower="-2.90004" upper="2.89996"'), capsys)
    assert all(one.position == (-2.90004, 2.89996) for one in config.joints.values())
    beyond_zero, _ = described_anew(tmp_path, BARS.replace(BOUNDS, 'lower="0.331613" upper="5.95157"'), capsys)
    assert all(one.position == (0.331613, 5.95157) for one in beyond_zero.joints.values())
    # The two meshes are not there.
    assert "a mesh of elbow, shoulder could not be read" in said
    (forearm,) = config.geometry["elbow"]
    assert (forearm.start, forearm.end) == ((0.0, 0.0, 0.0), (0.04, -0.02, 0.1))  # twice as far as its centre of mass
    assert config.constraints.total_mass.upper == pytest.approx(6.0)


@pytest.mark.slow
def test_a_bad_body_is_named_and_the_good_one_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config, said = described(tmp_path, BARS.replace('<mass value="1.0"/>', '<mass value="0"/>'), capsys)
    assert "bodies of elbow: rods" in said
    prior = arm_model(config).prior
    assert prior is not None
    assert prior[arm_model(config).layout.inertial(0)][-1] == pytest.approx(2.0)
    assert prior[arm_model(config).layout.inertial(1)][-1] > 0.0


@pytest.mark.slow
def test_all_that_no_urdf_says_is_reported_and_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config, said = described(tmp_path, BARS, capsys)
    text = (tmp_path / "bars.yaml").read_text()
    for key in (
        *("gravity", "terms", "acceleration", "jerk", "following_error", "drive_inertia", "kp 400", "home"),
        *("total_mass", "500 Hz", "after_stop", "friction_guess", "motions", "driver", "workspace: clearance 0.02 m"),
    ):
        assert key in said
    assert all(f"#   {line}\n" in text for line in said.splitlines())
    # The simulated brakes are written down as a question about the real ones.
    assert config.control.after_stop == "brake"
    assert "Of a real arm say at\n# each joint `brake: true` or `brake: false`" in text
    assert main(["config", "check", str(tmp_path / "bars.yaml")]) == 0
    told = capsys.readouterr().out
    assert "after a stop: held for two seconds, then released to its brakes; they hold shoulder, elbow\n" in told
    assert "  ASSUMED: brakes of shoulder, elbow, because the drives are simulated; for real ones" in told


@pytest.mark.slow
@pytest.mark.parametrize("angle", ["1.5708", "1.570796327"])  # a base parameter more; coefficients of 1e-10
def test_rounded_angles_are_taken_for_exact(tmp_path: Path, capsys: pytest.CaptureFixture[str], angle: str) -> None:
    rounded = BARS.replace('xyz="0.4 0 0" rpy="0 0 0"', f'xyz="0.4 0 0" rpy="{angle} 0 0"')
    assert rounded != BARS
    config, said = described(tmp_path, rounded, capsys)
    assert config.kinematics.snap == ("rounded multiples" in said)
    assert config.kinematics.snap
    model = arm_model(config)
    assert not any(re.search(r"\de-\d", one) for one in base_parameters(model.chain, model.layout).expressions)


@pytest.mark.parametrize(
    ("angles", "rounded"),
    [
        ((math.pi / 2, 0.0, -3.0 * math.pi / 4, 0.4), False),  # exact already
        ((1.570796327, 0.0, 0.4), True),
        ((3.1416, -0.261799), True),
        ((1.570796327, 0.0004), False),  # the second is calibrated, so the first may be, too
        ((0.4, 1.0), False),
        ((), False),
    ],
)
def test_angles_are_called_rounded_where_all_of_them_may_be(angles: tuple[float, ...], rounded: bool) -> None:
    assert angles_barely_rounded(angles) == rounded


@pytest.mark.slow
def test_a_base_whose_mesh_is_not_there_has_no_geometry(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    base = '<link name="base_link"/>'
    assert base in BARS
    mesh = (
        '<link name="base_link"><collision><geometry><mesh filename="package://none/base.stl"/></geometry></collision>'
    )
    config, said = described(tmp_path, BARS.replace(base, f"{mesh}</link>"), capsys)
    assert "a mesh of base, elbow, shoulder could not be read; capsules are guessed where none of a link was" in said
    assert config.geometry["base"] == ()
    assert config.geometry["shoulder"]
    assert main(["config", "check", str(tmp_path / "bars.yaml")]) == 0


@pytest.mark.parametrize("scale", ["0.001", "1 1", "0 1 1", "nan 1 1", "one"])
def test_a_mesh_whose_scale_is_none_is_not_read(scale: str, tmp_path: Path) -> None:
    (tmp_path / "bar.stl").write_bytes(box_stl(0.15, 0.02, 0.01))
    here = BARS.replace("package://boxes/", "")
    assert urdf_outline(here, tmp_path).unread == frozenset()
    assert urdf_outline(here.replace('"2 1 1"', f'"{scale}"'), tmp_path).unread == {"upper", "lower"}


@pytest.mark.slow
def test_gravity_and_the_range_of_a_slide_are_the_mjcfs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "gantry.xml").write_text(
        '<mujoco><option gravity="0 -9.81 0"/><worldbody><body name="b">'
        '<joint name="x" type="slide" axis="1 0 0" range="0 1.5"/><geom type="sphere" size=".1" mass="1"/>'
        '<body name="c" pos="0 0 .2"><joint name="y" axis="0 0 1" range="-90 90"/>'
        '<geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="1"/></body></body></worldbody></mujoco>'
    )
    assert main(["new", str(tmp_path / "gantry.xml"), "--out", str(tmp_path / "gantry.yaml")]) == 0
    told = capsys.readouterr().out
    assert "gravity: 0 -9.81 0 m/s^2 in the base frame; of gantry.xml\n" in told
    assert "in a folder made for it" not in told
    text, config = (tmp_path / "gantry.yaml").read_text(), load_arm(tmp_path / "gantry.yaml")
    assert "\ngravity: [0.0, -9.81, 0.0] # m/s^2 in the base frame; of gantry.xml\n" in text
    assert config.gravity == (0.0, -9.81, 0.0)
    assert config.joints["x"].position == (0.0, 1.5)
    assert config.joints["y"].position == pytest.approx((-math.pi / 2, math.pi / 2))


@pytest.mark.slow
def test_gravity_is_turned_into_the_frame_of_a_tilted_base(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lying = BARS.replace('<link name="base_link"/>', link("root", 1.0) + '<link name="base_link"/>').replace(
        "</robot>", joint("wall", "fixed", "root", "base_link", "0 0 0.5 1.5707963267948966 0 0") + "</robot>"
    )
    (tmp_path / "bars.urdf").write_text(lying)
    words = ["new", str(tmp_path / "bars.urdf"), "--base", "base_link", "--out", str(tmp_path / "made" / "bars.yaml")]
    assert main(words) == 0
    told = capsys.readouterr().out
    assert told.splitlines()[0].endswith(
        "bars.yaml: description written, with a simulated driver, in a folder made for it"
    )
    assert "gravity: 0 -9.81 0 m/s^2 in the base frame; the root of bars.urdf stands upright" in told
    assert load_arm(tmp_path / "made" / "bars.yaml").gravity == (0.0, -9.81, 0.0)


def test_degrees_in_limits_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "bars.urdf").write_text(BARS.replace(BOUNDS, 'lower="-115" upper="115"'))
    assert main(["new", str(tmp_path / "bars.urdf"), "--out", str(tmp_path / "bars.yaml")]) == 2
    assert "shoulder turns from -115 to 115 rad: its limits are to be radians" in capsys.readouterr().err
    assert not (tmp_path / "bars.yaml").exists()


def test_what_is_there_is_not_written_over(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "panda.urdf").write_text(PANDA)
    (tmp_path / "panda.yaml").write_text("mine")
    assert main(["new", str(tmp_path / "panda.urdf"), "--out", str(tmp_path / "panda.yaml")]) == 2
    assert "panda.yaml: exists already; give another file by --out" in capsys.readouterr().err
    assert (tmp_path / "panda.yaml").read_text() == "mine"
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "panda.urdf").write_text("mine")
    assert main(["new", str(tmp_path / "panda.urdf"), "--out", str(tmp_path / "other" / "a.yaml")]) == 2
    assert "give --out a file in another folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("other",), "other: is a folder, not a file"),
        (("panda.urdf", "--out", "other"), "other: is a folder; give another file by --out"),
        (("panda.urdf", "--convention", "modified"), "--convention is of DH tables"),
    ],
)
def test_what_cannot_be_meant_is_refused(
    words: tuple[str, ...],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "panda.urdf").write_text(PANDA)
    (tmp_path / "other").mkdir()
    assert main(["new", *words]) == 2
    assert message in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["other", "panda.urdf"]


@pytest.mark.parametrize(
    ("text", "code", "words"),
    [
        ("no xml", 2, "not a URDF that can be read"),
        ('<robot\nname="é"/>', 2, "x.urdf:2: not UTF-8 text; save the file in that encoding"),
        ('<robot name="x"><link name="a"/></robot>', 2, "no movable joint"),
        ('<robot name="x"><link name="a"/><link name="b"/></robot>', 2, "2 links hang on no joint"),
    ],
)
def test_a_file_that_holds_no_arm_leaves_nothing(
    text: str, code: int, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "x.urdf").write_text(text, encoding="latin-1")
    assert main(["new", str(tmp_path / "x.urdf"), "--out", str(tmp_path / "new" / "x.yaml")]) == code
    assert words in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["x.urdf"]


def tree(*joints: tuple[str, str, str, str], lengths: dict[str, float] | None = None) -> Outline:
    """The outline of a URDF of these joints, each 0.1 m from the one before."""
    names = dict.fromkeys(name for _, parent, child, _ in joints for name in (parent, child))
    links = "".join(link(name, 1.0) for name in names)
    places = {name: f"0 0 {(lengths or {}).get(name, 0.1)} 0 0 0" for name, *_ in joints}
    rows = "".join(joint(name, kind, parent, child, places[name]) for name, parent, child, kind in joints)
    return urdf_outline(f'<robot name="t">{links}{rows}</robot>', Path())


ARM = [(f"j{k}", f"l{k}", f"l{k + 1}", "revolute") for k in range(5)]


def test_the_arm_is_the_longest_branch_and_ends_where_its_gripper_begins() -> None:
    assert arm_part(tree(*ARM), "t", None, None) == {}
    fingers = [("f1", "l5", "f1", "prismatic"), ("f2", "l5", "f2", "prismatic")]
    assert arm_part(tree(*ARM, *fingers), "t", None, None)["tip"] == "l5"
    other = [(f"o{k}", "l0" if k == 0 else f"o{k}", f"o{k + 1}", "revolute") for k in range(3)]
    assert arm_part(tree(*ARM, *other), "t", None, None)["tip"] == "l5"
    assert arm_part(tree(*ARM), "t", "l1", "l3") == {"base": "l1", "tip": "l3"}
    with pytest.raises(ModelError, match="--base"):
        arm_part(tree(*ARM, ("p", "elsewhere", "else", "revolute")), "t", None, None)


def test_a_hand_with_long_chains_of_short_fingers_is_no_part_of_the_arm() -> None:
    fingers = [
        (f"{hand}{k}", "l5" if k == 0 else f"{hand}{k}", f"{hand}{k + 1}", "revolute")
        for hand in "abc"
        for k in range(4)
    ]
    lengths = {f"{hand}{k}": 0.02 for hand in "abc" for k in range(4)}
    assert arm_part(tree(*ARM, *fingers, lengths=lengths), "t", None, None)["tip"] == "l5"
    # As long as the arm, they are no fingers: the first is the rest of the arm.
    assert arm_part(tree(*ARM, *fingers), "t", None, None)["tip"] == "a4"


def test_a_torso_that_carries_a_head_beside_the_arm_is_no_part_of_it() -> None:
    torso = [("lift", "root", "l0", "prismatic"), ("head", "l0", "face", "revolute")]
    assert arm_part(tree(*torso, *ARM), "t", None, None) == {"base": "l0", "tip": "l5"}
    # Without a head, it is a joint of the arm like others.
    assert arm_part(tree(torso[0], *ARM), "t", None, None) == {}


@pytest.mark.slow
@given(st.integers(0, 2**32 - 1))
def test_a_drawn_body_is_real_and_near(seed: int) -> None:
    rng = np.random.default_rng(seed)
    body = np.array([0.3, 0.01, -0.02, 0.4, 0.03, 0.2, 0.1, -0.2, 0.3, 4.0])
    drawn = perturbed_body(body, rng)
    inertia = inertia_from_delta(drawn)
    assert np.linalg.eigvalsh(0.5 * np.trace(inertia.inertia) * np.eye(3) - inertia.inertia)[0] > 0.0
    assert 0.85 < drawn[9] / body[9] < 1.15


@given(st.integers(0, 2**32 - 1), st.integers(2, 40))
def test_a_capsule_encloses_its_points(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3)) * rng.uniform(0.01, 0.5, size=3) + rng.normal(size=3)
    capsule = capsule_around(points)
    start, end = np.array(capsule.start), np.array(capsule.end)
    way = end - start
    share = np.clip((points - start) @ way / max(way @ way, 1e-12), 0.0, 1.0)
    apart = np.linalg.norm(points - start - share[:, None] * way, axis=1)
    assert (apart <= capsule.radius + 5e-4).all()


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.integers(1, 30))
def test_capsules_enclose_every_triangle(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    corners = rng.normal(size=(count, 3, 3)) * rng.uniform(0.01, 0.5, size=3)
    found = capsules_around(corners)
    assert 1 <= len(found) <= 4
    weights = rng.dirichlet(np.ones(3), size=(200,))
    points = np.einsum("pk,pki->pi", weights, corners[rng.integers(0, count, 200)])
    apart = []
    for one in found:
        start, way = np.array(one.start), np.subtract(one.end, one.start)
        share = np.clip((points - start) @ way / max(way @ way, 1e-12), 0.0, 1.0)
        apart.append(np.linalg.norm(points - start - share[:, None] * way, axis=1) - one.radius)
    assert (np.min(apart, axis=0) <= 5e-4).all()


def test_a_bent_link_is_enclosed_in_several_capsules_and_a_straight_one_in_one() -> None:
    faces = np.frombuffer(box_stl(0.3, 0.03, 0.03)[84:], dtype=np.dtype([("n", "<12f4"), ("a", "<u2")]))["n"]
    bar = np.array(faces.reshape(-1, 4, 3)[:, 1:], dtype=float)
    upright = bar[..., [2, 1, 0]] + [0.3, 0.0, 0.3]
    assert len(capsules_around(bar)) == 1
    bent = capsules_around(np.concatenate([bar, upright]))
    assert 2 <= len(bent) <= 4
    assert max(one.radius for one in bent) < 0.1  # a single one has 0.2 m


@pytest.mark.slow
def test_placeholders_and_undeclared_prefixes_of_a_urdf(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    urdf = BARS.replace('effort="87"', 'drake:acceleration="2.5" effort="1000"')
    config, said = described(tmp_path, urdf, capsys)
    assert "1000 at every joint of the file is more than 5 times what any of them needs" in said
    assert all(one.torque is not None and one.torque < 200.0 for one in config.joints.values())
    assert "guessed: the file's is of no drive" in (tmp_path / "bars.yaml").read_text()


def test_an_arm_that_no_torque_rate_can_move_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    heavy = BARS.replace('effort="87"', 'effort="0"').replace('<mass value="1.0"/>', '<mass value="5000"/>')
    (tmp_path / "bars.urdf").write_text(heavy)
    assert main(["new", str(tmp_path / "bars.urdf"), "--out", str(tmp_path / "bars.yaml")]) == 3
    err = capsys.readouterr().err
    assert "by its masses: friction alone would take" in err
    assert "is the file in metres, radians and kilograms?" in err
    assert not (tmp_path / "bars.yaml").exists()
