"""A report from every recording of a real arm, and from the WAM's simulated ones, which are a minute at 1 kHz each."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from benchmarks.real_data import CASES, DATA, Case
from report.pages import parsed, sections

from ident_service.config.load import load_arm
from ident_service.results.evidence import Evidence
from ident_service.results.report_files import read_evidence_of
from ident_service.results.run_folder import read_results
from ident_service.service.commission import simulate
from ident_service.service.identification import Request, identify_files

pytestmark = pytest.mark.slow

MOST = 3_000_000


def read(folder: Path) -> tuple[str, Evidence]:
    return (folder / "report.html").read_text(encoding="utf-8"), read_evidence_of(read_results(folder))


def require_whole(page: str, evidence: Evidence) -> None:
    """What holds of every report: all sections, all joints, small, and the errors that were measured."""
    assert len(page.encode()) < MOST
    found = sections(page)
    joints = len(evidence.joints)
    assert len(found["torque"].all("figure")) == joints * len(evidence.recordings)
    assert len(found["residual"].all("figure")) == joints
    assert len(found["friction"].all("figure")) == joints
    assert len(found["bodies"].all("figure")) == 2
    assert len(found["timing"].all("figure")) == len(evidence.recordings)
    assert f"{evidence.estimates[evidence.chosen].identification:.3g} %" in found["verdict"].words
    for traced in evidence.recordings:
        for joint in traced.joints:
            # What is left lies between the extremes of both, and is smaller than what was measured.
            assert np.abs(joint.residual).max() < 2.0 * np.abs(joint.torque).max()
    assert parsed(page).all("h1")


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.arm)
@pytest.mark.parametrize("swapped", [False, True], ids=["as_published", "swapped"])
def test_a_report_from_each_recording(shared: Path, case: Case, swapped: bool, tmp_path: Path) -> None:
    if swapped and case.judged is None:
        pytest.skip("there is one recording only")
    names = [case.fitted, *([case.judged] if case.judged else [])]
    paths = [DATA / case.folder / name for name in (names[::-1] if swapped else names)]
    made = identify_files(Request(case.arm, (paths[0],), tuple(paths[1:])), tmp_path / "out")
    page, evidence = read(tmp_path / "out")
    require_whole(page, evidence)
    assert [one.name for one in evidence.recordings] == [path.name for path in paths]
    # Every warning of the command line is in the report.
    assert len(evidence.warnings) == len(made.warnings)
    assert len(sections(page)["warnings"].all("li")) == len(made.warnings)
    assert all(one.source == "stamps" for one in evidence.timing)


def test_a_report_of_an_infeasible_estimate(shared: Path, tmp_path: Path) -> None:
    case = CASES[0]
    path = DATA / case.folder / case.fitted
    made = identify_files(Request(case.arm, (path,), set_name="none"), tmp_path / "out")
    assert not made.estimate.feasible
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "No real body has these parameters" in sections(page)["verdict"].words
    assert "No body has these parameters" in sections(page)["bodies"].words


def test_the_wam_s_report_is_small(tmp_path: Path) -> None:
    config = load_arm("wam7_sim")
    simulate(config, tmp_path / "run")
    page, evidence = read(tmp_path / "run")
    require_whole(page, evidence)
    assert [one.source for one in evidence.timing] == ["cycle", "cycle"]
    assert all(one.time[-1] - one.time[0] > 55.0 for one in evidence.recordings)
    assert (tmp_path / "run" / "evidence.json").stat().st_size < MOST
    files = json.loads((tmp_path / "run" / "manifest.json").read_text())["files"]
    assert {"evidence.json", "report.html"} <= set(files)
