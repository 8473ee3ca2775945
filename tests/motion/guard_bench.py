"""A guard that is shown one position after another, and how its faults are read."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from motion_bench import bench_limits

from drivers.arm import Sample
from ident_service.motion.faults import FAULTS, Fault, Reaction
from ident_service.motion.safety_monitor import JUMP, SafetyMonitor
from ident_service.motion.trajectory import rest

Array = np.ndarray
NAMES = ("shoulder", "elbow")
LIMITS = bench_limits()
PERIOD = 1e-3
HOME = np.array([0.1, -0.1])
STILL = np.zeros(2)
WINDOW = JUMP * LIMITS.velocity * PERIOD
OFF, QUICK, LOWER = Reaction.TORQUE_OFF, Reaction.QUICK_STOP, Reaction.DAMPED_LOWERING
STOP, WARN = Reaction.CONTROLLED_STOP, Reaction.WARN


def unit(joint: int) -> Array:
    return np.eye(2)[joint]


class Bench:
    """A guard that is shown one position after another."""

    def __init__(self, position: Array = HOME, **options: Any) -> None:
        self.guard = SafetyMonitor(NAMES, LIMITS, PERIOD, position, **options)
        self.cycle = 0

    def see(
        self,
        position: Array,
        reference: Array | None = None,
        velocity: Array = STILL,
        valid: tuple[bool, bool] = (True, True),
        correction: Array = STILL,
        answer: Array | None = None,
        measured: Array | None = None,
        elapsed: float | None = None,
        known: bool = True,
        unexplained: Array = STILL,
        **other: Any,
    ) -> tuple[list[bool], Fault | None]:
        flags = np.array(valid)
        age = np.where(flags, 0, 1)
        sample = Sample(self.cycle, self.cycle * 1_000_000, np.array(position), measured, np.zeros(2), flags, age)
        sample = replace(sample, **other)
        self.cycle += 1
        setpoint = rest(position if reference is None else reference)
        usable, fault = self.guard.check_feedback(
            sample,
            setpoint,
            velocity,
            correction,
            answer,
            elapsed,
            elapsed_is_exact=known,
            unexplained_torque=unexplained,
        )
        return usable.tolist(), fault


def is_fault(fault: Fault | None, code: str, joint: int | None = None) -> str:
    """Check a fault's code, reaction and joint; its code."""
    assert fault is not None
    assert fault.code == code
    assert fault.reaction is FAULTS[code].reaction
    if joint is not None:
        assert fault.message.startswith(f"{NAMES[joint]}: ")
    return code
