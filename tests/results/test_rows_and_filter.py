"""The words beside torque errors: which rows, and through which filters."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report.pages import parsed

from ident_service.cli import main
from ident_service.config.arm import Identification
from ident_service.results.summary import rows_and_filter, wrapped

PLAIN: dict[str, Any] = {
    "method": "ols",
    "edge": 0.5,
    "reversal": {"speed": 0.05, "window": 0.2},
    "smoothing": {"cutoff": 8, "filter_torque": False, "decimate": 1},
}


def said(**changes: Any) -> str:
    smoothing = PLAIN["smoothing"] | changes.pop("smoothing", {})
    return " ".join(rows_and_filter(Identification.model_validate(PLAIN | {"smoothing": smoothing} | changes)))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, "every sample of a recording but 0.5 s at its ends and at gaps."),
        ({"smoothing": {"decimate": 25}}, "at its ends and at gaps, thinned out to one of 25."),
        ({}, "of that joint is not faster than 0.05 rad/s (or m/s), and without those within 0.2 s of them."),
        ({"reversal": {"speed": 0.1, "window": 0}}, "a drive of that joint is not faster than 0.1 rad/s (or m/s)."),
        ({"reversal": {"speed": 0, "window": 0}}, "without rows in which a drive of that joint stands still."),
        ({}, "through a zero-phase Butterworth low-pass of order 3 at 8 Hz. Measured torque: as recorded, so that"),
        ({"smoothing": {"filter_torque": True}}, "Measured torque: through the same low-pass."),
        (
            {"smoothing": {"filter_torque": True, "method": "savitzky_golay"}},
            "degree 3, cut-off 8 Hz. Measured torque: through a zero-phase Butterworth low-pass of order 3 at 8 Hz.",
        ),
        ({"smoothing": {"regressor_cutoff": 5}}, "Then measured and predicted torque: through a low-pass at 5 Hz."),
        ({"period": 20}, "Position and torque: averaged over periods of 20 s."),
    ],
)
def test_every_setting_that_changes_a_figure_is_stated(changes: dict[str, Any], words: str) -> None:
    assert words in said(**changes)


def test_settings_that_differ_never_sound_alike() -> None:
    variants: list[dict[str, Any]] = [
        {},
        {"edge": 0.25},
        {"reversal": {"speed": 0.02, "window": 0.2}},
        {"reversal": {"speed": 0.05, "window": 0.1}},
        *({"smoothing": one} for one in ({"cutoff": 9}, {"order": 4}, {"filter_torque": True}, {"decimate": 2})),
        *({"smoothing": one} for one in ({"method": "savitzky_golay"}, {"regressor_cutoff": 5})),
    ]
    assert len({said(**one) for one in variants}) == len(variants)


def test_lines_fit_a_terminal() -> None:
    assert max(map(len, wrapped(rows_and_filter(Identification.model_validate(PLAIN))))) <= 100


@pytest.mark.slow
def test_the_words_stand_beside_the_figures_everywhere(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = ["t,q1,q2,tau1,tau2"]
    for t in np.arange(0.0, 20.0, 0.01):
        q = np.sin(1.3 * t), np.cos(2.1 * t)
        rows.append(f"{t:.2f},{q[0]:.6f},{q[1]:.6f},{3.0 * q[0] + np.sign(np.cos(1.3 * t)):.6f},{q[1]:.6f}")
    (tmp_path / "run.csv").write_text("\n".join(rows) + "\n")
    words = ["identify", str(tmp_path / "run.csv"), "--arm", "planar2", "--out", str(tmp_path / "out")]
    main(words)
    text = capsys.readouterr().out
    content = json.loads((tmp_path / "out" / "parameters.json").read_text())
    sentences = content["fit"]["rows_and_filter"]
    assert sentences[0].startswith("All rows: every sample")
    assert any(sentence.startswith("Most of the motion is not repeated, so noise and model") for sentence in sentences)
    page = parsed((tmp_path / "out" / "report.html").read_text()).words
    for sentence in sentences:
        assert sentence in " ".join(text.split())
        assert sentence in " ".join((tmp_path / "out" / "report.txt").read_text().split())
        assert sentence in page
    main([*words, "--json"])
    assert json.loads(capsys.readouterr().out)["rows_and_filter"] == sentences
