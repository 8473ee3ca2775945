"""Emulate the torque loop of a drive in cyclic synchronous torque mode (CiA 402-2, 14): demand, limits, status.

Demand is target plus offset, in counts of the target, cut off at the drive's limits (of CiA 402: thousandths of the
rated torque, 6072h and 6073h). Above the speed limit (6080h) no torque acts that leads faster; the target is ignored
then, and the statusword says so (bit 12). Software position limits (607Dh) are of the position modes: torque acts
beyond them. Current is told as torque, since the motor is linear.
"""

from __future__ import annotations

import math

from sim_backend.canopen_device.objects import Objects
from sim_backend.canopen_device.personality import Personality
from sim_backend.emulator.motor import Motor

_RPM = 60.0 / (2.0 * math.pi)


class TorqueLoop:
    """Compute demand and limits of one motor.

    Attributes:
        limited: whether a limit of the drive holds the torque back (bit 11 of the statusword).
        follows: whether the target acts (bit 12).
    """

    def __init__(self, objects: Objects, motor: Motor, personality: Personality) -> None:
        """Start with a loop that is not closed."""
        self._objects, self._motor, self._personality = objects, motor, personality
        self.limited = self.follows = False

    def release(self) -> None:
        """End the torque loop; the power stage decides what the motor does now."""
        self.limited = self.follows = False
        for index in (0x6074, 0x6077, 0x6078):
            self._objects.values[index << 8] = 0

    def evaluate(self, now_ns: int) -> None:
        """Make the motor give the torque that is asked for, as far as limits let it."""
        number = self._objects.number
        values = self._objects.values
        cyclic = number(0x6061) in self._personality.modes
        target = self._personality.target
        asked = number(target >> 8, target & 0xFF) + number(0x60B2) if cyclic else 0
        reach = int(self._personality.reach(self._objects) * self._motor.defects.torque_share)
        demand = min(max(asked, -reach), reach)
        self.follows = cyclic
        self.limited = demand != asked
        if demand and self._leads_faster(demand, now_ns):
            demand, self.limited, self.follows = 0, True, False
        values[0x607400] = demand
        fraction = self._motor.defects.torque_fraction
        values[0x607700] = values[0x607800] = round(fraction * demand)
        self._motor.drive(self._personality.torque(fraction * demand, self._objects), now_ns)

    def _leads_faster(self, demand: int, now_ns: int) -> bool:
        speed = self._motor.speed(now_ns)
        limited = 0x608000 in self._objects.entries
        return limited and speed * demand > 0.0 and abs(speed) * _RPM > self._objects.number(0x6080)
