"""`IdentClient` on a daemon that runs: lists, computations, a motion under its lease, live samples, one error tree."""

from __future__ import annotations

import re
import signal
import socket
import threading
from collections.abc import Iterator
from http import HTTPStatus
from pathlib import Path

import pytest
from daemon.conftest import checked_before, patient_text, quick_text
from daemon.served import daemon_process, daemon_thread
from daemon.verbs_bench import unstable_text

from ident_service import errors
from ident_service.cli import main
from ident_service.client import IdentClient, left_alone
from ident_service.client.connection import error_of
from ident_service.errors import (
    AccessRefused,
    AlreadyThere,
    AnotherDrive,
    ArmError,
    ArmFault,
    ConfigError,
    DiskFull,
    IdentError,
    ModelError,
    MotionRefused,
    PersonNeeded,
    Problem,
    RecordingError,
    RecordingNotWritten,
    SolverError,
    Stopped,
    StorageError,
    UnknownId,
    UsageError,
)
from ident_service.motion.command_channel import is_control_file_in_use
from ident_service.registry.database import Database, note
from ident_service.registry.state_folder import control_path

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def state(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("client") / "state"


@pytest.fixture(scope="module")
def client(state: Path) -> Iterator[IdentClient]:
    """A daemon with two arms that were checked: `quick`, and `patient`, whose motion outlasts a test."""
    for text in (quick_text(), patient_text("patient")):
        checked_before(state, text)
    with daemon_thread(state) as client:
        client.add_arm(quick_text())
        client.add_arm(patient_text("patient"))
        yield client


def test_lists_are_read_to_their_end(client: IdentClient, state: Path) -> None:
    assert {"quick", "patient", "planar2"} <= {arm["name"] for arm in client.arms()}
    with Database(state) as db:
        for number in range(30):
            note(db, "me", "did", str(number))
    whole = list(client.pages("/api/v1/audit?most=500"))
    assert list(client.pages("/api/v1/audit?most=7")) == whole
    assert len(whole) > 30


def test_errors_are_of_one_tree(
    client: IdentClient, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    with pytest.raises(UnknownId, match="nothing"):
        client.job("nothing")
    with pytest.raises(UnknownId):
        client.job("../runs")
    with pytest.raises(AlreadyThere, match="quick"):
        client.add_arm(quick_text(periods=8))
    with pytest.raises(ConfigError, match=r"arm.yaml:\d+:\d+") as mistakes:
        client.add_arm(quick_text("third").replace("terms:", "termz:"))
    assert mistakes.value.problems[0].path.name == "arm.yaml"
    assert mistakes.value.problems[0].line > 1
    with pytest.raises(MotionRefused, match="typed"):
        client.arm("quick").run(confirm="quack")
    with IdentClient(client.url, "ident_no") as nobody, pytest.raises(AccessRefused, match="valid token"):
        nobody.arms()
    with monkeypatch.context() as patched:  # at a terminal, whose words are no HTTP
        patched.setenv("IDENT_TOKEN", "ident_no")
        assert main(["jobs", "list", "--server", client.url]) == 2
    said = capsys.readouterr().err
    assert said.startswith(
        f"ident: {client.url}: the token from $IDENT_TOKEN does not count there: it was revoked, or is"
    )
    assert "`ident tokens add NAME --role operator`" in said
    assert "Bearer" not in said
    with monkeypatch.context() as patched:
        patched.delenv("IDENT_TOKEN", raising=False)
        assert main(["jobs", "list", "--server", client.url, "--state", str(tmp_path / "fresh")]) == 2
    assert "there is none in $IDENT_TOKEN or " in capsys.readouterr().err
    for token in (None, "ident_no"):  # in words that are no HTTP, either
        with (
            IdentClient(client.url, token) as nobody,
            pytest.raises(AccessRefused, match="or none was given") as caught,
        ):
            nobody.arms()
        assert "Bearer" not in str(caught.value)
    with pytest.raises(UsageError, match="the token is empty"):
        IdentClient(client.url, "")
    for odd in ("secret\u00fc", "sec ret", "sec\nret"):
        with pytest.raises(UsageError, match="characters that no token has") as caught_odd:
            IdentClient(client.url, odd)
        assert odd not in str(caught_odd.value)
    with IdentClient(client.url, "ident_no\n") as nobody, pytest.raises(AccessRefused, match="or none was given"):
        nobody.arms()  # a file's last line break is no part of a token
    with pytest.raises(UsageError, match="https only"):
        IdentClient("http://robot.example:8470", "x")
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{closed.getsockname()[1]}"
        with IdentClient(url) as nobody, pytest.raises(ArmError, match=r"cannot be reached.* has ended"):
            nobody.stop()


def test_a_computation_is_waited_for_and_its_key_is_kept(client: IdentClient) -> None:
    ended = client.compute("base", arm="planar2", key="one")
    assert (ended.state, ended.live) == ("done", False)
    assert client.answer(ended.id)["exit_code"] == 0
    assert client.begin("base", arm="planar2", key="one").id == ended.id
    assert [job.id for job in client.jobs(arm="planar2")] == [ended.id]


def test_a_computation_that_fails_is_an_error_of_the_tree(client: IdentClient, tmp_path: Path) -> None:
    (tmp_path / "torn.csv").write_text("t,q1,q2,tau1,tau2\n0,0,0,0\n")
    torn = client.upload("planar2", tmp_path / "torn.csv")
    with pytest.raises(RecordingError, match=r"torn.csv: .*\(job ") as caught:
        client.compute("identify", arm="planar2", recordings=[torn])
    assert caught.value.path.name == "torn.csv"
    with pytest.raises(UsageError, match="no simulated driver"):
        client.compute("simulate", arm="wam7")
    begun = client.begin("design", arm="planar2", seconds=600.0)
    client.post(f"/api/v1/jobs/{begun.id}/cancel")  # at once: a search that has begun ends with what it has
    assert client.wait(begun.id).state == "cancelled"


def test_a_run_is_watched_and_kept_alive_to_its_end(client: IdentClient) -> None:
    with client.arm("quick").run(confirm="quick") as job:
        with pytest.raises(UsageError, match="has not ended"):
            _ = job.ended
        samples = list(job.live())
    assert job.ended.state == "done", job.ended
    assert len(samples) > 20
    assert samples[0].joints == ("shoulder", "elbow")
    assert {len(sample.position) for sample in samples} == {len(sample.torque) for sample in samples} == {2}
    times = [sample.time for sample in samples]
    assert times == sorted(times)
    assert job.ended.run in [run["id"] for run in client.runs(arm="quick")]


def test_an_exception_stops_the_arm(client: IdentClient, state: Path) -> None:
    job = client.arm("patient").run(confirm="patient")
    with pytest.raises(ZeroDivisionError):  # noqa: PT012, SIM117 - it is raised within the block of the motion
        with job:
            next(job.live())
            raise ZeroDivisionError
    assert job.ended.state == "cancelled"
    assert not is_control_file_in_use(control_path(state, "patient"))


def test_a_stop_elsewhere_ends_the_block(client: IdentClient) -> None:
    with pytest.raises(Stopped, match=r"owner asked for a stop \(job \S+-run-"):  # noqa: PT012, SIM117 - at the block's end
        with client.arm("patient").run(confirm="patient") as job:
            live = job.live()
            next(live)
            threading.Timer(0.5, client.stop).start()
            assert sum(1 for _ in live) > 5
    assert job.ended.state == "cancelled"
    assert "stop" in job.ended.detail


def test_a_stop_of_ones_own_is_no_error(client: IdentClient) -> None:
    with client.arm("patient").run(confirm="patient") as job:
        next(job.live())
        job.cancel()
    assert job.ended.state == "cancelled"


def test_a_motion_that_is_refused_raises_at_the_end_of_its_block(client: IdentClient) -> None:
    with pytest.raises(MotionRefused, match="no preflight ticket"), client.arm("planar2").run(confirm="planar2") as job:
        pass
    assert job.ended.state == "refused"
    client.add_arm(unstable_text().replace("name: quick", "name: unstable"))
    with (
        pytest.raises(MotionRefused, match=r"stability: .*\(job \S+-check-"),
        client.arm("unstable").check(confirm="unstable") as check,
    ):
        pass
    assert check.ended.state == "refused"


def test_a_motion_that_ends_in_a_fault_raises_it(client: IdentClient, state: Path) -> None:
    # Later than its preflight ends, and in the midst of its motion.
    text = quick_text("faulty", 16).replace("driver:\n", "driver:\n  faults: [{kind: nan_position, at: 25}]\n", 1)
    assert "faults" in text
    checked_before(state, text)
    client.add_arm(text)
    with pytest.raises(ArmFault) as caught, client.arm("faulty").run(confirm="faulty") as job:
        pass
    assert job.ended.state == "faulted"
    assert caught.value.code in [fault["code"] for fault in client.arm("faulty").faults()]


def test_a_daemon_that_ends_says_what_becomes_of_the_motion(tmp_path: Path) -> None:
    state = tmp_path / "state"
    checked_before(state, patient_text())
    with daemon_process(state) as (process, client):
        client.add_arm(patient_text())
        with (  # noqa: PT012 - it is raised at the end of the block of the motion
            pytest.raises(ArmError, match=r"quick stops by itself: .*`ident jobs show \S+-run-"),
            client.arm("quick").run(confirm="quick") as job,
        ):
            next(job.live())
            process.send_signal(signal.SIGTERM)
            process.wait(60)
    assert not is_control_file_in_use(control_path(state, "quick"))


def test_a_line_that_breaks_is_told_in_whole_sentences() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def hang_up() -> None:
            while True:
                try:
                    listening.accept()[0].close()
                except OSError:
                    return

        threading.Thread(target=hang_up, daemon=True).start()
        with IdentClient(f"http://127.0.0.1:{listening.getsockname()[1]}", "x") as client:
            with pytest.raises(ArmError) as caught:
                client.get("/api/v1/arms")
            said = str(left_alone(caught.value, "quick", "j1"))
        listening.shutdown(socket.SHUT_RDWR)
    assert ": cannot be reached: " in said
    assert ". quick stops by itself: " in said
    assert ".." not in said


def test_every_kind_that_the_api_tells_is_an_error_of_the_tree() -> None:
    source = "".join(path.read_text() for path in (ROOT / "ident_service" / "daemon").rglob("*.py"))
    told = set(re.findall(r"""(?:\d{3}, |: \()"([A-Z][a-z]+[A-Za-z]*)",""", source))
    told |= {
        HTTPStatus(int(code)).phrase.title().replace(" ", "") for code in re.findall(r"HTTPException\((\d+)", source)
    }
    told |= {"NotFound", "MethodNotAllowed", "TooLarge"} - {"RequestEntityTooLarge", "ContentTooLarge"}
    assert told >= {"InvalidRequest", "RegistryBusy", "DiskFull", "WrongHost", "Busy", "Unauthorized", "InternalError"}
    page = (ROOT / "docs" / "programming.md").read_text()
    for kind in told:
        error = error_of(kind, "words")
        assert isinstance(error, IdentError)
        assert type(error) is not IdentError or kind == "InternalError", kind
        assert hasattr(errors, kind) or f"`{kind}`" in page, kind


@pytest.mark.parametrize(
    "error",
    [
        ConfigError([Problem(Path("arm.yaml"), 3, 7, "a: b\nand more"), Problem(Path("x.eds"), 1, 1, "c")]),
        RecordingError("a.csv", "line 3: torn"),
        RecordingNotWritten("run.mcap", "No space left on device"),
        StorageError("s3://bucket/x", "cannot be reached"),
        SolverError("weights", "infeasible"),
        ArmFault("late_cycle", "a cycle came late"),
        PersonNeeded("look"),
        AnotherDrive("7"),
        ModelError("no"),
        DiskFull("no room"),
    ],
)
def test_an_error_that_is_reported_is_the_one_that_was_raised(error: IdentError) -> None:
    again = error_of(type(error).__name__, str(error))
    assert type(again) is type(error)
    assert str(again) == str(error)
    assert vars(again) == vars(error)
