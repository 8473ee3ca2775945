"""`ident bus probe`: what drives can, by uploads alone; whatever a drive or a file says, there is a report."""

from __future__ import annotations

import json
import random
import struct
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers.emulated_arms import EDS, weightless_config
from helpers.makers import CAPABLE, REFUSED, SHEETS, Bench, arm_of, sheet

from drivers.can.can_frame import Frame
from drivers.can.can_link import Link
from drivers.canopen.capabilities import family_of, shipped_families
from ident_service.cli import DONE, USAGE, VERDICT_NO, main
from ident_service.config.arm import ArmConfig
from ident_service.config.drive_family import parse_family
from ident_service.config.eds import data_sheet
from ident_service.config.load import load_arm, shipped_arms
from ident_service.config.quantities import TextFile
from ident_service.errors import ConfigError, DriverError, UsageError
from ident_service.operations.description_check import check_description
from ident_service.operations.fieldbus import Probe, bus_probe, probe_document, probe_text, store_probe_outcome
from sim_backend.canopen_device.drive import CanopenDrive
from sim_backend.emulator.process import emulate

needs_sheets = pytest.mark.skipif(not SHEETS.is_dir(), reason="the makers' data sheets are not beside this checkout")


def reported(config: ArmConfig, found: Probe) -> str:
    """The report as text, when the same stands in the document."""
    document = probe_document(config, found)
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    assert document["good"] == found.good
    return probe_text(config, found)


def settings(bench: Bench) -> list[dict[int, object]]:
    """What every entry holds that a host could have written."""
    found = []
    for face in bench.behind.emulator.faces:
        assert isinstance(face, CanopenDrive)
        entries = face.objects.entries
        found.append(
            {key: value for key, value in face.objects.values.items() if key in entries and entries[key].writable}
        )
    return found


def probed(bench: Bench, config: ArmConfig) -> str:
    """A probe, which is proven to have sent nothing but uploads and to have changed nothing."""
    before = settings(bench)
    found = bus_probe(config, (), bench.links)  # type: ignore[arg-type]
    for frame in bench.taps[0].sent:
        assert 0x600 < frame.identifier < 0x680
        assert frame.data[0] >> 5 in (2, 3), frame  # initiate upload, upload segment (CiA 301, 7.2.4.3)
    assert settings(bench) == before
    return reported(config, found)


@needs_sheets
@pytest.mark.parametrize("name", CAPABLE)
def test_drives_with_a_torque_mode_say_what_they_can(name: str) -> None:
    config = arm_of(name)
    text = probed(Bench(config), config)
    watchdog, mode, _ = CAPABLE[name]
    assert text.startswith("weightless: every drive can be driven; nothing was written\n")
    assert f"mode {mode}, " in text
    assert watchdog in text
    assert "not on hardware" in text
    assert "highest rate:" in text


@needs_sheets
def test_what_is_reported_of_an_epos4_is_what_its_makers_files_say() -> None:
    config = arm_of("maxon_epos4_50-8_0110h.eds")
    (first, _) = bus_probe(config, (), Bench(config).links).probed  # type: ignore[arg-type]
    assert first.can is not None
    assert first.can.family.name == "maxon EPOS4"
    assert first.can.count == pytest.approx(1e-3)  # of 1 N m, which 6076h holds as 1000000 uN m
    assert first.can.limit is not None
    assert (first.can.limit.entry, first.can.limit.per) == ("3001:2/u32", "3001:1/u32")
    assert (first.can.watchdogs, first.can.event, first.can.shares) == (("heartbeat",), False, False)


@needs_sheets
@pytest.mark.parametrize("name", REFUSED)
def test_drives_without_one_are_refused_in_one_sentence(name: str) -> None:
    config = arm_of(name)
    text = probed(Bench(config), config)
    refusals = [line for line in text.splitlines() if "REFUSED" in line]
    assert len(refusals) == 2
    assert "torque mode" in refusals[0]
    assert "highest rate" not in text
    assert "drive 1, drive 2: another drive is needed" in text.partition("what helps:\n")[2]


@needs_sheets
def test_a_drive_without_torques_that_takes_positions_is_named_with_the_remedy() -> None:
    text = EDS
    for index in ("6071", "6087"):
        text = text.replace(f"[{index}]", f"[{int(index, 16) - 0x1000:04X}]")
    config = weightless_config()
    found = bus_probe(config, [TextFile(name="speedy.eds", text=text)])
    told = reported(config, found)
    assert "REFUSED" in told
    assert "what helps:\n  speedy.eds: positions can be streamed: `driver: {streams: position, ...}` at 100" in told


def test_a_more_trusted_watchdog_and_further_axes_are_reported() -> None:
    text = EDS + "".join(f"\n[{index}]\nDataType=6\nAccessType=ro\n" for index in ("6841", "7041"))
    config = arm_of("", text=text, torque_frames="shared", drive={"watchdog": "heartbeat"})
    told = probed(Bench(config), config)
    assert "rpdo_timer misses the frames themselves, heartbeat (drives.watchdog) only their sender" in told
    assert "6841h is there: of its axes only the first one (6041h) is driven" in told
    plain = probed(Bench(weightless_config()), weightless_config())
    assert "misses the frames" not in plain
    assert "6841h" not in plain


def test_capabilities_of_a_silent_drive_are_predicted() -> None:
    config = weightless_config()
    bench = Bench(config)
    for face in bench.behind.emulator.faces:
        face.listens = lambda identifier: False  # type: ignore[method-assign]
    found = bus_probe(config, (), bench.links)  # type: ignore[arg-type]
    text = reported(config, found)
    assert not found.good
    assert "predicted from its EDS" in text
    assert "no proper answer" in text


@pytest.mark.slow
def test_a_drive_that_says_nonsense_gets_a_report() -> None:
    """Answers of every kind but good ones; a seed each."""
    config = weightless_config()
    for seed in range(60):
        chance = random.Random(seed)  # noqa: S311 - nothing secret
        bench = Bench(config)

        class Mad:
            def __init__(self, link: Link, chance: random.Random) -> None:
                self._link, self._chance = link, chance

            def __getattr__(self, name: str) -> object:
                return getattr(self._link, name)

            def receive(self, deadline_ns: int) -> Frame | None:
                frame = self._link.receive(deadline_ns)
                if frame is None or self._chance.random() < 0.7:
                    return frame
                kind, length = self._chance.choice(("bytes", "abort", "short")), self._chance.randrange(9)
                if kind == "abort":
                    code = self._chance.choice((0x06020000, 0x06090011, 0x08000000, self._chance.getrandbits(32)))
                    return frame._replace(data=b"\x80" + frame.data[1:4] + struct.pack("<I", code))
                return frame._replace(data=self._chance.randbytes(8 if kind == "bytes" else length))

        def links(config: ArmConfig, bench: Bench = bench, chance: random.Random = chance) -> list[Link]:
            return [Mad(link, chance) for link in bench.links(config)]  # type: ignore[arg-type, misc]

        assert reported(config, bus_probe(config, (), links))


@pytest.mark.slow
@needs_sheets
def test_a_file_that_is_broken_gets_a_report() -> None:
    config = weightless_config()
    for name in (*CAPABLE, *REFUSED):
        text = sheet(name)["text"]
        for seed in range(8):
            chance = random.Random(seed)  # noqa: S311 - nothing secret
            broken = list(text)
            for _ in range(chance.choice((1, 30, 1000))):
                broken[chance.randrange(len(broken))] = chance.choice("[]=0x9Z$\n; \0")
            torn = "".join(broken)[: chance.randrange(len(broken))]
            assert reported(config, bus_probe(config, [TextFile(name="broken", text=torn)]))
    for text in ("", "\0", "[", "[DeviceInfo]", "[1000]\nDataType=7\nDefaultValue=0x192\n", "no ini"):
        assert reported(config, bus_probe(config, [TextFile(name="broken", text=text)]))


def test_the_command_judges_files_without_a_bus(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    eds = shipped_arms()["planar2"].parent / "emulated_drive.eds"
    assert main(["bus", "probe", "wam7_canopen", "--eds", str(eds)]) == DONE
    assert "emulated_drive.eds, node 1: emulated drive: can be driven, predicted" in capsys.readouterr().out
    (tmp_path / "none.eds").write_bytes(b"\xff\xfe no file of ours")
    assert main(["bus", "probe", "wam7_canopen", "--json", "--eds", str(eds), str(tmp_path / "none.eds")]) == USAGE
    document = json.loads(capsys.readouterr().out)
    assert [one["drivable"] for one in document["drives"]] == [True, False]
    assert "is no EDS" in document["drives"][1]["silent"]
    assert document["advice"] == ["none.eds: take the EDS or DCF of the drive's maker, undamaged"]
    assert document["highest_rate"] < 1000
    for words in (
        ["bus", "probe", "wam7_canopen", "--eds", str(tmp_path)],
        ["emulate", "wam7_canopen", "--eds", str(tmp_path)],
    ):
        assert main(words) == USAGE
        assert f"{tmp_path} is a folder; name a file in it" in capsys.readouterr().err
    assert main(["bus", "probe", "wam7_canopen", "--eds", "no.eds"]) == USAGE


@needs_sheets
@pytest.mark.parametrize("name", [*CAPABLE, *REFUSED])
def test_a_file_that_is_cut_off_is_reported(name: str) -> None:
    text, config = sheet(name)["text"], weightless_config()
    assert data_sheet(text).cut_off == ""
    for percent in (20, 50, 95):
        torn = TextFile(name="torn.eds", text=text[: len(text) * percent // 100])
        told = reported(config, bus_probe(config, [torn]))
        assert "it seems to end too early: " in told, percent
        assert ("torn.eds: get the whole file" in told) == ("every drive can be driven" not in told)


def test_a_description_whose_file_is_cut_off_is_warned_of(tmp_path: Path) -> None:
    (tmp_path / "cut.eds").write_text(EDS[: len(EDS) * 3 // 4])
    (tmp_path / "arm.yaml").write_text(
        "extends: wam7_canopen\nname: cut\ndriver: {kind: canopen, eds: cut.eds, torque_frames: single}\n"
        "control: {rate: 500}\n"
    )
    (warning,) = check_description(tmp_path / "arm.yaml").warnings
    assert warning.startswith("cut.eds seems to end too early: of ")


def test_an_arm_without_a_bus_is_refused() -> None:
    with pytest.raises(UsageError, match="a bus probe is of CANopen drives"):
        bus_probe(load_arm("planar2"))


def test_every_shipped_family_says_where_its_facts_are_from() -> None:
    families = shipped_families()
    assert families[-1].name == "generic402"
    assert len({family.name for family in families}) == len(families) > 12
    for family in families:
        assert not family.proved  # nobody has run one on hardware yet
        assert family.match.vendor is not None or family is families[-1]
        assert set(family.sources) == family.model_fields_set - {"name", "proved", "sources", "notes"}


def test_families_are_found_by_vendor_and_product_and_the_users_come_first() -> None:
    assert family_of({"vendor": 0xFB, "product": 0x65510000}).name == "maxon EPOS4"
    assert family_of({"vendor": 0xFB, "product": 1}).name == "generic402"
    assert family_of({"vendor": 0x9A, "product": 0x30923}).name == "Elmo Gold"
    assert family_of({"vendor": 0x9A}).name == "Elmo SimplIQ"
    assert family_of({}).name == "generic402"
    mine = parse_family("mine.yaml", "{name: mine, proved: yes, match: {vendor: 0xFB}, sources: {match: my bench}}")
    assert family_of({"vendor": 0xFB, "product": 1}, [mine]).name == "mine"
    assert family_of({"vendor": 0xFB, "product": 1}, [mine]).torque_limit == shipped_families()[-1].torque_limit


# Families of which no file is at hand: the vendor, and entries that only the family knows.
UNSEEN = {
    "ZeroErr eDriver": (0x5A65726F, {0x607200: 1000}),
    "Copley": (0xAB, {0x607200: 1000}),
    "Nanotec": (0x26C, {0x203B01: 2000, 0x607200: 0}),
    "Synapticon SOMANET": (0x22D2, {0x607200: 1000, 0x200401: 7}),
    "Kollmorgen AKD": (0x6A, {0x607300: 1000}),
}


@needs_sheets
@pytest.mark.parametrize("name", UNSEEN)
def test_makers_without_a_file_at_hand_are_emulated_by_what_their_family_says(name: str) -> None:
    """An anonymous drive's file with the maker's number and entries: opened, enabled, given a torque that acts."""
    vendor, own = UNSEEN[name]
    text = sheet("e35.eds")["text"].replace("VendorNumber=101", f"VendorNumber={vendor:#x}")
    head, tail = text.split("[1018sub1]")
    text = head + "[1018sub1]" + tail.replace("DefaultValue=0xFF", f"DefaultValue={vendor:#x}", 1)
    if 0x607200 not in own:
        text = text.replace("[6072]", "[5FFE]")
    for key, value in own.items():
        if key >> 8 not in (0x6072, 0x6073):
            index, sub = f"{key >> 8:04X}", key & 0xFF
            text += f"\n[{index}]\nSubNumber=2\nObjectType=0x9\n[{index}sub0]\nDataType=5\nDefaultValue=1\n"
            kind = 7 if key == 0x203B01 else 6
            text += f"[{index}sub{sub:X}]\nDataType={kind}\nAccessType=rw\nDefaultValue={value}\n"
    constant = {"torque_constant": 0.5} if name == "Nanotec" else {}
    config = arm_of("e35.eds")
    tree = config.model_dump(mode="json", by_alias=True)
    file = {"name": "maker.eds", "text": text}
    tree["driver"]["eds"], tree["driver"]["emulation"]["eds"] = file, [file]
    for drive in tree["driver"]["drives"]:
        drive.update({"eds": file} | constant)
    config = ArmConfig.model_validate(tree)
    bench = Bench(config)
    found = bus_probe(config, (), bench.links)  # type: ignore[arg-type]
    (first, _) = found.probed
    assert first.can is not None
    assert first.can.family.name == name
    assert found.good, probe_text(config, found)
    assert ("brake" in probe_document(config, found)["drives"][0]["facts"]) is (0x200401 in own)
    with bench.arm as arm:
        arm.enable()
        for _ in range(20):
            sample = arm.exchange(np.array([0.1, 0.05]))
        np.testing.assert_allclose(sample.torque, [0.1, 0.05], atol=1.1e-3)
        torques = bench.behind.emulator.body.truth(bench.behind.clock.now_ns()).torque
        np.testing.assert_allclose(torques, sample.torque, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{name: x, proved: no, match: {vendor: 1}, sources: {}}", "sources are needed for match"),
        ("{name: x, proved: no, unit: {unit: mNm}, sources: {unit: y}}", "either `rated` names an entry"),
        ("{name: x, proved: no, torque: [{mode: 4, target: 6071}], sources: {torque: y}}", "target"),
        (
            "{name: x, proved: no, torque: [{mode: 200, target: '6071:0/i16'}], sources: {torque: y}}",
            "does not fit 6060h",
        ),
        ("{name: x, proved: no, torque: [{mode: 4, target: '201C:0/u32'}], sources: {torque: y}}", "should match"),
        (
            "{name: x, proved: no, torque: [{mode: 4, target: '201C:0/i16', shift: 2}], sources: {torque: y}}",
            "only counts in a target of 32 bits are shifted",
        ),
        ("{name: x, proved: no, unit: {count: 1, unit: mA, writable: yes}, sources: {unit: y}}", "only a rated torque"),
        ("{name: x, proved: no, unit: null, sources: {unit: y}}", "leave out what is not known"),
        ("{name: x, proved: no, surprise: 1, sources: {}}", "surprise"),
        ("[", "no family of drives"),
    ],
)
def test_a_family_with_a_mistake_is_refused_in_words(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(DriverError, match=words):
        parse_family("mine.yaml", text)
    (tmp_path / "mine.yaml").write_text(text)
    arm = tmp_path / "arm.yaml"
    wam = shipped_arms()["wam7_canopen"]
    tree = f"extends: {wam}\nname: mine\ndriver:\n  kind: canopen\n  profiles: [mine.yaml]\n"
    arm.write_text(tree)
    with pytest.raises(ConfigError, match=r"driver\.profiles"):
        load_arm(arm)


def arm_file(folder: Path, *, rated: float) -> Path:
    """A small arm with drives of two makers on a bus of python-can in this process."""
    drive = {"rated_torque": rated, "max_torque": 4.0 * rated, "max_speed": 3000.0}
    epos, e35 = (str(SHEETS / name) for name in ("maxon_epos4_50-8_0110h.eds", "e35.eds"))
    tree = {
        "extends": str(shipped_arms()["planar2"]),
        "name": "mixed",
        "transmission": {"ratios": [40.0, 20.0], "drive_terms": "joints"},
        "driver": {
            "kind": "canopen",
            "eds": epos,
            "torque_frames": "single",
            "buses": [{"interface": "virtual", "channel": f"probe-{folder.name}"}],
            "drives": [
                drive | {"node": 1, "watchdog": "heartbeat"},
                drive | {"node": 2, "watchdog": "node_guarding", "eds": e35},
            ],
            "emulation": {"eds": [epos, e35]},
        },
    }
    path = folder / f"arm{rated:g}.yaml"
    path.write_text(yaml.safe_dump(tree))
    return path


@needs_sheets
@pytest.mark.slow
def test_the_command_probes_a_bus_of_python_can(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    there, other, state = (
        arm_file(tmp_path, rated=0.5),
        arm_file(tmp_path, rated=0.05),
        ["--state", str(tmp_path / "s")],
    )
    end = threading.Event()
    thread = threading.Thread(target=lambda: emulate(load_arm(there), stop_requested=end.is_set))
    thread.start()
    try:
        until = time.monotonic() + 60.0
        while main(["bus", "probe", str(there), *state]) != DONE:  # the drives are not there yet
            assert "No SDO response received" in capsys.readouterr().out
            assert time.monotonic() < until
        assert capsys.readouterr().out.startswith("mixed: every drive can be driven; nothing was written\n")
        first = json.loads((tmp_path / "s" / "arms" / "mixed" / "drives.json").read_text())
        assert main(["bus", "probe", str(other), "--json", *state]) == VERDICT_NO
    finally:
        end.set()
        thread.join()
    document = json.loads(capsys.readouterr().out)
    for drive in document["drives"]:
        (change,) = drive["can"]["changes"]
        assert change["where"] == "drives.rated_torque"
        assert "wrong by 10, which is another unit" in change["why"]
    assert [first["drives"][f"drive {n}"]["can"]["identity"]["vendor"] for n in (1, 2)] == [0xFB, 0xFF]
    assert not [line for line in document["changed"] if "changes was" not in line]  # the drives are the same


@needs_sheets
def test_a_drive_that_cannot_keep_a_zero_is_reported() -> None:
    config = arm_of("maxon_epos4_50-8_0110h.eds")
    at_home = config.model_copy(update={"driver": config.driver.model_copy(update={"zero": "at_home"})})  # type: ignore[union-attr]
    text = probed(Bench(config), at_home)
    assert "to change       driver.zero: at_home: it has no 1020h" in text


def test_what_a_probe_found_is_kept_and_what_differs_is_reported(tmp_path: Path) -> None:
    path, can = tmp_path / "arms" / "a" / "drives.json", {"identity": {"vendor": 1}, "mode": 10, "asked": True}
    drive = {"title": "drive 1", "node": 3, "silent": "", "can": can}
    assert store_probe_outcome(path, {"drives": [drive]}) == []
    assert store_probe_outcome(path, {"drives": [drive | {"silent": "no answer"}]}) == []
    (line,) = store_probe_outcome(path, {"drives": [drive | {"can": can | {"mode": 4}}]})
    assert line.startswith("drive 1, node 3: mode was 10, is 4 (probe of ")
    (line,) = store_probe_outcome(path, {"drives": [drive | {"can": can | {"identity": {"vendor": 2}}}]})
    assert "another drive than at the last probe" in line
    path.write_text("{")
    with pytest.raises(UsageError, match=r"cannot be read .*remove the file"):
        store_probe_outcome(path, {"drives": [drive]})


def test_emulated_drives_need_files_that_are_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["emulate", "wam7_canopen", "--eds", "no.eds"]) == USAGE
    assert "no such file" in capsys.readouterr().err
