"""A light two-joint arm for preflight, arms with one defect each, and what preflight makes of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import timedelta
from typing import Any

import numpy as np
import pytest
from motion.motion_bench import JOINTS, TRUTH, bench_config

from drivers.arm import Arm, ArmDescription, Sample, StopKind
from drivers.clock import VirtualClock
from ident_service.config.arm import ArmConfig
from ident_service.errors import DriverError
from ident_service.excitation.described_motion import excitation
from ident_service.excitation.motion_file import Excitation
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.motion.ticket import Check, Ticket, Verdict
from ident_service.preflight.preflight import preflight
from sim_backend.arm import SimulatedArm, from_config
from sim_backend.faults import Fault

Array = np.ndarray
NAMES = ("shoulder", "elbow")
LIMIT = np.array([40.0, 15.0])
FOREVER = 10**7


def flight_config(**changes: Any) -> ArmConfig:
    """The arm of the motion tests at 500 Hz with coarser encoders; `changes` replace top-level sections."""
    driver = {"kind": "simulated", "truth": TRUTH, "encoder_resolution": 2e-5, "torque_resolution": 0.01}
    return bench_config(**({"control": {"rate": 500.0}, "driver": driver} | changes))


def joint_changes(joint: str, **changes: Any) -> dict[str, Any]:
    """The section `joints` with other values for one of them."""
    return JOINTS | {joint: JOINTS[joint] | changes}


class FlightArm(Arm):
    """An arm that remembers what was asked of it, whose bus a test can bend, and that ends torque-free."""

    def __init__(self, inner: SimulatedArm) -> None:
        self.inner = inner
        self.clock = inner.clock
        self.torques: list[Array] = []
        self.calls: list[str] = []
        self.told: Callable[[Array], Array] = lambda torque: torque
        self.shown: Callable[[Sample], Sample] = lambda sample: sample
        self.description: Callable[[ArmDescription], ArmDescription] = lambda description: description

    def open(self) -> None:
        self.calls.append("open")
        self.inner.open()

    def describe(self) -> ArmDescription:
        return self.description(self.inner.describe())

    def enable(self) -> None:
        self.calls.append("enable")
        self.inner.enable()

    def reset(self) -> None:
        self.calls.append("reset")
        self.inner.reset()

    def exchange(self, torque: Array | None) -> Sample:
        if torque is None:
            sample = self.inner.exchange(None)
        else:
            self.torques.append(torque.copy())
            sample = replace(self.inner.exchange(self.told(torque)), torque=torque.copy())
        return self.shown(sample)

    def stop(self, kind: StopKind) -> None:
        self.calls.append("stop")
        self.inner.stop(kind)

    def close(self) -> None:
        self.calls.append("close")
        self.inner.close()


@dataclass
class Flight:
    """One preflight on one arm."""

    faults: tuple[Fault, ...] = ()
    changes: dict[str, Any] = field(default_factory=dict)
    clock: VirtualClock = field(default_factory=VirtualClock)
    typed: str = "bench"
    questions: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.model: ArmModel = arm_model(flight_config(**self.changes))
        self.motion: Excitation = excitation(self.model, "identification")
        self.arm = FlightArm(from_config(self.model.config, faults=self.faults))

    def confirm(self, question: str) -> str:
        assert "enable" not in self.arm.calls, "asked only when the arm was energised"
        self.questions.append(question)
        return self.typed

    def ticket(self, **options: Any) -> Ticket:
        """Check; whatever comes of it, the arm is closed without torque, and no torque was too large."""
        try:
            return preflight(
                self.arm, self.model, self.motion, confirm=self.confirm, clock=self.clock,
                **{"idle_seconds": 0.2} | options,
            )  # fmt: skip
        finally:
            assert all((np.abs(torque) <= LIMIT).all() for torque in self.arm.torques)
            if "open" in self.arm.calls:
                assert self.arm.calls[-1] == "close"
                with pytest.raises(DriverError, match="not open"):
                    self.arm.inner.exchange(None)
                self.arm.inner.faults = ()
                self.arm.inner.open()
                np.testing.assert_array_equal(self.arm.inner.exchange(None).torque, 0.0)
                self.arm.inner.close()


@dataclass
class Flown:
    """A preflight that is over.

    Attributes:
        flight: what was checked.
        ticket: what came of it.
        told: codes of the checks in the order told.
        seen: positions of all samples [rad].
    """

    flight: Flight
    ticket: Ticket = field(init=False)
    told: list[str] = field(default_factory=list)
    seen: list[np.ndarray] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.flight.arm.shown = lambda sample: self.seen.append(sample.position) or sample
        self.ticket = self.flight.ticket(
            on_check=lambda check: self.told.append(check.code), validity=timedelta(minutes=3)
        )


def check_of(ticket: Ticket, code: str) -> Check:
    (found,) = [check for check in ticket.checks if check.code == code]
    return found


def verdicts(ticket: Ticket) -> dict[str, Verdict]:
    return {check.code: check.verdict for check in ticket.checks}


def only_failure(ticket: Ticket, code: str) -> Check:
    """The check that failed, when it is the only one."""
    assert [check.code for check in ticket.checks if check.verdict is Verdict.FAILED] == [code]
    assert ticket.verdict is Verdict.FAILED
    return check_of(ticket, code)
