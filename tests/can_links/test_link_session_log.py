"""A session in a file: all formats, read by others, killed, and played again."""

from __future__ import annotations

import resource
from collections.abc import Sequence
from pathlib import Path

import can
import pytest
from helpers.replay import LoggedFrame, ReplayLink, read_session
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from link_bench import frames, process, wait_for

from drivers.can.bus_state import BUS_OFF
from drivers.can.can_frame import Frame
from drivers.can.frame_log import SessionLog
from drivers.can.frame_log_process import OrderedLog
from drivers.clock import RealClock, VirtualClock
from ident_service.errors import DriverError, RecordingError

MS = 1_000_000
UTC = 1_700_000_000_000_000_000


class Script:
    """A link that hears what it was told beforehand, at the times it was told, in virtual time."""

    def __init__(self, heard: Sequence[Frame]) -> None:
        self.clock = VirtualClock(0, UTC)
        self.heard = list(heard)

    def send(self, frame: Frame) -> None:
        """Nobody listens."""

    def receive(self, deadline_ns: int) -> Frame | None:
        if self.heard and self.heard[0].stamp_ns <= deadline_ns:
            self.clock.sleep_until_ns(self.heard[0].stamp_ns)
            return self.heard.pop(0)
        self.clock.sleep_until_ns(deadline_ns)
        return None

    def drain(self) -> Sequence[Frame]:
        return ()

    def close(self) -> None:
        """Nothing."""


def three_cycles(path: Path) -> list[Frame]:
    """Log three cycles of 2 ms: SYNC and, 0.3 ms and 0.5 ms later, a position of each of two drives."""
    heard = [
        Frame(0x180 + n, bytes([k, n]), stamp_ns=k * 2 * MS + n * 200_000 + 100_000) for k in range(3) for n in (1, 2)
    ]
    link = Script(heard)
    with SessionLog(path, link.clock) as log:
        logged = log.link(link)
        for k in range(3):
            link.clock.sleep_until_ns(k * 2 * MS)
            logged.send(Frame(0x201, bytes(8)))
            logged.send(Frame(0x080))
            while logged.receive((k * 2 + 1) * MS) is not None:
                pass
        logged.close()
    assert log.report is not None
    assert (log.report.written, log.report.lost, log.report.error) == (12, 0, "")
    return heard


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf"])
def test_every_format_says_what_was_sent_and_heard_when(tmp_path: Path, suffix: str) -> None:
    heard = three_cycles(tmp_path / f"session{suffix}")
    session = read_session(tmp_path / f"session{suffix}")
    assert [logged.sent for logged in session] == [True, True, False, False] * 3
    found = [logged.frame for logged in session if not logged.sent]
    for one, other in zip(found, heard, strict=True):
        assert one._replace(stamp_ns=0) == other._replace(stamp_ns=0)
        assert abs(one.stamp_ns - other.stamp_ns) <= 2000  # these formats keep microseconds
    # python-can reads the same.
    with can.LogReader(tmp_path / f"session{suffix}") as reader:
        messages = list(reader)
    assert [m.arbitration_id for m in messages] == [0x201, 0x080, 0x181, 0x182] * 3
    assert [m.is_rx for m in messages] == [False, False, True, True] * 3


@given(
    drawn=st.lists(st.tuples(frames(fd=True, errors=True), st.booleans(), st.integers(0, 3)), min_size=1, max_size=20),
    number=st.integers(0, 2**60),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=100)
def test_any_frame_survives_candumps_format(tmp_path: Path, drawn: list[tuple[Frame, bool, int]], number: int) -> None:
    path = tmp_path / f"{number}.log"
    path.unlink(missing_ok=True)
    log = OrderedLog(path, UTC)
    wanted = []
    for k, (frame, sent, bus) in enumerate(drawn):
        sent = sent and not frame.error
        stamped = frame._replace(stamp_ns=k * 1000)
        log.add(bus, [(stamped, sent)])
        wanted.append((bus, sent, frame))
    log.close()
    found = read_session(path)
    assert [(logged.bus, logged.sent, logged.frame._replace(stamp_ns=0)) for logged in found] == wanted


def test_frames_are_put_in_the_order_of_their_stamps(tmp_path: Path) -> None:
    log = OrderedLog(tmp_path / "x.log", UTC)
    log.add(0, [(Frame(0x100 + k, stamp_ns=k * MS), False) for k in (3, 1, 5)])
    log.add(1, [(Frame(0x100 + k, stamp_ns=k * MS), False) for k in (2, 4)])
    log.close()
    assert [logged.frame.identifier for logged in read_session(tmp_path / "x.log")] == [
        0x101,
        0x102,
        0x103,
        0x104,
        0x105,
    ]
    assert log.written == 5


def test_an_error_frame_keeps_its_kind_where_the_format_can(tmp_path: Path) -> None:
    for suffix, kind in ((".log", BUS_OFF), (".blf", BUS_OFF), (".asc", 0)):
        log = OrderedLog(tmp_path / f"x{suffix}", UTC)
        log.add(0, [(Frame(0x181, b"a", stamp_ns=1), False), (Frame(BUS_OFF, bytes(8), error=True, stamp_ns=2), False)])
        log.close()
        found = read_session(tmp_path / f"x{suffix}")[1].frame
        assert (found.error, found.identifier) == (True, kind)


_LOGGER = """
import sys, time
from drivers.can.can_frame import Frame
from drivers.can.frame_log import SessionLog
from drivers.clock import RealClock
clock = RealClock()
log = SessionLog(sys.argv[1], clock)
for k in range(160):
    log.write(0, [(Frame(0x181, bytes([k]), stamp_ns=clock.now_ns()), False)])
print("ready", flush=True)
time.sleep(60)
"""


@pytest.mark.parametrize("suffix", [".log", ".blf"])
def test_a_log_outlives_the_process_it_is_of(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"session{suffix}"
    with process("-c", _LOGGER, str(path)) as child:
        child.kill()
        child.wait()

    def whole() -> bool:
        try:
            return len(read_session(path)) == 160
        except RecordingError:  # still being written
            return False

    wait_for(whole)
    assert [logged.frame.data[0] for logged in read_session(path)] == list(range(160))


def test_when_the_writing_process_dies_the_loop_goes_on_and_the_report_says_so(tmp_path: Path) -> None:
    log = SessionLog(tmp_path / "x.log", RealClock())
    log._process.kill()
    log._process.wait()
    log.write(0, [(Frame(0x181), False)] * 3)
    assert log.lost == 3
    log.close()
    assert log.report is not None
    assert log.report.lost == 3
    assert "has died" in log.report.error


def test_a_log_that_cannot_be_is_refused(tmp_path: Path) -> None:
    (tmp_path / "there.log").write_text("precious")
    clock = RealClock()
    with pytest.raises(DriverError, match=r"there\.log: exists already"):
        SessionLog(tmp_path / "there.log", clock)
    assert (tmp_path / "there.log").read_text() == "precious"
    with pytest.raises(DriverError, match=r"ends in \.log, \.asc, \.blf"):
        SessionLog(tmp_path / "x.txt", clock)
    with pytest.raises(DriverError, match="No such file or directory"):
        SessionLog(tmp_path / "none" / "x.log", clock)


def test_what_the_disk_refuses_is_reported_and_holds_nobody_up(tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))  # the writing process inherits it
    try:
        log = SessionLog(tmp_path / "x.log", RealClock())
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    for k in range(1000):
        log.write(0, [(Frame(0x181, stamp_ns=k * 10**9), False)])
    log.close()
    assert log.report is not None
    assert log.report.error == "File too large"
    assert log.report.lost > 800  # 4096 bytes hold about a hundred lines
    assert log.report.written + log.report.lost == 1000


def test_a_replay_answers_each_sync_as_the_log_did_however_late_it_is(tmp_path: Path) -> None:
    three_cycles(tmp_path / "x.log")
    link = ReplayLink(read_session(tmp_path / "x.log"), clock=VirtualClock(50 * MS))
    times = []
    for begin in (50 * MS, 60 * MS, 61 * MS):  # late, then early
        link.clock.sleep_until_ns(begin)
        start = link.clock.now_ns()
        link.send(Frame(0x201, bytes(8)))
        link.send(Frame(0x080))
        heard = []
        while (frame := link.receive(start + 900_000)) is not None:
            heard.append(frame.identifier)
            times.append(frame.stamp_ns - start)
            assert link.clock.now_ns() == frame.stamp_ns
        assert heard == [0x181, 0x182]
    assert times == [300_000, 500_000] * 3
    assert link.finished
    assert [frame.identifier for frame in link.sent] == [frame.identifier for frame in link.logged]


def test_a_replay_keeps_quiet_until_the_driver_asks() -> None:
    session = [
        LoggedFrame(0, False, Frame(0x701, stamp_ns=0)),
        LoggedFrame(0, True, Frame(0x080, stamp_ns=MS)),
        LoggedFrame(1, False, Frame(0x182, stamp_ns=MS + 1)),
        LoggedFrame(0, False, Frame(0x181, stamp_ns=MS + 5)),
    ]
    link = ReplayLink(session)
    assert [frame.identifier for frame in link.drain()] == [0x701]
    assert link.receive(10 * MS) is None
    assert link.clock.now_ns() == 10 * MS
    link.send(Frame(0x080))
    assert link.receive(20 * MS) == Frame(0x181, stamp_ns=10 * MS + 5)
    assert link.receive(20 * MS) is None


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("x.log", "(1.0) can0 181#00\nnonsense\n", "line 2: not a frame"),
        ("x.log", "(1.0) can0 181#0\n", "line 1"),
        ("x.blf", "nonsense", "not a log of CAN frames"),
        ("x.txt", "", "ends in .log, .asc or .blf"),
    ],
)
def test_a_file_that_is_no_log_is_refused(tmp_path: Path, name: str, text: str, says: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(RecordingError, match=says):
        read_session(tmp_path / name)


def test_a_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    for name in ("x.log", "x.blf", "x.asc"):
        with pytest.raises(RecordingError, match="No such file"):
            read_session(tmp_path / name)


def test_candumps_own_lines_are_read(tmp_path: Path) -> None:
    lines = [
        "(1436509052.249713) vcan0 044#2A366C2BBA",
        "(1436509052.449847) vcan0 0F6#7ADFE07BD2",
        "(1436509053.000000) can1 12345678#R",
        "(1436509053.500000) can1 20000040#0000000000000000",
        "(1436509054.000000) can1 123##1AABB",
    ]
    (tmp_path / "x.log").write_text("\n".join(lines) + "\n")
    found = read_session(tmp_path / "x.log")
    assert [logged.bus for logged in found] == [0, 0, 1, 1, 1]
    assert [logged.frame.identifier for logged in found] == [0x44, 0xF6, 0x12345678, 0x40, 0x123]
    assert [logged.frame.error for logged in found] == [False, False, False, True, False]
    assert found[1].frame.stamp_ns == 200_134_000
    assert found[4].frame.data == b"\xaa\xbb"
