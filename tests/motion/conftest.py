"""Open arms for whole runs, closed afterwards."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from motion_bench import WatchedArm, watched
from run_bench import RATE, Bench, Healthy

from sim_backend.arm import Truth
from sim_backend.faults import Fault

Array = np.ndarray


@pytest.fixture
def make() -> Iterator[Callable[..., Bench]]:
    arms: list[WatchedArm] = []

    def build(*faults: Fault, **changes: Any) -> Bench:
        truth: list[Truth] = []
        arm = watched(faults, truth.append, **RATE | changes)
        arm.open()
        arms.append(arm)
        return Bench(arm, truth)

    yield build
    for arm in arms:
        arm.close()


@pytest.fixture(scope="session")
def healthy() -> Healthy:
    """An undisturbed run of the bench, for all to read and none to change."""
    truth: list[Truth] = []
    with watched((), truth.append, **RATE) as arm:
        bench = Bench(arm, truth)
        return Healthy(bench, bench.run())
