"""`ident payload` on a simulated arm: what it finds, what it writes, what it refuses."""

from __future__ import annotations

import json
import shutil
from importlib.resources import files
from pathlib import Path

import jsonschema
import numpy as np
import pinocchio as pin
import pytest
from compare.conftest import Ident
from helpers.changed_arms import changed, identified_folder, recorded_arm
from helpers.once import made_once

from ident_service.certificate_verifier import verify
from ident_service.operations.verify import verify_file
from ident_service.recordings.cycle import Cycle
from ident_service.recordings.mcap_reader import McapRecording
from ident_service.recordings.mcap_writer import RecordingWriter
from ident_service.results.run_folder import read_results

pytestmark = pytest.mark.slow

MASS, CENTER = 0.2, np.array([0.03, 0.01, 0.0])
TOOL = {
    "Lxx2": 1e-4 + MASS * CENTER[1] ** 2,
    "Lxy2": -MASS * CENTER[0] * CENTER[1],
    "Lyy2": 1e-4 + MASS * CENTER[0] ** 2,
    "Lzz2": 1e-4 + MASS * float(CENTER @ CENTER),
    "lx2": MASS * CENTER[0],
    "ly2": MASS * CENTER[1],
    "m2": MASS,
}
RATE = 250.0  # Hz; at half of it the tool is found, with another number in its first digit
UNSEEN = {"Lxx2", "Lxy2", "Lxz2", "Lyy2", "Lyz2", "lz2"}


@pytest.fixture(scope="session")
def arms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders of results `bare` and `tooled`, recordings `bare.mcap` and `tooled.mcap`."""

    def make(folder: Path) -> None:
        identified_folder(changed("planar2", rate=RATE, periods=1, seed=11), folder / "bare")
        identified_folder(changed("planar2", rate=RATE, periods=1, seed=12, added=TOOL), folder / "tooled")
        recorded_arm(changed("planar2", rate=RATE, periods=1, seed=13), folder / "bare.mcap")
        recorded_arm(changed("planar2", rate=RATE, periods=1, seed=14, added=TOOL), folder / "tooled.mcap")

    return made_once(tmp_path_factory, "payload", make)


def within(document: dict[str, object], truth: dict[str, float], sign: float) -> None:
    table = document["base_parameters"]
    assert isinstance(table, dict)
    for name, value, sigma in zip(table["expressions"], table["values"], table["standard_deviations"], strict=True):
        assert abs(value - sign * truth[name]) < 3.0 * sigma


def test_a_tool_is_found_and_written(arms: Path, ident: Ident, tmp_path: Path) -> None:
    out = tmp_path / "with_tool"
    code, text, _ = ident("payload", arms / "bare", arms / "tooled.mcap", "--out", out)
    assert code == 0
    assert text.startswith("ADDED: a body was added to the last link\n")
    assert "not excited by any motion of this arm: Lxx2 Lxy2 Lxz2 Lyy2 Lyz2 lz2" in text
    assert "\nCHANGED\n  body of link 2: " in text
    assert "about +0.2 kg\n    may mean: another tool or payload" in text
    wanted = ["arm.json", "comparison.html", "comparison.json", "comparison.txt", "identified.urdf", "manifest.json"]
    wanted += ["parameters.json", "payload.json", "payload.txt", "verify.py"]
    assert sorted(path.name for path in out.iterdir()) == wanted
    document = json.loads((out / "payload.json").read_text())
    jsonschema.validate(
        document, json.loads(files("ident_service.results").joinpath("payload.schema.json").read_text())
    )
    assert document["verdict"] == "added"
    within(document, TOOL, 1.0)
    body = dict(zip(document["body"]["names"], document["body"]["values"], strict=True))
    assert body["m2"] == pytest.approx(MASS, abs=0.005)
    # What a planar motion does not show is as in a compact load, and is said to be chosen, in the URDF's link, too.
    words = dict(zip(document["body"]["names"], document["body"]["verdicts"], strict=True))
    assert {name for name, word in words.items() if word == "chosen"} == UNSEEN
    assert max(abs(body[name]) for name in UNSEEN) < 1e-3
    (line,) = (line for line in text.splitlines() if "not identified, chosen as a compact load" in line)
    assert all(f"{name} " in line for name in UNSEEN)
    assert "m2" not in line
    assert (document["recordings"][0]["name"], document["link"]) == ("tooled.mcap", 2)


def test_the_arm_with_its_tool_is_a_folder_like_any_other(arms: Path, ident: Ident, tmp_path: Path) -> None:
    out = tmp_path / "with_tool"
    assert ident("payload", arms / "bare", arms / "tooled.mcap", "--out", out)[0] == 0
    loaded = read_results(out)
    assert verify_file(out / "parameters.json").verdict == "feasible"
    # Only the last link's body has moved.
    before, after = (read_results(one).parameters.content["link_parameters"] for one in (arms / "bare", out))
    moved = {
        name
        for name, old, new in zip(before["names"], before["values"], after["values"], strict=True)
        if abs(old - new) > 1e-12
    }
    assert moved
    assert all(name.endswith("2") and name[0] in "Llm" for name in moved)
    mass = dict(zip(after["names"], after["values"], strict=True))["m2"]
    assert mass - dict(zip(before["names"], before["values"], strict=True))["m2"] == pytest.approx(MASS, abs=0.005)
    # It is the arm that an identification with the tool finds.
    assert ident("compare", arms / "tooled", out)[0] == 0
    # And what was put on comes off again.
    code, text, _ = ident("payload", out, arms / "bare.mcap", "--out", tmp_path / "off")
    assert code == 0
    assert text.startswith("REMOVED")
    names = list(pin.buildModelFromUrdf(str(out / "identified.urdf")).names)[1:]
    assert names == list(loaded.config.joints)


def test_a_recording_that_ended_in_a_fault_is_refused(arms: Path, ident: Ident, tmp_path: Path) -> None:
    faulty = tmp_path / "fault.mcap"
    with_event(arms / "tooled.mcap", faulty, 10.0, 40, "following_error: j1 lags by 0.3 rad")
    out = tmp_path / "out"
    code, _, err = ident("payload", arms / "bare", faulty, "--out", out)
    assert code == 2
    assert "fault.mcap: ended in a fault 10 s after its first sample: following_error: j1 lags by 0.3 rad" in err
    assert "give a part before: fault.mcap@0:SECONDS" in err
    assert not out.exists()
    code, text, _ = ident("payload", arms / "bare", f"{faulty}@0:9", "--out", out)
    assert (code, text[:6]) == (0, "ADDED:")
    # A warning is no fault.
    with_event(arms / "tooled.mcap", tmp_path / "warned.mcap", 10.0, 30, "late_cycle: 2 ms")
    assert ident("payload", arms / "bare", tmp_path / "warned.mcap", "--out", tmp_path / "warned")[0] == 0


def with_event(recording: Path, copy: Path, seconds: float, level: int, message: str) -> None:
    """Write a recording again with a line of its story."""
    source = McapRecording(recording)
    (block,) = source.blocks(1 << 30)
    with RecordingWriter(copy, source.joint_names, "<robot/>", 0) as writer:
        for k in range(len(block.stamp_ns)):
            q, tau = block.position[k], block.torque[k]
            whole, none = np.ones(len(q), bool), np.zeros(len(q), int)
            writer.sample(Cycle(int(block.stamp_ns[k]), q, None, tau, q, q, k, 0, 0, whole, none, 0))
        writer.event(int(block.stamp_ns[0]) + int(seconds * 1e9), level, message)


def test_nothing_on_the_arm_is_reported_as_nothing(arms: Path, ident: Ident, tmp_path: Path) -> None:
    code, text, _ = ident("payload", arms / "bare", arms / "bare.mcap", "--out", tmp_path / "none")
    assert code == 3
    assert text.startswith("NO PAYLOAD: the arm moves as it was identified\n")
    assert sorted(path.name for path in (tmp_path / "none").iterdir()) == [
        "manifest.json",
        "payload.json",
        "payload.txt",
    ]


def test_a_tool_that_was_taken_off_is_a_removal(arms: Path, ident: Ident, tmp_path: Path) -> None:
    code, out, _ = ident("payload", arms / "tooled", arms / "bare.mcap", "--out", tmp_path / "off", "--json")
    assert code == 0
    document = json.loads(out)
    assert document["verdict"] == "removed"
    within(document, TOOL, -1.0)
    body = dict(zip(document["body"]["names"], document["body"]["values"], strict=True))
    assert body["m2"] == pytest.approx(MASS, abs=0.005)
    assert document["files"][-1] == "manifest.json"
    assert verify_file(tmp_path / "off" / "parameters.json").verdict == "feasible"
    assert ident("compare", arms / "bare", tmp_path / "off")[0] == 0


def test_the_body_s_certificate_is_a_proof(arms: Path, ident: Ident, tmp_path: Path) -> None:
    document = json.loads(ident("payload", arms / "bare", arms / "tooled.mcap", "--out", tmp_path / "a", "--json")[1])
    body, base = document["body"], document["base_parameters"]
    assert base["expressions"] == ["Lzz2", "lx2", "ly2", "m2"]
    table = dict(zip(body["names"], body["values"], strict=True))
    content = {
        "format": "ident-parameters",
        "version": 1,
        "base_parameters": {
            "expressions": base["expressions"],
            "values": [table[name] for name in base["expressions"]],
        },
        "feasibility": {"feasible": True, "margin": body["margin"], "certificate": body["certificate"]},
    }
    assert verify(json.dumps(content)).verdict == "feasible"


def test_what_cannot_be_meant_is_refused(arms: Path, ident: Ident, tmp_path: Path) -> None:
    bare, tooled = arms / "bare", arms / "tooled.mcap"
    torn = tmp_path / "torn"
    shutil.copytree(bare, torn)
    (torn / "arm.json").write_text("{}")
    other = tmp_path / "other.csv"
    other.write_text("t,q1,tau1\n" + "".join(f"{k / 100},{k},0\n" for k in range(500)))
    out = tmp_path / "out"
    cases = [
        ((tmp_path / "nowhere", tooled), 2, "not a folder; give the folder of results of the arm without the load"),
        ((bare / "parameters.json", tooled), 2, "not a folder"),
        ((torn, tooled), 2, "arm.json: not what the manifest names"),
        ((bare, bare / "identification.mcap"), 2, "the arm was identified from it; give a recording with the load"),
        ((bare, tooled, tooled), 2, "the same recording twice"),
        ((bare, tmp_path / "no.mcap"), 2, "no such file"),
        ((bare, other), 2, "other.csv"),
    ]
    for words, wanted, reason in cases:
        code, text, err = ident("payload", *words, "--out", out)
        assert (code, text) == (wanted, ""), err
        assert reason in err
        assert not out.exists()
    code, _, err = ident("payload", bare, tooled, "--out", bare)
    assert code == 2
    assert "would replace the arm's parameters" in err
    read_results(bare)
