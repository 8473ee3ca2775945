"""Seconds left out of one recording, not of the others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ident_service.errors import UsageError
from ident_service.record.open import open_recording
from ident_service.record.part import TrimmedRecording
from ident_service.service.identification import Request, identify_files


def written(path: Path, samples: int = 3000) -> Path:
    rows = ["t,q1,q2,tau1,tau2"]
    for k in range(samples):
        t = 0.005 * k
        rows.append(f"{t:.3f},{np.sin(t):.6f},{np.cos(1.3 * t):.6f},{np.sin(t + 0.3):.6f},{np.cos(2.0 * t):.6f}")
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize(("start", "end"), [(0.0, 1.5), (2.0, 0.0), (2.0, 1.5)])
def test_the_ends_are_left_out_and_nothing_else(tmp_path: Path, start: float, end: float) -> None:
    whole = open_recording(written(tmp_path / "run.csv"))
    part = TrimmedRecording(whole, start, end)
    stamps = np.concatenate([block.stamp_ns for block in whole.blocks(700)])
    inside = (stamps >= stamps[0] + start * 1e9) & (stamps <= stamps[-1] - end * 1e9)
    got = np.concatenate([block.stamp_ns for block in part.blocks(700)])
    np.testing.assert_array_equal(got, stamps[inside])
    assert (part.sha256, part.joints) == (whole.sha256, whole.joints)


def test_a_trimmed_path_reads_fewer_samples_than_the_whole(tmp_path: Path) -> None:
    path = written(tmp_path / "run.csv")
    counts = [
        identify_files(Request("planar2", (Path(text),)), tmp_path / f"out{k}").estimate.samples
        for k, text in enumerate((str(path), f"{path}@2:1.5"))
    ]
    assert counts[0] - counts[1] == round(3.5 / 0.005)


def test_a_trimmed_path_to_nothing_is_told_by_its_name(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"missing\.csv"):
        identify_files(Request("planar2", (tmp_path / "missing.csv@1:1",)), tmp_path / "out")
