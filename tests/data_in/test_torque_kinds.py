"""Which torque recordings give, and that two kinds are not mixed in one estimate."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ident_service.config.load import load_arm
from ident_service.errors import RecordingError
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.urdf import urdf_text
from ident_service.operations.recordings import open_together, torque_in
from ident_service.recordings.cycle import Cycle
from ident_service.recordings.mcap_writer import RecordingWriter

STEP_NS = 1_000_000
LOST = 0.25  # N m between what drives were told and what they measured


@pytest.fixture(scope="module")
def model() -> ArmModel:
    return arm_model(load_arm("planar2"))


def written(path: Path, model: ArmModel, *, measured: bool, samples: int = 400) -> Path:
    q, told = np.array([0.1, 0.2]), np.array([1.0, 2.0])
    with RecordingWriter(path, model.chain.names, urdf_text(model, model.prior), 0) as writer:
        for k in range(samples):
            timing = (k, 0, 0, np.ones(2, bool), np.zeros(2, int), 0)
            acted = told - LOST if measured else None
            writer.sample(Cycle(10**9 + k * STEP_NS, q, None, told, q, q, *timing, acted))
    return path


def torques(opened: object) -> list[float]:
    return [float(np.concatenate([block.torque for block in one.blocks()])[:, 0].mean()) for one in opened.recordings]  # type: ignore[attr-defined]


def test_measured_torque_is_taken_where_all_recordings_have_it(tmp_path: Path, model: ArmModel) -> None:
    paths = [written(tmp_path / f"{name}.mcap", model, measured=True) for name in "ab"]
    opened = open_together([Path(f"{paths[0]}@0.1:0.3"), paths[1]], model)
    assert (opened.torque, opened.remarks) == ("measured", ())
    assert torques(opened) == pytest.approx([0.75, 0.75])


def test_the_two_kinds_are_not_mixed(tmp_path: Path, model: ArmModel) -> None:
    paths = [written(tmp_path / "with.mcap", model, measured=True)]
    paths.append(written(tmp_path / "without.mcap", model, measured=False))
    opened = open_together(paths, model)
    assert opened.torque == "commanded"
    assert torques(opened) == pytest.approx([1.0, 1.0])
    (remark,) = opened.remarks
    assert "drives measured none in without.mcap" in remark
    assert [torque_in(one) for one in opened.recordings] == ["commanded", "commanded"]


def test_a_demand_for_measured_torque_refuses_a_recording_without(tmp_path: Path, model: ArmModel) -> None:
    paths = [written(tmp_path / "with.mcap", model, measured=True)]
    paths.append(written(tmp_path / "without.mcap", model, measured=False))
    options = model.config.identification.model_copy(update={"torque": "measured"})
    demanding = replace(model, config=model.config.model_copy(update={"identification": options}))
    with pytest.raises(RecordingError, match=r"without.mcap.*identification.torque to commanded"):
        open_together(paths, demanding)
    assert open_together(paths, demanding, torque="commanded").torque == "commanded"


def test_a_file_of_another_program_does_not_say_which_it_is(tmp_path: Path, model: ArmModel) -> None:
    rows = "".join(f"{0.001 * k},0.1,0.2,1,2\n" for k in range(50))
    (tmp_path / "run.csv").write_text("t,q1,q2,tau1,tau2\n" + rows)
    ours = written(tmp_path / "with.mcap", model, measured=True)
    opened = open_together([ours, tmp_path / "run.csv"], model)
    assert (opened.torque, opened.remarks) == ("measured and recorded", ())
