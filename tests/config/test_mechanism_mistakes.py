"""What only shows when the mechanism is computed is told with its place too, and is a mistake of the description."""

from __future__ import annotations

import re
from pathlib import Path

import pinocchio
import pytest
from model.test_locked_joints import PANDA

from ident_service.cli import main
from ident_service.config.quantities import TextFile
from ident_service.errors import ModelError
from ident_service.model.mechanism import require_urdf

ARM = """\
format: ident-arm
version: 1
name: panda
kinematics: {urdf: panda.urdf, tip: panda_hand}
joints:
""" + "".join(f"  panda_joint{k}: {{home: 0}}\n" for k in range(1, 8))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "panda.urdf").write_text(PANDA)
    return tmp_path


@pytest.mark.parametrize(
    ("change", "place", "words"),
    [
        (("tip: panda_hand", "tip: nowhere"), "4:32: kinematics.tip: ", "no link 'nowhere'"),
        (
            ("tip: panda_hand", "tip: panda_hand, lock: {panda_joint3: 9}"),
            "4:49: kinematics.lock: ",
            "panda_joint3 at 9 is outside its limits",
        ),
        (("panda_joint7:", "elbow:"), "5:1: joints: ", "but the mechanism has panda_joint1"),
        (
            ("joints:", "driver: {kind: simulated, truth: {m1: 1, m99: 2}}\njoints:"),
            "5:42: driver.truth: ",
            "parameters this arm does not have: m99",
        ),
        (("joints:", "prior: {m1: 1, Q4: 2}\njoints:"), "5:16: prior", "parameters this arm does not have: Q4"),
    ],
)
def test_it_has_a_place(
    folder: Path, change: tuple[str, str], place: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = folder / "arm.yaml"
    path.write_text(ARM.replace(*change))
    assert main(["config", "check", str(path)]) == 2
    err = capsys.readouterr().err
    assert f"arm.yaml:{place}" in err
    assert words in err


def with_mass(text: str) -> tuple[str, int]:
    """The Panda's URDF with another mass of its fourth link, and the line where it stands."""
    lines = PANDA.replace("<link", "\n<link").replace("<mass", "\n<mass").splitlines()
    begin = next(k for k, line in enumerate(lines) if 'name="panda_link4"' in line)
    place = next(k for k in range(begin, len(lines)) if "<mass" in lines[k])
    lines[place] = re.sub(r'<mass value="[^"]*"', f'<mass value="{text}"', lines[place])
    return "\n".join(lines), place + 1


@pytest.mark.parametrize("mass", ["nan", "inf", "-inf", "0", "0.0", "-2.5"])
def test_a_mass_that_no_link_has_is_refused_with_its_line(
    folder: Path, mass: str, capsys: pytest.CaptureFixture[str]
) -> None:
    text, line = with_mass(mass)
    (folder / "panda.urdf").write_text(text)
    path = folder / "arm.yaml"
    path.write_text(ARM)
    assert main(["config", "check", str(path)]) == 2
    err = capsys.readouterr().err
    assert f"arm.yaml:4:14: kinematics.urdf: panda.urdf:{line}: link 'panda_link4' has mass of" in err
    assert mass in err
    # Whoever knows the links gives them in the description, and the URDF's are not asked.
    prior = ", ".join(f"m{k}: 1, Lxx{k}: 0.1, Lyy{k}: 0.1, Lzz{k}: 0.1" for k in range(1, 8))
    path.write_text(f"{ARM}prior: {{{prior}}}\n")
    assert main(["config", "check", str(path)]) == 0


def test_an_inertia_that_is_no_number_is_refused_with_its_line(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "panda.urdf").write_text(re.sub(r'iyy="[^"]*"', 'iyy="nan"', PANDA, count=1))
    (folder / "arm.yaml").write_text(ARM)
    assert main(["config", "check", str(folder / "arm.yaml")]) == 2
    assert "has inertia (iyy) of 'nan'" in capsys.readouterr().err


def test_frames_without_a_body_and_urdfs_without_any_are_good(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    none = '<inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/>'
    frame = f'<link name="mark"><inertial><mass value="0"/>{none}</inertial></link>'
    at = '<joint name="marked" type="fixed"><parent link="panda_link4"/><child link="mark"/></joint></robot>'
    (folder / "panda.urdf").write_text(PANDA.replace("</robot>", frame + at))
    (folder / "arm.yaml").write_text(ARM)
    assert main(["config", "check", str(folder / "arm.yaml")]) == 0
    bare = re.sub(r"<inertial>.*?</inertial>", "", PANDA, flags=re.DOTALL)
    assert "<mass" not in bare
    (folder / "panda.urdf").write_text(bare)
    assert main(["config", "check", str(folder / "arm.yaml")]) == 0


@pytest.mark.slow
def test_a_name_that_no_file_can_have_is_a_mistake(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "arm.yaml").write_text(f"format: ident-arm\nextends: {'y' * 5000}\n")
    assert main(["config", "check", str(folder / "arm.yaml")]) == 2
    assert "arm.yaml:2:1: yyyy" in capsys.readouterr().err
    for words in (["config", "check"], ["new"], ["base"]):
        assert main([*words, "z" * 5000]) == 2
        assert "this name is too long for a file" in capsys.readouterr().err


def test_without_a_mistake_it_is_good(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "arm.yaml").write_text(ARM)
    assert main(["config", "check", str(folder / "arm.yaml")]) == 0, capsys.readouterr().err


BODY = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
URDF = f"""\
<robot name="r">
<link name="base">{BODY}</link>
<link name="b">{BODY}</link>
<joint name="j" type="revolute">
<parent link="base"/>
<child link="b"/>
<origin xyz="0 0 1" rpy="0 0 0"/>
<axis xyz="0 0 1"/>
<limit lower="-1" upper="1" velocity="1" effort="10"/>
</joint>
</robot>
"""
LIMIT = '<limit lower="-1" upper="1" velocity="1" effort="10"/>'
REFUSED = [
    (
        '<link name="base">',
        '<link name="ground">',
        "5: joint 'j': its parent link 'base' is declared nowhere; add <link",
    ),
    ('effort="10"', 'effort="abc"', "9: joint 'j': limit effort is 'abc'; give a number of N m (N of a slide)"),
    ('lower="-1"', 'lower="nan"', "9: joint 'j': limit lower is 'nan'; give a number of rad (m of a slide)"),
    (' velocity="1"', "", "9: joint 'j': its limit has no velocity; give it in rad/s (m/s of a slide)"),
    (LIMIT, "", "4: joint 'j': is revolute and has no limit; give <limit lower= upper= effort= velocity=>"),
    ('axis xyz="0 0 1"', 'axis xyz="0 0"', "8: joint 'j': axis xyz is '0 0'; give three numbers"),
    ('rpy="0 0 0"', 'rpy="0 90deg 0"', "7: joint 'j': origin rpy is '0 90deg 0'; give three numbers"),
    (
        "revolute",
        "hinge",
        "4: joint 'j': type 'hinge' is none of revolute, prismatic, continuous, fixed, floating, planar",
    ),
    ('<parent link="base"/>', "", "4: joint 'j': names no parent link; give <parent link=...>"),
    ('<link name="b">', '<link name="base">', "3: link 'base' is there already, in line 2; rename one of them"),
    ('<joint name="j"', "<joint", "4: a joint without a name; give <joint name=...>"),
    ('<robot name="r">', "<robot>", "1: the robot has no name; give <robot name=...>"),
    (LIMIT, f'{LIMIT}<mimic multiplier="two"/>', "9: joint 'j': mimic multiplier is 'two'; give a number"),
    (LIMIT, f'{LIMIT}<dynamics damping="x"/>', "9: joint 'j': dynamics damping is 'x'; give a number"),
    (
        "</robot>",
        '<link name="far"/></robot>',
        "11: 2 links hang on no joint: 'base' (line 2), 'far' (line 11); a URDF is",
    ),
]
TAKEN = [
    ('axis xyz="0 0 1"', 'axis xyz="0 0 -250"'),
    ("revolute", "continuous"),
    (LIMIT, '<limit velocity="+1.e0" effort=" 10"/>'),
    (LIMIT, f'{LIMIT}<limit effort="x"/>'),
    (LIMIT, f'{LIMIT}<dynamics damping="0.5"/><safety_controller k_velocity="1"/>'),
    ("</robot>", '<gazebo><link name="x"/></gazebo><transmission name="t"><joint name="j"/></transmission></robot>'),
    ("</link>", '<visual><geometry><box size="a"/></geometry></visual></link>'),
]


@pytest.mark.slow
@pytest.mark.parametrize(("old", "new", "said"), REFUSED)
@pytest.mark.parametrize("verb", [("config", "check"), ("base",), ("new",)])
def test_what_a_urdfs_parser_refuses_is_reported_with_its_line_and_in_our_words(
    tmp_path: Path, old: str, new: str, said: str, verb: tuple[str, ...], capfd: pytest.CaptureFixture[str]
) -> None:
    assert old in URDF
    (tmp_path / "r.urdf").write_text(URDF.replace(old, new))
    arm = tmp_path / "arm.yaml"
    arm.write_text("format: ident-arm\nversion: 1\nname: r\nkinematics: {urdf: r.urdf}\n")
    given = [str(tmp_path / "r.urdf"), "--out", str(tmp_path / "o" / "x.yaml")] if verb == ("new",) else [str(arm)]
    assert main([*verb, *given]) == 2
    err = capfd.readouterr().err  # what libraries in C++ write as well
    assert err.startswith("ident: r.urdf:" if verb == ("new",) else f"ident: {arm}:4:1: kinematics: r.urdf:")
    assert f"r.urdf:{said}" in err
    assert len(err.splitlines()) == 1
    assert not (tmp_path / "o").exists()
    with pytest.raises(ValueError, match="valid URDF"):
        pinocchio.buildModelFromXML((tmp_path / "r.urdf").read_text())


@pytest.mark.parametrize("axis", ["0 0 0", "0 -0.0 0e5", "1e-170 0 0", "1e300 0 0"])
@pytest.mark.parametrize("verb", [("config", "check"), ("new",)])
def test_an_axis_that_is_no_direction_is_refused(
    tmp_path: Path, axis: str, verb: tuple[str, ...], capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "r.urdf").write_text(URDF.replace('axis xyz="0 0 1"', f'axis xyz="{axis}"'))
    (tmp_path / "arm.yaml").write_text("format: ident-arm\nversion: 1\nname: r\nkinematics: {urdf: r.urdf}\n")
    file = tmp_path / ("r.urdf" if verb == ("new",) else "arm.yaml")
    assert main([*verb, str(file), *(["--out", str(tmp_path / "o")] if verb == ("new",) else [])]) == 2
    assert f"r.urdf:8: joint 'j': axis xyz is '{axis}', which is no direction; give one" in capfd.readouterr().err
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize(("old", "new"), [("", ""), *TAKEN])
def test_nothing_is_refused_that_the_parser_takes(old: str, new: str) -> None:
    text = URDF.replace(old, new) if old else URDF
    assert old in URDF
    pinocchio.buildModelFromXML(text)
    require_urdf(TextFile(name="r.urdf", text=text))


def test_of_many_mistakes_the_first_are_reported() -> None:
    text = URDF.replace('"0 0 1"', '"x"').replace('lower="-1" upper="1" velocity="1" effort="10"', 'lower="y"')
    text = text.replace('rpy="0 0 0"', 'rpy="z"').replace('"revolute"', f'"{"w" * 5000}"')
    with pytest.raises(ModelError, match=r"^r\.urdf:4: .*r\.urdf:7: .*r\.urdf:7: .*; and 2 more$") as caught:
        require_urdf(TextFile(name="r.urdf", text=text))
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize("verb", [("config", "check"), ("base",), ("simulate",), ("new",)])
def test_what_breaks_a_parser_is_counted_first_at_the_command_line_too(
    tmp_path: Path, verb: tuple[str, ...], capfd: pytest.CaptureFixture[str]
) -> None:
    count = 5000
    links = "".join(f'<link name="l{k}"/>' for k in range(count))
    joints = "".join(
        f'<joint name="j{k}" type="fixed"><parent link="l{k}"/><child link="l{k + 1}"/></joint>'
        for k in range(count - 1)
    )
    (tmp_path / "r.urdf").write_text(f'<robot name="r">{links}{joints}</robot>')
    (tmp_path / "arm.yaml").write_text("extends: threelink\nname: r\nkinematics: {urdf: r.urdf}\n")
    file = tmp_path / ("r.urdf" if verb == ("new",) else "arm.yaml")
    assert main([*verb, str(file), *(["--out", str(tmp_path / "o")] if verb[0] in ("new", "simulate") else [])]) == 2
    err = capfd.readouterr().err
    assert "r.urdf: more than 256 links; an arm has fewer" in err
    assert len(err.splitlines()) == 1
