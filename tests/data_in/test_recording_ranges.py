"""Ranges of a recording's time: what is read, what shares samples, and standstill at the ends."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_recordings import moving, whole

from ident_service.cli import main
from ident_service.cli.remote_recordings import recording_reference
from ident_service.client import IdentClient
from ident_service.config.arm import ArmConfig
from ident_service.config.load import load_arm
from ident_service.config.recording import RecordingFormat
from ident_service.daemon.jobs.commands import range_words
from ident_service.daemon.jobs.requests import RecordingReference
from ident_service.errors import RecordingError, UsageError
from ident_service.model.arm_model import arm_model
from ident_service.operations.identification import Request, identify_files
from ident_service.operations.recordings import file_and_range, open_for_arm, own_formats
from ident_service.recordings.adapters import RangeRecording, overlap, without_standstill
from ident_service.recordings.files import split_range
from ident_service.recordings.open import open_recording

PERIOD = 0.005
EDGES = 200  # rows at both ends that are not used, 0.5 s each


def written(
    path: Path, *, header: str = "t,q1,q2,tau1,tau2", still: tuple[int, int] = (0, 0), noise: float = 0.0
) -> Path:
    rng, rows = np.random.default_rng(1), [header]
    for k in range(3000 + sum(still)):
        t = PERIOD * min(max(k - still[0], 0), 2999)
        q = np.array([np.sin(t), np.cos(1.3 * t)]) + noise * rng.standard_normal(2)
        rows.append(f"{100.0 + PERIOD * k:.3f},{q[0]:.6f},{q[1]:.6f},{np.sin(t + 0.3):.6f},{np.cos(2.0 * t):.6f}")
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return path


def described(folder: Path) -> str:
    """Describe an arm whose rows can be counted: none are left out but those at the ends, 0.5 s each."""
    (folder / "arm.yaml").write_text(
        f"extends: {Path('configs/planar2.yaml').resolve()}\n"
        "identification: {method: ols, smoothing: {cutoff: 8, decimate: 1}, edge: 0.5}\n"
    )
    return str(folder / "arm.yaml")


def planar() -> ArmConfig:
    return load_arm("planar2")


@pytest.mark.parametrize(("start", "end"), [(0.0, 4.0), (4.0, np.inf), (2.0, 7.5), (0.0, np.inf), (2.0025, 2.0125)])
@pytest.mark.parametrize("samples", [1, 700, 4096])
def test_a_range_has_its_samples_and_no_others(start: float, end: float, samples: int) -> None:
    file = moving(10**18 + np.arange(2000, dtype=np.int64) * 5_000_000)
    part = RangeRecording(file, start, end, "@label")
    elapsed = (whole(file).stamp_ns - whole(file).stamp_ns[0]) * 1e-9
    inside = (elapsed >= start) & (elapsed < end)
    np.testing.assert_array_equal(whole(part, samples).stamp_ns, whole(file).stamp_ns[inside])
    np.testing.assert_array_equal(whole(part, samples).torque, whole(file).torque[inside])
    assert (part.sha256, part.joints, part.path.name) == (file.sha256, file.joints, "made@label")


SECONDS = st.floats(0.0, 20.0)


@given(SECONDS, SECONDS, SECONDS, SECONDS)
def test_ranges_that_are_apart_share_no_sample(a: float, b: float, c: float, d: float) -> None:
    file = moving(np.arange(100, dtype=np.int64) * 200_000_000)
    one, other = (RangeRecording(file, min(pair), max(pair)) for pair in ((a, b), (c, d)))
    stamps = []
    for part in (one, other):
        try:
            stamps.append(set(whole(part).stamp_ns.tolist()))
        except RecordingError:
            stamps.append(set())
    if not overlap(one, other):
        assert not stamps[0] & stamps[1]
    assert overlap(one, file)


def test_names_of_ranges(tmp_path: Path) -> None:
    path = written(tmp_path / "run.csv")
    assert file_and_range(path) == (path, None)
    assert file_and_range(Path(f"{path}@0:40")) == (path, (0.0, 40.0))
    assert file_and_range(Path(f"{path}@41.5:")) == (path, (41.5, np.inf))
    assert file_and_range(Path(f"{path}@:40")) == (path, (0.0, 40.0))
    odd = written(tmp_path / "run@1:2")
    assert file_and_range(odd) == (odd, None)
    assert file_and_range(Path(f"{odd}@3:4")) == (odd, (3.0, 4.0))
    with pytest.raises(UsageError, match=r"run\.csv@2:1\.5: a range ends after it begins; .* seconds .* that are read"):
        file_and_range(Path(f"{path}@2:1.5"))


def test_a_range_beyond_the_end_says_how_long_the_recording_is(tmp_path: Path) -> None:
    recording = open_for_arm(Path(f"{written(tmp_path / 'run.csv')}@41:60"), arm_model(planar()))
    with pytest.raises(RecordingError, match=r"run\.csv@41:60: no sample from 41 s to 60 s; it lasts 14\.995 s"):
        list(recording.blocks())
    # A rounded end is no mistake, seconds that are milliseconds are.
    list(open_for_arm(Path(f"{tmp_path / 'run.csv'}@2:15"), arm_model(planar())).blocks())
    late = open_for_arm(Path(f"{tmp_path / 'run.csv'}@2:15000"), arm_model(planar()))
    with pytest.raises(RecordingError, match=r"ends at 15000 s, the recording at 14\.995 s; leave the end out"):
        list(late.blocks())


def test_one_file_to_fit_and_to_validate(tmp_path: Path) -> None:
    path = written(tmp_path / "run.csv")
    arm, out = described(tmp_path), tmp_path / "out"
    found = identify_files(Request(arm, (Path(f"{path}@0:8"),), (Path(f"{path}@8:15"),)), out)
    assert found.estimate.recordings == (("run.csv@0:8", open_recording(path).sha256),)
    assert [score.recording for score in found.estimate.candidates[0].validation] == ["run.csv@8:15"]
    assert found.estimate.samples == 1600 - EDGES
    for ours, theirs in (("@0:8.01", "@8:15"), ("@0:8", ""), ("", "@8:15"), ("", "")):
        with pytest.raises(UsageError, match="a recording that is fitted to cannot validate the fit"):
            identify_files(Request(arm, (Path(f"{path}{ours}"),), (Path(f"{path}{theirs}"),)), out)
    with pytest.raises(UsageError, match=r"run\.csv@7:9: the same recording twice"):
        identify_files(Request(arm, (Path(f"{path}@0:8"), Path(f"{path}@7:9"))), out)


@pytest.mark.parametrize("noise", [0.0, 3e-4])
def test_standstill_at_the_ends_is_left_out_and_stated(tmp_path: Path, noise: float) -> None:
    path = written(tmp_path / "run.csv", still=(700, 460), noise=noise)
    said: list[str] = []
    found = identify_files(Request(described(tmp_path), (path,), cut_standstill=True), tmp_path / "out", said.append)
    # Half a second of it stays, as long as the edges that are not used, and what a tenth of a second cannot tell.
    assert said == ["run.csv: standstill left out, 2.90 s at the start and 1.70 s at the end"]
    left_out = round((2.9 + 1.7) / PERIOD)
    assert abs(found.estimate.samples - (4160 - left_out - EDGES)) <= 2


def test_standstill_of_a_range_counts_from_its_own_ends(tmp_path: Path) -> None:
    path = written(tmp_path / "run.csv", still=(700, 460))
    file = open_recording(path)
    part = without_standstill(RangeRecording(file, 1.0, 19.2), 0.5)
    assert part.standstill == pytest.approx((2.0, 0.2), abs=0.11)
    elapsed = (whole(part).stamp_ns - whole(file).stamp_ns[0]) * 1e-9
    assert elapsed[0] == pytest.approx(3.0, abs=0.11)
    assert elapsed[-1] == pytest.approx(19.0, abs=0.11)
    moves = RangeRecording(file, 5.0, 10.0)
    assert without_standstill(moves, 0.5).standstill == (0.0, 0.0)
    with pytest.raises(RecordingError, match=r"no joint moves faster than 0\.005"):
        without_standstill(RangeRecording(file, 0.0, 3.0), 0.5)


def test_a_columns_file_for_one_recording(tmp_path: Path) -> None:
    ours = written(tmp_path / "ours.csv")
    theirs = written(tmp_path / "theirs.csv", header="time,a,b,c,d")
    columns = tmp_path / "theirs.yaml"
    columns.write_text("columns: {t: time, q1: a, q2: b, tau1: c, tau2: {column: d, factor: -2}}\n")
    model = arm_model(planar())
    named = [ours, Path(f"{theirs}@2:9")]
    forms = own_formats({theirs: columns}, named, model)
    assert set(forms) == {named[1]}
    read = open_for_arm(named[1], model, forms[named[1]])
    np.testing.assert_allclose(whole(read).torque[:, 1], -2.0 * whole(open_recording(ours)).torque[400:1800, 1])
    with pytest.raises(UsageError, match=r"other\.csv is none of the recordings"):
        own_formats({tmp_path / "other.csv": columns}, named, model)
    columns.write_text("{gap: 4, stamps: arrival, columns: {t: time, q1: a, tau1: c}}\n")
    with pytest.raises(UsageError, match=r"theirs\.yaml: gap, stamps is of all recordings"):
        own_formats({theirs: columns}, named, model)
    columns.write_text("{torque_side: motor, columns: {t: time, q1: a, tau1: c}}\n")
    with pytest.raises(UsageError, match=r"torque_side: motor, but there is no transmission; .* 1 joints, but the arm"):
        own_formats({theirs: columns}, named, model)


@pytest.mark.slow
@pytest.mark.parametrize("general", ["", "recording: {trim: [0.5, 0.25]}\n"])
def test_what_is_trimmed_of_one_recording_is_what_is_trimmed_of_all(tmp_path: Path, general: str) -> None:
    path, columns = written(tmp_path / "run.csv", header="time,a,b,c,d", still=(700, 460)), tmp_path / "own.yaml"
    columns.write_text("{trim: [2, 1.5], columns: {t: time, q1: a, q2: b, tau1: c, tau2: d}}\n")
    arm = Path(described(tmp_path))
    arm.write_text(arm.read_text() + general)
    wanted = identify_files(Request(str(arm), (path,), columns=columns), tmp_path / "all")
    found = identify_files(Request(str(arm), (path,), columns_of={path: columns}), tmp_path / "one")
    assert found.estimate.samples == wanted.estimate.samples
    np.testing.assert_array_equal(found.estimate.beta, wanted.estimate.beta)
    assert wanted.estimate.samples < 4160 - 3.5 / PERIOD


@pytest.mark.slow
def test_others_keep_the_trim_of_the_description(tmp_path: Path) -> None:
    ours, theirs = written(tmp_path / "ours.csv"), written(tmp_path / "theirs.csv", header="time,a,b,c,d")
    columns = tmp_path / "own.yaml"
    columns.write_text("{trim: [2, 1], columns: {t: time, q1: a, q2: b, tau1: c, tau2: d}}\n")
    arm = Path(described(tmp_path))
    arm.write_text(arm.read_text() + "recording: {trim: [0.5, 0.25]}\n")
    found = identify_files(Request(str(arm), (ours,), (theirs,), columns_of={theirs: columns}), tmp_path / "out")
    alone = identify_files(Request(str(arm), (ours,)), tmp_path / "alone")
    assert found.estimate.samples == alone.estimate.samples
    columns.write_text("{trim: [10, 10], columns: {t: time, q1: a, q2: b, tau1: c, tau2: d}}\n")
    with pytest.raises(RecordingError, match=r"theirs\.csv: nothing is left after trimming 10 s and 10 s of 14\.995 s"):
        identify_files(Request(str(arm), (ours,), (theirs,), columns_of={theirs: columns}), tmp_path / "none")


def test_words_that_cannot_be_meant(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, columns = str(written(tmp_path / "run.csv")), tmp_path / "own.yaml"
    columns.write_text("columns: {t: t, q1: q1, q2: q2, tau1: tau1, tau2: tau2}\n")
    words = ["identify", path, "--arm", "planar2", "--out", str(tmp_path / "out")]
    for more, said in (
        (["--columns", str(columns), "--columns", str(columns)], "one file is for all recordings"),
        (["--columns", f"{path}={columns}", "--columns", f"{path}={columns}"], "has a columns file already"),
        (["--columns", f"other.csv={columns}"], "other.csv is none of the recordings"),
        (["--validate", f"{path}@3:2"], "a range ends after it begins"),
    ):
        assert main([*words, *more]) == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


class Knowing(IdentClient):
    """A client of a daemon that has every run."""

    def get(self, path: str, **_: object) -> dict[str, object]:
        return {"path": path}


def remote_recording(path: Path) -> dict[str, object]:
    """Name a recording of a daemon, which is asked for nothing else."""
    client = Knowing("http://127.0.0.1:1", "token")
    return recording_reference(client, argparse.Namespace(json=True), "planar2", path)


def test_a_daemon_is_sent_the_same_range() -> None:
    assert remote_recording(Path("run-1/other.mcap@2.5:")) == {"run": "run-1", "name": "other.mcap", "start": 2.5}
    asked = RecordingReference.model_validate(remote_recording(Path("run-1@1:40")))
    assert (asked.run, asked.name, asked.start, asked.end) == ("run-1", None, 1.0, 40.0)
    assert range_words(asked) == "@1.000000000:40.000000000"
    assert split_range(f"run.mcap{range_words(asked)}") == ("run.mcap", (1.0, 40.0))
    assert range_words(RecordingReference(run="run-1")) == ""


def test_the_description_may_say_that_standstill_is_cut(tmp_path: Path) -> None:
    config = load_arm(described(tmp_path)).model_copy(update={"recording": RecordingFormat(standstill="cut")})
    path = written(tmp_path / "run.csv", still=(400, 0))
    assert len(whole(open_for_arm(path, arm_model(config))).stamp_ns) == 3400 - 280
