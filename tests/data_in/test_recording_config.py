"""The sections `recording` and `transmission`, in an arm's file and alone: every mistake has its place."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ident_service.config.load import load_arm, load_recording_format
from ident_service.config.recording import RecordingFormat
from ident_service.errors import ConfigError, UsageError

ARM = """\
format: ident-arm
version: 1
name: two
kinematics: {dh: {convention: standard, joints: {one: {a: 0.5}, two: {a: 0.25}}}}
transmission:
  ratios: [50, -40]
  coupling: [[1, 0], [0.5, 1]]
  offsets: [0, pi/2]
recording:
  side: motor
  columns: {t: time, q1: a1, q2: a2, tau1: m1, tau2: m2}
  joint_names: {one: axis_1}
  topic: /arm/joint_states
  trim: [1, 0.5]
  gap: 2.5
  rate: 500
"""


def mistakes_in_arm(folder: Path, old: str, new: str) -> list[str]:
    assert ARM.count(old) == 1
    path = folder / "arm.yaml"
    path.write_text(ARM.replace(old, new))
    with pytest.raises(ConfigError) as caught:
        load_arm(path)
    return [str(problem).removeprefix(f"{path.resolve()}:") for problem in caught.value.problems]


def test_both_sections_are_read_and_belong_to_the_hash(tmp_path: Path) -> None:
    (tmp_path / "arm.yaml").write_text(ARM)
    config = load_arm(tmp_path / "arm.yaml")
    assert config.transmission is not None
    assert config.transmission.ratios == (50, -40)
    assert config.transmission.offsets == (0, pytest.approx(1.5707963267948966))
    assert config.recording.joint_names == {"one": "axis_1"}
    assert (config.recording.trim, config.recording.gap, config.recording.rate) == ((1, 0.5), 2.5, 500)
    (tmp_path / "other.yaml").write_text(ARM.replace("[50, -40]", "[50, 40]"))
    assert load_arm(tmp_path / "other.yaml").sha256 != config.sha256


def test_without_them_nothing_is_assumed() -> None:
    config = load_arm("planar2")
    assert config.recording == RecordingFormat()
    assert config.transmission is None


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("ratios: [50, -40]", "ratios: [50, 0]", "6:3: transmission.ratios: a ratio of zero moves nothing"),
        ("ratios: [50, -40]", "ratios: [50]", "7:3: transmission.coupling: 1 ratios need 1 rows of 1 numbers"),
        ("[[1, 0], [0.5, 1]]", "[[1, 0], [0.5]]", "7:3: transmission.coupling: 2 ratios need 2 rows of 2 numbers"),
        ("[[1, 0], [0.5, 1]]", "[[1, 2], [0.5, 1]]", "7:3: transmission.coupling: the matrix has no inverse"),
        ("[0, pi/2]", "[0]", "8:3: transmission.offsets: 1 offsets for 2 ratios"),
        ("[0, pi/2]", "[0, north]", "8:16: transmission.offsets.1: not an angle"),
        ("side: motor", "side: left", "10:3: recording.side: must be 'joint' or 'motor', not 'left'"),
        ("q2: a2, ", "", "11:3: recording.columns: no column for q2"),
        ("q2: a2, ", "q2: a2, dq2: v2, ", "11:3: recording.columns: no column for dq1"),
        ("q2: a2, ", "q2: a1, ", "11:3: recording.columns: column 'a1' stands for more than one"),
        ("q2: a2, ", "q2: a2, ddq1: b, ", "recording.columns.ddq1: "),
        (", tau2: m2}", ", tau2: m2, q3: a3, tau3: m3}", "11:3: recording.columns: 3 joints, but the arm has 2"),
        ("{one: axis_1}", "{three: axis_3}", "12:17: recording.joint_names: no joint 'three'"),
        ("{one: axis_1}", "{one: a, two: a}", "12:3: recording.joint_names: name 'a' stands for more than one"),
        ("trim: [1, 0.5]", "trim: [-1, 0.5]", "recording.trim.0: must be at least 0"),
        ("gap: 2.5", "gap: 1", "15:3: recording.gap: must be greater than 1"),
        ("rate: 500", "rate: 0", "16:3: recording.rate: must be greater than 0"),
        ("rate: 500", "rates: 500", "16:3: recording.rates: unknown key 'rates'"),
    ],
)
def test_a_mistake_is_named_at_its_place(tmp_path: Path, old: str, new: str, expected: str) -> None:
    assert any(expected in problem for problem in mistakes_in_arm(tmp_path, old, new))


def test_all_disagreements_come_at_once(tmp_path: Path) -> None:
    text = ARM.replace("[50, -40]", "[50, -40, 3]").replace(
        "  coupling: [[1, 0], [0.5, 1]]\n  offsets: [0, pi/2]\n", ""
    )
    path = tmp_path / "arm.yaml"
    path.write_text(text.replace("{one: axis_1}", "{uno: axis_1}"))
    with pytest.raises(ConfigError, match=r"(?s)6:3: .*3 values for 2 joints.*no joint 'uno'"):
        load_arm(path)


def test_motor_side_needs_a_transmission(tmp_path: Path) -> None:
    start, stop = ARM.index("transmission:"), ARM.index("recording:")
    path = tmp_path / "arm.yaml"
    path.write_text(ARM[:start] + ARM[stop:])
    with pytest.raises(ConfigError, match=r"6:3: recording\.side: motor, but there is no transmission"):
        load_arm(path)
    path.write_text(path.read_text().replace("side: motor", "torque_side: motor"))
    with pytest.raises(ConfigError, match=r"6:3: recording\.torque_side: motor, but there is no transmission"):
        load_arm(path)


def test_descriptions_without_later_keys_keep_their_hash() -> None:
    # Of the version before: results name descriptions by it.
    known = set(json.loads(load_arm("ur10").model_dump_json(include={"recording"}))["recording"])
    assert known == {"columns", "joint_names", "topic", "side", "stamps", "trim", "gap", "rate"}


def test_the_format_alone(tmp_path: Path) -> None:
    path = tmp_path / "format.yaml"
    path.write_text("trim: [2, 1]\ncolumns: {t: time, q1: angle, tau1: moment}\n")
    form = load_recording_format(path)
    assert form == RecordingFormat(trim=(2.0, 1.0), columns={"t": "time", "q1": "angle", "tau1": "moment"})
    with pytest.raises(UsageError, match="no such file"):
        load_recording_format(tmp_path / "none.yaml")


def test_the_format_alone_has_all_its_mistakes_at_once(tmp_path: Path) -> None:
    path = tmp_path / "format.yaml"
    path.write_text("trim: [2]\ncolumn: {t: time}\ngap: wide\n")
    with pytest.raises(ConfigError) as caught:
        load_recording_format(path)
    assert [(problem.line, problem.column) for problem in caught.value.problems] == [(1, 1), (3, 1), (2, 1)]
    assert "unknown key 'column'" in str(caught.value)
