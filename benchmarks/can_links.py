"""Links to a CAN bus: a round trip of one frame, and a cycle of seven drives (3 frames out, 7 back), per link.

About a minute: `python -m benchmarks.can_links`. The other side is a process of its own (a thread for python-can's
`virtual`, which has no other) that answers at once. The machine is used as it is, without real-time privileges.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

from benchmarks.harness import Row, table, write
from drivers.can.bus_load import exact_bits
from drivers.can.can_frame import Frame
from drivers.can.can_link import Link
from drivers.can.frame_log import SessionLog
from drivers.can.python_can_link import PythonCanLink, open_bus
from drivers.clock import RealClock
from ident_service.config.can_bus import CanBus
from sim_backend.can_bus.host import LocalPort
from sim_backend.can_bus.hub import CanBusServer
from sim_backend.can_bus.link import Connection, WireLink
from sim_backend.can_bus.packets import Hello

_ROUNDS = int(os.environ.get("IDENT_BENCH_CAN_ROUNDS", "5000"))
_PING, _SYNC = 0x100, 0x080
_TORQUES = (Frame(0x201, bytes(range(8))), Frame(0x205, bytes(range(6))))
_POSITIONS = tuple(Frame(0x180 + n, bytes((n, 2, 3, 4))) for n in range(1, 8))
_WIRE, _GROUP, _PORT = f"bench-{os.getpid()}", "239.74.163.99", 43311
_WAIT_NS = 50_000_000


def measure() -> list[Row]:
    """All figures."""
    rows = []
    for name, bus, side in (
        ("virtual", CanBus(interface="virtual", channel="bench"), "thread"),
        ("udp_multicast", _udp(), "udp"),
        ("ident_wire, python-can, wire in a third process", _wire_bus(), "wire-can"),
        ("ident_wire, direct, wire in a third process", None, "wire"),
        ("ident_wire, direct, wire in the drives' process", None, "host"),
        ("ident_wire, direct, paced at 1 Mbit/s there", None, "paced"),
    ):
        with _other_side(side), ExitStack() as stack:
            link: Link = WireLink(Connection(_WIRE, Hello("bench"))) if bus is None else _python_can(bus)
            stack.callback(link.close)
            rows += _figures(name, link)
    with _other_side("host"), tempfile.TemporaryDirectory() as folder:
        log = SessionLog(Path(folder) / "bench.log", RealClock())
        with log:
            link = log.link(WireLink(Connection(_WIRE, Hello("bench"))))
            rows += _figures("the last but one, and a log of the session", link)
            link.close()
        rows.append(Row("log: frames lost, at several times what 1 Mbit/s carries", log.lost, "frames"))
    return [*rows, *_bits()]


def _udp() -> CanBus:
    return CanBus(interface="udp_multicast", channel=_GROUP, options={"hop_limit": 0, "port": _PORT})


def _wire_bus() -> CanBus:
    return CanBus(interface="ident_wire", channel=_WIRE)


def _python_can(bus: CanBus) -> PythonCanLink:
    return PythonCanLink(open_bus(bus), bus)


def _figures(name: str, link: Link) -> list[Row]:
    _rounds(link, (Frame(_PING),), 1, 200)
    link.drain()
    single, lost = _rounds(link, (Frame(_PING),), 1, _ROUNDS)
    link.drain()
    begin = time.perf_counter()
    cycle, more = _rounds(link, (*_TORQUES, Frame(_SYNC)), 7, _ROUNDS)
    seconds = time.perf_counter() - begin
    return [
        *_percentiles(f"{name}: there and back", single),
        *_percentiles(f"{name}: 3 out, 7 back", cycle),
        Row(f"{name}: frames a second so", 10 * _ROUNDS / seconds, "1/s"),
        Row(f"{name}: rounds without all answers", lost + more, "rounds", "0"),
    ]


def _rounds(link: Link, out: Sequence[Frame], answers: int, count: int) -> tuple[np.ndarray, int]:
    """Time from before the first frame to after the last answer [ns], and how many rounds had not all of them."""
    taken, incomplete = np.empty(count, np.int64), 0
    for k in range(count):
        begin = time.monotonic_ns()
        for frame in out:
            link.send(frame)
        heard = 0
        while heard < answers and link.receive(begin + _WAIT_NS) is not None:
            heard += 1
        taken[k] = time.monotonic_ns() - begin
        incomplete += heard < answers
    return taken, incomplete


def _percentiles(name: str, nanoseconds: np.ndarray) -> list[Row]:
    median, most = np.percentile(nanoseconds, [50, 99.9]) * 1e-3
    return [Row(f"{name}, median", float(median), "us"), Row(f"{name}, 99.9 %", float(most), "us")]


def _bits() -> list[Row]:
    frame, repeats = Frame(0x181, b"\x12\x34\x56\x78"), 20_000
    exact_bits(frame)
    begin = time.perf_counter()
    for _ in range(repeats):
        exact_bits(frame)
    return [Row("exact bits of a frame", (time.perf_counter() - begin) / repeats * 1e6, "us")]


@contextmanager
def _other_side(side: str) -> Iterator[None]:
    if side == "thread":
        link, ended = _python_can(CanBus(interface="virtual", channel="bench")), threading.Event()
        thread = threading.Thread(target=_answer, args=(link, ended), daemon=True)
        thread.start()
        yield
        ended.set()
        thread.join()
        link.close()
        return
    with ExitStack() as stack:
        if side in ("wire", "wire-can"):
            stack.enter_context(_process("sim_backend.can_bus", _WIRE))
        stack.enter_context(_process("benchmarks.can_links", side, _WIRE))
        yield


@contextmanager
def _process(module: str, *arguments: str) -> Iterator[None]:
    with subprocess.Popen([sys.executable, "-m", module, *arguments], stdout=subprocess.PIPE, text=True) as child:
        if child.stdout is None or child.stdout.readline().strip() != "ready":
            raise RuntimeError(f"{module} did not start")
        yield
        child.kill()


def _answer(link: Link, ended: threading.Event) -> None:
    all_at_once = getattr(link, "send_all", None)
    while not ended.is_set():
        frame = link.receive(time.monotonic_ns() + 100_000_000)
        if frame is None or frame.identifier not in (_PING, _SYNC):
            continue
        answers = _POSITIONS[:1] if frame.identifier == _PING else _POSITIONS
        if all_at_once is not None:
            all_at_once(answers)
        else:
            for position in answers:
                link.send(position)


def _serve(side: str, name: str) -> None:
    """The drives' side, in its own process."""
    with ExitStack() as stack:
        link: Link
        if side in ("host", "paced"):
            wire = stack.enter_context(CanBusServer(name, 1_000_000 if side == "paced" else 0))
            link = LocalPort(wire, "drives")
        elif side == "wire":
            link = WireLink(Connection(name, Hello("drives")))
        else:
            link = _python_can(_udp() if side == "udp" else CanBus(interface="ident_wire", channel=name))
        print("ready", flush=True)
        _answer(link, threading.Event())


if __name__ == "__main__":
    if len(sys.argv) == 3:
        _serve(*sys.argv[1:])
    else:
        found = measure()
        load = ", ".join(f"{value:.2f}" for value in os.getloadavg())
        print(f"{platform.platform()}, {os.cpu_count()} cores, load {load}, Python {platform.python_version()}")
        print(table(found))
        print(f"written to {write(found, Path(__file__).parent / 'results', 'can_links')}")
