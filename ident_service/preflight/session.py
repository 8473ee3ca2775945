"""Run the part of preflight with torque: a closed loop that may go next to nowhere.

Such a fault names its own joint. For other faults (an arm that does not go where it should) the trace must tell more:
`preflight.py` looks there for wrong signs.

The arm has just been seen at rest without torque, so it is supported where it stands. The loop is that of a run, but
its guard stops it `FARTHEST` from where it should be, at a crawl, and its torque is kept to a band around the model's
gravity torque: a wrong sign or a wrong scale then drives the arm no farther than a few hundredths of a radian, from
where it can be let go. So every end here, good or bad, is torque off; a drive's own quick stop would trust the very
sign that has not been proven yet.

Drives that are given positions close the loop by themselves, and no torque of ours is kept to a band: what they measure
must stay within it instead, or the loop is ended. Their positions pass the same guard.

While the torque is on nothing is worked out between two cycles, for drives give up within a few cycles without torque
frames: what was recorded is evaluated when torque is off again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from drivers.arm import Arm, ArmDescription, Flags, Sample, StopKind, Vector
from ident_service.config.motion_limits import MotionLimits
from ident_service.errors import ArmFault
from ident_service.model.arm_model import ArmModel, control_model
from ident_service.model.expected_friction import ExpectedFriction
from ident_service.model.pinocchio_models import InverseDynamics
from ident_service.motion.controller import ComputedTorque
from ident_service.motion.cycle_timing import Elapsed
from ident_service.motion.encoder_observer import encoder_coupling
from ident_service.motion.run import MOVED
from ident_service.motion.safety_monitor import Reaction, SafetyMonitor
from ident_service.motion.trajectory import Reference, Setpoint
from ident_service.preflight.stability import INERTIA, known_drive_inertia

_DRIVE = "Read the drive's own fault code and mend its cause; then `ident recover` tells what else is in the way."
RATE_REMEDY = (
    "Give the process a core of its own and real-time priority (`ident doctor ARM` says what is missing), stop "
    "other load, or lower control.rate."
)
_LINK = "Check power, cables and bus of the axes named, and the drives' own fault codes."
ANSWERS_REMEDY = "Check power, cables and bus termination of the axes that do not answer."
UNREACHABLE_REMEDY = "Check power, cables, and that no other program uses the arm."
BROKEN_REMEDY = "Check power, cables, bus and the drives' own fault codes."
CLOSING_REMEDY = (
    "Take the drives' power away before anybody goes near, then check power, cables and bus of these drives."
)
NO_CABLE = frozenset({_LINK, ANSWERS_REMEDY, UNREACHABLE_REMEDY, BROKEN_REMEDY})
"""Remedies that do not apply where drives are a program on this computer."""
EMULATED_REMEDY = (
    "No cable leads to these drives, which `ident emulate ARM` runs on this computer: see that it runs. If it does, it "
    "or this process came too late: stop other load, or see what `ident doctor ARM` says, and check again."
)
_ENCODER = "Check the encoder of the joint named, its cable and connectors; free the joint if it is jammed."

_SUPPLY = "Check the limits that the drive keeps by itself, its temperature and its supply."

# By codes of `faults.FAULTS`, also of warnings that went on for too long.
REMEDIES: dict[str, str] = {
    "emergency_stop": (
        "Find out why the emergency stop was pressed or its circuit is open, then release it; on a WAM's pendant "
        "press Shift-Idle, too."
    ),
    "drive_fault": _DRIVE,
    "drive_emergency": _DRIVE,
    "drive_restarted": _DRIVE,
    "drive_left": _DRIVE,
    "torque_ignored": _DRIVE,
    "drive_silent": _LINK,
    "status_stale": _LINK,
    "feedback_gone": _LINK,
    "driver": _LINK,
    "bus_off": _LINK,
    "bus_silent": _LINK,
    "bus_degraded": _LINK,
    "second_host": "Stop or disconnect whatever else commands the arm.",
    "transmission_slipped": "Check the cables or belts of the joint named, then its encoder and the motors'.",
    "joint_encoder_lost": "Check the joint's own encoder and its cable to the puck named.",
    "frozen_encoder": _ENCODER,
    "feedback_not_finite": _ENCODER,
    "encoder_jumps": _ENCODER,
    "encoder_jump": _ENCODER,
    "lost_feedback": _LINK,
    "strange_frame": _LINK,
    "late_cycle": RATE_REMEDY,
    "late_cycles": RATE_REMEDY,
    "torque_not_applied": _SUPPLY,
    "torque_limited": _SUPPLY,
    "drive_warning": _SUPPLY,
    "drive_notice": _DRIVE,
    "drive_watchdog": (
        "Compare control.rate with the drives' watchdog in the driver's section, and look for other load on this "
        "machine: the drives must hear from it well within that time."
    ),
}


TORQUE_WARNINGS = ("torque_rate", "torque_saturated")
"""Warnings of what the loop asks for, which a wrong sign may make it ask for, too."""
SHAKEN_REMEDY = (
    "The loop swings or is shaken: lower kp and kd of the joint named, or its control.velocity_cutoff where its "
    "encoder is noisy; see that its drive delays no torque, and that design.friction_guess is not too small."
)


def remedy_of(fault: ArmFault) -> str | None:
    """Return one sentence that says what to do about a fault, by its code; None where the code does not tell.

    Args:
        fault: fault that ended the loop.

    Returns:
        None where the fault does not say what failed: the arm is not where it should be, too fast, or told too much.
    """
    return REMEDIES.get(code_of(fault))


def code_of(fault: ArmFault) -> str:
    """Return the code of a fault; for `repeated_warnings`, the code of the warning that was repeated."""
    if fault.code == "repeated_warnings":
        return str(fault).removeprefix(f"{fault.code}: ").split(" ", 1)[0]
    return fault.code


FARTHEST = 0.08  # rad or m from the reference, twice the amplitude of the motions that prove directions
FASTEST = 1.0  # rad/s or m/s: where the guard stops; motions here are slower by far
BAND = 0.25  # of the torque limit, beside the model's gravity torque and expected friction
CREEP = 0.02  # rad/s or m/s, below which friction is not compensated, so that nothing hunts at rest
MISSING = 2  # cycles in a row without its position, after which a joint's drive may have left on purpose
RELEASE = 0.5  # s over which torque is led to zero
MOVED_CODE = "moved_before_enabled"
SUNK = 0.02  # rad or m: what sinks farther while torque fades has no support, and torque is taken off at once

Rows = Sequence[tuple[Sample, Setpoint]]


@dataclass(frozen=True)
class Trace:
    """Hold the cycles of a loop as arrays, one row per period from the first cycle's stamp on.

    In a period in which no cycle came, because the machine was late, positions and references are between those around
    it, and the torque before it acted on.

    Attributes:
        position: measured position [rad or m], shape (cycles, joints).
        torque: torque that acts from each stamp on [N m or N], shape (cycles, joints).
        reference: position asked for [rad or m], shape (cycles, joints).
        rate: velocity asked for [rad/s or m/s], shape (cycles, joints).
        period: [s].
    """

    position: Vector
    torque: Vector
    reference: Vector
    rate: Vector
    period: float


def trace_of(rows: Rows, period: float) -> Trace:
    """Return positions, torques and references of cycles as arrays with even time steps, missing cycles filled in.

    Args:
        rows: cycles, at least one, whose stamps rise.
        period: [s].
    """
    stamps = np.array([sample.stamp_ns for sample, _ in rows])
    index = np.rint((stamps - stamps[0]) * 1e-9 / period).astype(int)
    position = np.array([sample.position for sample, _ in rows])
    torque = np.array([sample.torque for sample, _ in rows])
    reference = np.array([setpoint.position for _, setpoint in rows])
    rate = np.array([setpoint.velocity for _, setpoint in rows])
    grid = np.arange(index[-1] + 1)
    if len(grid) != len(rows):
        position, reference, rate = (
            np.column_stack([np.interp(grid, index, column) for column in values.T])
            for values in (position, reference, rate)
        )
        torque = torque[np.searchsorted(index, grid, side="right") - 1]
    return Trace(position, torque, reference, rate, period)


class Session:
    """Run a guarded loop on an open arm at rest.

    Attributes:
        home: position in which the arm stood [rad or m], shape (joints,).
        gravity: model's torque in that position [N m or N], shape (joints,).
        mass: model's mass matrix in that position, shape (joints, joints).
        inertia: mass matrix with the drive inertia that the description knows of and the prior lacks.
        lightest: the least inertia that each joint may have [kg m^2 or kg], shape (joints,): links lighter than
            modelled, and all of the described drive inertia.
        period: [s].
        torque_limit: torque limits of the description [N m or N], shape (joints,).
        gives_positions: whether the drives are given positions.
        dry_friction: torque that each drive needed besides the model's when it was moved last while friction was
            learned, the mean of both directions [N m or N], shape (joints,); 0 for one that was not.
    """

    def __init__(
        self,
        arm: Arm,
        model: ArmModel,
        limits: MotionLimits,
        described: ArmDescription,
        home: Vector,
        friction: ExpectedFriction,
    ) -> None:
        """Prepare the loop; nothing is sent.

        Args:
            arm: open, at rest, not enabled.
            model: model with a prior.
            limits: of the arm.
            described: description of the open arm.
            home: position in which the arm stands [rad or m], shape (joints,).
            friction: expected friction, which widens the band of torques.
        """
        period = 1.0 / described.rate
        known = control_model(model).prior
        dynamics = InverseDynamics(model.chain, model.layout, np.zeros(model.layout.size) if known is None else known)
        still = np.zeros_like(home)
        self.home = home.copy()
        self._dynamics = dynamics
        self.gravity = dynamics.torque(home, still, still)
        self.mass = dynamics.mass_matrix(home)
        self.inertia = self.mass + np.diag(known_drive_inertia(control_model(model)))
        prior = np.zeros(model.layout.size) if model.prior is None else model.prior
        links = InverseDynamics(model.chain, model.layout, prior).mass_matrix(home)
        self.lightest = np.diag(self.inertia - (1.0 - INERTIA[0]) * links)
        self._arm = arm
        self.period = period
        self.torque_limit = limits.torque
        self._band = np.minimum(BAND * limits.torque + friction.coulomb, limits.torque)
        narrow = replace(
            limits,
            following_error=np.minimum(limits.following_error, FARTHEST),
            velocity=np.minimum(limits.velocity, FASTEST),
        )
        self.gives_positions = described.streams_position
        self._guard = SafetyMonitor(
            model.chain.names,
            narrow,
            period,
            home,
            revolute=model.chain.revolute,
            max_age=described.lost_cycles,
            most_torque=np.minimum(np.abs(self.gravity) + self._band, limits.torque) if self.gives_positions else None,
            coupling=encoder_coupling(model.config),
            report_delay=described.report_delay,
        )
        self._control = ComputedTorque(dynamics, limits, period, model.config.control.velocity_cutoff, home)
        self._since = Elapsed(period)
        self._target = home.copy() if self.gives_positions else self.gravity.copy()
        self._explained: Vector | None = None  # the model's torque, where drives are given positions
        self._correction = np.zeros_like(home)  # in the target that was sent last
        self._rows: list[tuple[Sample, Setpoint]] = []
        self._first: Sample | None = None  # of an arm that a person has enabled, not judged yet
        self._words: tuple[int, ...] = ()
        self._friction, self.dry_friction = still, still.copy()
        self._coupling = model.chain.coupling
        # With a load, or drives that share joints, the model's gravity is less well known: see `follow`.
        coupled = not np.array_equal(self._coupling, np.eye(len(self._coupling)))
        self._averages = coupled or model.config.payload is not None
        to_drives = np.linalg.inv(self._coupling).T
        self._stiffness = to_drives**2 @ (limits.kp * np.diag(self.mass))
        self._most = (np.abs(to_drives) * self._band).max(axis=1)

    def energise(self) -> None:
        """Enable the drives; if the arm moved while a person had to enable it, end the torque and raise ArmFault.

        Raises:
            ArmFault: a person enabled the arm, and it had been moved meanwhile; it is without torque again.
            DriverError: the drives refuse.
        """
        waits = bool(self._arm.operator_action)
        self._arm.enable()
        self._target = self._passed(self.home) if self.gives_positions else self._limited(self.gravity)
        if waits:
            self._first = sample = self.exchange()
            if not bool((np.abs(sample.position - self.home) <= np.minimum(MOVED, self._guard.jump)).all()):
                self._arm.stop(StopKind.TORQUE_OFF)
                raise ArmFault(MOVED_CODE, "the arm was moved while a person was waited for; check again", [sample])

    def follow(
        self,
        reference: Reference,
        seconds: float,
        friction_learning_rate: float = 0.0,
        shaking_torque: tuple[Vector, float] | None = None,
    ) -> Rows:
        """Control the arm along a reference for some seconds, safety checks on; return cycles' samples and references.

        Args:
            reference: trajectory from the present setpoint on.
            seconds: duration [s].
            friction_learning_rate: how fast the torque that dry friction takes is learned from the lag of moving
                joints, as a share of `kp M` times that lag per second [1/s]. Without, small motions get lost in
                friction: what moves a WAM's first joint takes 13 mrad of error.
            shaking_torque: amplitude [N m or N], shape (joints,), and frequency [Hz] of a sinusoidal torque on top; of
                drives that are given positions none can be.

        Returns:
            The cycles with their references, for `trace_of`.

        Raises:
            ArmFault: the guard or a drive found something that is more than a warning; `trace` tells the story.
            DriverError: the arm does not answer.
        """
        self._rows = []
        learned: dict[bool, list[Vector]] = {}
        begin_ns: int | None = None
        while True:
            sample, self._first = self._first or self.exchange(), None
            if begin_ns is None:
                begin_ns = sample.stamp_ns
            elapsed = (sample.stamp_ns - begin_ns) * 1e-9
            setpoint = reference.at(elapsed)
            self._rows.append((sample, setpoint))
            self._words = sample.status
            wanted = self._safe_torque(sample, setpoint, np.zeros(len(self.home), dtype=bool))
            if shaking_torque is not None:
                # On its way only: a joint that sticks would look like one whose encoder does.
                moving = np.clip(np.abs(setpoint.velocity) / (2.0 * CREEP), 0.0, 1.0)
                wanted = wanted + moving * shaking_torque[0] * np.sin(2.0 * np.pi * shaking_torque[1] * elapsed)
            if self.gives_positions:
                self._target = self._passed(setpoint.position)
            else:
                self._target = self._limited(wanted + self._learned_friction(setpoint, friction_learning_rate))
            if friction_learning_rate and not self.gives_positions and setpoint.velocity.any():
                learned.setdefault(bool(setpoint.velocity.sum() > 0.0), []).append(self._friction)
            if elapsed >= seconds:
                if learned:
                    # What the model lacks of gravity is taken for friction on one way, and against it on the other.
                    # The first half of a way is where it is still being learned.
                    halves = [np.mean(way[len(way) // 2 :], axis=0) for way in learned.values()]
                    mean = np.mean(halves, axis=0)
                    moved = np.any([np.abs(self._coupling @ asked.velocity) > CREEP for _, asked in self._rows], axis=0)
                    self.dry_friction = np.where(moved, mean, self.dry_friction)
                    if self._averages:
                        self._friction = mean
                return self._rows

    def gravity_at(self, positions: Vector) -> Vector:
        """Return the model's gravity torque in postures [N m or N], shape (cycles, joints)."""
        still = np.zeros_like(self.home)
        return np.array([self._dynamics.torque(position, still, still) for position in positions])

    def exchange(self, *, sends: bool = True) -> Sample:
        """Send the present target, or with `sends` False none; return the cycle's sample, or raise DriverError."""
        if not sends:
            return self._arm.exchange(None)
        return (self._arm.exchange_position if self.gives_positions else self._arm.exchange)(self._target)

    def check_without_signal(self, sample: Sample, setpoint: Setpoint, given_up: Flags, *, sends: bool) -> None:
        """Check a cycle in which a signal is withheld from drives on purpose, and compute the next target.

        What drives report of themselves is what is being tried, and is not judged here; neither are joints whose drives
        have given up torque, but for their position limits. Every other joint is held and guarded as before. A drive
        that misses its host may leave `operational` and tell no position any more: its joints stand where they were
        seen last, and the caller says how long that may go on. Where no targets are sent, joints are pushed by the last
        one, and drives that are given positions are to hold theirs.

        Args:
            sample: of this cycle.
            setpoint: setpoint of the joints that are held.
            given_up: mask of the joints that are held no more, shape (joints,).
            sends: whether targets are sent; where they are what drives miss, the last one stays the last one.

        Raises:
            ArmFault: the guard found something that is more than a warning.
        """
        self._rows.append((sample, setpoint))
        given_up = given_up | (sample.age >= MISSING)
        undisturbed = replace(
            sample,
            status=self._words,
            events=(),
            torque=sample.torque if self.gives_positions else self._target,
            torque_difference=None,
            valid=sample.valid | given_up,
            age=np.where(given_up, 0, sample.age),
        )
        if self.gives_positions and not sends:
            setpoint = Setpoint(self._target, np.zeros_like(self.home), np.zeros_like(self.home))
        there = np.where(given_up, sample.position, setpoint.position)
        going = np.where(given_up, 0.0, setpoint.velocity)
        asked = Setpoint(there, going, np.where(given_up, 0.0, setpoint.acceleration))
        wanted = self._safe_torque(undisturbed, asked, given_up, sends=sends) + self._learned_friction(asked, 0.0)
        if sends:
            self._target = self._passed(asked.position) if self.gives_positions else self._limited(wanted)

    def keep_last_target(self) -> None:
        """Keep the last target for the next cycle, after the safety checks, while drives report no positions.

        Raises:
            ArmFault: the guard found something that is more than a warning.
        """
        self._target = self._passed(self._target) if self.gives_positions else self._limited(self._target)

    def trace(self) -> Trace:
        """Return the cycles of the last `follow` as arrays with even time steps, also if a fault ended it."""
        return trace_of(self._rows, self.period)

    def release(self) -> None:
        """Hand the arm back to its support, or to its brakes: torque fades, then the drives are switched off.

        Raises:
            ArmFault, DriverError: from the loop; the drives are still enabled, and the caller stops them.
        """
        cycles = 1 if self.gives_positions else max(1, round(RELEASE / self.period))
        held = self._target
        for left in range(cycles - 1, -1, -1):
            sample = self.exchange()
            if self.gives_positions or not bool((np.abs(sample.position - self.home) <= SUNK).all()):
                break
            self._target = self._limited(held * (left / cycles), band=False)
        self._arm.stop(StopKind.TORQUE_OFF)

    def _safe_torque(self, sample: Sample, setpoint: Setpoint, given_up: Flags, *, sends: bool = True) -> Vector:
        """Check a sample by the guard and return the control law's torque for it [N m or N], shape (joints,)."""
        since, control = self._since(sample.stamp_ns, sample.stamp_doubt_ns), self._control
        velocity, correction = (np.where(given_up, 0.0, of) for of in (control.velocity, self._correction))
        known = self._since.known
        pushes = sample.torque - self._explained if self._explained is not None else np.zeros_like(velocity)
        usable, fault = self._guard.check_feedback(
            sample,
            setpoint,
            velocity,
            correction,
            elapsed=since,
            elapsed_is_exact=known,
            unexplained_torque=np.where(given_up, 0.0, pushes),
        )
        if fault is not None and fault.reaction is not Reaction.WARN:
            raise ArmFault(fault.code, fault.message, [row[0] for row in self._rows[-100:]])
        law = control.torque(sample.position, usable, setpoint, since if known else 0.0)
        if sends:
            self._correction = control.correction
        if self.gives_positions:
            self._explained = law - control.correction
        return law

    def _learned_friction(self, setpoint: Setpoint, learning: float) -> Vector:
        """Torque that moving joints need besides the model's, learned from how they lag [N m or N], shape (joints,).

        Friction is the drives': one that moves several joints lags by what all of them do, and pushes all of them.
        """
        rate = self._coupling @ setpoint.velocity
        direction = np.where(np.abs(rate) > CREEP, np.sign(rate), 0.0)
        lag = self._coupling @ (setpoint.position - self._control.position) * direction
        self._friction = np.clip(self._friction + learning * self.period * self._stiffness * lag, 0.0, self._most)
        return np.asarray(self._coupling.T @ (self._friction * np.clip(rate / CREEP, -1.0, 1.0)))

    def _passed(self, wanted: Vector) -> Vector:
        """Return the position that the guard lets pass [rad or m], shape (joints,)."""
        position, fault = self._guard.limit_position(wanted)
        if fault is not None and fault.reaction is not Reaction.WARN:
            raise ArmFault(fault.code, fault.message, [row[0] for row in self._rows[-100:]])
        return position

    def _limited(self, wanted: Vector, *, band: bool = True) -> Vector:
        if band:
            wanted = np.clip(wanted, self.gravity - self._band, self.gravity + self._band)
        torque, fault = self._guard.limit_torque(wanted)
        if fault is not None and fault.reaction is not Reaction.WARN:
            raise ArmFault(fault.code, fault.message, [row[0] for row in self._rows[-100:]])
        return torque
