"""The canopen library, which knows nothing of this project, drives an emulated node over python-can."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import canopen
import pytest
from canopen.profiles.p402 import BaseNode402
from drives_bench import EDS, drives_config

from ident_service.errors import DriverError
from sim_backend.emulator.process import Emulated, emulate

CHANNEL = "drives-foreign"


class Bus:
    """The library's network, and the drives in a thread that boot once it knows them."""

    def __init__(self, network: canopen.Network, power_up: Callable[[], None]) -> None:
        self.network, self._power_up = network, power_up

    def boot(self, node: canopen.RemoteNode) -> None:
        self.network.add_node(node)
        node.sdo.RESPONSE_TIMEOUT = 20.0  # or a busy machine's drives answer too late
        self._power_up()
        deadline = time.monotonic() + 20.0
        while node.nmt.timestamp is None:  # `wait_for_bootup` misses a message that came before it listened
            assert time.monotonic() < deadline, "no boot-up message"
            time.sleep(0.005)
        assert node.nmt.state == "PRE-OPERATIONAL"


@pytest.fixture
def bus(tmp_path: Path) -> Iterator[Bus]:
    config = drives_config(tmp_path, buses=[{"interface": "virtual", "channel": CHANNEL}])
    end = threading.Event()
    done: list[Emulated] = []
    network = canopen.Network()
    network.connect(interface="virtual", channel=CHANNEL)
    thread = threading.Thread(target=lambda: done.append(emulate(config, stop_requested=end.is_set)))
    try:
        yield Bus(network, thread.start)
    finally:
        network.disconnect()
        end.set()
        thread.join()
    assert done[0].sent > 0
    assert done[0].unsent == 0


@pytest.mark.slow
def test_sdo_reads_writes_and_refuses(bus: Bus) -> None:
    node = canopen.RemoteNode(1, str(EDS))
    bus.boot(node)
    assert node.sdo["Manufacturer device name"].raw == "Emulated torque drive"
    assert node.sdo[0x1018][1].raw == 0
    assert node.sdo[0x1018][2].raw == 1
    node.sdo[0x6072].raw = 1234
    assert node.sdo[0x6072].raw == 1234
    node.sdo.download(0x6072, 0, (999).to_bytes(2, "little"), force_segment=True)
    assert node.sdo[0x6072].raw == 999
    for index, subindex, data, code in (
        (0x2345, 0, b"\0", 0x06020000),
        (0x1018, 9, b"\0\0\0\0", 0x06090011),
        (0x6041, 0, b"\0\0", 0x06010002),
        (0x6072, 0, b"\0\0\0\0", 0x06070012),
        (0x6072, 0, b"\0", 0x06070013),
        (0x6007, 0, (4).to_bytes(2, "little"), 0x06090031),
        (0x6007, 0, (-1).to_bytes(2, "little", signed=True), 0x06090032),
    ):
        with pytest.raises(canopen.SdoAbortedError) as refused:
            node.sdo.download(index, subindex, data)
        assert refused.value.code == code


@pytest.mark.slow
def test_pdos_states_and_torque(bus: Bus) -> None:
    node = BaseNode402(1, str(EDS))
    bus.boot(node)
    node.rpdo.read()
    node.tpdo.read()
    node.rpdo[3].clear()
    node.rpdo[3].add_variable(0x6071)
    node.rpdo[3].cob_id, node.rpdo[3].trans_type, node.rpdo[3].enabled = 0x201, 1, True
    node.rpdo[1].enabled = False
    node.tpdo[3].clear()
    node.tpdo[3].add_variable(0x6064)
    node.tpdo[3].add_variable(0x6077)
    node.tpdo[3].cob_id, node.tpdo[3].trans_type, node.tpdo[3].enabled = 0x381, 1, True
    # The library waits for a status to be repeated.
    node.tpdo[1].event_timer = node.tpdo[2].event_timer = 20
    for pdo in (node.rpdo[1], node.rpdo[3], node.tpdo[1], node.tpdo[2], node.tpdo[3]):
        pdo.save()
    node.sdo[0x6072].raw = 5000
    # The library looks for the objects of the state machine in the PDOs that it reads here.
    node.setup_402_state_machine(read_pdos=True)
    node.nmt.state = "OPERATIONAL"
    node.op_mode = "CYCLIC SYNCHRONOUS TORQUE"
    for state in ("READY TO SWITCH ON", "SWITCHED ON", "OPERATION ENABLED"):
        node.state = state
    assert node.state == "OPERATION ENABLED"
    # The second drive has no power, so that the arm is still held; the torque is told all the same.
    node.rpdo[3][0x6071].raw = -321
    node.rpdo[3].transmit()
    torques = []
    for _ in range(3):
        bus.network.sync.transmit()
        assert node.tpdo[3].wait_for_reception(1.0)
        torques.append(node.tpdo[3][0x6077].raw)
    assert torques == [0, -321, -321]
    node.sdo[0x605A].raw = 6  # stay in quick stop, where the library can see it
    for state in ("QUICK STOP ACTIVE", "SWITCH ON DISABLED"):
        node.state = state
        assert node.state == state


@pytest.mark.slow
def test_heartbeat_emergency_and_fault_reset(bus: Bus) -> None:
    node = BaseNode402(2, str(EDS))
    bus.boot(node)
    node.sdo[0x1017].raw = 20
    assert node.nmt.wait_for_heartbeat(2.0) == "PRE-OPERATIONAL"
    node.sdo[0x6007].raw = 1
    node.sdo[0x1016][1].raw = 127 << 16 | 100
    bus.network.send_message(0x700 + 127, b"\x05")
    assert node.emcy.wait(0x8130, 2.0).register == 0x11
    assert node.sdo[0x603F].raw == 0x8130
    assert node.sdo[0x1003][1].raw == 0x8130
    assert node.sdo[0x6041].raw & 0x4F == 0x08
    node.sdo[0x6040].raw = 0x80
    assert node.sdo[0x6041].raw & 0x4F == 0x40
    bus.network.send_message(0x700 + 127, b"\x05")
    assert node.emcy.wait(0x0000, 2.0).register == 0


def test_an_unknown_interface_is_reported(tmp_path: Path) -> None:
    config = drives_config(tmp_path, buses=[{"interface": "no_such_interface"}])
    with pytest.raises(OSError, match="bus 0: no_such_interface can0"):
        emulate(config, seconds=0.01)


def test_frames_are_of_the_kind_they_were_sent_as() -> None:
    """A bus that nobody listens on must not hinder the sender; python-can's virtual bus keeps kinds apart."""
    from drivers.can.can_frame import Frame
    from ident_service.config.can_bus import CanBus
    from sim_backend.emulator.process import PythonCanBuses

    with can.Bus(interface="virtual", channel="drives-kinds") as other:
        station = PythonCanBuses([CanBus(interface="virtual", channel="drives-kinds")])
        station.send([(0, Frame(0x123, b"\x01")), (0, Frame(0x040, bytes(8), error=True))])
        first, second = other.recv(1.0), other.recv(1.0)
        assert first is not None
        assert second is not None
        assert (first.arbitration_id, first.is_error_frame, second.is_error_frame) == (0x123, False, True)
        other.send(can.Message(arbitration_id=0x7FF, is_remote_frame=True, is_extended_id=False))
        assert station.receive(1.0) == (0, Frame(0x7FF, remote=True))
        assert station.receive(0.0) is None
        station.close()


def test_one_of_two_interfaces_that_is_gone_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    from ident_service.config.can_bus import CanBus
    from sim_backend.emulator.process import PythonCanBuses

    buses = [CanBus(interface="virtual", channel=f"drives-gone-{number}") for number in range(2)]
    station = PythonCanBuses(buses)
    try:
        assert station.receive(0.0) is None

        def unplugged(timeout: float | None = None) -> None:
            raise can.CanOperationError("unplugged")

        monkeypatch.setattr(station._buses[1], "recv", unplugged)
        with pytest.raises(DriverError, match="bus 1 is gone: unplugged"):
            station.receive(10.0)
    finally:
        station.close()
