"""`ident report` and `ident figures`: from a folder of results, verified, to files."""

from __future__ import annotations

import json
import shutil
import sys
from functools import partial
from pathlib import Path

import pytest
from cli.conftest import Commissioned, Ended, Ident, left_over

from ident_service.results.evidence.file import read_evidence
from ident_service.results.run_folder import read_results, write_manifest


@pytest.fixture
def folder(quick: Commissioned, tmp_path: Path) -> Path:
    return Path(shutil.copytree(quick.folder, tmp_path / "run"))


def test_report_makes_the_page_that_simulate_made(folder: Path, ident: Ident) -> None:
    first = (folder / "report.html").read_bytes()
    (folder / "report.html").unlink()
    write_manifest(folder)
    ended = ident("report", folder)
    assert (ended.code, ended.err) == (0, "")
    assert ended.out.startswith("USE")
    assert ended.out.endswith(f"{folder / 'report.html'}: {len(first) / 1e6:.2f} MB\nnext: ident export {folder}\n")
    assert (folder / "report.html").read_bytes() == first
    # The manifest names it again.
    assert "report.html" in read_results(folder).sha256


def test_report_elsewhere_leaves_the_folder_alone(folder: Path, ident: Ident, tmp_path: Path) -> None:
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    document = ident("report", folder, "--out", tmp_path / "page.html", "--json").json
    assert document["file"] == str(tmp_path / "page.html")
    assert document["bytes"] == (tmp_path / "page.html").stat().st_size
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert (tmp_path / "page.html").read_bytes() == before["report.html"]


def test_timing_is_the_loop_s_own_account(folder: Path) -> None:
    content = json.loads((folder / "evidence.json").read_text())
    assert [one["source"] for one in content["timing"]] == ["cycle", "cycle"]
    assert content["timing"][0]["invalid"] == [0, 0]
    assert content["timing"][0]["rate"] == pytest.approx(125.0)


def test_a_folder_without_evidence_says_what_to_do(folder: Path, ident: Ident) -> None:
    (folder / "evidence.json").unlink()
    write_manifest(folder)
    for words in (("report", folder), ("figures", folder, "--out", folder.parent / "figures")):
        ended = ident(*words)
        assert ended.code == 2
        assert ended.err == (
            f"ident: {folder}: evidence.json is not among its files; identify again from the recordings to have it\n"
        )
    assert not (folder.parent / "figures").exists()


def test_what_is_no_folder_of_an_identification_says_what_it_is(folder: Path, ident: Ident, tmp_path: Path) -> None:
    verbs = (
        ("report",),
        ("figures", "--out", tmp_path / "figures"),
        ("export",),
        ("accept", "--note", "x"),
        ("import",),
    )
    for verb in verbs:
        ended = ident(*verb, folder / "parameters.json")
        assert (ended.code, ended.err) == (2, f"ident: {folder / 'parameters.json'}: is a file; give its folder\n")
    page = tmp_path / "nowhere" / "page.html"
    ended = ident("report", folder, "--out", page)
    assert ended.code == 2
    assert f"{page}: there is no folder {page.parent}; make it first" in ended.err
    file, parameters = page.with_suffix(".json"), folder / "parameters.json"
    for words in (("project", parameters), ("compare", parameters, parameters)):
        ended = ident(*words, "--out", file)
        assert (ended.code, ended.err) == (
            2,
            f"ident: {file}: there is no folder {file.parent}; make it first, or give another place\n",
        )
    # What `ident payload` leaves: no evidence, and a comparison where the bare arm was known.
    (folder / "evidence.json").unlink()
    (folder / "payload.json").write_text("{}")
    (folder / "comparison.html").write_text("")
    write_manifest(folder)
    for verb in (("report",), ("figures", "--out", tmp_path / "figures")):
        ended = ident(*verb, folder)
        assert ended.code == 2
        assert ended.err == f"ident: {folder}: holds a payload, which has no report; comparison.html shows it\n"
    (folder / "comparison.html").unlink()
    assert "see payload.txt" in ident("report", folder).err


def test_a_changed_file_is_refused(folder: Path, ident: Ident) -> None:
    path = folder / "evidence.json"
    path.write_bytes(path.read_bytes()[:-100])
    ended = ident("report", folder)
    assert ended.code == 2
    assert "evidence.json: not what the manifest names" in ended.err


def test_a_page_does_not_go_over_a_result(folder: Path, ident: Ident, tmp_path: Path) -> None:
    for name, reason in (("parameters.json", "is one of the results"), ("manifest.json", "is one of the results")):
        ended = ident("report", folder, "--out", folder / name)
        assert ended.code == 2
        assert reason in ended.err
    assert "is a folder" in ident("report", folder, "--out", tmp_path).err
    read_results(folder)


def skip_without_font(ended: Ended) -> None:
    if "PNG needs one of the fonts" in ended.err:
        pytest.skip("no font on this machine: install the system's package fonts-dejavu-core")


@pytest.mark.slow
@pytest.mark.parametrize("form", ["svg", "png"])
def test_figures(folder: Path, ident: Ident, tmp_path: Path, form: str) -> None:
    if form == "png":
        pytest.importorskip("resvg_py")
    out = tmp_path / "figures"
    ended = ident("figures", folder, "--format", form, "--out", out, "--json")
    skip_without_font(ended)
    assert ended.code == 0, ended.err
    assert sorted(ended.json["files"]) == left_over(out)
    assert len(ended.json["files"]) == 4 + 2 + 2 + 2 + 2 + 2
    start = b"<svg xmlns=" if form == "svg" else b"\x89PNG\r\n\x1a\n"
    assert all(path.read_bytes().startswith(start) for path in out.iterdir())


@pytest.mark.campaign
@pytest.mark.slow
def test_letters_are_in_a_png(folder: Path, ident: Ident, tmp_path: Path) -> None:
    resvg = pytest.importorskip("resvg_py")
    ended = ident("figures", folder, "--format", "png", "--out", tmp_path / "png")
    skip_without_font(ended)
    assert ended.code == 0, ended.err
    assert ident("figures", folder, "--out", tmp_path / "svg").code == 0
    text = (tmp_path / "svg" / "deviations.svg").read_text()
    # With a font that is not there, letters would be missing without a word.
    mute = bytes(resvg.svg_to_bytes(svg_string=text, sans_serif_family="No Such Font", zoom=3.0))
    assert len((tmp_path / "png" / "deviations.png").read_bytes()) > len(mute) + 5000


def test_png_without_its_library_says_how_to_get_it(
    folder: Path, ident: Ident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "resvg_py", None)
    ended = ident("figures", folder, "--format", "png", "--out", tmp_path / "figures")
    assert ended.code == 2
    assert "pip install 'ident-service[figures]'" in ended.err
    assert not (tmp_path / "figures").exists()


@pytest.mark.slow
def test_png_without_a_font_is_refused(
    folder: Path, ident: Ident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    resvg = pytest.importorskip("resvg_py")
    # As on a machine without fonts: with some, a renderer takes another for one that is not there.
    monkeypatch.setattr(resvg, "svg_to_bytes", partial(resvg.svg_to_bytes, skip_system_fonts=True))
    ended = ident("figures", folder, "--format", "png", "--out", tmp_path / "figures")
    assert ended.code == 2
    assert "PNG needs one of the fonts DejaVu Sans" in ended.err


def test_figures_do_not_go_into_the_results(folder: Path, ident: Ident) -> None:
    ended = ident("figures", folder, "--out", folder)
    assert ended.code == 2
    assert "holds the results" in ended.err


def test_evidence_says_with_which_driver_its_recordings_were_made(
    quick: Commissioned, ident: Ident, tmp_path: Path
) -> None:
    recordings = sorted(quick.folder.glob("*.mcap"))
    ended = ident("identify", f"{recordings[0]}@0.5:", "--arm", quick.arm, "--out", tmp_path / "again")
    assert ended.code in (0, 3)
    for folder in (quick.folder, tmp_path / "again"):
        evidence = read_evidence(folder / "evidence.json")
        assert {one.driver for one in evidence.recordings} == {"simulated"}
        assert "no commissioning of a real arm" in (folder / "report.html").read_text()
