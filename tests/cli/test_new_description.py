"""`ident new`: a URDF becomes a description that simulates, says what it guessed, and leaves nothing half-written."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from model.test_locked_joints import PANDA, joint, link

from ident_service.cli import main
from ident_service.config.arm import ArmConfig
from ident_service.config.load import load_arm
from ident_service.config.motion_limits import motion_limits
from ident_service.config.simulation import SimulatedDriver
from ident_service.errors import ModelError
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import arm_model, control_model
from ident_service.model.likely_bodies import perturbed_body
from ident_service.model.outline import capsule_around
from ident_service.model.pinocchio_models import InverseDynamics, inertia_from_delta
from ident_service.motion.controller import ComputedTorque
from ident_service.motion.trajectory import rest
from ident_service.operations.new_description import arm_part

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
def test_a_stock_urdf_simulates_without_an_edit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "stock").mkdir()
    (tmp_path / "stock" / "panda.urdf").write_text(PANDA)
    assert main(["new", "stock/panda.urdf", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["description"] == "panda.yaml"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["panda.urdf", "panda.yaml", "stock"]
    config = load_arm(tmp_path / "panda.yaml")
    # The hand's fingers are held; the limits are the file's.
    assert len(config.joints) == 7
    assert all(one.position == (-2.9, 2.9) and one.torque == 87.0 for one in config.joints.values())
    assert main(["config", "check", "panda.yaml"]) == 0
    assert main(["simulate", "panda.yaml", "--out", "run", "--state", "state"]) == 0
    scored = json.loads((tmp_path / "run" / "score.json").read_text())
    assert scored["noise_free_torque_error_percent"] < 1.0
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


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("arm", ["threelink", "ur10", "tx40", "kuka_lwr4"])
def test_shipped_urdfs_simulate_without_an_edit(arm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A slide of 0.3 m that a slow motion leaves at a standstill, joints so heavy that an encoder's count is a jump."""
    monkeypatch.chdir(tmp_path)
    assert main(["new", str(CONFIGS / f"{arm}.urdf"), "--out", "arm.yaml"]) == 0
    assert main(["config", "check", "arm.yaml"]) == 0
    assert main(["simulate", "arm.yaml", "--out", "run", "--state", "state"]) == 0
    scored = json.loads((tmp_path / "run" / "score.json").read_text())
    assert scored["noise_free_torque_error_percent"] < 1.0


@pytest.mark.slow
def test_motions_are_faster_where_a_joint_would_stand_still(tmp_path: Path) -> None:
    assert main(["new", str(CONFIGS / "threelink.urdf"), "--out", str(tmp_path / "arm.yaml")]) == 0
    config = load_arm(tmp_path / "arm.yaml")
    model = arm_model(config)
    for which in ("identification", "validation"):
        path = excitation(model, which).path
        pace = np.abs(path.at(np.linspace(0.0, path.duration, 2000))[1])
        assert ((pace > config.identification.reversal.speed).mean(axis=0) >= 0.3).all()
    assert config.joints["slide"].home == pytest.approx(0.15)  # its middle: zero is the end of its range


@pytest.mark.slow
def test_one_count_of_the_encoder_is_no_jump_of_the_torque(tmp_path: Path) -> None:
    assert main(["new", str(CONFIGS / "ur10.urdf"), "--out", str(tmp_path / "arm.yaml")]) == 0
    config = load_arm(tmp_path / "arm.yaml")
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
def test_all_that_no_urdf_says_is_told_and_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
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
    assert "Of a real arm say in\n# the braces of each joint `brake: true` or `brake: false`" in text
    assert main(["config", "check", str(tmp_path / "bars.yaml")]) == 0
    told = capsys.readouterr().out
    assert "after a stop: held for two seconds, then released to its brakes; they hold shoulder, elbow\n" in told
    assert "  ASSUMED: brakes of shoulder, elbow, because the drives are simulated; for real ones" in told


@pytest.mark.slow
def test_rounded_angles_are_taken_for_exact(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rounded = BARS.replace('xyz="0.4 0 0" rpy="0 0 0"', 'xyz="0.4 0 0" rpy="1.5708 0 0"')
    assert rounded != BARS
    config, said = described(tmp_path, rounded, capsys)
    assert config.kinematics.snap == ("rounded multiples" in said)
    assert config.kinematics.snap


def test_degrees_in_limits_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "bars.urdf").write_text(BARS.replace(BOUNDS, 'lower="-115" upper="115"'))
    assert main(["new", str(tmp_path / "bars.urdf"), "--out", str(tmp_path / "bars.yaml")]) == 2
    assert "shoulder turns from -115 to 115 rad: limits of a URDF are radians" in capsys.readouterr().err
    assert not (tmp_path / "bars.yaml").exists()


def test_what_is_there_is_not_written_over(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "panda.urdf").write_text(PANDA)
    (tmp_path / "panda.yaml").write_text("mine")
    assert main(["new", str(tmp_path / "panda.urdf"), "--out", str(tmp_path / "panda.yaml")]) == 2
    assert "exists already" in capsys.readouterr().err
    assert (tmp_path / "panda.yaml").read_text() == "mine"


@pytest.mark.parametrize(
    ("text", "code", "words"),
    [
        ("no xml", 2, "not a URDF that can be read"),
        ('<robot name="x"><link name="a"/></robot>', 2, "no movable joint"),
        ('<robot name="x"><link name="a"/><link name="b"/></robot>', 2, "2 links hang on no joint"),
    ],
)
def test_a_file_that_holds_no_arm_leaves_nothing(
    text: str, code: int, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "x.urdf").write_text(text)
    assert main(["new", str(tmp_path / "x.urdf"), "--out", str(tmp_path / "new" / "x.yaml")]) == code
    assert words in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["x.urdf"]


def tree(*joints: tuple[str, str, str, str]) -> str:
    names = dict.fromkeys(name for _, parent, child, _ in joints for name in (parent, child))
    links = "".join(link(name, 1.0) for name in names)
    return (
        '<robot name="t">' + links + "".join(joint(n, k, p, c, "0 0 0.1 0 0 0") for n, p, c, k in joints) + "</robot>"
    )


def test_the_arm_is_the_longest_branch_and_ends_where_its_gripper_begins() -> None:
    arm = [(f"j{k}", f"l{k}", f"l{k + 1}", "revolute") for k in range(5)]
    assert arm_part(tree(*arm), "t", None, None) == {"urdf": "t"}
    fingers = [("f1", "l5", "f1", "prismatic"), ("f2", "l5", "f2", "prismatic")]
    assert arm_part(tree(*arm, *fingers), "t", None, None)["tip"] == "l5"
    other = [(f"o{k}", "l0" if k == 0 else f"o{k}", f"o{k + 1}", "revolute") for k in range(3)]
    assert arm_part(tree(*arm, *other), "t", None, None)["tip"] == "l5"
    assert arm_part(tree(*arm), "t", "l1", "l3") == {"urdf": "t", "base": "l1", "tip": "l3"}
    with pytest.raises(ModelError, match="--base"):
        arm_part(tree(*arm, ("p", "elsewhere", "else", "revolute")), "t", None, None)


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
