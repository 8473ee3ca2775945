"""All benchmarks: medians of repeated calls within one run."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pinocchio as pin

from benchmarks import canopen, estimation, real_data
from benchmarks.harness import Row, median_seconds, table, write
from ident_service.config.load import load_arm
from ident_service.estimation.equations import equations
from ident_service.estimation.feasible.feasible_set import feasible_set
from ident_service.estimation.feasible.problems import (
    constrained_least_squares,
    feasibility_correction,
    feasibility_test,
)
from ident_service.estimation.identify import identify
from ident_service.estimation.least_squares import ordinary_least_squares
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.base_parameters import base_parameters
from ident_service.model.pinocchio_models import pinocchio_model
from ident_service.model.regressor import joint_regressor
from ident_service.motion.arm_factory import make_arm
from ident_service.operations.commissioning import record_motion
from ident_service.recordings.cached_recording import CachedRecording
from ident_service.recordings.open import open_recording
from ident_service.results.parameter_file import parameters_document, write_parameters

SAMPLES = 57_656


def main() -> None:
    model = arm_model(load_arm("wam7_sim"))
    with tempfile.TemporaryDirectory() as folder:
        rows = [*_model(model), *_run(model, Path(folder)), *_estimation(model, Path(folder)), *estimation.measure()]
    rows += canopen.in_one_process()
    if real_data.DATA.is_dir():
        found, text = real_data.measure()
        rows += found
        (Path(__file__).parents[1] / "docs" / "real-data.md").write_text(text, encoding="utf-8")
    else:
        print("real recordings: skipped, there is no folder shared/data beside the checkout")
    print(table(rows))
    print(f"written to {write(rows, Path(__file__).parent / 'results')}")


def _model(model: ArmModel) -> list[Row]:
    chain, layout = model.chain, model.layout
    base = base_parameters(chain, layout)
    series = excitation(model, "identification").path.series
    q, dq, ddq, _ = series.at(np.arange(SAMPLES) * 1e-3)

    def batched() -> None:
        H = None
        for start in range(0, SAMPLES, 4096):
            part = slice(start, start + 4096)
            H = joint_regressor(chain, layout, q[part], dq[part], ddq[part], base.base, H)

    assert model.prior is not None  # noqa: S101  # the shipped WAM has one
    pinocchio = pinocchio_model(chain, layout, model.prior)
    data = pinocchio.createData()
    kept = np.empty((SAMPLES, chain.joints, 10 * chain.joints))

    def one_by_one() -> None:
        for k in range(SAMPLES):
            kept[k] = pin.computeJointTorqueRegressor(pinocchio, data, q[k], dq[k], ddq[k])

    ours, theirs = median_seconds(batched, 5), median_seconds(one_by_one, 5)
    return [
        Row(
            "base parameters of the WAM with expressions",
            median_seconds(lambda: base_parameters(chain, layout)),
            "s",
            "< 2",
        ),
        Row(f"batched base regressor, {SAMPLES} samples", ours, "s"),
        Row("pinocchio called per sample and kept, over batched", theirs / ours, "ratio", ">= 4"),
    ]


def _run(model: ArmModel, folder: Path) -> list[Row]:
    motion = excitation(model, "identification")
    count = 0

    def once() -> None:
        nonlocal count
        count += 1
        record_motion(make_arm(model.config), model, motion, folder / f"run{count}.mcap")

    seconds = median_seconds(once, repeats=3, warmups=0)
    return [Row("60 s motion at 1 kHz in virtual time, recorded", seconds, "s", "< 15")]


def _estimation(model: ArmModel, folder: Path) -> list[Row]:
    path = folder / "run1.mcap"
    names = model.chain.names
    table = [np.column_stack([one.stamp_ns * 1e-9, one.position, one.torque]) for one in open_recording(path).blocks()]
    head = ",".join(["t", *(f"{kind}{number + 1}" for kind in ("q", "tau") for number in range(len(names)))])
    as_csv = folder / "run1.csv"
    np.savetxt(as_csv, np.concatenate(table), delimiter=",", fmt="%.12g", header=head, comments="")

    def whole(recorded: Path) -> None:
        estimate = identify(model, [CachedRecording(open_recording(recorded, names))])  # as the command reads it
        write_parameters(folder / "parameters.json", parameters_document(estimate))

    base = base_parameters(model.chain, model.layout)
    total = equations(open_recording(path, names), model, base).total
    fit = ordinary_least_squares(total)
    rows = [
        Row(
            f"62 s {kind} (62,500 samples) to certified parameters.json",
            median_seconds(lambda p=file: whole(p), 5),
            "s",
            target,
        )
        for kind, file, target in (("MCAP", path, "<= 0.8"), ("CSV", as_csv, "<= 1.0"))
    ]
    for kind in ("inertia", "pseudo_inertia"):
        conditions = feasible_set(kind, base.names, model.config)
        for name, call in (
            ("feasibility test", lambda s=conditions: feasibility_test(fit.beta, base, s)),
            ("feasibility correction", lambda s=conditions: feasibility_correction(fit.beta, base, s)),
            ("constrained least squares", lambda s=conditions: constrained_least_squares(fit, base, s)),
        ):
            rows.append(Row(f"{name}, WAM, {kind}, set-up included", 1e3 * median_seconds(call), "ms", "<= 50"))
        solver = constrained_least_squares(fit, base, conditions).solver_seconds
        rows.append(Row(f"constrained least squares, WAM, {kind}, in the solver", 1e3 * solver, "ms"))
    return rows


if __name__ == "__main__":
    main()
