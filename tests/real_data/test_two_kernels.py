"""Two processors give the same answer: OpenBLAS computes with the instructions of one or of the other.

Its kernels for AVX (Sandybridge), AVX2 (Haswell) and AVX-512 (SkylakeX) round differently. What a report prints must
not: parameters, deviations, margins and errors to five digits, link values behind them to 2e-4, verdicts, active
constraints, and whether the certificate proves them.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline

from benchmarks.real_data import CASES
from ident_service.config.load import load_arm
from ident_service.model.arm_model import arm_model
from ident_service.model.regressor import joint_regressor

pytestmark = pytest.mark.slow

HERE = Path(__file__).resolve().parent
# By instruction set; OpenBLAS takes a kernel by name and ends the process where the processor lacks its instructions.
KERNELS = {"avx": "Sandybridge", "avx2": "Haswell", "avx512f": "SkylakeX"}
PRINTED = {"links": 2e-4, "margin": 2e-5}  # relative: the fourth digit; of all others half a unit of the fifth


def told(kernels: str, *words: str) -> dict[str, Any]:
    environment = {**os.environ, "OPENBLAS_CORETYPE": kernels, "PYTHONPATH": f"{HERE.parent}:{HERE.parents[1]}"}
    probe = [sys.executable, str(HERE / "kernel_probe.py"), *words]
    done = subprocess.run(probe, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    answer: dict[str, Any] = json.loads(done.stdout)
    assert answer["kernels"] == [kernels]
    return answer


def assert_same(*words: str) -> None:
    one, other = (told(kernels, *words) for kernels in two_kernels())
    assert one["words"] == other["words"]
    assert one["words"]["certificate"] == "feasible"
    for name, numbers in one["numbers"].items():
        size = float(np.max(np.abs(numbers)))
        np.testing.assert_allclose(
            other["numbers"][name], numbers, rtol=PRINTED.get(name, 5e-6), atol=1e-7 * size, err_msg=name
        )


def two_kernels() -> list[str]:
    """Return the kernels of the two newest instruction sets of this processor."""
    flags = set(Path("/proc/cpuinfo").read_text().split())
    known = [kernels for flag, kernels in KERNELS.items() if flag in flags]
    if len(known) < 2:
        pytest.skip("this processor has no AVX2: only one kind of kernel runs here")
    return known[-2:]


NIGHT = ("tx40", "kuka_lwr4", "ur10")  # beside the arm of the demo


@pytest.mark.usefixtures("shared")
@pytest.mark.parametrize(
    "case",
    [pytest.param(case, id=case.arm, marks=pytest.mark.campaign if case.arm in NIGHT else ()) for case in CASES],
)
def test_a_real_arm_has_the_same_parameters_on_two_processors(case: Any) -> None:
    assert_same(case.arm)


def test_the_arm_of_the_demo_has_the_same_parameters_on_two_processors(wam7_data: Path, tmp_path: Path) -> None:
    config = load_arm("wam7_sim")
    model = arm_model(config)
    # The published reference, 1 kHz: every fourth sample is enough.
    reference = np.loadtxt(wam7_data / "traj1_reference.csv.gz", delimiter=",", skiprows=1)[::4]
    time = np.arange(len(reference)) / 250.0
    path = make_interp_spline(time, reference, k=5)
    q, dq, ddq = (path.derivative(order)(time) if order else reference for order in range(3))
    truth = model.layout.vector(config.driver.truth)  # type: ignore[union-attr, arg-type]
    torque = np.einsum("jcs,c->sj", joint_regressor(model.chain, model.layout, q, dq, ddq), truth)
    torque += np.random.default_rng(1).normal(size=q.shape) * config.driver.torque_noise  # type: ignore[union-attr]
    header = ",".join(["t", *(f"q{k}" for k in range(1, 8)), *(f"tau{k}" for k in range(1, 8))])
    recording = tmp_path / "demo.csv"
    np.savetxt(recording, np.column_stack([time, q, torque]), delimiter=",", header=header, comments="", fmt="%.9g")
    assert_same("wam7_sim", str(recording))
