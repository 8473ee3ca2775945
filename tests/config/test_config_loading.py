"""What a description means: extending, file names, angles, numbers, the hash, the shipped arms."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

from ident_service.config.arm import ArmConfig, FourierMotion, PluginDriver, SeededMotion, SimulatedDriver
from ident_service.config.load import find_arm, load_arm, shipped_arms
from ident_service.config.motion_limits import motion_limits
from ident_service.config.quantities import Angle, Interval
from ident_service.errors import ConfigError, MotionRefused
from ident_service.model.arm_model import arm_model

BASE = """\
format: ident-arm
version: 1
name: base
kinematics: {dh: {convention: standard, joints: {one: {a: 0.5}, two: {a: 0.25, d: 0.1}}}}
joints:
  one: {velocity: 1, torque: 10, position: [-1, 1]}
  two: {velocity: 2, torque: 20}
gravity: [0, 0, -9.81]
motions:
  identification: {kind: seeded, seed: 5, harmonics: 4}
driver: {kind: simulated, seed: 3, torque_noise: 0.1}
"""


def written(folder: Path, text: str, name: str = "arm.yaml") -> ArmConfig:
    """The configuration that a text is."""
    (folder / name).write_text(text)
    return load_arm(folder / name)


@pytest.fixture
def base_file(tmp_path: Path) -> Path:
    """A description to extend."""
    (tmp_path / "base.yaml").write_text(BASE)
    return tmp_path / "base.yaml"


def test_extending_merges_mappings_key_by_key(base_file: Path, tmp_path: Path) -> None:
    base = load_arm(base_file)
    child = written(tmp_path, "extends: base.yaml\nname: child\njoints: {one: {velocity: 7}}\n")
    assert child.name == "child"
    assert child.joints["one"].velocity == 7
    assert child.joints["one"].torque == 10
    assert child.joints["two"] == base.joints["two"]
    assert list(child.joints) == ["one", "two"]
    assert child.kinematics == base.kinematics


def test_extending_replaces_lists_as_a_whole(base_file: Path, tmp_path: Path) -> None:
    child = written(tmp_path, "extends: base.yaml\ngravity: [1, 2, 3]\njoints: {one: {position: [-3, 4]}}\n")
    assert child.gravity == (1, 2, 3)
    assert child.joints["one"].position == (-3, 4)


@pytest.mark.parametrize(
    ("base", "text", "message"),
    [
        (BASE, "gravity: [0, 0]", "gravity: must be a list of 3, not 2"),
        (
            BASE.replace("harmonics: 4", "harmonics: 4, joints: {}"),
            "motions: {identification: {kind: fourier, base_frequency: 0.1}}",
            "'joints' is missing; add it",
        ),
    ],
)
def test_a_mistake_in_what_was_replaced_has_its_place_in_the_file_that_replaces_it(
    base_file: Path, tmp_path: Path, base: str, text: str, message: str
) -> None:
    base_file.write_text(base)
    with pytest.raises(ConfigError) as mistakes:
        written(tmp_path, f"extends: base.yaml\n{text}\n")
    (problem,) = mistakes.value.problems
    assert message in problem.message
    assert (problem.path, problem.line) == (tmp_path / "arm.yaml", 2)


def test_a_section_of_the_same_kind_inherits(base_file: Path, tmp_path: Path) -> None:
    child = written(
        tmp_path,
        "extends: base.yaml\ndriver: {seed: 4}\nmotions: {identification: {kind: seeded, harmonics: 6}}\n",
    )
    assert child.driver == SimulatedDriver(kind="simulated", seed=4, torque_noise=0.1)
    assert child.motions.identification == SeededMotion(kind="seeded", seed=5, harmonics=6)


def test_a_section_of_another_kind_replaces(base_file: Path, tmp_path: Path) -> None:
    child = written(
        tmp_path,
        "extends: base.yaml\n"
        "driver: {kind: other_bus, port: can0}\n"
        "motions:\n"
        "  identification:\n"
        "    kind: fourier\n"
        "    base_frequency: 0.1\n"
        "    joints: {one: {a: [1], b: [1], q0: 0}, two: {a: [1], b: [1], q0: 0}}\n",
    )
    assert child.driver == PluginDriver(kind="other_bus", port="can0")  # type: ignore[call-arg]
    assert isinstance(child.motions.identification, FourierMotion)


def test_extending_works_over_several_files(base_file: Path, tmp_path: Path) -> None:
    (tmp_path / "middle.yaml").write_text("extends: base.yaml\nname: middle\ndescription: from the middle\n")
    child = written(tmp_path, "extends: middle.yaml\nname: child\n")
    assert (child.name, child.description, child.joints["two"].torque) == ("child", "from the middle", 20)


def test_file_names_are_relative_to_the_file_they_stand_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "prior.json").write_text('{"names": ["m1"], "values": [1.5]}')
    (tmp_path / "deep" / "base.yaml").write_text(BASE + "prior: prior.json\n")
    (tmp_path / "truth.json").write_text('{"names": ["m1"], "values": [2.5]}')
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    child = written(tmp_path, "extends: deep/base.yaml\ndriver: {truth: truth.json}\n")
    assert child.prior is not None
    assert child.prior.values == (1.5,)
    assert isinstance(child.driver, SimulatedDriver)
    assert child.driver.truth is not None
    assert child.driver.truth.values == (2.5,)


def test_the_hash_is_the_same_for_the_same_content(base_file: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    copy.mkdir()
    (copy / "other.yaml").write_text("# the same arm\n" + BASE)
    assert load_arm(base_file).sha256 == load_arm(base_file).sha256 == load_arm(copy / "other.yaml").sha256
    assert len(load_arm(base_file).sha256) == 64


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("name: base", "name: basis"),
        ("a: 0.25", "a: 0.2500000001"),
        ("velocity: 1,", "velocity: 1.5,"),
        ("-9.81", "-9.80665"),
        ("seed: 5", "seed: 6"),
        ("torque_noise: 0.1", "torque_noise: 0.2"),
        ("one: {velocity", "one: {jerk: 3, velocity"),
    ],
)
def test_the_hash_changes_with_any_content(tmp_path: Path, old: str, new: str) -> None:
    assert BASE.count(old) == 1
    assert written(tmp_path, BASE).sha256 != written(tmp_path, BASE.replace(old, new)).sha256


def test_real_time_is_no_part_of_a_motion_and_leaves_the_hash_of_who_does_not_describe_it(tmp_path: Path) -> None:
    plain, described = written(tmp_path, BASE), written(tmp_path, BASE + "realtime: {priority: 60, cores: [3]}\n")
    assert "realtime" not in plain.model_dump(mode="json")
    assert written(tmp_path, BASE + "realtime: {priority: 50}\n").sha256 == plain.sha256
    assert described.sha256 != plain.sha256
    assert described.motion_sha256 == plain.motion_sha256
    assert ArmConfig.model_validate(described.model_dump(mode="json", by_alias=True)) == described
    with pytest.raises(ConfigError, match="must be at most 98"):
        written(tmp_path, BASE + "realtime: {priority: 99}\n")  # that of the kernel's own threads


def test_the_hash_changes_with_the_content_of_named_files(tmp_path: Path) -> None:
    text = BASE.replace("kinematics: {dh: {", "kinematics: {urdf: arm.urdf}\nprior: prior.json\n#")
    text = text.replace(
        "joints:\n  one: {velocity: 1, torque: 10, position: [-1, 1]}\n  two: {velocity: 2, torque: 20}\n", ""
    )
    hashes = set()
    for urdf in ("<robot/>", "<robot />"):
        for value in ("1.5", "1.6"):
            (tmp_path / "arm.urdf").write_text(urdf)
            (tmp_path / "prior.json").write_text(f'{{"names": ["m1"], "values": [{value}]}}')
            hashes.add(written(tmp_path, text).sha256)
    assert len(hashes) == 4


@pytest.mark.parametrize("arm", sorted(shipped_arms()))
def test_every_shipped_arm_loads_and_has_a_model(arm: str) -> None:
    config = load_arm(arm)
    assert config.name == arm
    model = arm_model(config)
    assert model.layout.joints == model.chain.joints > 0
    assert not config.joints or tuple(config.joints) == model.chain.names


@pytest.mark.parametrize("arm", ["planar2", "threelink", "wam7", "wam7_sim"])
def test_arms_that_can_be_moved_have_all_limits_and_a_prior(arm: str) -> None:
    model = arm_model(load_arm(arm))
    assert model.prior is not None
    assert motion_limits(model.config).kp.shape == (model.chain.joints,)


def test_shipped_arms_are_found_by_name_and_files_by_path(base_file: Path) -> None:
    assert {"wam7", "wam7_sim", "planar2", "threelink"} <= set(shipped_arms())
    assert find_arm("wam7") == shipped_arms()["wam7"]
    assert find_arm(str(base_file)) == base_file


ANGLE = TypeAdapter(Angle)


@given(
    sign=st.sampled_from(["", "+", "-", "- "]),
    factor=st.one_of(st.none(), st.integers(0, 1000), st.floats(0, 100).map(lambda x: round(x, 4))),
    star=st.sampled_from(["", "*", " * "]),
    divisor=st.one_of(st.none(), st.integers(1, 1000)),
)
def test_fractions_of_pi_are_angles(sign: str, factor: float | None, star: str, divisor: int | None) -> None:
    number = "" if factor is None else format(factor, "f").rstrip("0") if isinstance(factor, float) else str(factor)
    text = f"{sign}{number}{star if factor is not None else ''}pi{'' if divisor is None else f'/{divisor}'}"
    expected = (1.0 if factor is None else factor) * math.pi / (divisor or 1)
    expected = -expected if "-" in sign else expected
    assert ANGLE.validate_python(text) == pytest.approx(expected, rel=1e-15, abs=1e-300)


@given(st.integers(-3_600_000, 3_600_000).map(lambda n: n / 10_000), st.sampled_from(["", " ", "  "]))
def test_degrees_are_angles(degrees: float, space: str) -> None:
    text = f"{degrees:.4f}{space}deg"
    assert ANGLE.validate_python(text) == pytest.approx(math.radians(degrees), rel=1e-14)


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_numbers_are_radians(value: float) -> None:
    assert ANGLE.validate_python(value) == value


@pytest.mark.parametrize(
    "text",
    ["", "p", "pie", "pi pi", "2*3*pi", "pi*2", "pi/-2", "1 rad", "90", "deg", "1e3 deg", "__import__('os')", "pi**9"],
)
def test_other_texts_are_no_angles(text: str) -> None:
    with pytest.raises(ValidationError, match="not an angle"):
        ANGLE.validate_python(text)


def test_intervals_take_angles_and_keep_their_order() -> None:
    assert TypeAdapter(Interval).validate_python(("-pi/2", "90 deg")) == (-math.pi / 2, math.pi / 2)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-4", 1e-4),
        ("1E+2", 100.0),
        (".5", 0.5),
        ("5.", 5.0),
        ("+3", 3.0),
        ("0.25", 0.25),
        ("010", 10.0),
        ("2.0e-5", 2e-5),
    ],
)
def test_numbers_people_write_are_numbers(tmp_path: Path, text: str, value: float) -> None:
    assert written(tmp_path, BASE.replace("torque: 10", f"torque: {text}")).joints["one"].torque == value


@pytest.mark.parametrize("text", ["0x10", "1_000", "1e", "'3'", "~", "[3]", "true"])
def test_other_spellings_are_not(tmp_path: Path, text: str) -> None:
    (tmp_path / "arm.yaml").write_text(BASE.replace("harmonics: 4", f"harmonics: {text}"))
    with pytest.raises(ConfigError, match="harmonics"):
        load_arm(tmp_path / "arm.yaml")


def test_configurations_are_frozen() -> None:
    config = load_arm("planar2")
    with pytest.raises(ValidationError, match="frozen"):
        config.name = "other"  # type: ignore[misc]


def test_every_gap_in_the_limits_is_named(tmp_path: Path) -> None:
    config = written(tmp_path, BASE)
    with pytest.raises(MotionRefused) as caught:
        motion_limits(config)
    for joint in ("one", "two"):
        for key in ("acceleration", "jerk", "following_error", "kp", "kd"):
            assert f"joints.{joint}.{key}" in str(caught.value)
    assert "joints.two.position" in str(caught.value)
    for given_key in ("joints.one.position", "joints.one.velocity", "joints.two.torque"):
        assert given_key not in str(caught.value)


def test_home_defaults_to_the_place_nearest_to_zero(tmp_path: Path) -> None:
    rest = "velocity: 1, acceleration: 1, jerk: 1, torque: 1, following_error: 1, kp: 1, kd: 1"
    text = BASE[: BASE.index("joints:\n")]
    text += f"joints:\n  one: {{position: [0.5, 2], {rest}}}\n  two: {{position: [-2, 1], {rest}, home: -1}}\n"
    limits = motion_limits(written(tmp_path, text))
    assert limits.home.tolist() == [0.5, -1.0]
    assert limits.lower.tolist() == [0.5, -2.0]
    assert limits.upper.tolist() == [2.0, 1.0]


def test_a_description_may_extend_a_shipped_one_by_its_name(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("extends: wam7_sim\nname: mine\n", encoding="utf-8")
    assert load_arm(path).model_copy(update={"name": "wam7_sim"}) == load_arm("wam7_sim")
    # A file beside it comes first.
    (tmp_path / "wam7_sim").write_text(f"extends: {shipped_arms()['planar2']}\n", encoding="utf-8")
    assert load_arm(path).joints == load_arm("planar2").joints
