"""The generated C against pinocchio's `rnea`: time per call. `python -m benchmarks.exports`; needs gcc.

Pinocchio is called through Python, which costs more than the recursion itself; the same call for an arm of one joint
says how much of that is the way there and back. The C functions are called from C, compiled with -O2 and nothing else.
"""

from __future__ import annotations

import statistics
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
import pinocchio as pin

from benchmarks.harness import Row, table, write
from ident_service.config.load import load_arm
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.base_parameters import base_parameters
from ident_service.model.dynamic_model import DynamicModel
from ident_service.results.export.c_header import c_header, c_prefix
from ident_service.results.export.identified_arm import IdentifiedArm

ARMS = ("planar2", "threelink", "sixaxis", "wam7_sim")
_STATES, _REPEATS = 1000, 41
_CALLS = {
    "inverse_dynamics": "q, dq, ddq",
    "rigid_dynamics": "q, dq, ddq",
    "gravity": "q",
    "mass_matrix": "q",
}
_MAIN = """\
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#include "arm.h"
static double states[STATES][3][NAME_JOINTS];
int main(void)
{
    volatile double kept = 0.0;
    int r, s, i, j;
    srand(1);
    for (s = 0; s < STATES; ++s)
        for (i = 0; i < 3; ++i)
            for (j = 0; j < NAME_JOINTS; ++j)
                states[s][i][j] = 6.0 * rand() / (double)RAND_MAX - 3.0;
    for (r = 0; r < REPEATS; ++r) {
        struct timespec begin, end;
        double sum = 0.0;
        clock_gettime(CLOCK_MONOTONIC, &begin);
        for (s = 0; s < STATES; ++s) {
            const double *q = states[s][0], *dq = states[s][1], *ddq = states[s][2];
            double out[NAME_JOINTS * NAME_JOINTS];
            (void)dq;
            (void)ddq;
            NAME_CALL(ARGUMENTS, out);
            for (j = 0; j < NAME_JOINTS; ++j)
                sum += out[j];
        }
        clock_gettime(CLOCK_MONOTONIC, &end);
        kept += sum;
        sum = (double)(end.tv_sec - begin.tv_sec) * 1e9 + (double)(end.tv_nsec - begin.tv_nsec);
        printf("%.17g\\n", sum / STATES);
    }
    return kept != kept;
}
"""


def measure() -> list[Row]:
    """Median time per call [ns] of every function, for every simulated arm."""
    rows = [Row("pinocchio rnea from Python, one joint (the way there and back)", _pinocchio(_one_joint()), "ns")]
    for name in ARMS:
        model = arm_model(load_arm(name))
        truth = model.layout.vector(model.config.driver.truth)  # type: ignore[union-attr, arg-type]
        rows.append(Row(f"{name}: pinocchio rnea from Python", _pinocchio(DynamicModel(model, truth).model), "ns"))
        rows += _generated(name, model, truth)
    return rows


def _pinocchio(model: pin.Model) -> float:
    data = model.createData()
    rng = np.random.default_rng(1)
    states = [tuple(rng.uniform(-3.0, 3.0, size=(3, model.nv))) for _ in range(_STATES)]
    times = []
    for _ in range(_REPEATS):
        begin = time.perf_counter_ns()
        for q, dq, ddq in states:
            pin.rnea(model, data, q, dq, ddq)
        times.append((time.perf_counter_ns() - begin) / _STATES)
    return statistics.median(times)


def _one_joint() -> pin.Model:
    model = pin.Model()
    index = model.addJoint(0, pin.JointModelRZ(), pin.SE3.Identity(), "j")
    model.appendBodyToJoint(index, pin.Inertia.Random(), pin.SE3.Identity())
    return model


def _generated(name: str, model: ArmModel, delta: np.ndarray) -> list[Row]:
    base = base_parameters(model.chain, model.layout)
    unknown = (None,) * base.size
    arm = IdentifiedArm(model, base, base.K @ delta, delta, unknown, ("",) * base.size, "0" * 64)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        text = c_header(arm)
        (Path(folder) / "arm.h").write_text(text, encoding="utf-8")
        for call, arguments in _CALLS.items():
            main = _MAIN.replace("CALL(ARGUMENTS", f"{call}({arguments}").replace("NAME", c_prefix(arm))
            main = main.replace("STATES", str(_STATES)).replace("REPEATS", str(_REPEATS))
            (Path(folder) / "main.c").write_text(main, encoding="utf-8")
            command = ["gcc", "-std=c99", "-Wall", "-Wextra", "-Werror", "-O2", "-o", "main", "main.c", "-lm"]
            subprocess.run(command, cwd=folder, check=True)
            done = subprocess.run([f"{folder}/main"], capture_output=True, text=True, check=True)
            rows.append(Row(f"{name}: C {call}", statistics.median(map(float, done.stdout.split())), "ns"))
    return rows


def main() -> None:
    rows = measure()
    print(table(rows))
    print(f"written to {write(rows, Path(__file__).parent / 'results', 'exports')}")


if __name__ == "__main__":
    main()
