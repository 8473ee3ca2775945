"""A light two-joint arm, an eye on every torque that reaches it, and a sink that keeps a run's story."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from drivers.arm import Arm, ArmDescription, Sample, StopKind
from ident_service.config.arm import ArmConfig
from ident_service.config.motion_limits import MotionLimits, motion_limits
from ident_service.excitation.described_motion import excitation
from ident_service.excitation.motion_file import Excitation
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.recordings.cycle import Cycle
from sim_backend.arm import Truth, from_config
from sim_backend.faults import Fault

Array = np.ndarray
LOOKED = 20  # cycles without torque before a run moves
PRIOR = {"Lxx1": 0.002, "Lyy1": 0.168, "Lzz1": 0.168, "lx1": -0.5, "m1": 2.0, "Ia1": 0.02}
PRIOR |= {"Lxx2": 0.001, "Lyy2": 0.084, "Lzz2": 0.084, "lx2": -0.25, "m2": 1.0, "Ia2": 0.01}
TRUTH = PRIOR | {"m1": 2.1, "lx1": -0.51, "fv1": 0.3, "fc1": 0.3, "fv2": 0.1, "fc2": 0.1}
GAINS = {"following_error": 0.2, "kp": 400.0, "kd": 40.0, "brake": True}
SHOULDER = GAINS | {"position": (-1.8, 1.8), "velocity": 2.0, "acceleration": 8.0, "jerk": 80.0, "torque": 40.0}
ELBOW = GAINS | {"position": (-2.0, 2.0), "velocity": 3.0, "acceleration": 15.0, "jerk": 150.0, "torque": 15.0}
JOINTS = {"shoulder": SHOULDER | {"home": 0.1}, "elbow": ELBOW | {"home": -0.1}}


def bench_config(**changes: Any) -> ArmConfig:
    """Two links of half a metre in a vertical plane; `changes` replace top-level sections."""
    description = {
        "format": "ident-arm",
        "version": 1,
        "name": "bench",
        "kinematics": {"dh": {"convention": "standard", "joints": {"shoulder": {"a": 0.5}, "elbow": {"a": 0.5}}}},
        "gravity": (0.0, -9.81, 0.0),
        "joints": JOINTS,
        "prior": PRIOR,
        "motions": {
            "identification": {"kind": "seeded", "seed": 3, "base_frequency": 0.8, "harmonics": 2, "periods": 1}
        },
        "driver": {"kind": "simulated", "truth": TRUTH, "encoder_resolution": 1e-5, "torque_resolution": 0.01},
    }
    return ArmConfig.model_validate(description | changes)


def bench_model(**changes: Any) -> ArmModel:
    return arm_model(bench_config(**changes))


def bench_limits() -> MotionLimits:
    return motion_limits(bench_config())


def bench_excitation() -> Excitation:
    return excitation(bench_model(), "identification")


class WatchedArm(Arm):
    """An arm that remembers what was asked of it, torques or positions, and fails where a test says so."""

    def __init__(self, inner: Arm) -> None:
        self.inner = inner
        self.clock = inner.clock
        self.torques: list[Array] = []
        self.enabled = 0
        self.stops: list[StopKind] = []
        self.before_exchange: Callable[[int], None] = lambda cycle: None
        self.after_enable: Callable[[], None] = lambda: None
        self.enable_error: BaseException | None = None
        self.stop_error: BaseException | None = None
        self.shown: Callable[[Sample], Sample] = lambda sample: sample
        self.cycle = 0  # exchanges so far

    def open(self) -> None:
        self.inner.open()
        self.clock = self.inner.clock

    def describe(self) -> ArmDescription:
        return self.inner.describe()

    def enable(self) -> None:
        self.enabled += 1
        self.inner.enable()
        if self.enable_error is not None:
            raise self.enable_error
        self.after_enable()

    def reset(self) -> None:
        self.inner.reset()

    def exchange(self, torque: Array | None) -> Sample:
        if torque is not None:
            self.torques.append(torque.copy())
        self.before_exchange(self.cycle)
        self.cycle += 1
        return self.shown(self.inner.exchange(torque))

    def exchange_position(self, position: Array) -> Sample:
        self.torques.append(position.copy())
        self.before_exchange(self.cycle)
        self.cycle += 1
        return self.shown(self.inner.exchange_position(position))

    def stop(self, kind: StopKind) -> None:
        self.stops.append(kind)
        self.inner.stop(kind)
        if self.stop_error is not None:
            raise self.stop_error

    def strike(self, fault: Any) -> None:
        """Let a fault come, now or later."""
        self.inner.faults = (fault,)

    def left_alone(self) -> None:
        """A run has ended, and whoever ran it may have died: for arms that must then stop by themselves."""

    def close(self) -> None:
        self.inner.close()


@dataclass
class Story:
    """A sink that keeps everything, and misbehaves where a test says so.

    `misbehave` is asked with the number of samples kept so far; what it returns is what `put` returns.
    """

    samples: list[dict[str, Any]] = field(default_factory=list)
    events: list[tuple[int, int, str]] = field(default_factory=list)
    misbehave: Callable[[int], bool] = lambda count: True
    at_event: Callable[[str], None] = lambda message: None
    error: str = ""

    def put(self, cycle: Cycle) -> bool:
        self.samples.append(cycle._asdict())
        return self.misbehave(len(self.samples))

    def event(self, stamp_ns: int, level: int, message: str) -> bool:
        self.at_event(message)
        self.events.append((stamp_ns, level, message))
        return True

    @property
    def states(self) -> list[str]:
        """States in the order told."""
        return [message for _, level, message in self.events if level == 20]

    @property
    def errors(self) -> list[str]:
        """Faults in the order told."""
        return [message for _, level, message in self.events if level >= 40]

    def column(self, name: str) -> Array:
        """One quantity of all samples."""
        return np.array([sample[name] for sample in self.samples])


def watched(
    faults: Sequence[Fault] = (), observer: Callable[[Truth], None] | None = None, **changes: Any
) -> WatchedArm:
    """The bench's arm, not open."""
    return WatchedArm(from_config(bench_config(**changes), faults=faults, observer=observer))
