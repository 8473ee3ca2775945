"""Columns in other units: what a number is multiplied by, and what is refused as a slip."""

from __future__ import annotations

import math
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from estimation.synthetic import recorded, waves
from hypothesis import given
from hypothesis import strategies as st
from made_recordings import whole

from ident_service.config.load import load_arm, load_recording_format
from ident_service.config.recording import Column, RecordingFormat
from ident_service.errors import ConfigError, ModelError, RecordingError
from ident_service.estimation.identify import Estimate, identify
from ident_service.estimation.plausibility import reasons_against
from ident_service.model.arm_model import arm_model
from ident_service.recordings.open import open_recording

PLAIN: dict[str, Any] = {"t": "t", "q1": "q1", "tau1": "tau1"}


def form(**columns: Any) -> RecordingFormat:
    return RecordingFormat.model_validate({"columns": PLAIN | columns})


def read(folder: Path, text: str, layout: RecordingFormat) -> tuple[list[int], list[float], list[float]]:
    (folder / "run.csv").write_text(text)
    block = whole(open_recording(folder / "run.csv", fmt=layout))
    return block.stamp_ns.tolist(), block.position[:, 0].tolist(), block.torque[:, 0].tolist()


@pytest.mark.parametrize(
    ("name", "column", "factor"),
    [
        ("q1", {"unit": "deg"}, math.pi / 180.0),
        ("q1", {"unit": "rev", "factor": -0.02}, -0.02 * 2.0 * math.pi),
        ("q1", {"unit": "counts", "factor": 1e-5}, 1e-5),
        ("q1", {"unit": "mm"}, 1e-3),
        ("dq1", {"unit": "rpm"}, 2.0 * math.pi / 60.0),
        ("dq1", {"unit": "deg / s", "factor": -1}, -math.pi / 180.0),
        ("tau1", {"unit": "mA", "factor": -11.2}, -0.0112),
        ("tau1", {"unit": "A", "factor": 11.2}, 11.2),
        ("tau1", {"unit": "A", "factor": 1.0}, 1.0),
        ("tau1", {"unit": "%", "factor": 1}, 0.01),
        ("tau1", {"unit": "%", "factor": 176}, 1.76),
        ("tau1", {"unit": "mN m", "factor": 100}, 0.1),
        ("tau1", {"unit": "N\u00b7m"}, 1.0),
        ("tau1", {"factor": -11.2}, -11.2),
        ("t", {"unit": "\u00b5s"}, 1e-6),
        ("t", {"unit": "counts", "factor": 0.004}, 0.004),
    ],
)
def test_a_number_times_this_is_si(name: str, column: dict[str, Any], factor: float) -> None:
    assert Column(column="theirs", **column).si_factor(name) == pytest.approx(factor, rel=1e-15)


@pytest.mark.parametrize(
    ("name", "column", "words"),
    [
        ("q1", {"unit": "degrees"}, "q1: unit 'degrees' is not known; known are rad, mrad, deg, rev, m, mm, counts"),
        ("q1", {"unit": "mA"}, "q1: unit 'mA' is a unit of torque, not of position"),
        ("tau1", {"unit": "deg"}, "tau1: unit 'deg' is a unit of position, not of torque"),
        ("tau1", {"unit": "mA"}, "tau1: unit 'mA' needs a factor in N m or N per A"),
        ("q1", {"unit": "counts"}, "needs a factor in rad or m per count"),
        ("q1", {"unit": "deg", "factor": 0.01745}, "converted by 0.0174533 already, and a factor of 0.01745 would"),
        ("q1", {"unit": "deg", "factor": -57.2958}, "would repeat or undo it; leave out one of the two"),
        ("tau1", {"unit": "mNm", "factor": 0.001}, "converted by 0.001 already"),
        ("tau1", {"factor": 0}, "a factor of zero makes every sample zero"),
        ("tau1", {"factor": math.nan}, "columns.tau1.factor: must be a number"),
        ("tau1", {"factor": -math.inf}, "columns.tau1.factor: must be a number"),
        ("t", {"factor": -1}, "a factor of -1 lets time run backwards"),
        ("t", {"unit": "rad"}, "'rad' is a unit of position, not of time"),
        ("tau1", {"sign": -1}, "unknown key 'sign'"),
        ("tau1", {"factr": -1}, "unknown key 'factr'; did you mean 'factor'?"),
    ],
)
def test_a_slip_is_named_with_its_place(name: str, column: dict[str, Any], words: str, tmp_path: Path) -> None:
    columns = PLAIN | ({"dq1": "dq1"} if name == "dq1" else {}) | {name: {"column": "theirs", **column}}
    path = tmp_path / "columns.yaml"
    path.write_text(yaml.safe_dump({"columns": columns}))
    with pytest.raises(ConfigError) as caught:
        load_recording_format(path)
    (problem,) = caught.value.problems
    assert words in str(problem)
    assert problem.line >= 1


def test_all_wrong_units_come_at_once(tmp_path: Path) -> None:
    path = tmp_path / "columns.yaml"
    path.write_text("columns: {t: t, q1: {column: a, unit: inch}, tau1: {column: b, unit: mA}}\n")
    with pytest.raises(ConfigError, match=r"(?s)q1: unit 'inch' is not known.*tau1: unit 'mA' needs a factor"):
        load_recording_format(path)


def test_values_are_converted_and_times_keep_their_digits(tmp_path: Path) -> None:
    layout = form(
        t={"column": "t", "unit": "us"}, q1={"column": "q1", "unit": "deg"}, tau1={"column": "i", "factor": -2}
    )
    text = "t,mode,q1,i\n1700000000000001,homing_1,90,3\n1700000000001001,\u00fcber,-180,4\n"
    stamps, position, torque = read(tmp_path, text, layout)
    assert stamps == [1700000000000001000, 1700000000001001000]
    assert position == pytest.approx([math.pi / 2, -math.pi], rel=1e-15)
    assert torque == [-6.0, -8.0]


def test_columns_that_are_read_have_to_be_numbers(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="line 2: q1 is '1_0', not a number"):
        read(tmp_path, "t,q1,tau1,mode\n0,1_0,1,x\n", form())
    with pytest.raises(RecordingError, match="line 3: tau1 is '\u0661', not a number"):
        read(tmp_path, "t,q1,tau1,mode\n0,1,1,x\n1,1,\u0661,x\n", form())


def test_times_in_other_units_are_pointed_at(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"not in seconds\? Name its unit"):
        read(tmp_path, "t,q1,tau1\n1700000000000000000,1,1\n", form())


@given(st.integers(0, 10**15), st.sampled_from([("s", 9), ("ms", 6), ("us", 3), ("ns", 0)]))
def test_whole_units_of_time_are_exact(count: int, unit: tuple[str, int]) -> None:
    name, digits = unit
    number = count // 10**digits
    scale = Column(column="t", unit=name).si_factor("t")
    assert number * Decimal(repr(scale)) * 10**9 == number * 10**digits


def test_plain_names_keep_the_hash_of_a_description() -> None:
    assert form().model_dump(mode="json")["columns"] == PLAIN
    again = form(q1={"column": "a", "unit": "deg"})
    assert again.model_dump(mode="json")["columns"]["q1"] == {"column": "a", "unit": "deg", "factor": 1.0}
    assert RecordingFormat.model_validate_json(again.model_dump_json()) == again


def test_metres_of_a_joint_that_turns_are_refused() -> None:
    config = load_arm("planar2")
    columns = {"t": "t", "tau1": "a", "tau2": "b", "q1": "c", "q2": {"column": "d", "unit": "mm"}}
    layout = RecordingFormat.model_validate({"columns": columns})
    with pytest.raises(
        ModelError, match=r"recording\.columns\.q2: unit 'mm', but .* turns; its position is in rad, mrad"
    ):
        arm_model(config.model_copy(update={"recording": layout}))
    motors = layout.model_copy(update={"side": "motor"})
    assert np.all(arm_model(config.model_copy(update={"recording": motors})).chain.revolute)


def test_a_factor_of_one_that_is_given_is_given_still_after_it_was_kept() -> None:
    """A results folder keeps the description, and identifies from it again."""
    column = Column(column="theirs", unit="A", factor=1.0)
    again = Column.model_validate_json(column.model_dump_json())
    assert again.si_factor("tau1") == 1.0


ODD_COLUMNS = """\
columns:
  t: {column: stamp, unit: ms}
  q1: {column: enc_1, unit: counts, factor: 1.0e-5}
  q2: {column: axis_2, unit: deg, factor: -1}
  tau1: {column: current_1, unit: mA, factor: 11.2}
  tau2: {column: current_2, unit: mA, factor: -4.5}
"""


@pytest.mark.slow
def test_counts_and_currents_with_their_signs_identify_as_si_does(tmp_path: Path) -> None:
    model = arm_model(load_arm("planar2"))
    delta, motion = model.prior, waves(4, 2)
    assert delta is not None
    exact = recorded(model, delta, motion, rate=100.0, seconds=20.0)
    rng = np.random.default_rng(1)
    time = np.arange(len(exact.position)) / 100.0
    # An encoder of 100,000 counts a radian; the second axis and its current count the other way round.
    counts = np.round(1e5 * exact.position[:, 0])
    torque = exact.torque + 0.02 * rng.normal(size=exact.torque.shape)
    plain = np.column_stack([time, 1e-5 * counts, exact.position[:, 1], torque])
    odd = np.column_stack(
        [1e3 * time, counts, -np.degrees(exact.position[:, 1]), 1e3 * torque[:, 0] / 11.2, 1e3 * torque[:, 1] / -4.5]
    )
    np.savetxt(tmp_path / "si.csv", plain, delimiter=",", header="t,q1,q2,tau1,tau2", comments="", fmt="%.15g")
    head = "stamp,enc_1,axis_2,current_1,current_2"
    np.savetxt(tmp_path / "odd.csv", odd, delimiter=",", header=head, comments="", fmt="%.15g")
    (tmp_path / "columns.yaml").write_text(ODD_COLUMNS)
    (tmp_path / "turned.yaml").write_text(ODD_COLUMNS.replace("-4.5", "4.5"))

    def identified(name: str, columns: str | None) -> Estimate:
        form = None if columns is None else load_recording_format(tmp_path / columns)
        return identify(model, [open_recording(tmp_path / name, model.chain.names, fmt=form or RecordingFormat())])

    wanted, found = identified("si.csv", None), identified("odd.csv", "columns.yaml")
    np.testing.assert_allclose(found.beta, wanted.beta, rtol=1e-6, atol=1e-8)
    truth = wanted.base.K @ delta
    assert np.linalg.norm(wanted.fit.R1 @ (wanted.beta - truth)) < 0.01 * np.linalg.norm(wanted.fit.R1 @ truth)
    assert reasons_against(found) == ()
    assert any("wrong sign" in reason for reason in reasons_against(identified("odd.csv", "turned.yaml")))
