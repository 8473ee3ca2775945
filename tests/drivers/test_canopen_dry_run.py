"""`--dry-run`: what opening would write, by uploads alone, and that it is what opening then writes."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.makers import CAPABLE, REFUSED, SHEETS, Bench, arm_of

from drivers.canopen.sdo import Change
from ident_service.config.arm import ArmConfig
from ident_service.operations.drive_configuration import (
    PlannedDrive,
    planned_configuration,
    planned_document,
    planned_text,
)

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


def test_every_change_is_told_with_both_values() -> None:
    config = arm_of("maxon_epos4_50-8_0110h.eds")
    found = planned(Bench(config), config)
    text = planned_text(config, found)
    assert text.startswith("weightless: what opening would write; nothing was written, and nothing moved\n")
    assert "6060h           1 (01h) -> 10 (0Ah)  mode of operation" in text
    document = planned_document(config, found)
    assert {"entry": "6060h", "name": "mode of operation", "before": 1, "after": 10} in document["drives"][0]["changes"]
    (limit,) = [change for change in found[0].changes if change.entry.index == 0x3001]
    assert isinstance(limit, Change)
    assert (limit.before, limit.after) == (30_000, 16_000)  # mA: 2000 per mille of the nominal current, 3001h:01


@pytest.mark.parametrize("name", REFUSED)
def test_a_drive_that_would_be_refused_is_told_so(name: str) -> None:
    config = arm_of(name, measured_torque="none")
    found = planned(Bench(config), config)
    assert places(found) == []
    assert all("cannot be driven" in one.refused for one in found)
    assert "REFUSED" in planned_text(config, found)


def test_no_verb_that_configures_drives_lacks_it() -> None:
    from ident_service.cli import parser

    for verb in ("check", "run", "rehearse", "home", "recover"):
        assert parser().parse_args([verb, "wam7_canopen", "--dry-run"]).dry_run


def test_the_command_refuses_arms_without_drives(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from ident_service.cli import USAGE, main

    assert main(["check", "planar2", "--dry-run", "--state", str(tmp_path)]) == USAGE
    assert "only CANopen drives" in capsys.readouterr().err
