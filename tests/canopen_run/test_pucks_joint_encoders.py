"""A cable that slips in the middle of a motion: the joint's own encoder shows it, the run ends latched and recorded."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from canopen_run_bench import SHORT, write
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from puck_run_bench import PUCK, puck_arm

from drivers.barrett.driver import BarrettArm
from ident_service.config.load import load_arm
from ident_service.errors import ArmFault
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import arm_model
from ident_service.operations.commissioning import record_motion
from ident_service.recordings.mcap_reader import McapRecording
from sim_backend.emulator.faults import DriveFault
from sim_backend.emulator.lock_step import LockStepArm

pytestmark = pytest.mark.slow  # whole runs

RATE = 250.0
SLIPS = 3.0  # s from the first request


@pytest.mark.parametrize("read", [True, False], ids=["read", "not read"])
def test_a_motion_whose_cable_slips_ends_where_an_encoder_shows_it(read: bool, tmp_path: Path) -> None:
    pucks = [PUCK | {"node": node, "joint_counts": 1 << 20 if read else None} for node in (1, 2)]
    encoders = {"pucks": pucks, "joint_encoders": [1, 2] if read else []}
    tree = puck_arm("slips", RATE, 225.0, 30.0, {"interface": "lock_step", "channel": "slips"}, **encoders)
    config = load_arm(write(tmp_path, tree | {"motions": {"identification": SHORT}}))
    # A motor that turns by 0.075 rad of its joint, in a fifth of a second, without the joint.
    slip = [DriveFault("encoder_offset", 1, at=SLIPS + k / RATE, duration=60.0, size=0.0015) for k in range(50)]
    behind, model, path = LockStepArm(config, slip), arm_model(config), tmp_path / "run.mcap"
    arm = BarrettArm(config, lambda _: [behind.link(0)])
    if not read:  # nobody knows better, and the arm is off by that much for good
        record_motion(arm, model, excitation(model, "identification"), path)
        return
    with pytest.raises(ArmFault, match="a cable slipped or broke") as caught:
        record_motion(arm, model, excitation(model, "identification"), path)
    assert caught.value.code == "transmission_slipped"
    assert "its encoder has moved" in str(caught.value)
    recorded = list(McapRecording(path).blocks())
    motors = np.concatenate([block.position for block in recorded])
    joints = encoder_positions(path)
    apart = np.abs(motors[: len(joints)] - joints).max(axis=1)
    assert len(joints) == len(motors) > SLIPS * RATE / 2
    assert apart[: len(joints) // 2].max() < 1e-3
    assert apart[-1] > 0.05


def encoder_positions(path: Path) -> np.ndarray:
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return np.array([list(one[3].position) for one in reader.iter_decoded_messages(topics=["/joint_encoders"])])
