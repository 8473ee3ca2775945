"""The wire over real sockets: who hears what, who vanishes, what nonsense does, and the tools of python-can on it."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path

import can
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from link_bench import PATIENCE, arm_on_bus, content, end_of, frames, greeted, process, soon

from drivers.can.bus_state import BUS_OFF, CONTROLLER, RESTARTED, RX_OVERFLOW, BusError
from drivers.can.can_frame import MAX_PACKET_BYTES, Frame, pack_frames
from drivers.can.can_link import open_links
from ident_service.errors import DriverError
from sim_backend.can_bus import link as address
from sim_backend.can_bus import packets
from sim_backend.can_bus.host import LocalPort, WireThread
from sim_backend.can_bus.hub import MOST_ENDS, CanBusServer
from sim_backend.can_bus.link import Connection, WireLink
from sim_backend.can_bus.packets import Hello


@given(drawn=st.lists(frames(), min_size=1, max_size=30))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=50)
def test_every_frame_reaches_all_others_in_its_order(wire: CanBusServer, drawn: list[Frame]) -> None:
    sender, *listeners = ends = [end_of(wire.name) for _ in range(3)]
    for frame in drawn:
        sender.send(frame)
    for listener in listeners:
        before = 0
        for frame in drawn:
            found = listener.receive(soon())
            assert content(found) == frame
            assert found is not None
            assert before <= found.stamp_ns <= time.monotonic_ns()
            before = found.stamp_ns
    assert sender.drain() == ()
    for end in ends:
        end.close()


def test_frames_that_wait_together_are_ordered_by_arbitration(name: str) -> None:
    with CanBusServer(name) as wire:
        connections = []
        for k in range(3):  # nobody hosts the wire yet, so the greeting is done in steps
            sock = address.connect(name)
            sock.send(packets.pack_hello(Hello(f"end {k}")))
            connections.append(sock)
        while len(wire.medium.ports) < 3:
            wire.poll(soon())
        listener = LocalPort(wire, "listener")
        for identifier, sock in zip((0x183, 0x181, 0x182), connections, strict=True):
            sock.send(pack_frames([(Frame(identifier), False), (Frame(identifier - 0x100), False)]))
        wire.poll(soon())
        assert [frame.identifier for frame in listener.drain()] == [0x181, 0x081, 0x182, 0x082, 0x183, 0x083]
        for sock in connections:
            sock.close()


def test_a_port_of_the_host_needs_no_socket_and_no_thread(name: str) -> None:
    with CanBusServer(name) as wire:
        one, other = LocalPort(wire, "one"), LocalPort(wire, "other")
        one.send_all([Frame(0x201, b"\1"), Frame(0x080)])
        assert [content(frame) for frame in other.drain()] == [Frame(0x201, b"\1"), Frame(0x080)]
        assert one.drain() == []
        assert one.receive(time.monotonic_ns() + 1_000_000) is None
        other.close()
        one.send(Frame(0x080))
        assert other.port.take() == []


def test_a_paced_wire_takes_the_time_of_its_bits(name: str) -> None:
    with WireThread(CanBusServer(name, 1_000_000)):
        sender, listener = end_of(name), end_of(name)
        sender.send_all([Frame(0x080)] * 20)
        stamps = [frame.stamp_ns for frame in (listener.receive(soon()) for _ in range(20)) if frame is not None]
        assert [b - a for a, b in pairwise(stamps)] == [51_000] * 19
        assert stamps[-1] <= time.monotonic_ns()  # nothing is heard before its end
        sender.close()
        listener.close()


def test_a_link_hears_sdo_and_all_else_of_canopen_but_not_itself(wire: CanBusServer) -> None:
    (link,) = open_links(arm_on_bus(interface="ident_wire", channel=wire.name))
    assert isinstance(link, WireLink)
    drive = end_of(wire.name)
    greeted(wire, 2)
    link.send(Frame(0x080))
    for frame in (Frame(0x100, extended=True), Frame(0x581), Frame(0x181)):
        drive.send(frame)
    assert content(link.receive(soon())) == Frame(0x581)
    assert content(link.receive(soon())) == Frame(0x181)
    assert content(drive.receive(soon())) == Frame(0x080)
    link.close()
    drive.close()


def test_without_a_wire_the_message_says_how_to_start_one(name: str) -> None:
    with pytest.raises(BusError, match=rf"nobody runs this wire; start `ident emulate.*can_bus {name}") as caught:
        open_links(arm_on_bus(interface="ident_wire", channel=name))
    assert caught.value.kind == "absent"
    with pytest.raises(can.CanInitializationError, match="nobody runs this wire"):
        can.Bus(interface="ident_wire", channel=name)
    with pytest.raises(DriverError, match=r"buses\.0\.options: ident_wire has only pace, found host"):
        open_links(arm_on_bus(interface="ident_wire", channel=name, options={"host": True}))


def test_a_wire_is_run_once(wire: CanBusServer) -> None:
    with pytest.raises(BusError, match="another process runs this wire"), CanBusServer(wire.name):
        pass


@pytest.mark.parametrize("channel", ["", "a\0b", "x" * 200])
def test_a_name_that_cannot_be_one_is_refused(channel: str) -> None:
    with pytest.raises(BusError, match="1 to 60 characters"), CanBusServer(channel):
        pass


def test_a_socket_file_is_its_owners_alone_and_does_not_outlive_its_wire_in_the_way(tmp_path: Path) -> None:
    path = tmp_path / "wire"
    with process("-m", "sim_backend.can_bus", str(path)) as child:
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        end_of(str(path)).close()
        child.kill()
        child.wait()
    assert path.exists()
    with WireThread(CanBusServer(str(path))):
        end_of(str(path)).close()
    assert not path.exists()
    path.write_text("not a socket")
    with pytest.raises(BusError), CanBusServer(str(path)):
        pass
    assert path.read_text() == "not a socket"


@pytest.mark.slow
def test_a_wire_that_is_killed_is_gone_and_another_one_takes_its_place(name: str) -> None:
    with process("-m", "sim_backend.can_bus", name) as child:
        link = end_of(name)
        child.kill()
        child.wait()
        with pytest.raises(BusError, match="has ended; start it again") as caught:
            link.receive(soon())
        assert caught.value.kind == "gone"
        with pytest.raises(BusError):
            link.send(Frame(0x080))
        link.close()
    with process("-m", "sim_backend.can_bus", name) as child:
        one, other = end_of(name), end_of(name)
        one.send(Frame(0x123))
        assert content(other.receive(soon())) == Frame(0x123)
        child.send_signal(signal.SIGTERM)
        assert child.wait(PATIENCE) == 0
        one.close()
        other.close()


_TALKER = """
import sys, time
from drivers.can.can_frame import Frame
from sim_backend.can_bus.link import Connection, WireLink
from sim_backend.can_bus.packets import Hello
link = WireLink(Connection(sys.argv[1], Hello("talker")))
print("ready", flush=True)
k = 0
while True:
    try:
        link.send_all([Frame(0x300 + k % 16, bytes(8))] * 4)
    except OSError:
        time.sleep(0.001)
    k += 1
"""


@pytest.mark.parametrize("bitrate", [0, 1_000_000])
def test_an_end_that_is_killed_while_it_talks_is_forgotten(name: str, bitrate: int) -> None:
    with WireThread(CanBusServer(name, bitrate)) as thread:
        one, other = end_of(name), end_of(name)
        with process("-c", _TALKER, name) as child:
            assert one.receive(soon()) is not None
            child.kill()
            child.wait()
        greeted(thread.wire, 2)
        one.drain()
        other.drain()
        one.send(Frame(0x123))
        while (found := other.receive(soon())) is not None and found.identifier != 0x123:
            pass
        assert content(found) == Frame(0x123)
        one.close()
        other.close()


@given(noise=st.lists(st.binary(min_size=1, max_size=200), min_size=1, max_size=5), greets=st.booleans())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=200)
def test_noise_on_the_socket_never_stops_the_wire(wire: CanBusServer, noise: list[bytes], greets: bool) -> None:
    one, other = end_of(wire.name), end_of(wire.name)
    with address.connect(wire.name) as sock:
        sock.settimeout(PATIENCE)
        if greets:
            sock.send(packets.pack_hello(Hello("noise")))
            sock.recv(MAX_PACKET_BYTES)
        try:
            for data in noise:
                sock.send(data)
        except (BrokenPipeError, ConnectionResetError):
            pass
    greeted(wire, 2)
    one.drain()
    other.drain()
    one.send(Frame(0x123))
    while (found := other.receive(soon())) is not None and found.identifier != 0x123:
        pass
    assert content(found) == Frame(0x123)
    one.close()
    other.close()
    greeted(wire, 0)


@pytest.mark.parametrize(
    "frame", [Frame(0x40, bytes(8), error=True), Frame(0x100, bytes(12))], ids=["error frame", "too long"]
)
def test_an_end_that_sends_what_no_controller_sends_is_thrown_out(wire: CanBusServer, frame: Frame) -> None:
    with address.connect(wire.name) as sock:
        sock.settimeout(PATIENCE)
        sock.send(packets.pack_hello(Hello("liar")))
        sock.recv(MAX_PACKET_BYTES)
        sock.send(pack_frames([(frame, False)]))
        assert sock.recv(MAX_PACKET_BYTES) == b""
    assert wire.expelled == 1


def test_a_crowded_wire_says_so(wire: CanBusServer) -> None:
    ends = [end_of(wire.name) for _ in range(MOST_ENDS)]
    with pytest.raises(BusError, match="no room for another end"):
        end_of(wire.name)
    for end in ends:
        end.close()
    greeted(wire, 0)
    end_of(wire.name).close()


def test_an_end_of_another_version_is_reported(wire: CanBusServer) -> None:
    with address.connect(wire.name) as sock:
        sock.settimeout(PATIENCE)
        sock.send(packets.pack_hello(Hello("old"))[:4] + b"\0" + bytes(40))
        assert packets.unpack_welcome(sock.recv(MAX_PACKET_BYTES)).answer == packets.OTHER_VERSION


def test_something_else_at_the_address_is_distinguished_from_a_wire(name: str) -> None:
    with address.listen(name) as listener:
        listener.setblocking(True)
        answers = [b"HTTP/1.1 200 OK", packets.pack_welcome(packets.Welcome(packets.OTHER_VERSION))]
        complaints = ["does not answer as a wire does", "another version"]
        for answer, complaint in zip(answers, complaints, strict=True):
            with ThreadPoolExecutor() as pool:
                end = pool.submit(end_of, name)
                with listener.accept()[0] as sock:
                    sock.recv(MAX_PACKET_BYTES)
                    sock.send(answer)
                    with pytest.raises(DriverError, match=complaint):
                        end.result(PATIENCE)


def test_who_does_not_read_loses_frames_is_warned_and_holds_nobody_up(wire: CanBusServer) -> None:
    sleeper, sender, listener = end_of(wire.name), end_of(wire.name), end_of(wire.name)
    count = 5000
    for k in range(count):
        sender.send(Frame(0x100 + k % 2, k.to_bytes(4)))
        found = listener.receive(soon())
        assert found is not None
        assert int.from_bytes(found.data) == k
    first = list(sleeper.drain())
    assert 0 < len(first) < count
    assert [int.from_bytes(frame.data) for frame in first] == list(range(len(first)))
    sender.send(Frame(0x123))
    told, found = sleeper.receive(soon()), sleeper.receive(soon())
    assert told is not None
    assert told.error
    assert (told.identifier, told.data[1]) == (CONTROLLER, RX_OVERFLOW)
    assert content(found) == Frame(0x123)
    for end in (sleeper, sender, listener):
        end.close()


def test_a_wire_that_is_too_slow_takes_no_more_and_never_blocks(name: str) -> None:
    with WireThread(CanBusServer(name, 1000)):  # 1 kbit/s
        sender, listener = end_of(name), end_of(name)

        def without_end() -> None:
            for _ in range(10_000):
                sender.send(Frame(0x080))

        with pytest.raises(BusError, match="takes no more frames") as caught:
            without_end()
        assert caught.value.kind == "full"
        sender.close()
        listener.close()


def test_bus_off_is_heard_then_sending_is_refused_until_a_restart(wire: CanBusServer) -> None:
    driver, drive = end_of(wire.name, "driver"), end_of(wire.name, "drive")
    greeted(wire, 2)
    (port,) = [port for port in wire.medium.ports if port.label == "driver"]
    with wire.lock:
        wire.medium.set_counters(port, 256, 0, time.monotonic_ns())
    wire.wake()
    told = driver.receive(soon())
    assert told is not None
    assert (told.error, told.identifier) == (True, BUS_OFF)
    with pytest.raises(BusError, match="bus-off") as caught:
        driver.send(Frame(0x080))
    assert caught.value.kind == "off"
    drive.send(Frame(0x181))
    assert drive.drain() == ()
    with wire.lock:
        wire.medium.restart(port, time.monotonic_ns())
    wire.wake()
    told = driver.receive(soon())
    assert told is not None
    assert (told.error, told.identifier) == (True, RESTARTED)
    driver.send(Frame(0x080))
    assert content(drive.receive(soon())) == Frame(0x080)
    driver.close()
    drive.close()


def test_a_connection_is_of_one_user_only(name: str) -> None:
    if os.getuid() != 0:
        pytest.skip("only root can become somebody else")
    with WireThread(CanBusServer(name)) as thread:
        code = (
            "import os, sys; from sim_backend.can_bus import link as address\n"
            "where = address.address_of(sys.argv[1]); import socket; os.setuid(65534)\n"
            "s = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET); s.settimeout(30); s.connect(where)\n"
            "sys.exit(0 if s.recv(100) == b'' else 3)"
        )
        child = subprocess.run([sys.executable, "-c", code, name], timeout=PATIENCE, check=False)
        assert child.returncode == 0
        assert thread.wire.medium.ports == []
        connection = Connection(name, Hello("me"))
        assert connection.welcome.answer == packets.ACCEPTED
        connection.close()


def test_a_frame_comes_when_it_was_sent_however_late_the_wires_host_is() -> None:
    with CanBusServer(f"late-{os.getpid()}") as wire, ThreadPoolExecutor(1) as others:
        port = LocalPort(wire, "drives")
        greeting = others.submit(end_of, wire.name)
        while not greeting.done():
            wire.poll(time.monotonic_ns() + 1_000_000)
        sender, sent = greeting.result(), list[tuple[int, int]]()
        for number in range(3):
            before = time.monotonic_ns()
            sender.send(Frame(0x080 + number))
            sent.append((before, time.monotonic_ns()))
            time.sleep(0.005)
        heard = [frame for _ in sent if (frame := port.receive(soon())) is not None]
        assert [frame.identifier for frame in heard] == [0x080, 0x081, 0x082]
        for frame, (before, after) in zip(heard, sent, strict=True):
            assert before <= frame.stamp_ns <= after
        # No end may say that it sent something long ago, or will.
        raw = sender._connection._socket
        for lie in (time.monotonic_ns() + 10**12, 1):
            raw.send(pack_frames([(Frame(0x083, stamp_ns=lie), False)]))
            last = port.receive(soon())
            assert last is not None
            assert heard[-1].stamp_ns <= last.stamp_ns <= time.monotonic_ns()
        sender.close()
