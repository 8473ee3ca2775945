"""What one control cycle computes: guard, control law and ring for the seven joints of the WAM, without an arm.

Two clocks: the wall's, which counts whatever else the machine does meanwhile, and this thread's own computing time.
"""

from __future__ import annotations

import gc
import time
from pathlib import Path

import numpy as np

from benchmarks.harness import Row, table, write
from drivers.arm import Sample
from ident_service.config.load import load_arm
from ident_service.config.motion_limits import motion_limits
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.collision import Contact
from ident_service.model.pinocchio_models import InverseDynamics
from ident_service.motion.controller import ComputedTorque
from ident_service.motion.cycle_timing import Deadlines
from ident_service.motion.encoder_observer import frozen_encoder_observer
from ident_service.motion.safety_monitor import SafetyMonitor
from ident_service.motion.trajectory import PathReference
from ident_service.recordings.cycle import Cycle
from ident_service.recordings.ring_buffer import RingWriter, create_ring

CYCLES = 20_000  # one period of the motion, which is played twice
WARM_UP = 1_000
MEDIAN, TAIL = "< 120", "< 300"


def measure(model: ArmModel) -> list[Row]:
    """Times along the shipped motion; samples are where the reference is, in steps of the encoders."""
    limits, prior, period = motion_limits(model.config), model.prior, 1e-3
    assert prior is not None  # noqa: S101  # the shipped WAM has one
    reference = PathReference(excitation(model, "identification").path)
    steps = np.array([3.65e-5, 5.4e-5, 5.4e-5, 8.5e-5, 7.9e-5, 7.9e-5, 1.03e-4])
    home = reference.at(0.0).position
    dynamics = InverseDynamics(model.chain, model.layout, prior)
    owed = frozen_encoder_observer(dynamics, model, limits, period, steps)
    guard = SafetyMonitor(model.chain.names, limits, period, home, contact=Contact(model), encoder_observer=owed)
    control = ComputedTorque(dynamics, limits, period, 30.0, home)
    deadlines = Deadlines(guard.findings, period)
    valid, age = np.ones(7, dtype=bool), np.zeros(7, dtype=np.int64)
    wanted = control.torque(home, valid, reference.at(0.0))
    torque, _ = guard.limit_torque(wanted)
    rows: list[Row] = []
    fd = create_ring(7)
    ring = RingWriter(fd)
    gc.collect()
    gc.freeze()
    for part, clock in (("wall", time.perf_counter_ns), ("thread", time.thread_time_ns)):
        spent = np.zeros((CYCLES, 4))
        for cycle in range(CYCLES):
            stamp_ns = len(rows) * CYCLES * 1_000_000 + cycle * 1_000_000
            begin = clock()
            setpoint = reference.at(cycle * period)
            middle = clock()
            position = np.rint(setpoint.position / steps) * steps
            sample = Sample(cycle, stamp_ns, position, None, torque, valid, age, 0, (1,) * 7)
            start = clock()
            deadlines.judge_cycle(stamp_ns, stamp_ns)
            usable, _ = guard.check_feedback(
                sample, setpoint, control.velocity, control.correction, control.feedback_acceleration
            )
            seen = clock()
            wanted = control.torque(position, usable, setpoint)
            law = clock()
            torque, _ = guard.limit_torque(wanted)
            judged = clock()
            ring.put(
                Cycle(
                    *(stamp_ns, position, None, torque, setpoint.position, setpoint.velocity),
                    *(cycle, 0, 0, valid, age, 0),
                )
            )
            spent[cycle] = middle - begin, seen - start + judged - law, law - seen, clock() - judged
        for name, times in (
            ("reference", spent[:, 0]),
            ("guard", spent[:, 1]),
            ("control law", spent[:, 2]),
            ("ring", spent[:, 3]),
            ("guard, control law and ring", spent[:, 1:].sum(axis=1)),
        ):
            kept, whole = times[WARM_UP:] * 1e-3, name.startswith("guard, ")
            rows.append(
                Row(f"{name}, seven joints, {part}, median", float(np.median(kept)), "us", MEDIAN if whole else None)
            )
            rows.append(
                Row(
                    f"{name}, seven joints, {part}, 99.9 %",
                    float(np.quantile(kept, 0.999)),
                    "us",
                    TAIL if whole else None,
                )
            )
    gc.unfreeze()
    return rows


def main() -> None:
    rows = measure(arm_model(load_arm("wam7_sim")))
    print(table(rows))
    print(f"written to {write(rows, Path(__file__).parent / 'results', 'cycle')}")


if __name__ == "__main__":
    main()
