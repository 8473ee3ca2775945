"""kill -9 of anybody at any time: the arm rests, nothing is left, what was recorded is read, the arm runs again.

Some kills in virtual time for every change; random ones, seventy-two of them, by `make campaign`.
"""

from __future__ import annotations

import numpy as np
import pytest
from kill_bench import REAL, SLOW, Kill, Lane, Outcome, kills

from sim_backend.plant_status import PlantState

LOST = 0.2  # s of samples that may be lost with the recorder
# Share of the velocity limit. The WAM has no brakes: its idle drives resist like friction, and a joint sinks as fast as
# gravity drives it against them, the more slowly the nearer it is to hanging down. After a minute it at most creeps.
CREEP = 0.02


@pytest.fixture(scope="module")
def virtual(tmp_path_factory: pytest.TempPathFactory) -> Lane:
    return Lane(tmp_path_factory.mktemp("kills") / "virtual", "planar2", "time: virtual")


@pytest.fixture(scope="module")
def real(tmp_path_factory: pytest.TempPathFactory) -> Lane:
    return Lane(tmp_path_factory.mktemp("kills") / "real", "planar2", REAL, SLOW)


@pytest.fixture(scope="module")
def wam(tmp_path_factory: pytest.TempPathFactory) -> Lane:
    return Lane(tmp_path_factory.mktemp("kills") / "wam", "wam7_sim", "time: virtual")


def noted(kill: Kill, outcome: Outcome) -> Outcome:
    """Prints the figures of a kill, for `pytest -rP`."""
    status = outcome.status
    rest = "no plant yet"
    if status is not None:
        speed = np.abs(status.velocity).max()
        rest = f"{status.state.name} after {status.silent_time:.3f} s at {speed:.2e}"
    print(f"kill: {kill} moved={outcome.moved} samples={outcome.samples} unsaved={outcome.unsaved:.3f} {rest}")
    return outcome


@pytest.mark.slow
@pytest.mark.parametrize("kill", [kills(1, 9, 0.5)[index] for index in (1, 2, 6)], ids=str)
def test_some_kills(kill: Kill, virtual: Lane, capsys: pytest.CaptureFixture[str]) -> None:
    outcome = noted(kill, virtual.kill(kill, capsys))
    assert outcome.status is None or outcome.status.came_to_rest


@pytest.mark.campaign
@pytest.mark.slow
def test_an_arm_whose_runs_were_killed_runs(virtual: Lane) -> None:
    virtual.runs()


@pytest.mark.campaign
@pytest.mark.parametrize("kill", kills(11, 36, 1.0), ids=str)
def test_kills_in_virtual_time(kill: Kill, virtual: Lane, capsys: pytest.CaptureFixture[str]) -> None:
    outcome = noted(kill, virtual.kill(kill, capsys))
    assert outcome.status is None or outcome.status.came_to_rest


@pytest.mark.campaign
@pytest.mark.parametrize("kill", kills(12, 27, 3.0), ids=str)
def test_kills_in_real_time(kill: Kill, real: Lane, capsys: pytest.CaptureFixture[str]) -> None:
    outcome = noted(kill, real.kill(kill, capsys))
    assert outcome.status is None or outcome.status.came_to_rest
    if kill.victim == "recorder":
        assert outcome.unsaved <= LOST


@pytest.mark.campaign
@pytest.mark.parametrize("kill", kills(13, 9, 2.0), ids=str)
def test_kills_of_an_arm_without_brakes(kill: Kill, wam: Lane, capsys: pytest.CaptureFixture[str]) -> None:
    status = noted(kill, wam.kill(kill, capsys)).status
    if status is not None and not status.came_to_rest:
        assert status.state is PlantState.ENDED_MOVING
        limits = np.array([joint.velocity for joint in wam.config.joints.values()])
        assert (np.abs(status.velocity) <= CREEP * limits).all()


@pytest.mark.campaign
def test_arms_whose_runs_were_killed_run(virtual: Lane, real: Lane, wam: Lane) -> None:
    for lane in (virtual, real, wam):
        lane.runs()
