"""A report from every recording of a real arm; the WAM's simulated ones have theirs in `test_wam_commissioning.py`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from report.pages import parsed, sections

from benchmarks.real_data import CASES, DATA, Case
from ident_service.operations.identification import Request, identify_files
from ident_service.results.evidence.evidence import Evidence
from ident_service.results.report_files import read_evidence_of
from ident_service.results.run_folder import read_results

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

MOST = 1_800_000


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


# One recording; the others are for the campaign.
SOME = [pytest.param(one, marks=[] if one.arm == "ur10" else [pytest.mark.campaign], id=one.arm) for one in CASES]


@pytest.mark.parametrize("case", SOME)
def test_a_report_from_each_recording(shared: Path, case: Case, tmp_path: Path) -> None:
    paths = [DATA / case.folder / name for name in (case.fitted, case.judged) if name]
    made = identify_files(Request(case.arm, (paths[0],), tuple(paths[1:])), tmp_path / "out")
    page, evidence = read(tmp_path / "out")
    require_whole(page, evidence)
    assert [one.name for one in evidence.recordings] == [path.name for path in paths]
    # Every warning of the command line is in the report.
    assert len(evidence.warnings) == len(made.warnings)
    said = [item.words for item in sections(page)["verdict"].all("li")]
    assert {" ".join(line.split()) for line in made.warnings} <= set(said)
    # None of these recordings tells every parameter, and the page says so.
    assert any("base parameters are unidentified" in line for line in said)
    assert all(one.source == "stamps" for one in evidence.timing)
