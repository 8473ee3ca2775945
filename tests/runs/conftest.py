"""Runs in processes of their own, on a small arm whose plant lives in one too."""

from __future__ import annotations

from pathlib import Path

import pytest
from kill_bench import REAL, SLOW

from ident_service.config.load import shipped_arms

GAINS = "{kp: 225, kd: 30, following_error: 0.4}"
# An eighth of the cycles of a real arm, with gains that are stable at this rate and the two cycles that a watchdog must
# last.
COARSE = f"control: {{rate: 125}}\njoints: {{shoulder: {GAINS}, elbow: {GAINS}}}\ndriver: {{watchdog: 0.016}}\n"


def written(path: Path, motion: str) -> Path:
    """The planar arm in virtual time with one motion for all."""
    path.write_text(
        f"extends: {shipped_arms()['planar2']}\n{COARSE}motions: {{identification: {motion}, validation: {motion}}}\n"
    )
    return path


@pytest.fixture
def real_arm(tmp_path: Path) -> Path:
    """An arm in real time, slow enough for a busy machine."""
    path = tmp_path / "real.yaml"
    driver = f"{{process: separate, {REAL}, status: {tmp_path / 'plant.status'}}}"
    path.write_text(f"extends: {shipped_arms()['planar2']}\n{SLOW}driver: {driver}\n")
    return path


@pytest.fixture
def virtual_arm(tmp_path: Path) -> Path:
    """The same in virtual time at 125 Hz, with motions of ten seconds."""
    return written(tmp_path / "virtual.yaml", "{kind: seeded, seed: 1, base_frequency: 0.2, harmonics: 5, periods: 2}")
