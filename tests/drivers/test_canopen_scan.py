"""`ident bus scan`: who is on the bus of emulated drives, and that nothing but SDO uploads leaves the host."""

from __future__ import annotations

import json
import struct
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from contract_bench import canopen_config
from test_canopen_monitoring import Bench, Tap

from drivers.arm import StopKind
from drivers.can.can_frame import Frame
from drivers.can.can_link import Link
from drivers.canopen.bus_scan import NODES
from ident_service.cli import DONE, USAGE, VERDICT_NO, main
from ident_service.config.arm import ArmConfig
from ident_service.config.load import load_arm, shipped_arms
from ident_service.errors import DriverError, UsageError
from ident_service.operations.fieldbus import Match, Scan, bus_scan, scan_document, scan_text
from sim_backend.emulator.process import emulate

MS = 1_000_000
DRIVE = {"counts": 65536, "rated_torque": 1.0, "max_speed": 6000.0, "max_torque": 5.0}


def scanned(bench: Bench, config: ArmConfig | None = None) -> Scan:
    """A scan, which is proven to have sent nothing but uploads and to have changed nothing."""
    bench.sent.clear()
    states, objects = bench.states(), bench.objects()
    found = bus_scan(bench.config if config is None else config, bench._links)
    assert {frame.identifier - 0x600 for frame in bench.sent} == set(NODES)
    for frame in bench.sent:
        assert frame.data[0] >> 5 in (2, 3), frame  # initiate upload, upload segment (CiA 301, 7.2.4.3)
    assert bench.states() == states
    assert bench.objects() == objects
    document = scan_document(bench.config, found)
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    assert document["complete"] == found.complete
    return found


def configured(bench: Bench, *drives: dict[str, Any]) -> ArmConfig:
    """The bench as another description has it: other nodes or identities than the emulated ones."""
    return ArmConfig.model_validate(
        bench.config.model_dump(mode="json")
        | {"driver": canopen_config(drives=[DRIVE | drive for drive in drives]).model_dump(mode="json")["driver"]}
    )


def test_drives_that_were_just_powered() -> None:
    bench = Bench()
    found = scanned(bench)
    assert found.complete
    assert [(line.node, line.drive, line.match) for line in found.lines] == [
        (1, 1, Match.CONFIGURED),
        (2, 2, Match.CONFIGURED),
    ]
    for line in found.lines:
        node = line.found
        assert node is not None
        assert (node.name, node.status, node.error_register, node.history) == ("Emulated torque drive", 0x0250, 0, ())
        assert node.identity["product"] == 1
        assert node.nmt == "sends no heartbeat"
        assert node.unread == []
    text = scan_text(bench.config, found)
    assert text.startswith("bench: every configured drive is there\n\nbus 0: lock_step bench, 1 Mbit/s\n")
    assert "     1  1     configured       switch on disabled          sends no heartbeat\n" in text


def test_errors_and_nmt_states_are_reported_in_words() -> None:
    bench = Bench()
    with bench.arm as arm:
        arm.enable()
        bench.inject(kind="drive_fault", joint="slide", duration=0.002)
        for _ in range(30):
            arm.exchange(np.zeros(2))
        arm.stop(StopKind.QUICK_STOP)
    bench.behind.emulator.faces[0].nmt.command(b"\x02\x01")  # type: ignore[attr-defined]
    found = scanned(bench)
    # A stopped node answers no SDO request, so that nobody knows who it is.
    stopped, faulty = found.lines
    assert (stopped.match, stopped.found and stopped.found.nmt) == (Match.SILENT, "stopped")
    assert not found.complete
    assert faulty.match is Match.CONFIGURED
    assert faulty.found is not None
    assert faulty.found.nmt == "pre-operational"
    assert faulty.found.last_error == 0x5400
    text = scan_text(bench.config, found)
    assert text.startswith("bench: node 1 on bus 0 DOES NOT ANSWER\n")
    assert "     2  2     configured       fault" in text
    assert "        has errors: generic; 603Fh: 5400h power section\n" in text
    assert "        history, latest first: 5400h power section\n" in text


def test_missing_other_and_unknown_nodes() -> None:
    bench = Bench(drives=[DRIVE | {"node": 2, "identity": {"serial": 5}}, DRIVE | {"node": 9}])
    wanted = configured(bench, {"node": 2, "identity": {"serial": 6, "product": 1}}, {"node": 3})
    found = scanned(bench, wanted)
    assert [(line.node, line.match, line.why) for line in found.lines] == [
        (2, Match.OTHER, "serial is 00000005h instead of 00000006h"),
        (3, Match.MISSING, "silent"),
        (9, Match.UNKNOWN, ""),
    ]
    assert not found.complete
    text = scan_text(wanted, found)
    assert text.startswith("bench: node 2 on bus 0 IS ANOTHER ONE; node 3 on bus 0 IS MISSING\n")
    assert "\n     9  -     not configured" in text


def test_an_unknown_node_alone_is_no_mismatch() -> None:
    bench = Bench(drives=[DRIVE | {"node": 1}, DRIVE | {"node": 127}], heartbeats={"node": 126})
    wanted = configured(bench, {"node": 1})
    found = scanned(bench, wanted)
    assert [line.match for line in found.lines] == [Match.CONFIGURED, Match.UNKNOWN]
    assert found.complete


def test_nodes_on_two_buses_are_kept_apart() -> None:
    buses = [{"interface": "lock_step", "channel": "a"}, {"interface": "lock_step", "channel": "b"}]
    bench = Bench(buses=buses, drives=[DRIVE | {"node": 1}, DRIVE | {"node": 1, "bus": 1}])
    found = scanned(bench)
    assert [(line.bus, line.node, line.drive, line.match) for line in found.lines] == [
        (0, 1, 1, Match.CONFIGURED),
        (1, 1, 2, Match.CONFIGURED),
    ]


class Heard(Tap):
    """A link on which frames come that none of the emulated drives sends."""

    script: Sequence[Frame] = ()

    def receive(self, deadline_ns: int) -> Frame | None:
        if self.script:
            frame, self.script = self.script[0], self.script[1:]
            return frame._replace(stamp_ns=self.clock.now_ns())
        return super().receive(deadline_ns)


def with_script(bench: Bench, *script: Frame) -> Scan:
    def links(_: ArmConfig) -> list[Link]:
        link = Heard(bench.behind.link(0), bench.sent)
        link.script = script
        return [link]

    return bus_scan(bench.config, links)


def test_where_another_host_streams_nobody_is_asked() -> None:
    bench = Bench()
    bench.sent.clear()
    with pytest.raises(DriverError, match="another host sends SYNC on bench; a scan would delay its frames"):
        with_script(bench, Frame(0x080))
    assert bench.sent == []


def test_heartbeats_boot_ups_and_noise() -> None:
    bench = Bench()
    noise = [Frame(0x730, b"\x05", remote=True), Frame(0x731, b""), Frame(0x040, bytes(8), error=True), Frame(0x7A0)]
    found = with_script(bench, Frame(0x70A, b"\x05"), Frame(0x70B, b"\x00"), Frame(0x70C, b"\x84"), *noise)
    strangers = {line.node: line.found.nmt for line in found.lines if line.found and not line.found.answers}
    assert strangers == {
        10: "operational, heartbeat missing",
        11: "pre-operational since it booted",
        12: "stopped, heartbeat missing",
    }
    assert found.complete


class Late(Tap):
    """One node answers the question of 1000h only after 100 ms, and refuses its error register."""

    def __init__(self, link: Link, sent: list[Frame]) -> None:
        super().__init__(link, sent)
        self.due: list[Frame] = []

    def send(self, frame: Frame) -> None:
        if frame.identifier == 0x632:
            self._sent.append(frame)
            index, sub = struct.unpack_from("<HB", frame.data, 1)
            if index == 0x1000:
                reply = struct.pack("<BHBI", 0x43, index, sub, 401)
                self.due.append(Frame(0x5B2, reply, stamp_ns=self.clock.now_ns() + 100 * MS))
            else:
                self.due.append(Frame(0x5B2, struct.pack("<BHBI", 0x80, index, sub, 0x08000022)))
        else:
            super().send(frame)

    def receive(self, deadline_ns: int) -> Frame | None:
        if self.due and self.due[0].stamp_ns <= deadline_ns:
            self.clock.sleep_until_ns(self.due[0].stamp_ns)
            return self.due.pop(0)
        return super().receive(deadline_ns)


def test_a_slow_node_is_queried_again_and_what_it_refuses_is_stated() -> None:
    bench = Bench()
    found = bus_scan(bench.config, lambda _: [Late(bench.behind.link(0), bench.sent)])
    line = found.lines[-1]
    assert (line.node, line.match) == (0x32, Match.UNKNOWN)
    assert line.found is not None
    assert line.found.device_type == 401
    assert not line.found.is_drive
    assert any("1001h:00 error register: 08000022h" in words for words in line.found.unread)
    assert "node 50: reading 1001h:00 error register: 08000022h data cannot" in scan_text(bench.config, found)


def test_something_that_is_no_drive_is_another_one() -> None:
    bench = Bench()
    wanted = configured(bench, {"node": 1}, {"node": 0x32})
    found = bus_scan(wanted, lambda _: [Late(bench.behind.link(0), bench.sent)])
    assert [(line.node, line.match) for line in found.lines] == [
        (1, Match.CONFIGURED),
        (2, Match.UNKNOWN),
        (0x32, Match.OTHER),
    ]
    assert found.lines[-1].why == "no drive of CiA 402 (1000h is 00000191h)"


def test_an_arm_without_a_bus_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UsageError, match="a bus scan is of CANopen drives"):
        bus_scan(canopen_config().model_copy(update={"driver": None}))
    assert main(["bus", "scan", "planar2"]) == USAGE
    assert "driver.kind: canopen" in capsys.readouterr().err


def arm_file(folder: Path, *nodes: int) -> Path:
    """A small arm whose drives have these numbers, on a bus of python-can in this process."""
    drive = {"rated_torque": 1.0, "max_torque": 10.0, "max_speed": 3000.0}
    shipped = shipped_arms()["planar2"]
    tree = {
        "extends": str(shipped),
        "name": "drives2",
        "transmission": {"ratios": [40.0, 20.0], "drive_terms": "joints"},
        "driver": {
            "kind": "canopen",
            "eds": str(shipped.parent / "emulated_drive.eds"),
            "buses": [{"interface": "virtual", "channel": f"scan-{folder.name}"}],
            "drives": [drive | {"node": node} for node in nodes],
        },
    }
    path = folder / f"nodes{''.join(map(str, nodes))}.yaml"
    path.write_text(yaml.safe_dump(tree))
    return path


@pytest.mark.slow
def test_the_command_scans_a_bus_of_python_can(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    there, other = arm_file(tmp_path, 1, 5), arm_file(tmp_path, 1, 2)
    end = threading.Event()
    thread = threading.Thread(target=lambda: emulate(load_arm(there), stop_requested=end.is_set))
    thread.start()
    try:
        assert main(["bus", "scan", str(there)]) == DONE
        assert capsys.readouterr().out.startswith("drives2: every configured drive is there\n")
        assert main(["bus", "scan", str(other), "--json"]) == VERDICT_NO
    finally:
        end.set()
        thread.join()
    document = json.loads(capsys.readouterr().out)
    assert [(node["node"], node["match"]) for node in document["nodes"]] == [
        (1, "configured"),
        (2, "missing"),
        (5, "unknown"),
    ]
    assert document["nodes"][2]["found"]["state"] == "switch on disabled"
