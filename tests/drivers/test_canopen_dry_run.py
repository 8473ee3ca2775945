"""`--dry-run`: what opening would write, by uploads alone, and that it is what opening then writes."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.emulated_arms import Tapped, tapped, weightless_config
from helpers.makers import CAPABLE, REFUSED, SHEETS, Bench, arm_of

from drivers.canopen.driver import CanopenArm
from drivers.canopen.sdo import Change
from ident_service.config.arm import ArmConfig
from ident_service.errors import DriverError
from ident_service.operations.drive_configuration import (
    PlannedDrive,
    drives_document,
    planned_configuration,
    planned_text,
    planned_zero,
)
from sim_backend.canopen_device.drive import PowerState

# What is tried and refused: limits and fixed entries that no upload shows.
REFUSES = {
    "elmo_simpliq.dcf": {(index, 1) for index in (0x1400, 0x1401, 0x1402, 0x1403, 0x1800, 0x1801, 0x1802, 0x1803)},
    "maxon_epos2_50-5_2126h.eds": {(0x60C2, 1)},
}
pytestmark = pytest.mark.skipif(not SHEETS.is_dir(), reason="the makers' data sheets are not beside this checkout")


def places(planned: tuple[PlannedDrive, ...]) -> list[tuple[int, int, int]]:
    """Node, index and sub-index of every change, in order."""
    return [(one.node, change.entry.index, change.entry.sub) for one in planned for change in one.changes]


def planned(bench: Bench, config: ArmConfig) -> tuple[PlannedDrive, ...]:
    """A dry run that is proven to have sent nothing but uploads."""
    found = planned_configuration(config, bench.links)  # type: ignore[arg-type]
    for frame in bench.taps[0].sent:
        assert 0x600 < frame.identifier < 0x680
        assert frame.data[0] >> 5 in (2, 3), frame
    return found


@pytest.mark.parametrize("name", CAPABLE)
def test_a_dry_run_tells_exactly_what_opening_writes(name: str) -> None:
    config = arm_of(name)
    bench = Bench(config)
    told = planned(bench, config)
    assert [one.refused for one in told] == ["", ""]
    with bench.arm:
        written = bench.downloads()
    refused = REFUSES.get(name, set())
    # A value beyond a limit of the drive, which no upload tells, is tried in earnest and refused.
    beyond = refused if name.startswith("maxon_epos2") else set()
    assert [one for one in places(told) if one[1:] not in beyond] == [one for one in written if one[1:] not in refused]
    assert len(places(told)) > 20


def test_every_change_is_reported_with_both_values() -> None:
    config = arm_of("maxon_epos4_50-8_0110h.eds")
    found = planned(Bench(config), config)
    text = planned_text(config, found)
    assert text.startswith("weightless: what opening would write; nothing was written, and nothing moved\n")
    assert "6060h           1 (01h) -> 10 (0Ah)  mode of operation" in text
    document = drives_document(config, found)
    assert {"entry": "6060h", "name": "mode of operation", "before": 1, "after": 10} in document["drives"][0]["changes"]
    (limit,) = [change for change in found[0].changes if change.entry.index == 0x3001]
    assert isinstance(limit, Change)
    assert (limit.before, limit.after) == (30_000, 16_000)  # mA: 2000 per mille of the nominal current, 3001h:01


@pytest.mark.parametrize("name", REFUSED)
def test_a_drive_that_would_be_refused_is_reported(name: str) -> None:
    config = arm_of(name, measured_torque="none")
    found = planned(Bench(config), config)
    assert places(found) == []
    assert all("cannot be driven" in one.refused for one in found)
    text = planned_text(config, found)
    assert text.count("REFUSED") == text.count("would be refused, and nothing written") == 2
    assert "has everything already" not in text


def test_no_verb_that_configures_drives_lacks_it() -> None:
    """Every verb that opens an arm, zeroes it, or writes what a person asks for."""
    from ident_service.cli import parser

    opening = ["check A", "preflight A", "run A", "rehearse A", "home A", "recover A", "reidentify A", "driver test A"]
    for words in (*opening, "set-home A", "bus import A one.dcf", "bus store A", "bus restore A"):
        assert parser().parse_args([*words.split(), "--dry-run"]).dry_run, words


def test_a_dry_run_of_zeroing_tells_the_counts_that_would_be_kept() -> None:
    tree = weightless_config(zero="at_home").model_dump(mode="json", by_alias=True)
    tree["joints"]["slide"]["home"] = 0.5
    config = ArmConfig.model_validate(tree)
    bench = Bench(config)
    found = planned_zero(config, bench.links)  # type: ignore[arg-type]
    assert all(frame.data[0] >> 5 in (2, 3) for frame in bench.taps[0].sent)  # uploads alone
    assert [(change.entry.index, change.entry.sub) for change in found[0].changes] == [(0x1020, 1), (0x1020, 2)]
    assert planned_text(config, found, "setting home").startswith("weightless: what setting home would write; nothing")
    taps: list[Tapped] = []

    def links(one: ArmConfig) -> list[Tapped]:
        taps[:] = tapped(bench.behind, one)
        return taps

    CanopenArm(config, links).zero()
    held = [face.objects.number(0x1020, sub) for face in bench.behind.emulator.faces for sub in (1, 2)]  # type: ignore[attr-defined]
    assert held == [change.after & 0xFFFF_FFFF for one in found for change in one.changes]
    face = bench.behind.emulator.faces[1]
    face.power.state = PowerState.OPERATION_ENABLED  # type: ignore[attr-defined]
    face.set_warning(False, bench.behind.clock.now_ns())  # which tells its state anew
    (_, second) = planned_zero(config, bench.links)  # type: ignore[arg-type]
    assert "only changed while it is off" in second.refused
    with pytest.raises(DriverError, match="no home is set"):
        planned_zero(weightless_config(), bench.links)  # type: ignore[arg-type]


def test_the_command_refuses_arms_without_drives(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from ident_service.cli import USAGE, main

    assert main(["check", "planar2", "--dry-run", "--state", str(tmp_path)]) == USAGE
    assert "only CANopen drives" in capsys.readouterr().err
