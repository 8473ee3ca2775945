"""Runs in processes of their own, on a small arm whose plant lives in one too."""

from __future__ import annotations

from pathlib import Path

import pytest

from ident_service.config.load import shipped_arms

# Watchdog and deadline are wide, because test machines stall; what they do is tested in virtual time.
DRIVER = "{process: separate, time: real, status: %s, watchdog: 0.5, deadline: 2.0}"


@pytest.fixture
def real_arm(tmp_path: Path) -> Path:
    """An arm in real time at 200 Hz, which any machine keeps."""
    path = tmp_path / "real.yaml"
    driver = DRIVER % (tmp_path / "plant.status")
    path.write_text(f"extends: {shipped_arms()['planar2']}\ncontrol: {{rate: 200}}\ndriver: {driver}\n")
    return path


@pytest.fixture
def virtual_arm(tmp_path: Path) -> Path:
    """The same in virtual time, with motions of ten seconds."""
    path = tmp_path / "virtual.yaml"
    motion = "{kind: seeded, seed: 1, base_frequency: 0.2, harmonics: 5, periods: 2}"
    path.write_text(
        f"extends: {shipped_arms()['planar2']}\nmotions: {{identification: {motion}, validation: {motion}}}\n"
    )
    return path
