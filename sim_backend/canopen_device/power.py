"""Emulate the state machine of the power drive system (CiA 402-2, 6.2): states, commands, transitions.

`TRANSITIONS` is the standard's table, `_LEAVING` says what the motor does when the drive function ends. A quick stop,
and a fault reaction by ramp, brake with shorted windings for as long as the configured deceleration would take, and on
for up to 0.1 s until the motor is slow; this drive has no other way to slow down. After that, and without power, the
motor coasts, unless the description says that the drive leaves the windings shorted or that the joint has a brake.
"""

from __future__ import annotations

import math
from enum import Enum, IntEnum

from sim_backend.canopen_device.node import Node
from sim_backend.emulator.motor import Motor

_RAMP = "ramp"
_MS = 1_000_000
# Share of the speed at which a stop began, and the time within which shorted windings are given to reach it.
_SLOW, _LONGEST_NS = 0.1, 100 * _MS


class PowerState(IntEnum):
    """Name the states by bits 0 to 3, 5 and 6 of the statusword."""

    NOT_READY = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY_TO_SWITCH_ON = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT_REACTION_ACTIVE = 0x0F
    FAULT = 0x08


class Command(Enum):
    """Name the commands of bits 0 to 3 of the controlword."""

    DISABLE_VOLTAGE = 0
    QUICK_STOP = 1
    SHUTDOWN = 2
    SWITCH_ON = 3
    ENABLE_OPERATION = 4


_S, _C = PowerState, Command
# With the numbers of the standard's figure; 3 and 4 in one go where operation is asked for at once.
TRANSITIONS: dict[tuple[PowerState, Command], PowerState] = {
    (_S.SWITCH_ON_DISABLED, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 2
    (_S.READY_TO_SWITCH_ON, _C.SWITCH_ON): _S.SWITCHED_ON,  # 3
    (_S.READY_TO_SWITCH_ON, _C.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 3, 4
    (_S.SWITCHED_ON, _C.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 4
    (_S.OPERATION_ENABLED, _C.SWITCH_ON): _S.SWITCHED_ON,  # 5
    (_S.SWITCHED_ON, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 6
    (_S.READY_TO_SWITCH_ON, _C.QUICK_STOP): _S.SWITCH_ON_DISABLED,  # 7
    (_S.READY_TO_SWITCH_ON, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 7
    (_S.OPERATION_ENABLED, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 8
    (_S.OPERATION_ENABLED, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 9
    (_S.SWITCHED_ON, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 10
    (_S.SWITCHED_ON, _C.QUICK_STOP): _S.SWITCH_ON_DISABLED,  # 10
    (_S.OPERATION_ENABLED, _C.QUICK_STOP): _S.QUICK_STOP_ACTIVE,  # 11
    (_S.QUICK_STOP_ACTIVE, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 12
    (_S.QUICK_STOP_ACTIVE, _C.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 16, where the drive stays in quick stop
}
POWERED = (_S.SWITCHED_ON, _S.OPERATION_ENABLED, _S.QUICK_STOP_ACTIVE, _S.FAULT_REACTION_ACTIVE)
_FAULTS = (_S.FAULT_REACTION_ACTIVE, _S.FAULT)
# Which option code chooses between coasting (0) and braking (else) when the drive function ends (605Bh, 605Ch).
_LEAVING = {_S.READY_TO_SWITCH_ON: 0x605B, _S.SWITCHED_ON: 0x605C}
_RESET = 0x80


def command_of(word: int) -> Command:
    """Return the command in a controlword (CiA 402-2, table 27)."""
    if not word & 2:
        return Command.DISABLE_VOLTAGE
    if not word & 4:
        return Command.QUICK_STOP
    if not word & 1:
        return Command.SHUTDOWN
    return Command.ENABLE_OPERATION if word & 8 else Command.SWITCH_ON


class PowerStage:
    """Emulate the power stage of one drive.

    Attributes:
        state: the present one.
        voltage: whether there is power to switch on.
    """

    def __init__(self, node: Node, motor: Motor) -> None:
        """Start before the self-test."""
        self._node, self._motor = node, motor
        self._word = 0
        self._slow, self._ramp_ends_ns = 0.0, 0
        self.state = PowerState.NOT_READY
        self.voltage = True

    def start(self) -> None:
        """End the self-test (transitions 0 and 1)."""
        self._word = 0
        self.state = PowerState.SWITCH_ON_DISABLED

    def down(self) -> None:
        """Stop the firmware."""
        self._node.stop(_RAMP)
        self.state = PowerState.NOT_READY

    def control(self, word: int) -> bool:
        """Process a controlword; returns whether it resets a fault."""
        before, self._word = self._word, word
        rising = bool(word & _RESET and not before & _RESET)
        if self.state is PowerState.FAULT:
            return rising
        command = command_of(word)
        target = TRANSITIONS.get((self.state, command))
        if target is None or (target in POWERED and not self.voltage):
            return False
        if self.state is PowerState.QUICK_STOP_ACTIVE and command is Command.ENABLE_OPERATION and not self._stays():
            return False
        if target is PowerState.QUICK_STOP_ACTIVE:
            self.quick_stop()
        else:
            self._to(target)
        return False

    def reset_fault(self) -> None:
        """Leave the state `fault` (transition 15): the cause is gone, and a host has reset it."""
        self.state = PowerState.SWITCH_ON_DISABLED

    def disable_voltage(self) -> None:
        """Do what the command disable voltage does."""
        if (target := TRANSITIONS.get((self.state, Command.DISABLE_VOLTAGE))) is not None:
            self._to(target)

    def quick_stop(self) -> None:
        """Start a quick stop (transition 11), or its counterpart in another state; option code 605Ah."""
        if self.state is PowerState.OPERATION_ENABLED:
            if self._node.objects.number(0x605A) == 0:
                self._to(PowerState.SWITCH_ON_DISABLED)
            else:
                self.state = PowerState.QUICK_STOP_ACTIVE
                self._brake()
        elif (target := TRANSITIONS.get((self.state, Command.QUICK_STOP))) is not None:
            self._to(target)

    def trip(self, *, coasting: bool = False) -> None:
        """Enter the fault states (transitions 13, 14) by option 605Eh, unless the power stage failed (`coasting`)."""
        if self.state in (*_FAULTS, PowerState.NOT_READY):
            return
        if coasting or self._node.objects.number(0x605E) == 0:
            end = self._motor.fail if coasting else self._motor.switch_off
            end(self._node.now_ns)
            self._node.stop(_RAMP)
            self.state = PowerState.FAULT
        elif self.state in (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE):
            self.state = PowerState.FAULT_REACTION_ACTIVE
            self._brake()
        else:
            self.state = PowerState.FAULT

    def supply(self, on: bool) -> None:
        """Switch the supply of the power stage on or off, from outside the drive."""
        self.voltage = on
        if not on:
            self._motor.switch_off(self._node.now_ns)
            if self.state in POWERED:
                self._node.stop(_RAMP)
                faulty = self.state is PowerState.FAULT_REACTION_ACTIVE
                self.state = PowerState.FAULT if faulty else PowerState.SWITCH_ON_DISABLED

    def due(self, name: str) -> None:
        """Handle the due timer of this name."""
        if name != _RAMP:
            return
        now = self._node.now_ns
        if now < self._ramp_ends_ns and abs(self._motor.speed(now)) > self._slow:
            self._node.after(_RAMP, _MS)
            return
        if self.state is PowerState.FAULT_REACTION_ACTIVE:
            self._motor.switch_off(self._node.now_ns)
            self.state = PowerState.FAULT  # 14
        elif self.state is PowerState.QUICK_STOP_ACTIVE and self._stays():
            self._motor.hold(self._node.now_ns)
        elif self.state is PowerState.QUICK_STOP_ACTIVE:
            self._motor.switch_off(self._node.now_ns)
            self.state = PowerState.SWITCH_ON_DISABLED  # 12

    def _stays(self) -> bool:
        return self._node.objects.number(0x605A) >= 5

    def _to(self, target: PowerState) -> None:
        self._node.stop(_RAMP)
        if self.state is PowerState.OPERATION_ENABLED and target is not PowerState.OPERATION_ENABLED:
            option = _LEAVING.get(target)
            if option is not None and self._node.objects.number(option):
                self._motor.brake(self._node.now_ns)
            else:
                self._motor.switch_off(self._node.now_ns)
        elif self.state is PowerState.QUICK_STOP_ACTIVE and target is PowerState.SWITCH_ON_DISABLED:
            self._motor.switch_off(self._node.now_ns)
        self.state = target

    def _brake(self) -> None:
        now = self._node.now_ns
        speed, per_radian = abs(self._motor.speed(now)), self._motor.counts_per_turn / (2.0 * math.pi)
        deceleration = self._node.objects.number(0x6085) or 1  # a drive without one brakes for as long as it may
        self._slow = max(_SLOW * speed, 1e-9 * _MS * deceleration / per_radian)
        self._ramp_ends_ns = now + _LONGEST_NS
        self._motor.brake(now)
        self._node.after(_RAMP, max(_MS, round(1e9 * speed * per_radian / deceleration)))
