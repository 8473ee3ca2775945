"""Simulate the arm behind emulated motors: the plant in the coordinates of its motors.

`q_motor = J (q - q0)` with `J = diag(r) C`, hence `dq_motor = J dq`, and since gears lose nothing here,
`tau = J^T tau_motor`. A motor's braking `b_i` is felt by the joints as `J^T diag(b) J`, which couples the joints of a
differential. (`config/recording.py` has the symbols.)

This is written apart from the driver's conversion, so that one can be checked against the other.

Between two instants at which something changes, motors do the same, and the plant moves in one step; a longer silence
is divided into steps near the nominal period, between which `watch` is called, so that whoever limits torques by
position and speed can. A step of exactly the nominal period is the simulated arm's. The arm is supported until all
motors are powered and one of them has been given torque, or holds a position: drives are enabled with no torque.

In real time cycles come a little early or late. There the plant may be `slack_ns` away from the time it is asked for,
its motors are where their speeds have brought them by then, and its steps stay nominal, so that `prepare` can compute
the next one before it is due.
"""

from __future__ import annotations

from collections.abc import Callable
from math import ceil
from operator import is_

import numpy as np

from drivers.arm import Vector
from ident_service.config.recording import Transmission
from ident_service.errors import DriverError
from sim_backend.emulator.motor import Motor, Power
from sim_backend.machine import Truth
from sim_backend.plant import Plant, PlantState


class Gears:
    """Represent the gears of one arm.

    Attributes:
        matrix: J, shape (motors, joints), read-only.
        ratios: r, shape (motors,), read-only.
    """

    def __init__(self, transmission: Transmission, joints: int) -> None:
        """Take the gears from an arm's description.

        Args:
            transmission: transmission section of the configuration.
            joints: of the arm.

        Raises:
            DriverError: not one motor a joint.
        """
        if len(transmission.ratios) != joints:
            raise DriverError(f"{len(transmission.ratios)} ratios in transmission, but the arm has {joints} joints")
        coupling = np.eye(joints) if transmission.coupling is None else np.array(transmission.coupling)
        self.ratios: Vector = np.array(transmission.ratios)
        self.matrix: Vector = self.ratios[:, None] * coupling
        self._offsets: Vector = np.zeros(joints) if transmission.offsets is None else np.array(transmission.offsets)
        self._inverse = np.linalg.inv(self.matrix)
        self.ratios.setflags(write=False)
        self.matrix.setflags(write=False)

    def motor_position(self, position: Vector) -> Vector:
        """Return the motor angles [rad] of joint positions [rad or m], shape (motors,)."""
        return np.asarray(self.matrix @ (position - self._offsets))

    def joint_position(self, angle: Vector) -> Vector:
        """Return the joint positions [rad or m] of motor angles [rad], shape (joints,)."""
        return np.asarray(self._inverse @ angle + self._offsets)

    def motor_velocity(self, velocity: Vector) -> Vector:
        """Return the motor speeds [rad/s] of joint velocities [rad/s or m/s], shape (motors,)."""
        return np.asarray(self.matrix @ velocity)

    def joint_torque(self, torque: Vector) -> Vector:
        """Return the joint torques [N m or N] of motor torques [N m], shape (joints,)."""
        return np.asarray(self.matrix.T @ torque)

    def joint_damping(self, damping: Vector) -> Vector:
        """Return the joints' damping by braked motors [N m s/rad or N s/m], symmetric, shape (joints, joints).

        Args:
            damping: of each motor [N m s/rad], shape (motors,).
        """
        return np.asarray(self.matrix.T @ (damping[:, None] * self.matrix))

    def motor_damping(self, damping: Vector) -> Vector:
        """Return motor dampings [N m s/rad] that brake no joint less than asked when all motors brake, shape (motors,).

        Args:
            damping: demanded damping per joint [N m s/rad or N s/m], shape (joints,).
        """
        squares = self.matrix**2
        needed = damping / squares.sum(axis=0)
        return np.asarray(np.where(squares > 0.0, needed, 0.0).max(axis=1))

    def fully_driven_joints(self, motor_mask: Vector) -> Vector:
        """Return which joints have all of their motors among the given ones: 1 or 0, shape (joints,).

        Args:
            motor_mask: 1 for each of these, else 0, shape (motors,).
        """
        return np.asarray(~((self.matrix != 0.0) & (motor_mask == 0.0)[:, None]).any(axis=0), dtype=float)


# An interval of up to this many nominal periods is one step.
_LONGEST = 1.5
_OVERDUE = 1.2  # periods; less than one step


class Body:
    """Simulate a plant moved by motors through gears.

    Attributes:
        plant: body of the arm.
        gears: between motors and joints.
        motors: motors, in the order of the configuration.
        now_ns: the time that the plant has been moved to.
        watch: called after each step but the last of a longer silence, with the time.
        supported: whether the arm is still supported.
        slack_ns: how far from the plant's time a time may be that needs no step; 0 in virtual time.
    """

    def __init__(self, plant: Plant, gears: Gears, noise: Vector, seed: int) -> None:
        """Place the arm at rest at time 0.

        Args:
            plant: body of the arm; its period is the nominal one.
            gears: between motors and joints.
            noise: standard deviation per cycle of what acts on powered joints besides the torque, shape (joints,).
            seed: of the noise.
        """
        self.plant, self.gears = plant, gears
        self.motors: tuple[Motor, ...] = ()
        self.now_ns = 0
        self.watch: Callable[[int], None] = lambda now_ns: None
        self.supported = True
        self.slack_ns = 0
        self._prepared: tuple[tuple[object, ...], PlantState] | None = None  # its conditions and its end
        self._regular = False  # whether the last step was nominal
        self._period_ns = round(plant.period * 1e9)
        self._noise_level = noise
        self._random = np.random.default_rng(seed) if noise.any() else None
        self._noise: Vector | None = None
        self._drawn_ns = -self._period_ns
        self._angles: list[float] = []
        self._speeds: list[float] = []
        self._seen: Vector | None = None
        self._outputs: tuple[tuple[Power, float], ...] = ()
        self._torque = np.zeros(plant.chain.joints)
        self._driven = np.zeros(plant.chain.joints)

    def set_clock(self, now_ns: int) -> None:
        """Set the clock to this time [ns], when the drives get power; the plant stays as it is."""
        self.now_ns = now_ns
        self._drawn_ns = now_ns - self._period_ns

    def angle(self, motor: int, now_ns: int) -> float:
        """Advance the plant to this time, and return the angle of a motor [rad]."""
        self.advance(now_ns)
        self._look()
        return self._angles[motor] + self._speeds[motor] * (now_ns - self.now_ns) * 1e-9

    def speed(self, motor: int, now_ns: int) -> float:
        """Advance the plant to this time, and return the speed of a motor [rad/s]."""
        self.advance(now_ns)
        self._look()
        return self._speeds[motor]

    def advance_before_change(self, now_ns: int) -> None:
        """Advance the plant, as `advance`, before a motor or a load changes now: the old state acts until then."""
        self.advance(now_ns)

    def advance(self, now_ns: int) -> None:
        """Advance the plant to this time, if it is behind by more than `slack_ns`.

        Raises:
            DriverError: the plant ran away.
        """
        begun = self.now_ns
        interval = now_ns - begun
        if interval <= self.slack_ns:
            return
        steps = ceil(interval / (_LONGEST * self._period_ns))
        for number in range(1, steps + 1):
            end = begun + interval * number // steps
            self._step(end)
            if number < steps:
                self.watch(end)

    def support(self, now_ns: int) -> None:
        """Hold the arm where it stands, at rest, until all motors are powered and one of them is given torque again."""
        if not self.supported:
            self.advance(now_ns)
            self.plant.rest()
            self._seen = None
            self.supported = True

    def lead(self, position: Vector, now_ns: int) -> None:
        """Move the supported arm to another position, at rest; DriverError where nobody supports it.

        Args:
            position: of the joints [rad or m], shape (joints,).
            now_ns: time of the move.

        Raises:
            DriverError: the arm is not supported.
        """
        if not self.supported:
            raise DriverError("nobody holds the arm: its drives have it, or it sinks")
        self.advance(now_ns)
        self.plant.place(position)

    def catch_up(self, now_ns: int) -> None:
        """Advance the plant to this time only if it lags by more than a step, before a frame takes effect."""
        if now_ns - self.now_ns > _LONGEST * self._period_ns:
            self.advance(now_ns)

    def prepare(self) -> None:
        """Compute the next nominal step in advance, where steps are regular; `advance` takes it if it still fits.

        Raises:
            DriverError: the plant will run away.
        """
        self._collect()
        if self._regular and not self.supported and self._prepared is None:
            self._prepared = self._conditions(), self.plant.state_after(self._acting_torque())

    @property
    def overdue_ns(self) -> int | None:
        """Return when a moving plant's next cycle is clearly overdue [ns]; None while the arm is supported."""
        return None if self.supported else self.now_ns + round(_OVERDUE * self._period_ns)

    def truth(self, stamp_ns: int) -> Truth:
        """Return the present motion of the plant; torques at the joints, without noise and braking."""
        plant = self.plant
        self._collect()
        return Truth(stamp_ns, plant.position, plant.velocity, plant.acceleration, self._torque)

    def _step(self, end_ns: int) -> None:
        interval = end_ns - self.now_ns
        self._collect()
        if self.supported:
            self.now_ns = end_ns
            return
        prepared, self._prepared = self._prepared, None
        self._regular = abs(interval - self._period_ns) <= self.slack_ns
        if not self._regular:
            self.plant.step(self._acting_torque(), interval * 1e-9)
            self.now_ns = end_ns
            return
        if prepared is not None and all(map(is_, prepared[0], self._conditions())):
            self.plant.set_state(prepared[1])
        else:
            self.plant.step(self._acting_torque())
        self.now_ns += self._period_ns

    def _conditions(self) -> tuple[object, ...]:
        """Return what a prepared step depends on; each of these is replaced when it changes."""
        return *self.plant.conditions, self._torque, self._driven

    def _acting_torque(self) -> Vector:
        """Return the torque that acts on the joints from now on [N m or N], with its noise, shape (joints,)."""
        torque = self._torque
        if self._random is not None and self._driven.any():
            # Once per cycle, however a cycle is divided: two buses have their SYNCs a little apart.
            if 2 * (self.now_ns - self._drawn_ns) >= self._period_ns or self._noise is None:
                self._noise = self._noise_level * self._random.standard_normal(torque.size)
                self._drawn_ns = self.now_ns
            torque = torque + self._noise * self._driven
        return torque

    def _collect(self) -> None:
        """Collect the motors' torques and braking at the joints; computed again only when a motor changed."""
        outputs = tuple([(motor.power, motor.torque) for motor in self.motors])
        if outputs == self._outputs:
            return
        before, self._outputs = self._outputs, outputs
        self._torque = self.gears.joint_torque(np.array([torque for _, torque in outputs]))
        self._torque.setflags(write=False)
        if self.supported:
            acts = self._torque.any() or any(motor.holds for motor in self.motors)
            self.supported = not (all(power is Power.TORQUE for power, _ in outputs) and acts)
        if [power for power, _ in before] == [power for power, _ in outputs]:
            return
        powered = np.array([power is Power.TORQUE for power, _ in outputs], dtype=float)
        self._driven = self.gears.fully_driven_joints(powered)
        braked = np.array([motor.damping for motor in self.motors])
        damping = self.gears.joint_damping(braked)
        self.plant.set_braking(damping if (damping != np.diag(np.diag(damping))).any() else np.diag(damping).copy())

    def _look(self) -> None:
        """Compute the motors' angles and speeds where the plant is; its arrays are replaced, never written into."""
        if self._seen is not self.plant.position:
            self._seen = self.plant.position
            self._angles = self.gears.motor_position(self.plant.position).tolist()
            self._speeds = self.gears.motor_velocity(self.plant.velocity).tolist()
