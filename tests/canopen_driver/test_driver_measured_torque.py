"""The torque that drives measure (6077h): at the joints, held against what they were told, and recorded beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.emulated_arms import EDS, weightless_config

from drivers.arm import Sample
from drivers.canopen.bus_load import budget
from drivers.canopen.driver import CanopenArm
from ident_service.config.arm import ArmConfig
from ident_service.config.canopen import CanopenDriver, disagreements
from ident_service.errors import RecordingError
from ident_service.recordings.adapters import MeasuredRecording
from ident_service.recordings.cycle import Cycle
from ident_service.recordings.mcap_reader import McapRecording
from ident_service.recordings.mcap_writer import RecordingWriter
from ident_service.recordings.open import open_recording
from ident_service.recordings.recording import join
from sim_backend.emulator.faults import parse_fault
from sim_backend.emulator.lock_step import LockStepArm
from sim_backend.machine import Truth

JOINTS = ("turn", "slide")
PUSH = np.array([3.0, 1.0])
STEP = 1e-3  # N m, a thousandth of the rated torque
# A differential: each motor turns both joints.
COUPLED = {"ratios": [2.0, -2.0], "coupling": [[1.0, -0.5], [1.0, 0.5]], "drive_terms": "joints"}


def config(measured: str | None, *, coupled: bool = False, **driver: Any) -> ArmConfig:
    found = weightless_config(measured_torque=measured, torque_deadline=1.0, **driver)
    if not coupled:
        return found
    return ArmConfig.model_validate(found.model_dump(mode="json", by_alias=True) | {"transmission": COUPLED})


def pushed(config: ArmConfig, fault: str = "", cycles: int = 200) -> tuple[list[Sample], list[Truth]]:
    """Samples and truths of an arm that is pushed to and fro, so slowly that it stays within its drives' limits."""
    behind = LockStepArm(config)
    truths: list[Truth] = []
    with CanopenArm(config, lambda _: [behind.link(0)]) as arm:
        arm.enable()
        if fault:
            behind.inject(parse_fault(fault, JOINTS))
        behind.emulator.observer = truths.append
        return [arm.exchange(PUSH * np.sin(0.05 * k)) for k in range(cycles)], truths


@pytest.mark.parametrize("coupled", [False, True])
def test_reported_in_every_cycle_it_is_what_acted_until_the_stamp(coupled: bool) -> None:
    samples, truths = pushed(config("cyclic", coupled=coupled))
    measured = np.array([sample.measured_torque for sample in samples])
    acted = np.array([truth.torque for truth in truths])  # from the stamp of the same cycle on
    np.testing.assert_allclose(measured[1:], acted[: len(samples) - 1], atol=1e-9)
    differences = np.array([sample.torque_difference for sample in samples])
    np.testing.assert_allclose(differences, 0.0, atol=1e-12)


def test_reported_with_the_status_it_comes_now_and_then() -> None:
    samples, truths = pushed(config(None))
    assert samples[-1].measured_torque is not None
    measured = np.array([np.full(2, np.nan) if s.measured_torque is None else s.measured_torque for s in samples])
    there = np.isfinite(measured)
    assert 2 <= there[:, 0].sum() <= 20  # on change, at most every 50 ms
    acted = np.array([truth.torque for truth in truths])
    for joint in range(2):
        rows = np.flatnonzero(there[:, joint])
        near = [np.abs(acted[max(row - 1, 0) : row + 1, joint] - measured[row, joint]).min() for row in rows]
        assert max(near) < STEP


@pytest.mark.parametrize("measured", ["cyclic", "status"])
def test_a_drive_that_applies_a_share_is_seen(measured: str) -> None:
    samples, _ = pushed(config(measured), "torque_fraction joint=turn size=0.5")
    differences = [s.torque_difference for s in samples if s.torque_difference is not None]
    largest = np.abs(differences).max(axis=0)
    assert 0.3 * PUSH[0] < largest[0] <= 0.5 * PUSH[0]  # of what the window leaves of a torque that changes
    assert largest[1] < 2 * STEP


def test_a_single_report_is_not_believed() -> None:
    samples, _ = pushed(config("cyclic"), "torque_fraction joint=turn size=0 at=0.05 duration=0.002")
    assert all(s.torque_difference is not None and np.abs(s.torque_difference).max() < 2 * STEP for s in samples)


def test_without_measurement_nothing_is_reported() -> None:
    for found in (config("none"), config(None, eds={"name": "bare.eds", "text": EDS.replace("[6077]", "[5F77]")})):
        assert isinstance(found.driver, CanopenDriver)
        assert found.driver.torque_reports == "none"
        samples, _ = pushed(found, cycles=20)
        assert {(s.measured_torque, s.torque_difference) for s in samples} == {(None, None)}


def test_drives_without_the_entry_are_reported() -> None:
    found = config("cyclic", eds={"name": "bare.eds", "text": EDS.replace("[6077]", "[5F77]")})
    assert isinstance(found.driver, CanopenDriver)
    (((where, what),)) = list(disagreements(found.driver, found.transmission, JOINTS, 500.0))
    assert where == ("driver", "measured_torque")
    assert "bare.eds has no 6077h" in what


def test_what_it_costs_is_in_the_budget() -> None:
    loads = {}
    for measured in ("none", "status", "cyclic"):
        driver = config(measured).driver
        assert isinstance(driver, CanopenDriver)
        (bus,) = budget(driver, 500.0).buses
        loads[measured] = bus.load.worst
    # Two bytes of each of two positions, 500 times a second: 20 bits with stuffing, each.
    assert loads["cyclic"] - loads["none"] == pytest.approx(2 * 20 * 500 / 1e6, abs=1e-3)
    assert loads["none"] < loads["status"] < loads["cyclic"]


def recorded(path: Path, samples: list[Sample]) -> Path:
    with RecordingWriter(path, JOINTS, "<robot/>", 10**18) as writer:
        for s in samples:
            writer.sample(
                Cycle(
                    *(s.stamp_ns, s.position, None, s.torque, s.position, s.position),
                    *(s.cycle, 0, 0, s.valid, s.age, s.lost, s.measured_torque),
                )
            )
    return path


def torques(path: Path, torque: Any) -> tuple[np.ndarray, np.ndarray]:
    block = join(list(open_recording(path, JOINTS, torque=torque).blocks(17)))
    return block.stamp_ns, block.torque


def test_identification_has_the_torque_that_really_acted(tmp_path: Path) -> None:
    samples, truths = pushed(config("cyclic"), "torque_fraction size=0.5")
    path = recorded(tmp_path / "run.mcap", samples)
    truth = {truth.stamp_ns: truth.torque for truth in truths}
    stamps, measured = torques(path, "measured")
    assert len(stamps) == len(samples) - 1  # nobody has told yet what acts after the last one
    np.testing.assert_allclose(measured, [truth[stamp] for stamp in stamps.tolist()], atol=STEP)
    stamps, commanded = torques(path, "commanded")
    assert len(stamps) == len(samples)
    np.testing.assert_array_equal(commanded, [sample.torque for sample in samples])
    np.testing.assert_array_equal(torques(path, None)[1], measured)


def test_a_sample_whose_torque_was_lost_is_left_out(tmp_path: Path) -> None:
    samples, _ = pushed(config("cyclic"), "lost_feedback joint=slide at=0.2")
    path = recorded(tmp_path / "run.mcap", samples)
    (lost,) = [k for k, s in enumerate(samples) if s.measured_torque is not None and np.isnan(s.measured_torque[1])]
    stamps, _ = torques(path, "measured")
    assert {s.stamp_ns for s in samples[:-1]} - set(stamps.tolist()) == {samples[lost - 1].stamp_ns}


def test_reports_now_and_then_are_not_identified_from(tmp_path: Path) -> None:
    samples, _ = pushed(config("status"))
    path = recorded(tmp_path / "run.mcap", samples)
    np.testing.assert_array_equal(torques(path, None)[1], [sample.torque for sample in samples])
    with pytest.raises(RecordingError, match=r"in \d+ % of the samples.*measured_torque: cyclic"):
        torques(path, "measured")


def test_a_recording_without_measured_torques_is_read_as_before(tmp_path: Path) -> None:
    samples, _ = pushed(config("none"), cycles=20)
    path = recorded(tmp_path / "run.mcap", samples)
    assert MeasuredRecording(McapRecording(path)).share == 0.0
    np.testing.assert_array_equal(torques(path, None)[1], [sample.torque for sample in samples])
    with pytest.raises(RecordingError, match="0 % of the samples"):
        torques(path, "measured")
