"""The recorder's process: the same file as in process, something readable whoever is killed, nothing left behind."""

from __future__ import annotations

import os
import random
import resource
import select
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from record_samples import read_all
from recorder_bench import URDF, WHAT, actor, await_stream, caught_up, check_prefix, cycles, ending, paced, process
from ring_actors import STEP_NS, holders, inode, record, store

from ident_service.errors import RecordingError, RecordingNotWritten, UsageError
from ident_service.recordings.cycle import Cycle
from ident_service.recordings.mcap_reader import McapRecording
from ident_service.recordings.mcap_writer import RecordingWriter
from ident_service.recordings.recorder import RecorderProcess
from ident_service.recordings.ring_sink import RingSink


@pytest.fixture(autouse=True)
def nothing_left() -> Iterator[None]:
    """No file descriptor and no child of this process is left by any of these tests."""
    before, family = fds(), offspring()
    yield
    assert fds() == before
    assert offspring() <= family


def offspring() -> set[str]:
    """Children of this process, dead ones too; other tests may have left helpers that live."""
    return {pid for task in Path("/proc/self/task").iterdir() for pid in (task / "children").read_text().split()}


def fds() -> dict[str, str]:
    found = {}
    for fd in Path("/proc/self/fd").iterdir():
        if fd.exists() or fd.is_symlink():
            found[fd.name] = str(fd.readlink())
    return {name: target for name, target in found.items() if "/proc/" not in target}


@pytest.mark.slow
@pytest.mark.parametrize("lock_step", [False, True])
def test_the_file_is_the_same_to_the_byte_as_from_a_writer_in_process(tmp_path: Path, lock_step: bool) -> None:
    with RecordingWriter(tmp_path / "in", *WHAT) as inside:
        for n in range(3000):
            made = record(n)
            if isinstance(made, Cycle):
                inside.sample(made)
            else:
                inside.event(*made)
    with process(tmp_path / "out", lock_step=lock_step) as outside:
        number = inode(outside.ends.ring)
        assert holders(number) == {os.getpid(), outside.pid}
        assert all(store(outside, n) for n in range(3000))
    assert (tmp_path / "in").read_bytes() == (tmp_path / "out").read_bytes()
    assert McapRecording(tmp_path / "out").metadata["complete"] == "true"
    assert outside.report is not None
    assert (outside.report.samples, outside.report.events) == (2572, 428)
    assert (outside.report.lost, outside.overruns, outside.error, outside.pid) == (0, 0, "", 0)
    outside.close()
    assert holders(number) == set()
    with pytest.raises(RecordingError, match="is not being recorded"):
        store(outside, 3000)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.5])
def test_lock_step_loses_nothing_at_full_speed(tmp_path: Path, share: float) -> None:
    count = 1500 if share == 0.0 else 20_000
    with process(tmp_path / "run", lock_step=True, slots=64, share=share) as recorder:
        assert all(store(recorder, n) for n in range(count))
    assert recorder.report is not None
    assert (recorder.report.lost, recorder.report.complete) == (0, True)
    assert len(read_all(McapRecording(tmp_path / "run")).stamp_ns) == len(cycles(count))


@pytest.mark.slow
def test_a_file_that_cannot_be_made_is_refused_on_entry(tmp_path: Path) -> None:
    (tmp_path / "there").touch()
    (tmp_path / "left.partial").touch()
    for name, message in (
        ("there", "exists already"),
        ("left", "left by an interrupted recording"),
        ("no/such/folder", "cannot be created: No such file"),
        ("there/run", "Not a directory"),
    ):
        recorder = process(tmp_path / name)
        with pytest.raises(RecordingError, match=message):
            recorder.__enter__()
        assert recorder.pid == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["left.partial", "there"]
    with pytest.raises(UsageError, match="not unique"):
        RecorderProcess(tmp_path / "run", ["a", "a"], URDF, 0, lock_step=True)
    with pytest.raises(UsageError, match="but a ring has"):
        process(tmp_path / "run", slots=1).__enter__()


def test_an_interpreter_that_does_not_start_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for executable, message in (("/bin/false", r"died at its start \(exit code 1\)"), ("/no", "cannot be started: No")):
        monkeypatch.setattr("sys.executable", executable)
        with pytest.raises(RecordingError, match=message):
            process(tmp_path / "run").__enter__()


@pytest.mark.slow
def test_a_killed_recorder_loses_at_most_200_ms(tmp_path: Path) -> None:
    recorder = process(tmp_path / "run")

    def loop() -> None:
        with recorder:
            assert all(paced(recorder, range(730)))
            os.kill(recorder.pid, signal.SIGKILL)
            answers = paced(recorder, range(730, 830))
            assert answers.index(False) < 60
            assert not any(answers[60:])
            assert recorder.error == "the recorder's process died"

    with pytest.raises(RecordingError, match=r"died while recording \(SIGKILL\); what it had written is in .*partial"):
        loop()
    with pytest.raises(RecordingError, match="SIGKILL"):
        recorder.close()
    assert recorder.report is None
    check_prefix(tmp_path / "run.partial", True)
    last = read_all(McapRecording(tmp_path / "run.partial")).stamp_ns[-1]
    assert 729 * STEP_NS - last <= 200_000_000


def test_lock_step_says_that_the_recorder_died(tmp_path: Path) -> None:
    for share in (0.0, 0.5):

        def loop(recorder: RecorderProcess) -> None:
            with recorder:
                for n in range(100_000):
                    store(recorder, n)
                    if n == 500:
                        os.kill(recorder.pid, signal.SIGKILL)

        with pytest.raises(RecordingError, match="the recorder's process died") as caught:
            loop(process(tmp_path / f"run{share}", lock_step=True, share=share, slots=64))
        assert "recording failed too" in caught.value.__notes__[0]


def test_lock_step_does_not_wait_for_ever(tmp_path: Path) -> None:
    with process(tmp_path / "run", lock_step=True, local=False) as recorder:
        sink = RingSink(recorder.ends, "run", lock_step=True, share=0.0, patience=0.3)
        os.kill(recorder.pid, signal.SIGSTOP)
        with pytest.raises(RecordingError, match=r"has taken nothing for 0\.3 s"):
            store(sink, 0)
        os.kill(recorder.pid, signal.SIGCONT)
        assert store(sink, 1)
        sink.close()
    sink.release()
    assert recorder.report is not None
    assert recorder.report.samples == 2


@pytest.mark.parametrize("lock_step", [False, True])
def test_a_full_disk_is_reported_with_its_reason(tmp_path: Path, lock_step: bool) -> None:
    recorder = process(tmp_path / "run", lock_step=lock_step)

    def loop() -> None:
        with recorder:
            resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (60_000, 60_000))
            for n in range(4000):
                if not store(recorder, n):
                    break
                time.sleep(0.0 if lock_step else 1e-3)
            else:
                pytest.fail("nobody told the loop")
            assert not store(recorder, 4000)
            assert recorder.error == "cannot be written: File too large"
            assert recorder.overruns == 2

    with pytest.raises(RecordingNotWritten, match="cannot be written: File too large"):
        loop()
    assert recorder.error == "cannot be written: File too large"
    assert not (tmp_path / "run").exists()
    assert check_prefix(tmp_path / "run.partial", True) > 100


def test_a_recorder_that_is_held_up(tmp_path: Path) -> None:
    """Behind by more than the share it is told; behind by less than the ring nothing is lost; by more it is counted."""
    with process(tmp_path / "a", slots=256) as recorder:
        assert all(paced(recorder, range(50)))
        caught_up(recorder)
        os.kill(recorder.pid, signal.SIGSTOP)
        answers = paced(recorder, range(50, 250), 1e-4)
        assert answers.index(False) == 128
        assert not any(answers[128:])
        os.kill(recorder.pid, signal.SIGCONT)
        caught_up(recorder)
        assert all(paced(recorder, range(250, 300)))
    assert recorder.overruns == answers.count(False)
    assert len(read_all(McapRecording(tmp_path / "a")).stamp_ns) == len(cycles(300))

    def loop() -> None:
        with recorder:
            os.kill(recorder.pid, signal.SIGSTOP)
            paced(recorder, range(100), 0.0)
            os.kill(recorder.pid, signal.SIGCONT)

    recorder = process(tmp_path / "b", slots=16)
    with pytest.raises(RecordingError, match="88 records are missing"):
        loop()
    file = McapRecording(tmp_path / "b")
    assert file.metadata["complete"] == "false"
    messages = [event.message for event in file.read_extras().events]
    assert "88 records before this were lost: the recorder was overrun" in messages


@pytest.mark.slow
def test_a_recorder_that_does_not_look(tmp_path: Path) -> None:
    """Stopped in its tracks for longer than two seconds it counts as dead, long before the ring is full."""
    with process(tmp_path / "run") as recorder:
        os.kill(recorder.pid, signal.SIGSTOP)
        answers = paced(recorder, range(49), 0.05)
        assert all(answers[:16])
        assert not answers[-1]
        os.kill(recorder.pid, signal.SIGCONT)


@pytest.mark.parametrize("lock_step", [False, True])
def test_a_wrong_shape_is_an_error_and_finishes_the_file(tmp_path: Path, lock_step: bool) -> None:
    def loop() -> None:
        with process(tmp_path / "run", lock_step=lock_step) as recorder:
            store(recorder, 0)
            recorder.put(cycles(2)[1]._replace(position=np.zeros(2)))

    with pytest.raises(RecordingError, match=r"recording failed: .* the ring has 3 joints"):
        loop()
    assert check_prefix(tmp_path / "run", False) == 1


def test_what_the_writer_refuses_reaches_the_loop(tmp_path: Path) -> None:
    """The ring takes any 64-bit number, the message only 32 bits of it."""

    def loop() -> None:
        with process(tmp_path / "run", lock_step=True, share=0.0) as recorder:
            store(recorder, 0)
            recorder.put(cycles(2)[1]._replace(lost=1 << 40))

    with pytest.raises(RecordingError, match="recording failed: "):
        loop()
    assert check_prefix(tmp_path / "run", False) == 1


def test_a_fault_in_the_loop_finishes_the_file(tmp_path: Path) -> None:
    def loop() -> None:
        with process(tmp_path / "run") as recorder:
            store(recorder, 0)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        loop()
    assert check_prefix(tmp_path / "run", False) == 1


def test_signals_to_the_group_do_not_end_a_recording(tmp_path: Path) -> None:
    with process(tmp_path / "run") as recorder:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            os.kill(recorder.pid, number)
            assert all(paced(recorder, range(3)))
            time.sleep(0.05)
            assert not select.select([recorder.ends.recorder], [], [], 0)[0]
        assert os.sched_getscheduler(recorder.pid) == os.SCHED_OTHER


@pytest.mark.slow
@pytest.mark.parametrize("lock_step", [False, True])
def test_a_killed_writer_leaves_a_finished_file(tmp_path: Path, lock_step: bool) -> None:
    with (
        actor("recording", tmp_path / "run", 0.0 if lock_step else 1e-3, lock_step) as (motion, (pid,)),
        ending(pid),
    ):
        time.sleep(0.5)
        motion.kill()
    assert not (tmp_path / "run.partial").exists()
    assert check_prefix(tmp_path / "run", False) > 50


@pytest.mark.slow
def test_a_parent_that_dies_leaves_writer_and_recorder_to_end_it(tmp_path: Path) -> None:
    with actor("split", tmp_path / "run", 600) as (parent, (pid, _)), ending(pid):
        await_stream(parent)
        parent.kill()
    file = McapRecording(tmp_path / "run")
    assert file.metadata["complete"] == "true"
    assert len(read_all(file).stamp_ns) == len(cycles(600))


@pytest.mark.slow
def test_a_writer_elsewhere_that_dies(tmp_path: Path) -> None:
    with actor("split", tmp_path / "run", 1 << 30) as (parent, (pid, motion)), ending(pid):
        await_stream(parent)
        os.kill(motion, signal.SIGKILL)
        assert parent.wait(20) == 0
    assert check_prefix(tmp_path / "run", False) > 10


def test_a_recording_that_nobody_wrote_ends(tmp_path: Path) -> None:
    with process(tmp_path / "run", local=False) as recorder:
        pass
    assert recorder.report is not None
    assert (recorder.report.samples, recorder.report.complete) == (0, False)


@pytest.mark.slow
def test_whoever_is_killed_something_readable_is_left(tmp_path: Path) -> None:
    killed(tmp_path, 6, random.Random(1))  # noqa: S311


@pytest.mark.campaign
def test_whoever_of_many_is_killed_something_readable_is_left(tmp_path: Path) -> None:
    killed(tmp_path, 60, random.Random(time.time_ns()))  # noqa: S311


def killed(tmp_path: Path, rounds: int, chance: random.Random) -> None:
    """Kill the motion, the recorder or both at some time."""
    for k in range(rounds):
        path = tmp_path / str(k)
        lock_step = chance.choice([True, False])
        with actor("recording", path, 0.0 if lock_step else 1e-3, lock_step) as (motion, (pid,)), ending(pid):
            time.sleep(chance.uniform(0.0, 0.6))
            victims = [motion.pid, pid]
            chance.shuffle(victims)
            os.kill(victims[0], signal.SIGKILL)
            if chance.random() < 0.5:
                os.kill(victims[1], signal.SIGKILL)
        (left,) = tmp_path.glob(f"{k}*")
        try:
            recording = McapRecording(left)
        except RecordingError as error:
            # Killed at the very start, a recorder leaves a file with its head only.
            if "no message on /joint_states" not in str(error):
                raise
        else:
            check_prefix(left, recording.torn)
