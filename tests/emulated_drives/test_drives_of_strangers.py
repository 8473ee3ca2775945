"""Files of drives that nobody here has seen: written in other ways, with less in them, or with nonsense.

What is only written differently means the same. Whatever a file says, it gets a report, drives are emulated from it,
and the driver opens them or refuses in words; what it has opened it does not configure again.
"""

from __future__ import annotations

import random
import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.emulated_arms import EDS
from helpers.examples import some
from helpers.makers import CAPABLE, SHEETS, Bench, arm_of
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.can.can_frame import Frame
from drivers.canopen.object_dictionary import Entry, Kind
from drivers.canopen.pdo_mapping import Pdo
from drivers.canopen.sdo import Objects, SdoRefused
from ident_service.cli import DONE, main
from ident_service.config.eds import DataSheet, data_sheet
from ident_service.config.load import read_eds_file
from ident_service.config.quantities import TextFile
from ident_service.errors import IdentError
from ident_service.operations.drive_configuration import planned_configuration, planned_text
from ident_service.operations.fieldbus import bus_probe, probe_document, probe_text
from sim_backend.emulator.lock_step import LockStepArm

FILES = sorted(SHEETS.glob("*.[ed][dc][sf]"))
VALUE = re.compile(
    r"^(\w*(?:Value|Limit|Type|Mapping|Number|Obj|Dummy\d{4}))\s*=\s*(.*)$", re.MULTILINE | re.IGNORECASE
)
needs_sheets = pytest.mark.skipif(not FILES, reason="the makers' data sheets are not beside this checkout")


def meaning(sheet: DataSheet) -> dict[int, tuple[object, ...]]:
    """Return of every entry what the driver uses, for node 5."""
    return {
        key: (one.kind, one.access, one.mappable, one.low, one.high, one.number(5), one.configured)
        for key, one in sheet.entries.items()
    }


def numbers(text: str, write: Callable[[int], str]) -> str:
    """The same file with all plain numbers written in another way."""

    def other(found: re.Match[str]) -> str:
        try:
            return f"{found[1]}={write(int(found[2].strip(), 0))}"
        except ValueError:
            return found[0]

    return VALUE.sub(other, text)


WAYS: dict[str, Callable[[str], str]] = {
    "decimal": lambda text: numbers(text, str),
    "hexadecimal in capitals": lambda text: numbers(text, lambda n: f"0X{n:X}" if n >= 0 else str(n)),
    "hexadecimal with an h": lambda text: numbers(text, lambda n: f"{n:X}h" if n >= 0 else str(n)),
    "hexadecimal without a mark": lambda text: numbers(
        text, lambda n: f"{n:X}" if n >= 0 and re.search("[A-F]", f"{n:X}") else str(n)
    ),
    "octal": lambda text: numbers(text, lambda n: f"0{n:o}" if n >= 0 else str(n)),
    "as in C": lambda text: numbers(text, lambda n: f"{n:#x}UL" if n >= 0 else str(n)),
    "quoted": lambda text: numbers(text, lambda n: f'"{n}"'),
    "with remarks": lambda text: numbers(text, lambda n: f"{n} ; n = {n}"),
    "node number first": lambda text: re.sub(
        r"=\s*(0x\w+)\s*\+\s*\$NODEID|=\s*\$NODEID\s*\+\s*(0x\w+)",
        lambda found: f"= $NodeId + {found[1] or found[2]}",
        text,
        flags=re.IGNORECASE,
    ),
    "node number last": lambda text: re.sub(r"(?i)=\s*\$NODEID\s*\+\s*(0x\w+)", r"=\1 + $NODEID", text),
    "capitals": lambda text: re.sub(r"^(\[.*\]|\w+\s*=)", lambda found: found[0].upper(), text, flags=re.MULTILINE),
    "indented": lambda text: re.sub(r"^(\w+\s*=)", r"\t \1", text, flags=re.MULTILINE),
    "blanks in headings": lambda text: re.sub(r"^\[(\w{4})(sub\w+)?\]", r"[ \1 \2 ]", text, flags=re.MULTILINE),
    "with lines of rubbish": lambda text: text.replace("\n[", "\n// end of it\n<b>\n: x\n\n[", 40),
    "carriage returns": lambda text: text.replace("\r", "").replace("\n", "\r"),
    "sections twice": lambda text: text + "\n" + text,
    "without names and lists": lambda text: re.sub(
        r"(?is)\[(FileInfo|Comments|StandardDataTypes|MandatoryObjects|OptionalObjects|ManufacturerObjects)\].*?(?=\n\[)",
        "",
        re.sub(r"(?im)^(ParameterName|ObjFlags|Denotation)\s*=.*$", "", text),
    ),
    "variables with no sub-indices": lambda text: re.sub(
        r"(?im)^ObjectType\s*=\s*0x0*7\s*$", "ObjectType=7\nSubNumber=0", text
    ),
}


@needs_sheets
@pytest.mark.parametrize("way", WAYS)
def test_a_file_that_is_written_in_another_way_means_the_same(way: str) -> None:
    changed = 0
    for path in FILES:
        text = path.read_text(encoding="latin-1")
        same = WAYS[way](text)
        changed += same != text
        plain, other = data_sheet(text), data_sheet(same)
        assert meaning(other) == meaning(plain), path.name
        assert (other.dummies, other.identity, other.mistake) == (plain.dummies, plain.identity, None), path.name
    assert changed


@needs_sheets
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "latin-1", "cp1252"])
def test_a_file_of_any_encoding_is_read(encoding: str, tmp_path: Path) -> None:
    text = (SHEETS / "e35.eds").read_text(encoding="latin-1")
    path = tmp_path / "drive.eds"
    path.write_bytes(text.replace("[1000]", "[1000]\nDenotation=Größe").encode(encoding))
    assert meaning(data_sheet(read_eds_file(str(path)).text)) == meaning(data_sheet(text))


def test_compact_arrays_have_their_elements_and_the_values_of_a_dcf() -> None:
    sheet = data_sheet(
        "[1003]\nObjectType=8\nDataType=7\nAccessType=ro\nCompactSubObj=3\nDefaultValue=5\n"
        "[1003Value]\nNrOfEntries=1\n2=0x7\n[1010]\nObjectType=0x8\nSubNumber=2\n[1010sub1]\nDataType=7\n"
    )
    values = [(key, one.number(1)) for key, one in sorted(sheet.entries.items())]
    assert values == [(0x100300, 3), (0x100301, 5), (0x100302, 7), (0x100303, 5), (0x101001, None)]
    assert [sheet.entries[key].configured for key in (0x100301, 0x100302)] == [False, True]
    assert sheet.mistake is None  # although it has no [DeviceInfo]


def test_pdos_that_are_only_summed_up_are_there_as_the_first_four_are_born() -> None:
    sheet = data_sheet("[DeviceInfo]\nNrOfRXPDO=5\nNrOfTXPDO=1\nCompactPDO=0x2E\n[1800sub1]\nDefaultValue=0x99\n")
    assert [sheet.entries[key].number(3) for key in (0x140001, 0x140301, 0x140401)] == [0x203, 0x503, 0x80000000]
    assert [sheet.has(0x1404, sub) for sub in (1, 2, 3, 5, 6)] == [True, True, True, True, False]
    assert sheet.entries[0x180001].number(3) == 0x99  # what is listed counts
    assert sheet.has(0x1A00, 8)
    assert not sheet.has(0x1801)


def test_a_file_that_lists_without_end_is_refused() -> None:
    text = "".join(f"[{index:04X}]\nCompactSubObj=254\n" for index in range(0x1000, 0x2000))
    assert data_sheet(text).mistake == "it lists more than 131072 entries"


def written_by_a_stranger(text: str) -> str:
    """A file as another hand would have written it, in all ways that go together."""
    for way in ("without names and lists", "hexadecimal with an h", "capitals", "indented", "with lines of rubbish"):
        text = WAYS[way](text)
    return text


def test_a_strangers_drive_is_emulated_probed_and_moved_like_the_plain_one() -> None:
    """Where no makers' file is at hand, too: the shipped one."""
    described: dict[str, Any] = {"torque_frames": "shared", "drive": {"watchdog": "rpdo_timer"}}
    bench = Bench(arm_of("", text=EDS, **described))
    strange = Bench(arm_of("", text=written_by_a_stranger(EDS), **described))
    for one in (bench, strange):
        with one.arm as arm:
            arm.enable()
            for _ in range(10):
                sample = arm.exchange(np.array([0.1, 0.05]))
            np.testing.assert_allclose(sample.torque, [0.1, 0.05], atol=1.1e-3)
    assert strange.downloads() == bench.downloads()


@needs_sheets
def test_the_command_takes_a_utf16_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "drive.eds"
    path.write_bytes((SHEETS / "maxon_epos4_50-8_0110h.eds").read_text(encoding="latin-1").encode("utf-16"))
    main(["bus", "probe", "wam7_canopen", "--eds", str(path)])
    assert "drive.eds, node 1: maxon EPOS4" in capsys.readouterr().out
    assert main(["emulate", "planar2", "--eds", str(path)]) != DONE  # refused for its driver, not for the file
    assert "not CANopen's" in capsys.readouterr().err


KINDS = ("0x0001", "0x0002", "0x0003", "0x0004", "0x0005", "0x0006", "0x0007", "0x0008", "0x0009", "0x000F", "0x1B", "")
ODD = ("", "0", "1", "0xFFFFFFFF", "-1", "255", "0x80000000", "9" * 30, "$NODEID", "x", "1.5")
MATTER = ("10", "14", "16", "18", "1A", "60", "64", "65")  # how the sections begin that the driver looks at


@pytest.mark.parametrize("kind", KINDS)
def test_what_the_firmware_keeps_is_read_and_sent_whatever_type_a_file_gives_it(kind: str) -> None:
    """A status word, and a torque of -3, of too few bits, without a sign, or of no number at all."""
    text = EDS
    for index in ("6041", "6077"):
        head, tail = text.split(f"[{index}]")
        text = f"{head}[{index}]{re.sub('DataType=.*', f'DataType={kind}', tail, count=1)}"
    config = arm_of("", text=text, torque_frames="shared", drive={"watchdog": "rpdo_timer"})
    behind = LockStepArm(config)
    face, link = behind.emulator.faces[0], behind.link(0)
    link.clock.sleep_until_ns(link.clock.now_ns() + 50_000_000)  # until it has booted
    objects = Objects(link, 1)
    face.objects.values[0x607700] = -3  # type: ignore[attr-defined]
    torque, status = (objects.read_bytes(index, 0, "") for index in (0x6077, 0x6041))
    size = face.objects.entries[0x607700].size or 4  # type: ignore[attr-defined]
    assert torque == (b"\x01" if kind == "0x0001" else (-3).to_bytes(size, "little", signed=True))
    assert status[0] & 0x6F == (1 if kind == "0x0001" else 0x40)
    (tpdo,) = [Pdo(3, True, 0x381, 1, (Entry(0x6077, 0, Kind[f"U{8 * size}"], "torque"),))]
    try:
        for write in tpdo.writes():
            objects.write(write)
    except SdoRefused:
        assert not face.objects.entries[0x607700].form  # type: ignore[attr-defined]  # what is no number is not mapped
        return
    link.send(Frame(0x000, b"\x01\x00"))
    face.objects.values[0x607700] = -3  # type: ignore[attr-defined]
    link.send(Frame(0x080))
    link.clock.sleep_until_ns(link.clock.now_ns() + 2_000_000)
    assert torque in [frame.data for frame in link.drain() if frame.identifier == 0x381]


def spoiled(text: str, chance: random.Random) -> str:
    """A file with some entries gone, of another type, read-only, or of another value."""
    parts = re.split(r"(?m)^(?=\[)", text)
    chosen = [k for k, part in enumerate(parts) if part[1:3].upper() in MATTER]
    for k in chance.sample(chosen, min(len(chosen), chance.choice((1, 3, 10, 40)))):
        match chance.randrange(6):
            case 0:
                parts[k] = ""
            case 1:
                parts[k] = re.sub(r"(?im)^DataType\s*=.*$", f"DataType={chance.choice(KINDS)}", parts[k])
            case 2:
                access = chance.choice(("ro", "const", "wo", "rw", "odd", ""))
                parts[k] = re.sub(r"(?im)^AccessType\s*=.*$", f"AccessType={access}", parts[k])
            case 3:
                parts[k] = re.sub(r"(?im)^PDOMapping\s*=.*$", f"PDOMapping={chance.choice('01')}", parts[k])
            case 4:
                limit = chance.choice(("LowLimit", "HighLimit"))
                parts[k] += f"\n{limit}={chance.choice(ODD)}\n"
            case _:
                parts[k] += f"\nDefaultValue={chance.choice(ODD)}\n"
    return "".join(parts)


def tried(name: str, text: str) -> bool:
    """Do with drives from a file all that commands do; tell if they could be opened."""
    config = arm_of(name, text=text)
    file = TextFile(name="strange.eds", text=text)
    for found in (bus_probe(config, [file]), bus_probe(config, (), Bench(config).links)):  # type: ignore[arg-type]
        assert probe_text(config, found)
        assert probe_document(config, found)
    assert planned_text(config, planned_configuration(config, Bench(config).links))  # type: ignore[arg-type]
    bench = Bench(config)
    try:
        with bench.arm as arm:
            assert bench.downloads()
            arm.enable()
            for _ in range(5):
                arm.exchange(np.zeros(2))
    except IdentError:
        assert not any("operation enabled" in state for state in bench.behind.emulator.states)
        return False
    return True


@pytest.mark.slow
@needs_sheets
@settings(some(8), derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(st.sampled_from(sorted(CAPABLE)), st.integers(0, 2**32))
def test_a_file_with_nonsense_gets_a_report_and_drives_that_are_opened_or_refused(name: str, seed: int) -> None:
    text = (SHEETS / name).read_text(encoding="latin-1")
    with suppress(IdentError):  # the description does not go with the file, or the file lists nothing
        tried(name, spoiled(text, random.Random(seed)))  # noqa: S311 - nothing secret


@needs_sheets
@pytest.mark.campaign
@pytest.mark.parametrize("name", [path.name for path in FILES])
def test_many_files_with_nonsense(name: str) -> None:
    text, opened = (SHEETS / name).read_text(encoding="latin-1"), 0
    for seed in range(40):
        with suppress(IdentError):
            opened += tried(name, spoiled(text, random.Random(seed)))  # noqa: S311 - nothing secret
    assert bool(opened) == (name in CAPABLE)
