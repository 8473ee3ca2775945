"""What a recording holds behind the end of a stopped motion is no evidence: brakes or drives act there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ident_service.config.load import load_arm
from ident_service.errors import RecordingError
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.urdf import urdf_text
from ident_service.operations.recordings import open_together
from ident_service.recordings.cycle import Cycle
from ident_service.recordings.mcap_writer import RecordingWriter

FIRST_NS, STEP_NS, SAMPLES = 10**9, 1_000_000, 400


@pytest.fixture(scope="module")
def model() -> ArmModel:
    return arm_model(load_arm("planar2"))


def written(path: Path, model: ArmModel, events: dict[int, str]) -> Path:
    """A recording with these events, by the sample at which each is logged."""
    q = np.array([0.1, 0.2])
    with RecordingWriter(path, model.chain.names, urdf_text(model, model.prior), 10**18) as writer:
        for k in range(SAMPLES):
            if k in events:
                writer.event(FIRST_NS + k * STEP_NS, 20, events[k])
            timing = (k, 0, 0, np.ones(2, bool), np.zeros(2, int), 0)
            writer.sample(Cycle(FIRST_NS + k * STEP_NS, q, None, q, q, q, *timing, None))
    return path


def samples(path: Path | str, model: ArmModel) -> tuple[int, tuple[str, ...]]:
    opened = open_together([Path(path)], model)
    return sum(len(block.stamp_ns) for block in opened.recordings[0].blocks()), opened.remarks


@pytest.mark.parametrize("end", ["stopped", "faulted"])
def test_it_is_left_out(tmp_path: Path, model: ArmModel, end: str) -> None:
    events = {10: "exciting", 200: "stopping", 250: end, 300: "stopped"}
    count, (remark,) = samples(written(tmp_path / "run.mcap", model, events), model)
    assert count == 250
    assert "run.mcap: left out from 0.25 s after its first sample on: the motion was stopped" in remark


def test_a_run_that_ends_in_order_is_whole(tmp_path: Path, model: ArmModel) -> None:
    events = {10: "exciting", 200: "pausing", 220: "paused", 250: "resuming", 350: "done"}
    assert samples(written(tmp_path / "run.mcap", model, events), model) == (SAMPLES, ())


def test_ranges_end_there_too(tmp_path: Path, model: ArmModel) -> None:
    path = written(tmp_path / "run.mcap", model, {250: "stopped"})
    assert samples(f"{path}@0.1:0.2", model)[0] == 100
    assert samples(f"{path}@0.2:0.35", model)[0] == 50
    with pytest.raises(RecordingError, match=r"the motion was stopped 0.25 s after the first sample"):
        samples(f"{path}@0.3:0.35", model)
