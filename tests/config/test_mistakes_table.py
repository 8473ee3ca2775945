"""`ident config check`: usual mistakes and what exactly is answered, each with its place and one thing to do."""

from __future__ import annotations

from pathlib import Path

import pytest

from ident_service.cli import main

GOOD = """\
format: ident-arm
version: 1
name: bench
kinematics:
  dh:
    convention: standard
    joints:
      shoulder: {a: 0.5}
      elbow: {a: 0.5}
joints:
  shoulder: {position: [-2, 2], velocity: 2, acceleration: 8, jerk: 80, torque: 40, following_error: 0.2, kp: 100, kd: 20}
  elbow: {position: [-2, 2], velocity: 2, acceleration: 8, jerk: 80, torque: 20, following_error: 0.2, kp: 100, kd: 20}
prior: {Lzz1: 0.5, m1: 2.0, Lzz2: 0.2, m2: 1.0}
control: {rate: 500}
motions: {identification: {kind: seeded, seed: 1}}
driver: {kind: simulated, truth: {Lzz1: 0.6, m1: 2.2, Lzz2: 0.2, m2: 1.0}}
"""  # noqa: E501
ELBOW = next(line.strip() for line in GOOD.splitlines() if line.startswith("  elbow: {position"))
SOFTER = "lower kp and kd, or raise control.rate or control.velocity_cutoff"
GUESSES = "`ident new` guesses them from a mechanism"
YAML = "quote text with a colon in it, and look for a bracket, a quote or an indentation that is wrong"


def answer(text: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, list[str]]:
    """Exit code, and the lines that are told, without the folder's name."""
    (folder / "arm.yaml").write_text(text)
    code = main(["config", "check", "arm.yaml"])
    told = capsys.readouterr()
    lines = (told.out + told.err).replace(f"{folder.resolve()}/", "").removeprefix("ident: ").splitlines()
    return code, [line for line in lines if not line.startswith("next: ")]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("old", "new", "lines"),
    [
        # Keys.
        (
            "velocity: 2, acceleration: 8, jerk: 80, torque: 40",
            "velocty: 2, acceleration: 8, jerk: 80, torque: 40",
            ["11:33: joints.shoulder.velocty: unknown key 'velocty'; did you mean 'velocity'?"],
        ),
        (
            "control: {rate: 500}",
            "control: {rate: 500}\nrate: 500",
            ["15:1: rate: unknown key 'rate'; it belongs in control or recording"],
        ),
        (
            "control: {rate: 500}",
            "control: {rate: 500, joints: 2}",
            ["14:22: control.joints: unknown key 'joints'; it belongs at the top of the file, not under control"],
        ),
        (
            "convention: standard",
            "convention: standard\n    urdf: x",
            ["7:5: kinematics.dh.urdf: unknown key 'urdf'; it belongs in kinematics, not under dh"],
        ),
        (
            "control: {rate: 500}",
            "realtime: {zzz: 1}",
            ["14:12: realtime.zzz: unknown key 'zzz'; leave it out: known here are cores, priority"],
        ),
        (
            "name: bench\n",
            "",
            [
                "1:1: 'name' is missing; add it: Name of the arm: letters, digits and `_.-`, at most 64; registry, "
                "folders and files use it."
            ],
        ),
        ("name: bench", "name: bench\nname: desk", ["4:1: 'name' stands twice; leave one out"]),
        # Choices and names.
        (
            "kind: simulated",
            "kind: simulatd",
            [
                "16:10: driver.kind: no driver is called 'simulatd'; known: barrett, canopen, simulated; did you mean "
                "'simulated'?"
            ],
        ),
        (
            "kind: simulated",
            "kind: kuka_fri",
            [
                "16:10: driver.kind: no driver is called 'kuka_fri'; known: barrett, canopen, simulated; install the "
                "package that brings it, or take one of these"
            ],
        ),
        (
            "kind: seeded",
            "kind: seded",
            ["15:11: motions.identification: kind must be fourier or seeded, not 'seded'; did you mean 'seeded'?"],
        ),
        (
            "convention: standard",
            "convention: modfied",
            [
                "6:5: kinematics.dh.convention: must be 'standard' or 'modified', not 'modfied'; did you mean "
                "'modified'?"
            ],
        ),
        (
            "m1: 2.2",
            "mm1: 2.2",
            ["16:46: driver.truth: parameters this arm does not have: mm1; did you mean 'm1'?"],
        ),
        (
            "m2: 1.0}\ncontrol",
            "weight: 1.0}\ncontrol",
            ["13:40: prior: parameters this arm does not have: weight; it has Lxx1 ... fo2"],
        ),
        (
            "m2: 1.0}\ncontrol",
            "m2: -1.0}\ncontrol",
            ["13:40: prior.m2: a link's mass is above 0, not -1 kg; give the masses of CAD, or no prior"],
        ),
        (
            "elbow: {position",
            "elbow_: {position",
            [
                "10:1: joints: shoulder, elbow_ are not those of kinematics.dh: shoulder, elbow; give the same names "
                "in the same order"
            ],
        ),
        (
            "control: {rate: 500}",
            "geometry: {elbw: [{from: [0, 0, 0], to: [0.4, 0, 0], radius: 0.05}]}",
            ["14:12: geometry: no joint 'elbw', and not 'base'; did you mean 'elbow'?"],
        ),
        (
            "name: bench",
            "name: bench\nextends: wam8.yaml",
            ["4:1: extends: no such file: wam8.yaml; did you mean 'wam7'?"],
        ),
        (
            "name: bench",
            "name: bench\nidentification: {method: hubber, smoothing: {cutoff: slow}}",
            [
                "4:18: identification.method: must be 'ols', 'wls', 'huber' or 'iv' or 'choose', not 'hubber'; did you "
                "mean 'huber'?",
                "4:46: identification.smoothing.cutoff: must be a number [Hz] or 'choose', not 'slow'",
            ],
        ),
        # Numbers and their units.
        (
            "position: [-2, 2], velocity: 2, acceleration: 8, jerk: 80, torque: 40",
            "position: [-170, 170], velocity: 180, acceleration: 8, jerk: 80, torque: 40",
            [
                "11:14: joints.shoulder.position: [-170, 170] rad (m of a slide) is no arm's; if it is in degrees, "
                "write [-170 deg, 170 deg]",
                "11:37: joints.shoulder.velocity: 180 rad/s (m/s of a slide) is no arm's; if it is in degrees per "
                "second, write 3.142",
            ],
        ),
        (
            "shoulder: {a: 0.5}",
            "shoulder: {a: 0.5, alpha: 90}",
            [
                "8:7: kinematics.dh.joints.shoulder: alpha: 90 rad is more than a turn; numbers are rad, degrees are "
                "written '90 deg'"
            ],
        ),
        (
            "elbow: {a: 0.5}",
            "elbow: {a: 500}",
            ["9:7: kinematics.dh.joints.elbow: a: 500 m is longer than the link of any arm; in mm? lengths are metres"],
        ),
        (
            "elbow: {position: [-2, 2]",
            "elbow: {position: [2, -2]",
            ["12:11: joints.elbow.position: lower bound 2 is not below upper bound -2; check order and units"],
        ),
        (
            "rate: 500",
            "rate: '500'",
            ["14:11: control.rate: '500' is text, and a number is needed; leave out the quotes"],
        ),
        ("rate: 500", "rate: fast", ["14:11: control.rate: must be a number [Hz], not 'fast'"]),
        ("rate: 500", "rate: 0", ["14:11: control.rate: must be greater than 0 [Hz], not 0"]),
        ("name: bench", "name: bench\ngravity: [0, -9.81]", ["4:1: gravity: must be a list of 3, not 2"]),
        # Files and YAML.
        (
            "dh:\n    convention: standard\n    joints:\n      shoulder: {a: 0.5}\n      elbow: {a: 0.5}",
            "urdf: bench.urdf",
            ["5:3: kinematics.urdf: no such file: bench.urdf; give its path as seen from the description's folder"],
        ),
        ("name: bench", "name: bench: desk", [f"3:12: mapping values are not allowed in this context; {YAML}"]),
    ],
)
def test_each_mistake_has_its_place_and_a_remedy(
    old: str, new: str, lines: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert old in GOOD
    code, told = answer(GOOD.replace(old, new, 1), folder, capsys)
    assert (code, told) == (2, [f"arm.yaml:{line}" for line in lines])


@pytest.mark.parametrize(
    ("old", "new", "lines"),
    [
        (
            ELBOW,
            "elbow: {position: [-2, 2], velocity: 2, jerk: 80, torque: 20}",
            [f"12:3: joints.elbow: a motion needs acceleration, following_error, kp, kd; {GUESSES}"],
        ),
        (
            "kp: 100, kd: 20}\n  elbow",
            "kp: 1e6, kd: 2000}\n  elbow",
            [
                "11:107: gains: shoulder: unstable for some inertia from 1 times the model's up (spectral radius "
                f"2.2064, gain margin 1.00); {SOFTER}",
                f"14:11: gains: all joints together are unstable (spectral radius 2.2064); {SOFTER}",
            ],
        ),
        (
            "kind: simulated, truth: {Lzz1: 0.6, m1: 2.2, Lzz2: 0.2, m2: 1.0}",
            "kind: barrett, heartbeat: 0.01, pucks: [{node: 1, ipnm: 2000, mt: 2000}, {node: 2, ipnm: 2000, mt: 2000}]",
            [],
        ),
        (
            "prior: {Lzz1: 0.5, m1: 2.0, Lzz2: 0.2, m2: 1.0}",
            "description: no masses",
            [
                "4:1: kinematics: computed torque needs a model of the links; give `prior`, or a URDF or MJCF with the "
                "masses of its links"
            ],
        ),
    ],
)
def test_what_cannot_move_is_never_called_good(
    old: str, new: str, lines: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = GOOD.replace(old, new, 1)
    assert text != GOOD
    if not lines:  # gravity moves the joints of this arm, and real drives have no brake unless one is described
        text = text.replace("joints:\n  sh", "gravity: [0, -9.81, 0]\ntransmission: {ratios: [20, 20]}\njoints:\n  sh")
        text = text.replace("position: [-2, 2]", "home: 0, position: [-2, 2]")
        lines = [
            "16:1: bench: shoulder, elbow would fall after a stop: gravity moves them, and no brake is described; set "
            "control.after_stop to hold or lower, or joints.shoulder.brake to true where there is one"
        ]
        text = text.replace("m1: 2.0", "lx1: 0.5, m1: 2.0").replace("m2: 1.0}\ncon", "lx2: 0.2, m2: 1.0}\ncon")
    code, told = answer(text, folder, capsys)
    assert code == 3
    assert told[0] == "arm.yaml: bench, 2 joints, 28 parameters: CANNOT MOVE"
    found = [line.removeprefix("  arm.yaml:") for line in told if line.startswith("  arm.yaml:")]
    assert found == lines
    assert not any(line.endswith("good") for line in told)


def test_mistakes_of_several_sections_are_told_at_once(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wrong = GOOD.replace("m1: 2.0", "m1: -2.0, m9: 1").replace("truth: {", "truth: {Lzz7: 1, ")
    lines = [
        "13:20: prior.m1: a link's mass is above 0, not -2 kg; give the masses of CAD, or no prior",
        "13:30: prior: parameters this arm does not have: m9; it has Lxx1 ... fo2",
        "16:35: driver.truth: parameters this arm does not have: Lzz7; did you mean 'Lzz2'?",
    ]
    code, told = answer(wrong, folder, capsys)
    assert (code, [line.removeprefix("arm.yaml:") for line in told]) == (2, lines)
    code, told = answer(wrong.replace("kind: simulated", "kind: simulatd"), folder, capsys)
    assert code == 2
    assert [line.removeprefix("arm.yaml:")[:20] for line in told] == [
        "16:10: driver.kind: ",
        *(one[:20] for one in lines[:2]),
    ]
    # Verbs that make a model of it tell the same places.
    assert main(["base-parameters", "arm.yaml"]) == 2
    assert capsys.readouterr().err.count("arm.yaml:") == 3


def test_a_mesh_that_no_clearance_can_be_computed_from_is_reported_before_preflight(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arms = Path(__file__).resolve().parents[2] / "configs"
    urdf = (
        (arms / "threelink.urdf")
        .read_text()
        .replace('<cylinder radius="0.08" length="0.1"/>', "<mesh filename='a.stl'/>")
    )
    (folder / "threelink.urdf").write_text(urdf)
    code, told = answer((arms / "threelink.yaml").read_text(), folder, capsys)
    assert code == 3
    assert told[0].endswith("CANNOT MOVE")
    assert "threelink.urdf: link 'base': its collision geometry is a mesh" in told[1]
    assert "give capsules for 'base' under geometry" in told[1]


def test_an_arm_without_a_driver_is_refused_with_what_a_motion_needs(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = GOOD.replace(ELBOW, "elbow: {position: [-2, 2]}").partition("driver:")[0]
    code, told = answer(text, folder, capsys)
    assert code == 0
    verdict = "good for identification from recordings; it cannot be moved"
    lacking = "velocity, acceleration, jerk, torque, following_error, kp, kd"
    assert told == [
        f"arm.yaml: bench, 2 joints, 28 parameters: {verdict}",
        f"  arm.yaml:12:3: joints.elbow: a motion needs {lacking}; {GUESSES}",
        "gains: not checked, because limits or gains are missing",
    ]
    assert answer(GOOD, folder, capsys)[1][0] == "arm.yaml: bench, 2 joints, 28 parameters: good"
