"""A DCF of the maker's tool is imported entry by entry, or not at all; drives store and restore on request only."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.emulated_arms import weightless_config
from helpers.makers import SHEETS, Bench, arm_of, sheet

from drivers.can.bus_state import BusError
from drivers.can.can_frame import Frame
from drivers.can.can_link import Link
from drivers.canopen import object_dictionary as od
from ident_service.cli import USAGE, VERDICT_NO, main
from ident_service.config.arm import ArmConfig
from ident_service.config.eds import DataSheetEntry
from ident_service.config.quantities import TextFile
from ident_service.errors import DriverError, FileCutOff, UsageError
from ident_service.operations.drive_configuration import (
    drives_document,
    import_configuration,
    imported_text,
    store_or_restore,
)
from sim_backend.emulator.faults import DriveFault

pytestmark = pytest.mark.skipif(not SHEETS.is_dir(), reason="the makers' data sheets are not beside this checkout")
EPOS4 = "maxon_epos4_50-8_0110h.eds"
NOMINAL, GAIN, RATED = "3001sub1", "30A0sub1", "6076"


def dcf(text: str = "", **values: int | str) -> TextFile:
    """An EDS as its maker's tool would write it for one drive, with these values."""
    text = text or sheet(EPOS4)["text"]
    for name, value in values.items():
        text, count = re.subn(rf"(?im)^(\[{name}\]\r?\n)", rf"\g<1>ParameterValue={value}\n", text)
        assert count == 1, name
    return TextFile(name="drive.dcf", text=text)


def held(bench: Bench, index: int, sub: int = 0) -> list[int]:
    return [face.objects.number(index, sub) for face in bench.behind.emulator.faces]  # type: ignore[attr-defined]


def test_what_differs_is_written_and_listed_and_what_is_ours_is_left() -> None:
    config = arm_of(EPOS4)
    bench = Bench(config)
    before = held(bench, 0x3001, 1)
    files = [dcf(**{NOMINAL: 4000, GAIN: 77, "6060": 3, "1017": 55})] * 2
    planned = import_configuration(config, files, dry=True, open_bus=bench.links)  # type: ignore[arg-type]
    assert bench.downloads() == []
    assert held(bench, 0x3001, 1) == before
    done = import_configuration(config, files, dry=False, open_bus=bench.links)  # type: ignore[arg-type]
    assert [one.changes for one in done] == [one.changes for one in planned]
    assert {(node, index) for node, index, _ in bench.downloads()} == {(n, i) for n in (1, 2) for i in (0x3001, 0x30A0)}
    assert (held(bench, 0x3001, 1), held(bench, 0x30A0, 1)) == ([4000] * 2, [77] * 2)
    assert [(one.same, one.left) for one in done] == [(0, 2)] * 2
    text = imported_text(config, done, dry=False)
    assert f"3001h:01        {before[0]} " in text
    assert "-> 4000 " in text
    assert "0 had their value already; 2 are set whenever the arm is opened" in text
    assert drives_document(config, done)["drives"][0]["changes"][0]["after"] == 4000
    (again, _) = import_configuration(config, files, dry=False, open_bus=bench.links)  # type: ignore[arg-type]
    assert (again.changes, again.same) == ((), 2)
    assert bench.downloads() == []


def test_a_refused_entry_sets_every_drive_back() -> None:
    config = arm_of(EPOS4)
    bench = Bench(config)
    before = held(bench, 0x3001, 1), held(bench, 0x30A0, 1)
    objects = bench.behind.emulator.faces[1].objects  # type: ignore[attr-defined]
    key = 0x30A001
    objects.entries[key] = type(objects.entries[key])(**{**vars(objects.entries[key]), "high": 10})
    with pytest.raises(DriverError, match=r"node 2: setting 30A0h.*every drive holds again what it held"):
        import_configuration(config, [dcf(**{NOMINAL: 4000, GAIN: 77})] * 2, dry=False, open_bus=bench.links)  # type: ignore[arg-type]
    assert (held(bench, 0x3001, 1), held(bench, 0x30A0, 1)) == before


def broken_at_the_last(bench: Bench, error: BaseException, times: int) -> Callable[[ArmConfig], list[Link]]:
    """Taps where waiting for the answer to the last drive's second value ends so; the answer still comes later."""

    def links(config: ArmConfig) -> list[Link]:
        (tap,) = taps = bench.links(config)
        receive, left = tap.receive, [times]

        def broken(deadline_ns: int) -> Frame | None:
            last, now = struct.pack("<HB", 0x30A0, 1), tap.sent[-1] if tap.sent else None
            reached = now is not None and (now.identifier, now.data[0] >> 5, now.data[1:4]) == (0x602, 1, last)
            if left[0] and (reached or left[0] < times):
                left[0] -= 1
                raise error
            return receive(deadline_ns)

        tap.receive = broken  # type: ignore[method-assign]
        return taps  # type: ignore[return-value]

    return links


@pytest.mark.parametrize("times", [1, 2])
@pytest.mark.parametrize(
    ("kind", "words"),
    [
        (KeyboardInterrupt, ()),
        (ValueError, ("a mistake",)),
        (BusError, ("full", "can0")),
        (DriverError, ("something",)),
    ],
)
def test_whatever_ends_an_import_sets_every_drive_back_and_is_told(
    kind: type[BaseException], words: tuple[str, ...], times: int
) -> None:
    error, interrupted = kind(*words), kind is KeyboardInterrupt
    config = arm_of(EPOS4)
    bench = Bench(config)
    before = held(bench, 0x3001, 1), held(bench, 0x30A0, 1)
    files = [dcf(**{NOMINAL: 4000, GAIN: 77})] * 2
    with pytest.raises(DriverError if interrupted else kind) as told:
        import_configuration(config, files, dry=False, open_bus=broken_at_the_last(bench, error, times))
    assert len({place for place in bench.downloads() if place[0] == 1}) == 2  # the first drive had been written
    assert (held(bench, 0x3001, 1), held(bench, 0x30A0, 1)) == before
    said = "; ".join([str(told.value), *getattr(told.value, "__notes__", ())])
    assert said.endswith("; every drive holds again what it held")
    assert said.startswith("interrupted" if interrupted else str(error))


def test_what_a_lost_bus_leaves_changed_is_named() -> None:
    config = arm_of(EPOS4)
    bench = Bench(config)
    lost = broken_at_the_last(bench, BusError("gone", "can0"), 1000)
    with pytest.raises(BusError) as told:
        import_configuration(config, [dcf(**{NOMINAL: 4000, GAIN: 77})] * 2, dry=False, open_bus=lost)
    changed = ", ".join(f"node {node} {entry}" for node in (2, 1) for entry in ("30A0h:01", "3001h:01"))
    assert told.value.__notes__ == [f"NOT set back: {changed}"]
    assert held(bench, 0x3001, 1) == [4000, 4000]


def test_nothing_is_said_to_be_set_back_where_nothing_was_written() -> None:
    config = arm_of(EPOS4)
    bench = Bench(config)
    del bench.behind.emulator.faces[1].objects.entries[0x30A001]  # type: ignore[attr-defined]
    for dry, values in ((True, {NOMINAL: 4000, GAIN: 77}), (False, {GAIN: held(bench, 0x30A0, 1)[0]})):
        with pytest.raises(DriverError, match=r"node 2: reading 30A0h.*; nothing was written$"):
            import_configuration(config, [dcf(**values)] * 2, dry=dry, open_bus=bench.links)  # type: ignore[arg-type]
        assert bench.downloads() == []


def test_a_drive_that_is_on_or_another_is_not_touched() -> None:
    config = arm_of(EPOS4)
    bench = Bench(config)
    other = TextFile(name="other.dcf", text=sheet("elmo_gold_V002.dcf")["text"])
    with pytest.raises(DriverError, match=r"node 2: vendor is 000000FBh, but other.dcf is for 0000009Ah"):
        import_configuration(config, [dcf(**{NOMINAL: 4000}), other], dry=False, open_bus=bench.links)  # type: ignore[arg-type]
    assert bench.downloads() == []
    bench.behind.settle(bench.behind.clock.now_ns() + 1_000_000_000)  # until it has booted
    face = bench.behind.emulator.faces[0]
    face.power.process_controlword(6)  # type: ignore[attr-defined]
    face.power.process_controlword(7)  # type: ignore[attr-defined]
    face.tick(bench.behind.clock.now_ns())
    assert bench.states[0] == "switched on"
    for act in (
        lambda: import_configuration(config, [dcf(**{NOMINAL: 4000})] * 2, dry=False, open_bus=bench.links),  # type: ignore[arg-type]
        lambda: store_or_restore(config, store=True, open_bus=bench.links),  # type: ignore[arg-type]
    ):
        with pytest.raises(
            DriverError, match="node 1: is switched on; its parameters are only changed while it is off"
        ):
            act()
        assert bench.downloads() == []


def test_files_that_configure_nothing_are_refused() -> None:
    config = arm_of(EPOS4)
    with pytest.raises(UsageError, match="1 files for 2 drives"):
        import_configuration(config, [dcf(**{NOMINAL: 1})], dry=True)
    with pytest.raises(UsageError, match="configures no drive: no entry has a ParameterValue"):
        import_configuration(config, [TextFile(name="a.eds", text=sheet(EPOS4)["text"])] * 2, dry=True)
    with pytest.raises(UsageError, match="configures no drive"):
        import_configuration(config, [TextFile(name="a.eds", text="x")] * 2, dry=True)


def no_bus(config: ArmConfig) -> list[Link]:
    raise AssertionError("a file was refused only after a bus had been opened")


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("99999999999", "6065h holds 0 to 4294967295, by its type"),
        ("0x100000000", "6065h holds 0 to 4294967295, by its type"),
        ("-1", "6065h holds 0 to 4294967295, by its type"),
        *(
            (text, "is no whole number; write 100, 0x64")
            for text in ("1e5", "abc", "12.5", "1F4h", "08", "1 2", "9" * 5000)
        ),
    ],
)
def test_a_value_that_an_entry_cannot_hold_is_refused_before_any_drive_is_asked(text: str, why: str) -> None:
    config, files = arm_of(EPOS4), [dcf(**{NOMINAL: 4000}), dcf(**{GAIN: 77, "6065": text})]
    for dry in (True, False):
        with pytest.raises(UsageError) as told:
            import_configuration(config, files, dry=dry, open_bus=no_bus)
        assert f"drive.dcf: [6065] ParameterValue={text[:40]}: {why}" in str(told.value)
        assert str(told.value).endswith("; nothing was written")


def test_every_wrong_value_counts_and_limits_of_the_file_too() -> None:
    config = arm_of(EPOS4)
    texts = {"6098": "128", "60FF": "3000000000", NOMINAL: "4294967295", GAIN: "x", "6065": "y"}
    with pytest.raises(UsageError, match=r"\[3001sub1\].*\[30A0sub1\].*\[6065\].*; and 2 more; nothing was written"):
        import_configuration(config, [dcf(**texts)] * 2, dry=True, open_bus=no_bus)
    for text in ("8001", "-1"):
        with pytest.raises(
            UsageError, match=rf"={text}: 3001h:01 holds 0 to 8000, by the file's LowLimit and HighLimit; nothing"
        ):
            import_configuration(config, [dcf(**{NOMINAL: text})] * 2, dry=True, open_bus=no_bus)


def test_a_value_that_cannot_be_imported_is_named() -> None:
    config = arm_of(EPOS4)
    own = {"6041": "7", "6502": "x", "1018sub4": "9"}  # read-only; the last is compared by hosts, and never written
    own |= {"21A0sub1": "1.5", "21A0sub2": "a drive", "21A0sub3": "0x500", "21A0sub4": "5"}
    text = sheet(EPOS4)["text"]
    added = (("0x8", "rw", "0"), ("0x9", "rw", ""), ("0x7", "rw", "$NODEID+0x400"), ("0x7", "wo", "0"))
    for number, (kind, access, default) in enumerate(added, 1):
        text += f"\n[21A0sub{number}]\nDataType={kind}\nAccessType={access}\nDefaultValue={default}\n"
    files = [dcf(text, **{NOMINAL: 4000}, **own)] * 2
    bench = Bench(config)
    for dry in (True, False):
        found = import_configuration(config, files, dry=dry, open_bus=bench.links)  # type: ignore[arg-type]
        assert list(found[1].left_out) == ["21A0h:01", "21A0h:02", "21A0h:03", "21A0h:04", "6041h", "6502h"]
        text = imported_text(config, found, dry=dry)
        assert "  left out        21A0h:01 (REAL32 is not imported); 21A0h:02 (VISIBLE_STRING is" in text
        assert "21A0h:03 (of a node number, which is the drive's own); 21A0h:04 (write-only: it could be" in text
        assert "neither compared nor set back); 6041h, 6502h (read-only)\n" in text
        assert drives_document(config, found)["drives"][0]["left_out"]["6041h"] == "read-only"
    with pytest.raises(UsageError, match=r"none of its values can be imported: 6041h \(read-only\)$"):
        import_configuration(config, [dcf(**{"6041": 7})] * 2, dry=True, open_bus=no_bus)


def test_numbers_are_read_as_the_standard_writes_them() -> None:
    numbers = {"10": 10, "+5": 5, "-3": -3, "0": 0, "0xA": 10, "0XaB": 171, "017": 15, "-0x5": -5}
    relative = {"$NODEID": 3, "$NODEID+0x200": 0x203, "0x200 + $NODEID": 0x203, "$nodeid+10": 13}
    others = ("", "0x", "1e5", "08", "12.5", "180h", "$NODEID5", "5$NODEID", "$NODEID-1", "'5'", "１")
    for text, number in (numbers | relative | dict.fromkeys(others)).items():
        assert DataSheetEntry(7, text=text).standard_number(3) == number, text
    config = arm_of(EPOS4)
    bench = Bench(config)
    values = {NOMINAL: "$NODEID+0x100", GAIN: "0115", "6083": "0x64", "6098": "0xFF", "60FF": "-5"}
    found = import_configuration(config, [dcf(**values)] * 2, dry=False, open_bus=bench.links)  # type: ignore[arg-type]
    assert [len(one.changes) for one in found] == [5, 5]
    assert (held(bench, 0x3001, 1), held(bench, 0x30A0, 1)) == ([0x101, 0x102], [77, 77])
    assert [held(bench, index) for index in (0x6083, 0x6098, 0x60FF)] == [[100] * 2, [-1] * 2, [-5] * 2]


def test_a_file_that_is_cut_off_is_refused_as_by_a_probe(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config, whole = arm_of(EPOS4), dcf(**{NOMINAL: 4000})
    half = TextFile(name="half.dcf", text=whole.text[: len(whole.text) * 7 // 10])
    told = r"^half.dcf seems to end too early: of 127 announced objects \d+ are missing; .*nothing was written$"
    for dry in (True, False):
        with pytest.raises(FileCutOff, match=told):
            import_configuration(config, [whole, half], dry=dry, open_bus=no_bus)
    file = tmp_path / "half.dcf"
    file.write_text(half.text, encoding="latin-1")
    for words in (
        ["probe", "wam7_canopen", "--eds", str(file)],
        ["import", "wam7_canopen", *[str(file)] * 7, "--dry-run"],
    ):
        assert main(["bus", *words]) == VERDICT_NO
        assert "seems to end too early: of 127 announced objects" in "".join(capsys.readouterr())


def test_drives_store_and_restore_what_they_hold() -> None:
    config = arm_of(EPOS4)
    bench = Bench(config)
    factory = held(bench, 0x3001, 1)

    def power_cycle() -> None:
        for number in range(2):
            bench.behind.inject(DriveFault("reboot", number))
        bench.behind.settle(bench.behind.clock.now_ns() + 1_000_000_000)

    import_configuration(config, [dcf(**{NOMINAL: 4000})] * 2, dry=False, open_bus=bench.links)  # type: ignore[arg-type]
    power_cycle()
    assert held(bench, 0x3001, 1) == factory
    import_configuration(config, [dcf(**{NOMINAL: 4000})] * 2, dry=False, open_bus=bench.links)  # type: ignore[arg-type]
    for store in (True, False):
        assert store_or_restore(config, store=store, dry=True, open_bus=bench.links) == (1, 2)  # type: ignore[arg-type]
        assert bench.downloads() == []
    assert store_or_restore(config, store=True, open_bus=bench.links) == (1, 2)  # type: ignore[arg-type]
    power_cycle()
    assert held(bench, 0x3001, 1) == [4000] * 2
    with bench.arm:  # and nothing of it is undone by opening
        assert held(bench, 0x3001, 1) == [4000] * 2
    assert store_or_restore(config, store=False, open_bus=bench.links) == (1, 2)  # type: ignore[arg-type]
    assert held(bench, 0x3001, 1) == [4000] * 2
    power_cycle()
    assert held(bench, 0x3001, 1) == factory


@pytest.mark.slow
def test_opening_never_stores() -> None:
    for name in (EPOS4, "e35.eds", "elmo_gold_V002.dcf"):
        bench = Bench(arm_of(name))
        with bench.arm:
            written = bench.downloads()
        assert not [one for one in written if one[1] in (0x1010, 0x1011)]


def test_a_zero_that_must_be_lost_with_power_is_not_stored_and_what_is_lacking_is_reported() -> None:
    config = weightless_config()
    bench = Bench(config)
    objects = bench.behind.emulator.faces[1].objects  # type: ignore[attr-defined]
    objects.put(od.ZERO_MARK.index, 5, od.ZERO_MARK.sub)
    words = "holds a zero" if od.STORED.key in objects.entries else "has no 1010h:01; use its maker's tool"
    with pytest.raises(DriverError, match=words):
        store_or_restore(config, store=True, open_bus=bench.links)  # type: ignore[arg-type]
    assert bench.downloads() == []
    elmo = Bench(arm_of("maxon_epos2_50-5_2126h.eds"))
    for face in elmo.behind.emulator.faces:
        face.objects.put(od.ZERO_MARK.index, 5, od.ZERO_MARK.sub)  # type: ignore[attr-defined]
    with pytest.raises(DriverError, match=r"node 1: holds a zero \(1020h\), which must be lost with its power"):
        store_or_restore(arm_of("maxon_epos2_50-5_2126h.eds"), store=True, open_bus=elmo.links)  # type: ignore[arg-type]


def test_the_commands_ask_for_the_arms_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "a.dcf"
    file.write_text(dcf(**{NOMINAL: "1e5"}).text, encoding="latin-1")
    for how in (["--dry-run"], ["--confirm", "wam7_canopen"]):
        assert main(["bus", "import", "wam7_canopen", *[str(file)] * 7, *how]) == USAGE
        assert "a.dcf: [3001sub1] ParameterValue=1e5: is no whole number" in capsys.readouterr().err
    file.write_text(dcf(**{NOMINAL: 4000}).text, encoding="latin-1")
    for words in (["import", "wam7_canopen", str(file)], ["store", "wam7_canopen"], ["restore", "wam7_canopen"]):
        for more in ([], ["--confirm", "other"]):
            assert main(["bus", *words, *more]) == USAGE
            assert "--confirm wam7_canopen; nothing was written" in capsys.readouterr().err
