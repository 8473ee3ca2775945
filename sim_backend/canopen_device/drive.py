"""Emulate a CANopen torque drive: frames and times in, frames out.

2F70h says after how many periods (1006h) without SYNC, and 2F75h after how many milliseconds without a target torque,
the drive takes its host for gone; 0 is never.

In mode 8 (cyclic synchronous position) a loop of 1 ms follows 607Ah, between two targets on a straight line that takes
the interpolation period (60C2h), by stiffness, damping and an integral part as a maker's tool would have tuned them.
The torque that it tells is then the mean since the SYNC before.

Demand is target plus offset, in counts of the target, cut off at the drive's limits (of CiA 402: thousandths of the
rated torque, 6072h and 6073h). Above the speed limit (6080h) no torque acts that leads faster; the target is ignored
then, and the statusword says so (bit 12). Software position limits (607Dh) are of the position modes: torque acts
beyond them. Current is told as torque, since the motor is linear.

`TRANSITIONS` is the standard's table, `_LEAVING` says what the motor does when the drive function ends. A quick stop,
and a fault reaction by ramp, brake with shorted windings for as long as the configured deceleration would take, and on
for up to 0.1 s until the motor is slow; this drive has no other way to slow down. After that, and without power, the
motor coasts, unless the description says that the drive leaves the windings shorted or that the joint has a brake.

A host configures it by SDO alone; all it does follows from its object dictionary. At a SYNC the position is sampled
and told, then the torque that came before the SYNC begins to act.

What makes it stop by itself, each by the option in 6007h (0 nothing, 1 fault, of a drive that is off too, 2 disable
voltage, 3 quick stop; CiA 402-2, 10.3.2; without 6007h the maker's choice, here 1): a heartbeat or a question of node
guarding that stays away (1016h, 100Ch and 100Dh, after which the node also leaves `operational`, 1029h:01), an RPDO
that stays away for longer than its event timer, SYNC that stays away for 2F70h of its periods (1006h), a target torque
that does for 2F75h [ms], and NMT commands that end `operational`. The two entries of the maker's stand for those of
real ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, IntEnum

from drivers.can.can_frame import Frame
from sim_backend.canopen_device import nmt
from sim_backend.canopen_device.emergency import Emergency
from sim_backend.canopen_device.nmt import Nmt, State
from sim_backend.canopen_device.node import Node
from sim_backend.canopen_device.objects import WRONG_STATE, WRONG_VALUE, Objects, SdoAbort, SdoServer
from sim_backend.canopen_device.pdo import COMMUNICATION, MAPPING, MOST_MAPPED, RPDO_TIMEOUT, Pdos, check_write
from sim_backend.canopen_device.personality import LIKE_NEW, DriveProperties, Firmware
from sim_backend.emulator.face import Traffic
from sim_backend.emulator.motor import Motor

NO_SYNC, NO_TARGET = 0x8700, 0xFF01
_PERIODS, _MILLISECONDS, _SYNC_PERIOD = 0x2F70, 0x2F75, 0x1006
_SYNC, _TARGET = "sync", "target"


class VendorWatchdogs:
    """Emulate both watchdogs of one drive; each starts with the first event that it supervises."""

    def __init__(self, node: Node, emergency: Emergency, late: Callable[[], None], *, there: bool) -> None:
        """Use the drive's parts; `late` is called when the host is gone, `there`: whether the drive has watchdogs."""
        self._there = there
        self._node, self._emergency, self._late = node, emergency, late

    def sync_arrived(self) -> None:
        """Restart the watchdog of SYNC, if the drive has it set, and end its emergency, which sends `error reset`."""
        number = self._node.objects.number
        self._wait(_SYNC, NO_SYNC, number(_PERIODS) * number(_SYNC_PERIOD) * 1_000)

    def target_arrived(self) -> None:
        """Restart the watchdog of target torques, if the drive has it set, and end its emergency (`error reset`)."""
        self._wait(_TARGET, NO_TARGET, self._node.objects.number(_MILLISECONDS) * 1_000_000)

    def stop(self) -> None:
        """Stop both watchdogs."""
        self._node.stop_timer(_SYNC)
        self._node.stop_timer(_TARGET)

    def timer_ran_out(self, timer: str) -> None:
        """Add the error of a missing SYNC or target, and let the drive react by 6007h, if `timer` is of one."""
        if timer in (_SYNC, _TARGET):
            self._emergency.add_error(NO_SYNC if timer == _SYNC else NO_TARGET)
            self._late()

    def _wait(self, name: str, code: int, delay_ns: int) -> None:
        if delay_ns and self._there:
            self._node.start_timer(name, delay_ns)
            self._emergency.remove_errors(code)


_RPM = 60.0 / (2.0 * math.pi)


@dataclass(frozen=True)
class Tuning:
    """Hold the gains of a position loop at the motor: [N m/rad], [N m s/rad], [N m/(rad s)]."""

    stiffness: float = 0.0
    damping: float = 0.0
    integral: float = 0.0


_CSP, _LOOP, _LOOP_NS = 8, "position loop", 1_000_000


class PositionLoop:
    """Follow target positions of one motor."""

    def __init__(self, objects: Objects, motor: Motor, tuning: Tuning) -> None:
        """Start with a loop that is not closed."""
        self._objects, self._motor, self._tuning = objects, motor, tuning
        self._line: tuple[float, float, int] | None = None  # from [counts], to [counts], since [ns]
        self._goal = 0
        self._integral, self._last_ns = 0.0, 0

    def release(self) -> None:
        """End the position loop; when `torque` is called again, it begins from where the motor is then."""
        self._line, self._integral = None, 0.0

    def torque(self, now_ns: int, max_torque: float) -> float:
        """Step the loop and return the motor torque it asks for [N m]; above `max_torque` its integral is frozen."""
        goal, per_radian = self._objects.number(0x607A), self._motor.counts_per_turn / (2.0 * math.pi)
        actual = self._motor.encoder(now_ns)
        if self._line is None:
            self._line, self._last_ns = (actual, goal, now_ns), now_ns
        elif goal != self._goal:
            self._line = self._at(now_ns)[0], goal, now_ns
        self._goal = goal
        there, slope = self._at(now_ns)
        away, seconds = (there - actual) / per_radian, (now_ns - self._last_ns) * 1e-9
        lag = slope / per_radian - self._motor.speed(now_ns)
        asked = self._tuning.stiffness * away + self._tuning.damping * lag + self._integral
        if abs(asked) < max_torque or asked * away < 0.0:
            self._integral += self._tuning.integral * away * seconds
        self._last_ns = now_ns
        return asked

    def _at(self, now_ns: int) -> tuple[float, float]:
        """Return where the motor shall be [counts], and how fast [counts/s]."""
        assert self._line is not None  # noqa: S101 - set by the caller
        first, last, since_ns = self._line
        number, power = self._objects.number(0x60C2, 1), self._objects.number(0x60C2, 2)
        period = number * 10.0 ** min(max(power, -9), 9) or 1e-3
        share = (now_ns - since_ns) * 1e-9 / period
        return (last, 0.0) if share >= 1.0 else (first + share * (last - first), (last - first) / period)


class TorqueLoop:
    """Compute demand and limits of one motor.

    Attributes:
        limited: whether a limit of the drive holds the torque back (bit 11 of the statusword).
        follows: whether the target acts (bit 12).
    """

    def __init__(self, objects: Objects, motor: Motor, personality: DriveProperties, tuning: Tuning) -> None:
        """Start with a loop that is not closed."""
        self._objects, self._motor, self._personality = objects, motor, personality
        self._position = PositionLoop(objects, motor, tuning)
        self._acting, self._sum, self._told_ns = (0.0, 0), 0.0, 0  # torque [counts] and since when [ns]
        self.limited = self.follows = False

    def release(self) -> None:
        """End the torque loop and set its reported torques to 0; the power stage decides what the motor does now."""
        self.limited = self.follows = self._motor.holds = False
        self._position.release()
        for index in (0x6074, 0x6077, 0x6078):
            self._objects.values[index << 8] = 0

    def evaluate(self, now_ns: int) -> None:
        """Limit the torque that is asked for, make the motor give it, and set the entries that report it."""
        number = self._objects.number
        values = self._objects.values
        cyclic = number(0x6061) in self._personality.modes
        target = self._personality.target_torque(self._objects) + number(0x60B2) if cyclic else 0
        if follows := number(0x6061) == _CSP and 0x607A00 in self._objects.entries:
            count = self._personality.torque_of_counts(1.0, self._objects)
            most, self._motor.holds = self._personality.torque_limit(self._objects) * count, True
            target = round(self._position.torque(now_ns, most) / count) if count else 0
        reach = int(self._personality.torque_limit(self._objects) * self._motor.defects.torque_share)
        demand = min(max(target, -reach), reach)
        self.follows = cyclic or follows
        self.limited = demand != target
        if demand and self._exceeds_max_speed(demand, now_ns):
            demand, self.limited, self.follows = 0, True, False
        values[0x607400] = demand
        fraction = self._motor.defects.torque_fraction
        if follows:
            self._add(fraction * demand, now_ns)
        else:
            values[0x607700] = values[0x607800] = round(fraction * demand)
        self._motor.drive(self._personality.torque_of_counts(fraction * demand, self._objects), now_ns)

    def _add(self, acts: float, now_ns: int) -> None:
        """Note the torque [counts] that acts from now on, for the mean that is reported."""
        acted, since_ns = self._acting
        self._sum += acted * (now_ns - since_ns)
        self._acting = acts, now_ns

    def report_mean_torque(self, now_ns: int) -> None:
        """Set 6077h and 6078h to the mean torque since the last call, while a position loop holds the motor."""
        if not self._motor.holds:
            return
        self._add(self._acting[0], now_ns)
        if now_ns > self._told_ns:
            values = self._objects.values
            values[0x607700] = values[0x607800] = round(self._sum / (now_ns - self._told_ns))
        self._sum, self._told_ns = 0.0, now_ns

    def _exceeds_max_speed(self, demand: int, now_ns: int) -> bool:
        speed, most = self._motor.speed(now_ns), self._personality.speed_limit(self._objects)
        return most is not None and speed * demand > 0.0 and abs(speed) * _RPM > most


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


def command_of(controlword: int) -> Command:
    """Return the command in a controlword (CiA 402-2, table 27)."""
    if not controlword & 2:
        return Command.DISABLE_VOLTAGE
    if not controlword & 4:
        return Command.QUICK_STOP
    if not controlword & 1:
        return Command.SHUTDOWN
    return Command.ENABLE_OPERATION if controlword & 8 else Command.SWITCH_ON


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
        """Enter `switch on disabled`, as the self-test has ended (transitions 0 and 1)."""
        self._word = 0
        self.state = PowerState.SWITCH_ON_DISABLED

    def shut_down(self) -> None:
        """Enter `not ready to switch on`, as when the firmware stops; the motor stays as it is."""
        self._node.stop_timer(_RAMP)
        self.state = PowerState.NOT_READY

    def process_controlword(self, controlword: int) -> bool:
        """Process a controlword; return True only where it resets a fault: a rising bit 7 in the state `fault`."""
        before, self._word = self._word, controlword
        rising = bool(controlword & _RESET and not before & _RESET)
        if self.state is PowerState.FAULT:
            return rising
        command = command_of(controlword)
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
        """Enter `switch on disabled` (transition 15): the cause of a fault is gone, and a host has reset it."""
        self.state = PowerState.SWITCH_ON_DISABLED

    def disable_voltage(self) -> None:
        """Make the transition of the command disable voltage, if the present state has one."""
        if (target := TRANSITIONS.get((self.state, Command.DISABLE_VOLTAGE))) is not None:
            self._to(target)

    def quick_stop(self) -> None:
        """Brake where operation is enabled (605Ah 0: switch off at once), else go where that command leads."""
        if self.state is PowerState.OPERATION_ENABLED:
            if self._node.objects.number(0x605A) == 0:
                self._to(PowerState.SWITCH_ON_DISABLED)
            else:
                self.state = PowerState.QUICK_STOP_ACTIVE
                self._brake()
        elif (target := TRANSITIONS.get((self.state, Command.QUICK_STOP))) is not None:
            self._to(target)

    def trip(self, *, coasting: bool = False) -> None:
        """Enter a fault state: after braking if the motor is driven, at once when `coasting` or by option 605Eh = 0."""
        if self.state in (*_FAULTS, PowerState.NOT_READY):
            return
        if coasting or self._node.objects.number(0x605E) == 0:
            end = self._motor.fail if coasting else self._motor.switch_off
            end(self._node.now_ns)
            self._node.stop_timer(_RAMP)
            self.state = PowerState.FAULT
        elif self.state in (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE):
            self.state = PowerState.FAULT_REACTION_ACTIVE
            self._brake()
        else:
            self.state = PowerState.FAULT

    def switch_supply(self, on: bool) -> None:
        """Switch the power stage's supply on or off; without it the motor is off and powered states end."""
        self.voltage = on
        if not on:
            self._motor.switch_off(self._node.now_ns)
            if self.state in POWERED:
                self._node.stop_timer(_RAMP)
                faulty = self.state is PowerState.FAULT_REACTION_ACTIVE
                self.state = PowerState.FAULT if faulty else PowerState.SWITCH_ON_DISABLED

    def timer_ran_out(self, timer: str) -> None:
        """Go on with braking, or end it, if `timer`, which ran out, is that of the ramp; ignore others."""
        if timer != _RAMP:
            return
        now = self._node.now_ns
        if now < self._ramp_ends_ns and abs(self._motor.speed(now)) > self._slow:
            self._node.start_timer(_RAMP, _MS)
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
        self._node.stop_timer(_RAMP)
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
        self._node.start_timer(_RAMP, max(_MS, round(1e9 * speed * per_radian / deceleration)))


BOOT_NS = 20_000_000  # from a reset to the boot-up message
NO_HEARTBEAT, SYNC_LENGTH, NO_VOLTAGE, POWER_STAGE = 0x8130, 0x8240, 0x3220, 0x5400
_PDO_PARAMETERS = {index for group in (*COMMUNICATION, *MAPPING) for index in group}
_DRIVE_OBJECTS = 0x6000
# CiA 301, 7.5.2.13 and 14: "save" and "load", little-endian.
_STORE, _RESTORE, NOT_STORED = 0x1010, 0x1011, 0x08000020
_SIGNATURES = {_STORE: 0x65766173, _RESTORE: 0x64616F6C}
_FAULT = 1  # of 6007h
_WARNING, _REMOTE, _LIMITED, _FOLLOWS, _VOLTAGE = 0x0080, 0x0200, 0x0800, 0x1000, 0x0010
# Key of the position entry; a TPDO without it is no feedback.
_POSITION = 0x606400


class CanopenDrive:
    """Emulate one node with its motor; implements the interface of `sim_backend/emulator/face.py`.

    Attributes:
        objects: object dictionary of the drive.
        motor: motor that it drives.
        emergency: errors of the drive.
        nmt: state of the drive in the network.
        power: state of the drive by CiA 402.
        sync_identifier: identifier of SYNC frames.
        deaf: whether a defect makes it go on when its watchdogs should stop it.
    """

    def __init__(
        self,
        eds: str,
        number: int,
        motor: Motor,
        own: dict[int, int] | None = None,
        like: DriveProperties = LIKE_NEW,
        tuning: Tuning = Tuning(),
    ) -> None:
        """Create a drive without power.

        Args:
            eds: text of its electronic data sheet.
            number: node id.
            motor: motor that it drives.
            own: numbers that its entries have instead of what the EDS says, by key.
            like: properties of the drive that are not in the EDS.
            tuning: tuning of its position loop.

        Raises:
            DriverError: an EDS that cannot be read.
        """
        self._personality = like
        self.objects = Objects(eds, number, {0x608F01: motor.counts_per_turn, **dict(like.motor), **(own or {})})
        self.motor = motor
        self._node = node = Node(number, self.objects)
        self._sdo = SdoServer(self.objects)
        self.emergency = Emergency(node)
        self.nmt = Nmt(
            node, boot_ns=BOOT_NS, entered=self._entered, reset=self._reset, lost=self._lost, found=self._found
        )
        self.power = PowerStage(node, motor)
        self._pdos = Pdos(node, self.emergency, self._arrived, self._late)
        self._torque = TorqueLoop(self.objects, motor, self._personality, tuning)
        self._firmware = Firmware(node, self._personality, self._control)
        self._makers = VendorWatchdogs(node, self.emergency, self._late, there=like.shipped)
        self._failure = 0
        self._warned = self._evaluated = self._synced = False
        self._ears: set[int] = set()
        self.sync_identifier = 0
        self.deaf = False
        self.objects.before_read = self._about_to_read
        self.objects.veto = self._veto
        self.objects.written = self._written
        self._like_new()

    @property
    def number(self) -> int:
        """Return the node id."""
        return self._node.number

    @property
    def next_deadline_ns(self) -> int | None:
        """Return when `tick` has something to do [ns]; None for never."""
        timers = self._node.timers
        return min(timers.values()) if timers else None

    @property
    def state(self) -> str:
        """Describe the state of the network, of the drive, and its errors, in words."""
        errors = "".join(f", error 0x{code:04X}" for code in self.emergency.active)
        return f"{self.nmt.state.name}, {self.power.state.name}".lower().replace("_", " ") + errors

    @property
    def released(self) -> bool:
        """Return whether the drive is off, and pre-operational because a host's NMT command put it there."""
        off = self.power.state is PowerState.SWITCH_ON_DISABLED
        return off and self.nmt.commanded and self.nmt.state is State.PRE_OPERATIONAL

    def power_up(self, now_ns: int) -> None:
        """Power the drive up; the boot-up message follows with the next `tick`."""
        self._node.now_ns = now_ns
        self.motor.power_up(now_ns)
        self._like_new()
        self.nmt.boot(0)

    def receive(self, frame: Frame, now_ns: int) -> list[Frame]:
        """Process a frame of another node and return the frames that follow; of a SYNC, only the answers to it.

        Args:
            frame: frame of any kind; one that is not for this drive does nothing.
            now_ns: present time [ns], not before that of the last call.
        """
        if frame.error or frame.extended:
            return []
        self._node.now_ns = now_ns
        if frame.remote:
            if frame.identifier == 0x700 + self._node.number and self.nmt.state is not State.INITIALISING:
                self.nmt.answer_guarding()
            return self._finish()
        identifier, state = frame.identifier, self.nmt.state
        if identifier == 0:
            self.nmt.command(frame.data)
        elif state is State.INITIALISING:
            return []
        elif identifier == self.sync_identifier:
            if state is not State.STOPPED:
                self._sync(frame.data)
                out, self._node.out = self._node.out, []
                return out
        elif identifier == 0x600 + self._node.number:
            if state is not State.STOPPED and (answer := self._sdo.answer(frame.data)) is not None:
                self._node.send(0x580 + self._node.number, answer)
        elif identifier in self._pdos.rpdos:
            if not self._pdos.receive(identifier, frame.data):
                return []
        elif 0x700 < identifier < 0x780:
            self.nmt.heartbeat_arrived(frame)
        return self._finish()

    def finish_sync(self, now_ns: int) -> list[Frame]:
        """Apply the received torques, after a SYNC that `receive` has answered; return the frames that follow."""
        self._node.now_ns = now_ns
        if self._synced:
            self._synced = self._evaluated = False
            self._pdos.apply_received()  # limits depend on where the motor is, whether a torque has come or not
            if not self._evaluated and self.power.state is PowerState.OPERATION_ENABLED:
                self._torque.evaluate(now_ns)
        return self._finish()

    def tick(self, now_ns: int) -> list[Frame]:
        """Process the timers that are due, in their order; returns the frames that the drive sends."""
        timers = self._node.timers
        while timers:
            name = min(timers, key=timers.__getitem__)
            if timers[name] > now_ns:
                break
            self._node.now_ns = max(timers.pop(name), self._node.now_ns)
            for part in (self.nmt, self._makers, self._pdos, self.power, self.emergency, self._firmware):
                part.timer_ran_out(name)
            if name == _LOOP and self.power.state is PowerState.OPERATION_ENABLED:
                self._sample(self._node.now_ns)
                self._torque.evaluate(self._node.now_ns)
            self._refresh()
            self._pdos.send_changes()
        self._node.now_ns = max(now_ns, self._node.now_ns)
        return self._finish()

    def watch(self, now_ns: int) -> None:
        """Sample position and speed between frames, and limit the torque by them, while operation is enabled."""
        if self.power.state is PowerState.OPERATION_ENABLED:
            self._sample(now_ns)
            self._torque.evaluate(now_ns)

    def listens(self, identifier: int) -> bool:
        """Return whether a frame of this identifier means anything to this drive."""
        return identifier in self._ears or 0x700 < identifier < 0x780

    def traffic_kind(self, frame: Frame) -> Traffic:
        """Return whether a frame that this drive has sent is position feedback, a heartbeat or another."""
        if frame.identifier == 0x700 + self._node.number:
            return Traffic.HEARTBEAT
        for number, index in enumerate(COMMUNICATION[1]):
            if self.objects.number(index, 1) & 0x7FF == frame.identifier:
                entries = range(1, min(self.objects.number(MAPPING[1][number]), MOST_MAPPED) + 1)
                keys = [self.objects.number(MAPPING[1][number], k) >> 8 for k in entries]
                return Traffic.FEEDBACK if _POSITION in keys else Traffic.OTHER
        return Traffic.OTHER

    def fail(self, code: int, now_ns: int, *, lasting: bool = False) -> list[Frame]:
        """Simulate a fault that the drive finds in itself; return the frames that it sends.

        Args:
            code: code of the emergency message, which is also in 603Fh.
            now_ns: present time [ns].
            lasting: whether it is the power stage that fails: the motor coasts at once, and no reset helps until
                `end_lasting_fault`.
        """
        self._node.now_ns = now_ns
        if lasting:
            self._failure = code
        self.emergency.add_error(code)
        self.power.trip(coasting=lasting)
        return self._finish()

    def end_lasting_fault(self) -> None:
        """End a lasting fault; it still has to be reset."""
        self._failure = 0

    def ignore_watchdogs(self, ignored: bool) -> None:
        """Set whether a defect makes the drive go on although its host is gone."""
        self.deaf = ignored

    def set_warning(self, active: bool, now_ns: int) -> list[Frame]:
        """Begin or end a warning (statusword bit 7, which errors set too); return the frames that the drive sends."""
        self._node.now_ns = now_ns
        self._warned = active
        return self._finish()

    def switch_supply(self, on: bool, now_ns: int) -> list[Frame]:
        """Switch the motor's power, not the firmware's, on or off; return the frames, an emergency with them."""
        self._node.now_ns = now_ns
        self.power.switch_supply(on)
        if on:
            self.emergency.remove_errors(NO_VOLTAGE)
        else:
            self.emergency.add_error(NO_VOLTAGE)
        return self._finish()

    def reboot(self, now_ns: int) -> list[Frame]:
        """Restart the firmware by itself, as after a brown-out; return the frames that the drive sends."""
        self._node.now_ns = now_ns
        self.nmt.reset(nmt.Command.RESET_NODE)
        return self._finish()

    def evaluate(self, now_ns: int) -> None:
        """Evaluate position, speed and torque again after a defect has changed, if operation is enabled."""
        self.watch(now_ns)

    # Called by the parts of the drive.

    def _sync(self, data: bytes) -> None:
        if data:
            self.emergency.add_error(SYNC_LENGTH)  # without a counter (1019h is 0) it has none (CiA 301, 7.2.5)
            return
        if self.nmt.state is State.OPERATIONAL:
            self._makers.sync_arrived()
        self._sample(self._node.now_ns)
        self._torque.report_mean_torque(self._node.now_ns)
        self._pdos.sync_arrived()
        self._synced = True

    def _sample(self, now_ns: int) -> None:
        values = self.objects.values
        values[_POSITION] = self.motor.encoder(now_ns)
        speed = self.motor.speed(now_ns) * self.motor.counts_per_turn / (2.0 * math.pi)
        values[0x606C00] = round(speed)

    def _arrived(self, keys: tuple[int, ...]) -> None:
        """Handle objects that an RPDO or an SDO has set."""
        if self._personality.target in keys and self.nmt.state is State.OPERATIONAL:
            self._makers.target_arrived()
        self._firmware.entries_written(keys)
        if self.power.state is PowerState.OPERATION_ENABLED:
            self._torque.evaluate(self._node.now_ns)
            self._evaluated = True

    def _control(self, word: int) -> None:
        if self.power.process_controlword(word) and not self._failure:
            self.power.reset_fault()
            waiting = {NO_HEARTBEAT} if self.nmt.silent_nodes else set()
            waiting |= {NO_VOLTAGE} if not self.power.voltage else set()
            self.emergency.remove_errors(*[code for code in self.emergency.active if code not in waiting])

    def _late(self) -> None:
        self._abort_connection()

    def _lost(self, number: int) -> None:
        self.emergency.add_error(NO_HEARTBEAT)
        self._abort_connection()
        if self.objects.number(0x1029, 1) == 0 and self.nmt.state is State.OPERATIONAL:
            self.nmt.leave_operational()

    def _found(self, number: int) -> None:
        if not self.nmt.silent_nodes:
            self.emergency.remove_errors(NO_HEARTBEAT)

    def _abort_connection(self) -> None:
        if self.deaf:
            return
        match self.objects.number(0x6007) if 0x600700 in self.objects.entries else _FAULT:  # its maker's
            case 1:
                self.power.trip()
            case 2:
                self.power.disable_voltage()
            case 3:
                self.power.quick_stop()

    def _entered(self, before: State) -> None:
        if self.nmt.state is State.OPERATIONAL:
            self._pdos.start()
        elif before is State.OPERATIONAL:
            self._pdos.stop()
            self._makers.stop()
            self.emergency.remove_errors(RPDO_TIMEOUT)
            self._abort_connection()
        if before is State.INITIALISING and self.power.state is PowerState.NOT_READY:
            self.power.start()

    def _reset(self, command: nmt.Command) -> None:
        self._sdo.reset()
        self.emergency.reset()
        if command is nmt.Command.RESET_NODE:
            self.power.shut_down()
            self.motor.power_up(self._node.now_ns)
            self._like_new()
        else:
            self._abort_connection()
            self._communication_like_new()

    def _like_new(self) -> None:
        self.objects.reset(_DRIVE_OBJECTS)
        self.power.shut_down()
        self._torque.release()
        self._communication_like_new()

    def _communication_like_new(self) -> None:
        self.objects.reset(last=_DRIVE_OBJECTS - 1)
        self._configure()

    def _configure(self) -> None:
        self._pdos.configure()
        self.sync_identifier = self.objects.number(0x1005) & 0x7FF or 0x80
        self._ears = {0, self.sync_identifier, 0x600 + self._node.number, *self._pdos.rpdos}

    def _about_to_read(self, key: int) -> None:
        if key in (_POSITION, 0x606C00):
            self._sample(self._node.now_ns)

    def _veto(self, key: int, value: int) -> None:
        check_write(self.objects, key, value)
        index = key >> 8
        if index in _PDO_PARAMETERS and not self._personality.shipped and self.nmt.state is State.OPERATIONAL:
            raise SdoAbort(WRONG_STATE)
        if key == 0x100300 and value:
            raise SdoAbort(WRONG_VALUE)
        if index in _SIGNATURES and value != _SIGNATURES[index]:
            raise SdoAbort(NOT_STORED)
        if index in (0x1005, 0x1014) and value & 0x7FFF_F800:
            raise SdoAbort(WRONG_VALUE)  # extended identifiers, and producing SYNC

    def _written(self, key: int) -> None:
        index = key >> 8
        # Process data and the history of errors are no configuration (CiA 301, 7.5.2.21).
        if index not in (0x1003, 0x1020) and not self.objects.entries[key].mappable:
            self.objects.put(0x1020, 0, 1)
            self.objects.put(0x1020, 0, 2)
        if index in _SIGNATURES:
            self.objects.values[key] = self.objects.entries[key].default  # what it tells is what it can
            (self.objects.store if index == _STORE else self.objects.restore)()
        elif index in _PDO_PARAMETERS or index == 0x1005:
            self._configure()
        elif index == 0x1016:
            self.nmt.configure_consumers()
        elif index == 0x1017:
            self.nmt.configure_producer()
        elif index in (0x100C, 0x100D):
            self.nmt.configure_guarding()
        elif key == 0x100300:
            for number in range(1, 9):
                self.objects.put(0x1003, 0, number)
        elif index >= _DRIVE_OBJECTS:
            self._arrived((key,))

    def _refresh(self) -> None:
        """Update the statusword (CiA 402-2, table 29)."""
        state = self.power.state
        if state is not PowerState.OPERATION_ENABLED and (self._torque.follows or self._torque.limited):
            self._torque.release()
        word = int(state) | _REMOTE
        if self.power.voltage:
            word |= _VOLTAGE
        if self._warned or (self.emergency.active and not state & 0x08):
            word |= _WARNING
        if self._torque.limited:
            word |= _LIMITED
        if self._torque.follows:
            word |= _FOLLOWS
        self.objects.values[0x604100] = word

    def _finish(self) -> list[Frame]:
        if self.nmt.state is not State.INITIALISING:
            self._refresh()
            self._pdos.send_changes()
        closed = self.power.state is PowerState.OPERATION_ENABLED and self.objects.number(0x6061) == _CSP
        if closed and _LOOP not in self._node.timers:
            self._node.start_timer(_LOOP, _LOOP_NS)
        out, self._node.out = self._node.out, []
        return out
