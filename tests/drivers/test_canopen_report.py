"""`ident bus report`: what others need to see why drives do not work, and nothing that they must not see."""

from __future__ import annotations

import json
from hashlib import sha256
from pathlib import Path
from zipfile import ZipFile

import pytest
from helpers.emulated_arms import EDS, weightless_config
from helpers.makers import Bench

from drivers.can.can_link import Link
from ident_service.cli import DONE, USAGE, main
from ident_service.config.arm import ArmConfig
from ident_service.errors import DriverError, UsageError
from ident_service.operations.fieldbus import bus_report

SECRET = "correct horse battery staple"  # noqa: S105 - of nobody


def described() -> ArmConfig:
    """An arm with a password among the options of its interface, and a profile of its own."""
    mine = "{name: mine, proved: no, match: {vendor: 0x77}, sources: {match: me}}"
    bus = {"interface": "lock_step", "options": {"password": SECRET}}
    return weightless_config(buses=[bus], profiles=[{"name": "/home/somebody/mine.yaml", "text": mine}])


def contents(path: Path) -> dict[str, str]:
    with ZipFile(path) as archive:
        assert archive.testzip() is None
        return {name: archive.read(name).decode() for name in archive.namelist()}


def test_it_has_what_helps_and_no_secret(tmp_path: Path) -> None:
    config = described()
    bench = Bench(config)
    ticket, frames = tmp_path / "ticket.json", tmp_path / "can.log"
    ticket.write_text('{"format": "ident-ticket"}')
    frames.write_text("(0.0) can0 080#\n")
    names = bus_report(config, tmp_path / "deep" / "r.zip", ticket, frames, bench.links)  # type: ignore[arg-type]
    found = contents(tmp_path / "deep" / "r.zip")
    assert sorted(found) == names
    assert set(names) == {
        *("versions.json", "description.json", "probe.txt", "probe.json", "probe.log"),
        *("configuration.txt", "configuration.json", "ticket.json", "can.log"),
    }
    assert json.loads(found["probe.json"])["good"]
    assert len(json.loads(found["configuration.json"])["drives"]) == 2
    drives = json.loads(found["description.json"])["drives"]
    assert [drive["eds"]["sha256"] for drive in drives] == [sha256(EDS.encode()).hexdigest()] * 2
    assert json.loads(found["versions.json"])["python"]
    # The frames are those of the probe: questions and answers, in candump's format.
    lines = found["probe.log"].splitlines()
    assert len(lines) > 100
    assert all(" can0 " in line and "#" in line for line in lines)
    everything = "".join(found.values())
    for word in (SECRET, str(tmp_path), "/home/somebody"):
        assert word not in everything
    with pytest.raises(UsageError, match="exists; give another name"):
        bus_report(config, tmp_path / "deep" / "r.zip", None, None, bench.links)  # type: ignore[arg-type]


def test_without_a_bus_it_says_why(tmp_path: Path) -> None:
    def gone(config: ArmConfig) -> list[Link]:
        raise DriverError("can0: no such CAN interface")

    names = bus_report(described(), tmp_path / "r.zip", tmp_path / "none.json", None, gone)
    assert set(names) == {"versions.json", "description.json", "probe.txt", "configuration.txt"}
    assert contents(tmp_path / "r.zip")["probe.txt"] == "no probe: can0: no such CAN interface\n"


def test_nothing_is_left_of_one_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="cannot be written"):
        bus_report(described(), tmp_path / "file" / "r.zip", None, None, lambda config: [])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file"]


def test_the_command_writes_below_the_state_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bus", "report", "planar2", "--state", str(tmp_path)]) == USAGE
    assert "CANopen" in capsys.readouterr().err
    assert main(["bus", "report", "wam7_canopen", "--state", str(tmp_path), "--run", str(tmp_path)]) == USAGE
    assert "has no can.log" in capsys.readouterr().err
    assert main(["bus", "report", "wam7_canopen", "--state", str(tmp_path), "--json"]) == DONE  # there is no can0
    document = json.loads(capsys.readouterr().out)
    assert Path(document["path"]).parent == tmp_path / "arms" / "wam7_canopen"
    assert "probe.txt" in document["files"]
