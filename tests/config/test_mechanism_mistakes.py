"""What only shows when the mechanism is computed is told with its place too, and is a mistake of the description."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from model.test_locked_joints import PANDA

from ident_service.cli import main

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
            "5:27: driver.truth: ",
            "parameters this arm does not have: m99",
        ),
        (("joints:", "prior: {m1: 1, Q4: 2}\njoints:"), "5:1: prior", "parameters this arm does not have: Q4"),
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
