"""Emulate one motor with its encoder and power stage, as the firmware in front of it sees it.

A power stage makes a torque, leaves the windings open (the motor coasts), or shorts them (it brakes, as idle WAM pucks
do). Without power a holding brake, where there is one, has the shaft. The firmware sets the power stage, `body.py`
moves the rotor, and `faults.py` sets the defects.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

_HISTORY = 4096  # encoder readings kept for an encoder that answers late
_COUNTS = 1 << 32
_HOLDING = 1e3  # times the braking of shorted windings: creeps by mrad/s where those let the joint sink by rad/s


class Power(Enum):
    """Name the states of the power stage."""

    COAST = "coasts"
    BRAKE = "brakes"
    TORQUE = "has torque"
    HELD = "is held, by its brake or by the drive's own loop"


class Rotor(Protocol):
    """Define the rotors of an arm, queried at any time."""

    def angle(self, motor: int, now_ns: int) -> float:
        """Return the angle of a motor at this time [rad]."""

    def speed(self, motor: int, now_ns: int) -> float:
        """Return the speed of a motor at this time [rad/s]."""

    def advance_before_change(self, now_ns: int) -> None:
        """Advance the arm to this time before something that moves it changes."""


@dataclass
class Defects:
    """Describe the defects of a motor; none at first.

    Attributes:
        reversed: the torque acts the other way round.
        stuck: the power stage goes on doing what it does.
        torque_share: share of the largest torque that the power stage can make.
        torque_fraction: share of the commanded torque that the power stage makes; only measured torque shows it.
        frozen: the encoder repeats its last reading.
        mirrored: the encoder counts the wrong way.
        shift: counts added to the encoder's reading.
        delay_ns: age of the encoder's reading [ns].
    """

    reversed: bool = False
    stuck: bool = False
    torque_share: float = 1.0
    torque_fraction: float = 1.0
    frozen: bool = False
    mirrored: bool = False
    shift: int = 0
    delay_ns: int = 0


class Motor:
    """Emulate a motor, its encoder and its power stage.

    Attributes:
        power: state of the power stage.
        torque: torque at the motor that acts when `power` is TORQUE [N m].
        holds: whether the drive closes a position loop over the torque.
        braking: damping when `power` is BRAKE [N m s/rad]; a thousand times that when it is HELD.
        defects: of the motor.
    """

    def __init__(
        self,
        rotor: Rotor,
        index: int,
        *,
        counts: int,
        scale: float,
        braking: float,
        relative: bool = False,
        unpowered: Power = Power.COAST,
    ) -> None:
        """Use a motor's place on the arm.

        Args:
            rotor: of the arm.
            index: of the motor.
            counts: counts of the encoder per turn.
            scale: acting torque over commanded torque.
            braking: damping with shorted windings [N m s/rad].
            relative: whether the encoder counts from where it was when power came, instead of from angle zero.
            unpowered: state of the power stage when it is off: COAST, BRAKE or HELD.
        """
        self._rotor = rotor
        self._index = index
        self._per_radian = counts / (2.0 * math.pi)
        self._scale = scale
        self._relative = relative
        self._unpowered = unpowered
        self._origin = 0
        self._shown = 0
        self._history: deque[tuple[int, int]] = deque(maxlen=_HISTORY)
        self.counts_per_turn = counts
        self.braking = braking
        self.power = unpowered
        self.torque = 0.0
        self.holds = False
        self.defects = Defects()

    def power_up(self, now_ns: int) -> None:
        """Start the firmware with the motor off, defects kept; a relative encoder counts from here."""
        if self._relative:
            self._origin = round(self._rotor.angle(self._index, now_ns) * self._per_radian)
        self.switch_off(now_ns)

    def encoder(self, now_ns: int) -> int:
        """Return the encoder's reading with its defects [counts], a signed number of 32 bits."""
        counts = round(self._rotor.angle(self._index, now_ns) * self._per_radian) - self._origin
        self._history.append((now_ns, counts))
        defects = self.defects
        if defects.frozen:
            return self._shown
        if defects.delay_ns:
            wanted = now_ns - defects.delay_ns
            counts = next((old for at, old in reversed(self._history) if at <= wanted), self._history[0][1])
        counts = (-counts if defects.mirrored else counts) + defects.shift
        self._shown = (counts + _COUNTS // 2) % _COUNTS - _COUNTS // 2
        return self._shown

    def speed(self, now_ns: int) -> float:
        """Return the true speed [rad/s]."""
        return self._rotor.speed(self._index, now_ns)

    def drive(self, motor_torque: float, now_ns: int) -> None:
        """Apply this torque [N m at the motor] from now on, times the motor's own factor of acting to commanded."""
        self._do(Power.TORQUE, motor_torque * self._scale, now_ns)

    @property
    def damping(self) -> float:
        """Return the present damping of the shaft [N m s/rad]."""
        return {Power.BRAKE: self.braking, Power.HELD: _HOLDING * self.braking}.get(self.power, 0.0)

    def switch_off(self, now_ns: int) -> None:
        """Take the power away: windings open or shorted, as this drive leaves them, or the brake closed."""
        self._do(self._unpowered, 0.0, now_ns)

    def hold(self, now_ns: int) -> None:
        """Hold the shaft by the drive's own loop, simulated as firm as a closed brake."""
        self._do(Power.HELD, 0.0, now_ns)

    def fail(self, now_ns: int) -> None:
        """Cut the power as a failed power stage does: windings open, or a brake that closes without power."""
        self._do(Power.HELD if self._unpowered is Power.HELD else Power.COAST, 0.0, now_ns)

    def brake(self, now_ns: int) -> None:
        """Brake the motor by shorting its windings."""
        self._do(Power.BRAKE, 0.0, now_ns)

    def _do(self, power: Power, torque: float, now_ns: int) -> None:
        if self.defects.stuck:
            return
        if self.defects.reversed:
            torque = -torque
        if power is not self.power or torque != self.torque:
            self._rotor.advance_before_change(now_ns)
            self.power, self.torque = power, torque
