"""The wire as an interface of python-can, and its tools on it."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import can
import canopen
import pytest
from link_bench import PATIENCE, content, end_of, soon

from drivers.can.can_frame import Frame
from sim_backend.can_bus.hub import CanBusServer


def test_python_can_talks_over_the_wire(wire: CanBusServer) -> None:
    link = end_of(wire.name)
    with can.Bus(interface="ident_wire", channel=wire.name, bitrate=1_000_000) as bus:
        before = time.time()
        link.send(Frame(0x181, b"\1\2"))
        message = bus.recv(PATIENCE)
        assert message is not None
        assert (message.arbitration_id, bytes(message.data), message.is_extended_id) == (0x181, b"\1\2", False)
        assert before - 1.0 < message.timestamp <= time.time()
        for frame in (Frame(0x80), Frame(0x1234567, b"\3", extended=True), Frame(0x701, remote=True)):
            bus.send(
                can.Message(
                    arbitration_id=frame.identifier,
                    data=None if frame.remote else frame.data,
                    is_extended_id=frame.extended,
                    is_remote_frame=frame.remote,
                )
            )
            assert content(link.receive(soon())) == frame
        assert bus.recv(0.0) is None
        bus.set_filters([{"can_id": 0x200, "can_mask": 0x7FF, "extended": False}])
        link.send_all([Frame(0x181), Frame(0x200)])
        message = bus.recv(PATIENCE)
        assert message is not None
        assert message.arbitration_id == 0x200
        with pytest.raises(can.CanOperationError):
            bus.send(can.Message(arbitration_id=1, is_extended_id=False, is_fd=True, data=bytes(12)))
    link.close()


def test_python_can_hears_itself_when_it_asks_for_it(name: str) -> None:
    with (
        can.Bus(interface="ident_wire", channel=name, host=True) as host,
        can.Bus(interface="ident_wire", channel=name, receive_own_messages=True) as bus,
    ):
        host.send(can.Message(arbitration_id=0x100, is_extended_id=False))
        first = bus.recv(PATIENCE)
        bus.send(can.Message(arbitration_id=0x101, is_extended_id=False))
        second = bus.recv(PATIENCE)
        assert first is not None
        assert second is not None
        assert [(m.arbitration_id, m.is_rx) for m in (first, second)] == [(0x100, True), (0x101, False)]
        heard = host.recv(PATIENCE)
        assert heard is not None
        assert heard.arbitration_id == 0x101
    with pytest.raises(can.CanInitializationError):
        can.Bus(interface="ident_wire", channel=name)


@pytest.mark.slow
def test_the_canopen_library_reads_an_object_over_the_wire(wire: CanBusServer) -> None:
    dictionary = canopen.ObjectDictionary()
    variable = canopen.objectdictionary.ODVariable("device type", 0x1000)
    variable.data_type = canopen.objectdictionary.UNSIGNED32
    variable.default = 0x00020192
    dictionary.add_object(variable)
    drives, host = canopen.Network(), canopen.Network()
    for network in (drives, host):
        network.connect(interface="ident_wire", channel=wire.name, bitrate=1_000_000)
    try:
        drives.create_node(5, dictionary)
        remote = host.add_node(5, dictionary)
        remote.sdo.RESPONSE_TIMEOUT = PATIENCE
        assert remote.sdo[0x1000].raw == 0x00020192
        remote.sdo.download(0x1000, 0, (0x11223344).to_bytes(4, "little"))
        assert remote.sdo.upload(0x1000, 0) == b"\x44\x33\x22\x11"
    finally:
        host.disconnect()
        drives.disconnect()


@pytest.mark.slow
def test_the_logger_of_python_can_sees_the_wire(wire: CanBusServer) -> None:
    link = end_of(wire.name)
    command = [sys.executable, "-u", "-m", "can.logger", "-i", "ident_wire", "-c", wire.name]
    child = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert child.stdout is not None
        told = iter(child.stdout)
        assert any(line.startswith("Can Logger (Started") for line in told)
        for k in range(10):
            link.send(Frame(0x181, bytes([k])))
        heard = [next(told).split() for _ in range(10)]
        child.send_signal(signal.SIGINT)
        assert list(told) == []
        assert child.wait() == 0
    finally:
        child.kill()
        child.communicate()
    assert [(words[words.index("ID:") + 1], words[words.index("DL:") + 2]) for words in heard] == [
        ("181", f"{k:02x}") for k in range(10)
    ]
    link.close()
