"""Convert a recording of motor positions and torques, or of motor torques alone, to the joint side.

`q = C^-1 diag(1/r) q_motor + q0`, `dq = C^-1 diag(1/r) dq_motor`, `tau = C^T diag(r) tau_motor`: what the motors put
in, the joints give out (`config/recording.py` has the symbols). Losses in the gears are the joints' friction.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ident_service.config.recording import Transmission
from ident_service.errors import RecordingError
from ident_service.recordings.recording import BLOCK_SAMPLES, Block, Matrix, Recording


class JointSideRecording:
    """Convert another recording's blocks from the motor side to the joint side.

    Attributes are the other recording's.
    """

    def __init__(
        self, motors: Recording, transmission: Transmission, *, positions: bool = True, torques: bool = True
    ) -> None:
        """Wrap the motors' recording.

        Args:
            motors: one column a motor, position [rad] and torque [N m] at the motor.
            transmission: from the motors to the joints.
            positions: whether positions and velocities are the motors'; the joints' otherwise.
            torques: whether torques are the motors'; the joints' otherwise.

        Raises:
            RecordingError: not as many columns as the transmission has ratios.
        """
        if motors.joints != len(transmission.ratios):
            raise RecordingError(
                motors.path, f"has {motors.joints} motors but the transmission has {len(transmission.ratios)} ratios"
            )
        self.path = motors.path
        self.sha256 = motors.sha256
        self.joint_names = motors.joint_names
        self.joints = motors.joints
        self.torque_held = motors.torque_held
        self.torn = motors.torn
        self._motors = motors
        self._positions, self._torques = positions, torques
        self._ratios = np.array(transmission.ratios)
        self._offsets = np.array(transmission.offsets or np.zeros(self.joints))
        self._coupling = None if transmission.coupling is None else np.array(transmission.coupling)

    def blocks(self, samples: int = BLOCK_SAMPLES) -> Iterator[Block]:
        """Read the samples in order, converted to the joint side; see `Recording.blocks`."""
        for block in self._motors.blocks(samples):
            position, velocity, torque = block.position, block.velocity, block.torque
            if self._positions:
                position = self._turned(position) + self._offsets
                velocity = None if velocity is None else self._turned(velocity)
            if self._torques:
                torque = torque * self._ratios
                torque = torque if self._coupling is None else torque @ self._coupling
            for array in (position, torque, velocity):
                if array is not None:
                    array.flags.writeable = False
            yield Block(block.stamp_ns, position, torque, velocity, block.repeats, block.skipped)

    def _turned(self, motors: Matrix) -> Matrix:
        """Convert motor angles to joint angles, shape (samples, joints)."""
        turns: Matrix = motors / self._ratios
        return turns if self._coupling is None else np.linalg.solve(self._coupling, turns.T).T
