"""CSV recordings: numbers survive, and every mistake is named with its line."""

from __future__ import annotations

import gzip
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from record_samples import read_all

from ident_service.config.recording import RecordingFormat
from ident_service.errors import RecordingError, UsageError
from ident_service.recordings import csv_reader as csv_file
from ident_service.recordings.csv_reader import CsvRecording
from ident_service.recordings.open import open_recording

HEADER = "t,q1,q2,tau1,tau2\n"
NUMBER = st.floats(allow_nan=False, allow_infinity=False)


def write(path: Path, text: str) -> Path:
    path.write_bytes(text.encode())
    return path


def rows(count: int) -> str:
    return "".join(f"{k * 0.004!r},{k},{-k},{k}.5,1e-3\n" for k in range(count))


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(st.tuples(NUMBER, NUMBER, NUMBER), min_size=1, max_size=40),
    st.permutations(["t", "q1", "dq1", "tau1"]),
    st.booleans(),
    st.sampled_from(["\n", "\r\n"]),
    st.integers(1, 50),
)
def test_numbers_round_trip(tmp_path: Path, values, header, compressed, end, samples) -> None:
    lines = [",".join(header)]
    for k, (q, dq, tau) in enumerate(values):
        fields = {"t": f"1700000000.{k:09d}", "q1": repr(q), "dq1": repr(dq), "tau1": repr(tau)}
        lines.append(",".join(fields[name] for name in header))
    data = (end.join(lines) + end).encode()
    path = tmp_path / "run"
    path.write_bytes(gzip.compress(data) if compressed else data)
    recording = open_recording(path, ["only"])
    block = read_all(recording, samples)
    assert block.stamp_ns.tolist() == [1_700_000_000_000_000_000 + k for k in range(len(values))]
    assert np.array_equal(block.position[:, 0], [q for q, _, _ in values])
    assert block.velocity is not None
    assert np.array_equal(block.velocity[:, 0], [dq for _, dq, _ in values])
    assert np.array_equal(block.torque[:, 0], [tau for _, _, tau in values])


@pytest.mark.parametrize("word", ["+1.5", ".25", "-.5", "3.", "007", " 2", "\t2 ", "1E3", "1" * 400 + "e-399", "-0"])
@pytest.mark.parametrize(
    "beside", ["0.1", "2.5e-324", "123456789012345678901234567890", "5.00000000000000011102230246"]
)
def test_numbers_as_python_reads_them(tmp_path: Path, word: str, beside: str) -> None:
    path = write(tmp_path / "run.csv", f"t,q1,tau1\n0,{word},{beside}\n1,{beside},{word}\n")
    block = read_all(CsvRecording(path))
    assert block.position[:, 0].tolist() == [float(word), float(beside)]
    assert block.torque[:, 0].tolist() == [float(beside), float(word)]


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.decimals(min_value=0, max_value=10_000, places=11), min_size=2, max_size=9, unique=True))
def test_times_are_rounded_as_they_are_written(tmp_path: Path, times: list[Decimal]) -> None:
    written = sorted(times)
    stamps = [round(time * 10**9) for time in written]
    assume(len(set(stamps)) == len(stamps))
    text = "".join(f"{time},{k},0\n" for k, time in enumerate(written))
    assert read_all(CsvRecording(write(tmp_path / "run.csv", "t,q1,tau1\n" + text))).stamp_ns.tolist() == stamps


@pytest.mark.parametrize(
    ("time", "stamp_ns"),
    [
        ("0.0000000025", 2),
        ("0.0000000035", 4),
        ("0.00000000250000000000000001", 3),
        ("8796.0930222084999", 8_796_093_022_208),
        ("1e-99999999999999999999", 0),
    ],
)
@pytest.mark.parametrize("end", ["20000", "1700000000.123456789"])
def test_half_nanoseconds(tmp_path: Path, time: str, stamp_ns: int, end: str) -> None:
    stamps = read_all(CsvRecording(write(tmp_path / "run.csv", f"t,q1,tau1\n{time},1,2\n{end},3,4\n"))).stamp_ns
    assert stamps.tolist() == [stamp_ns, round(Decimal(end) * 10**9)]
    assert read_all(CsvRecording(write(tmp_path / "one.csv", f"t,q1,tau1\n{time},1,2\n"))).stamp_ns[0] == stamp_ns


def test_door(tmp_path: Path) -> None:
    recording = CsvRecording(write(tmp_path / "run.csv", HEADER + rows(10)))
    assert (recording.joints, recording.joint_names) == (2, ())
    assert not recording.torque_zero_order_hold
    assert not recording.torn
    assert read_all(recording, 3).velocity is None
    assert read_all(recording).stamp_ns.tolist() == [k * 4_000_000 for k in range(10)]


def test_many_rows_in_small_reads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(csv_file, "_STEP", 97)
    recording = CsvRecording(write(tmp_path / "run.csv", HEADER + rows(9000)))
    assert np.array_equal(read_all(recording, 1000).position[:, 0], np.arange(9000))


def test_ends_that_are_no_mistake(tmp_path: Path) -> None:
    assert len(read_all(CsvRecording(write(tmp_path / "a", HEADER + rows(5) + "\n \n"))).stamp_ns) == 5
    assert len(read_all(CsvRecording(write(tmp_path / "b", HEADER + rows(5)[:-1]))).stamp_ns) == 5
    assert len(read_all(CsvRecording(write(tmp_path / "c", "\ufeff" + HEADER + rows(5)))).stamp_ns) == 5
    assert len(read_all(CsvRecording(write(tmp_path / "d", HEADER))).stamp_ns) == 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (rows(7) + "0.028,1,2", "line 9: has 3 fields but the header has 5; the row is torn"),
        (rows(7) + "0.028,1,2,3,4,5\n", "line 9: has 6 fields"),
        (rows(7) + "\n" + rows(1), "line 9: is empty"),
        (rows(2) + "0.008,1,zwei,3,4\n", "line 4: q2 is 'zwei', not a number"),
        (rows(2) + "0.008,1,1_0,3,4\n", "line 4: q2 is '1_0', not a number"),
        (rows(2) + "0.008,1,,3,4\n", "line 4: q2 is '', not a number"),
        (rows(2) + "0.008,1,\u0662,3,4\n", "line 4: q2 is '.*', not a number"),
        (rows(2) + "0.008,1,nan,3,4\n", r"line 4, 0\.008000 s after the first: position of joint 2 is nan"),
        (rows(2) + "0.008,1,1,3,-inf\n", r"line 4, 0\.008000 s after the first: torque of joint 2 is -inf"),
        (rows(2) + "0.004,1,1,3,4\n", "line 4, .* the stamp does not increase, but the values change"),
        (rows(2) + "0.004,1,-1,1.5,2e-3\n", "line 4, .* the stamp does not increase, but the values change"),
        (rows(2) + "-1,1,1,3,4\n", "line 4, .* the stamp does not increase, it runs back by 1.004 s"),
        (rows(2) + "nan,1,1,3,4\n", "line 4: time t is nan"),
        (rows(2) + "1700000000000,1,1,3,4\n", "line 4: time t is 1700000000000; not in seconds"),
        (rows(2) + "0.008,1,true,3,4\n", "line 4: q2 is 'true', not a number"),
        (rows(2) + "0.008,1,null,3,4\n", "line 4: q2 is 'null', not a number"),
        (rows(2) + "0.008,1,1 2,3,4\n", "line 4: q2 is '1 2', not a number"),
        (rows(2) + "0.008,1,[1],3,4\n", r"line 4: q2 is '\[1\]', not a number"),
        (rows(2) + "0.008,1,1e400,3,4\n", r"line 4, 0\.008000 s after the first: position of joint 2 is inf"),
    ],
)
def test_mistakes_name_their_line(tmp_path: Path, text: str, message: str) -> None:
    recording = CsvRecording(write(tmp_path / "run.csv", HEADER + text))
    for samples in (1, 3, 4096):
        with pytest.raises(RecordingError, match=message):
            list(recording.blocks(samples))


def test_a_header_lists_all_its_problems(tmp_path: Path) -> None:
    with pytest.raises(RecordingError) as caught:
        CsvRecording(write(tmp_path / "run.csv", "time,q1,q2,q3,q3,tau1,dq2\n"))
    for problem in (
        "column 'q3' appears twice",
        "unknown column 'time'",
        "no column 't'",
        "missing tau2, tau3",
        "missing dq1, dq3",
    ):
        assert problem in str(caught.value)
    with pytest.raises(RecordingError, match="column 'a12' appears twice; 15 more columns appear twice; "):
        CsvRecording(write(tmp_path / "run.csv", ",".join(2 * [f"a{k}" for k in range(20)]) + "\n"))
    for header in ("", "\n", "t,q9999\n", "t;q1;tau1\n", "t\n", "t,q0,tau0\n"):
        with pytest.raises(RecordingError):
            CsvRecording(write(tmp_path / "run.csv", header))


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("t;q1;tau1", "columns are separated by semicolons; separate them by commas, and write decimals with points"),
        ("t\tq1\ttau1", "columns are separated by tabs"),
        ("t q1 tau1", "columns are separated by spaces"),
        ("0.0,-1.5,2e3", "is numbers; put a line with the names of the columns above it: t,q1..qN,tau1..tauN"),
        ("# recorded by us", "is a comment; remove what stands"),
        ("t,q1,tau1\r0,1,2\r1,2,3", "lines end in a carriage return alone; save it with line feeds"),
        ('"t","q1","tau1"', "names are in quotation marks; write names and numbers without them"),
        ("<!DOCTYPE html>", "is HTML or XML, a page and no recording; download the file itself"),
        ("T,Q1,Tau1", "write the names in small letters: t,q1..qN,tau1..tauN"),
        ("# t, q1, tau1", "is a comment; remove what stands before the names of the columns"),
        (
            "time," + ",".join(f"pos_{k}" for k in range(7)) + ",eff_0",
            "unknown columns 'time', 'pos_0', 'pos_1', 'pos_2', 'pos_3', 'pos_4', 'pos_5', 'pos_6' and 1 more; no"
            " column 't' (time in seconds); no joints; expected a header t,q1..qN,tau1..tauN, or the names of"
            " these columns in recording.columns of the description (or --columns): columns: {t: NAME, q1: NAME, "
            "tau1: NAME, ...}",
        ),
    ],
)
def test_a_header_of_another_program_is_refused_with_a_remedy(tmp_path: Path, header: str, words: str) -> None:
    with pytest.raises(RecordingError) as caught:
        CsvRecording(write(tmp_path / "run.csv", header + "\n0,1,2\n"))
    assert words in str(caught.value)


def test_a_wrong_column_map_shows_the_columns_that_there_are(tmp_path: Path) -> None:
    path = write(tmp_path / "run.csv", "zeit,winkel,moment\n0,1,2\n")
    columns = {"t": "zeit", "q1": "angle", "tau1": "moment"}
    with pytest.raises(RecordingError, match=r"no column 'angle' for q1; .*the file has the columns zeit, winkel, mom"):
        open_recording(path, ["a"], fmt=RecordingFormat(columns=columns))


def test_a_column_map_of_another_arm_is_refused_in_one_sentence(tmp_path: Path) -> None:
    path = write(tmp_path / "run.csv", "t,q1,tau1\n0,1,2\n")
    columns = {"t": "t_s"} | {f"{kind}{joint}": f"{kind}_{joint}" for kind in ("q", "tau") for joint in range(1, 7)}
    with pytest.raises(RecordingError) as caught:
        open_recording(path, [f"j{joint}" for joint in range(1, 7)], fmt=RecordingFormat(columns=columns))
    assert str(caught.value) == (
        f"{path}: line 1: no columns 't_s' for t, 'q_1' for q1, 'q_2' for q2 and 10 more; the description or --columns "
        "names them so; the file has the columns t, q1, tau1"
    )


def test_other_headers_by_column_map(tmp_path: Path) -> None:
    path = write(tmp_path / "run.csv", "stamp,current,angle,torque\n0.5,9,1,2\n0.6,9,3,4\n")
    columns = {"t": "stamp", "q1": "angle", "tau1": "torque"}
    block = read_all(open_recording(path, ["a"], fmt=RecordingFormat(columns=columns)))
    assert block.position.tolist() == [[1.0], [3.0]]
    assert block.torque.tolist() == [[2.0], [4.0]]
    with pytest.raises(RecordingError, match="no column 'moment' for tau1"):
        open_recording(path, fmt=RecordingFormat(columns={**columns, "tau1": "moment"}))


def test_number_of_joints(tmp_path: Path) -> None:
    path = write(tmp_path / "run.csv", HEADER + rows(2))
    with pytest.raises(RecordingError, match="has 2 joints but the arm has 3"):
        open_recording(path, ["a", "b", "c"])
    with pytest.raises(UsageError):
        CsvRecording(tmp_path / "missing.csv")


def test_damaged_gzip(tmp_path: Path) -> None:
    data = gzip.compress((HEADER + rows(3000)).encode())
    path = tmp_path / "run.csv.gz"
    for cut in (len(data) // 2, len(data) - 1, 12, 3):
        path.write_bytes(data[:cut])
        with pytest.raises(RecordingError):
            list(CsvRecording(path).blocks())
    path.write_bytes(data[:500] + bytes(20) + data[520:])
    with pytest.raises(RecordingError):
        list(CsvRecording(path).blocks())


def test_gzip_bomb_and_endless_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(csv_file, "_RATIO_FROM", 1 << 20)
    path = tmp_path / "bomb.csv.gz"
    path.write_bytes(gzip.compress(HEADER.encode() + b"0,0,0,0,0\n" * 500_000))
    with pytest.raises(RecordingError, match="refused"):
        list(CsvRecording(path)._lines())
    path.write_bytes(bytes([32]) * (3 << 20))
    with pytest.raises(RecordingError, match="no CSV file"):
        CsvRecording(path)
