"""Drive an arm of Barrett's pucks: a WAM as it really speaks.

A person enables it. The host never raises a MODE: it asks for positions, sends torques of zero, says that
Shift-Activate is to be pressed, and waits; as soon as the safety puck says ACTIVE, the arm is enabled. An arm that
somebody activates while nobody waits is taken back to IDLE at once, as nothing would hold it.

Both kinds of stop are IDLE: the pucks short their windings and the arm sinks slowly, which is the best passive state of
an arm without brakes; a stream of zero torques would let it fall. IDLE is asked for in every cycle until all say so.

`Sample.torque` acts from the stamp of its cycle, to about 0.15 ms (`cycle.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from math import pi
from pathlib import Path
from typing import Final

import numpy as np

from drivers.arm import (
    Arm,
    ArmDescription,
    Sample,
    SetupCheck,
    StopKind,
    Vector,
    Watchdog,
    read_only,
    require_set_up,
)
from drivers.axis_status import AxisEvent, AxisEventCode, AxisStatus
from drivers.barrett import setup
from drivers.barrett.cycle import MotorPuck, PuckBus, PuckCodec, axis_status, budget
from drivers.barrett.protocol import POSITION_BITS, Group, Mode, Properties, SafetyMode, Status, get_frame, set_frame
from drivers.can.bus_load import Budget
from drivers.can.bus_state import BUS_EVENTS, HOST, Event, EventCode, controller_checks
from drivers.can.can_link import Link, open_links
from drivers.can.frame_log import BusSession
from drivers.clock import Clock, RealClock, VirtualClock
from drivers.motor_units import Coordinates, motor_coordinates, unwrapped
from ident_service.config.arm import ArmConfig
from ident_service.config.barrett import BarrettDriver
from ident_service.errors import ActionNeeded, DriverError, EmergencyStopped, NobodyEnabled, PositionUnknown

_CYCLES: Final = 3  # in a row beyond the tolerance: two encoders are not read in the very same moment


class JointEncoders:
    """Follow encoders at the joints, and compare how far joints and motors have moved since the arm was opened.

    What a joint encoder counts from is not known. So each takes the motors' position where the arm is opened, and from
    then on says the same as they, but for what cables stretch. Where it does not, a cable has slipped or broken, or one
    of the two encoders is wrong.
    """

    def __init__(self, driver: BarrettDriver, coordinates: Coordinates, names: Sequence[str]) -> None:
        """Use the description; nothing is known yet.

        Args:
            driver: the section `driver`.
            coordinates: of the arm.
            names: of the joints.
        """
        self._names, self._tolerance = names, driver.joint_tolerance
        self._radians = {k: 2.0 * pi / puck.joint_counts for k, puck in enumerate(driver.pucks) if puck.joint_counts}
        self._motors_of = coordinates.motors_of
        self._counts: dict[int, int] = {}
        self._origin: dict[int, float] = {}
        self.reset_counts()
        self._position = np.full(len(names), np.nan)

    def checks(self, pucks: Sequence[MotorPuck]) -> tuple[SetupCheck, ...]:
        """Return a set-up check of each puck that reports a joint encoder, or should by the description.

        Args:
            pucks: pucks with their answers.
        """
        remedy = "List the nodes that read one in driver.joint_encoders, with joint_counts; its bits are on the bus."
        words = {True: "told", False: "not told"}
        return tuple(
            SetupCheck(
                f"joint encoder of puck {puck.node}", words[puck.encoder is not None], words[k in self._radians], remedy
            )
            for k, puck in enumerate(pucks)
            if (puck.encoder is not None) or k in self._radians
        )

    def set_origins(self, pucks: Sequence[MotorPuck], position: Vector) -> None:
        """Set the encoders' origins so that they agree with the motors' position [rad], shape (joints,)."""
        for k in self._radians:
            self._counts[k] = pucks[k].encoder or 0
            self._origin[k] = float(position[k]) - self._counts[k] * self._radians[k]
        self.reset_counts()

    def reset_counts(self) -> None:
        """Reset the counts of deviations and of missing encoders, so that what persists is reported again."""
        self._beyond = dict.fromkeys(self._radians, 0)
        self._without = dict.fromkeys(self._radians, 0)

    def update(self, pucks: Sequence[MotorPuck], position: Vector) -> tuple[Vector | None, list[AxisEvent]]:
        """Return joint encoders' positions [rad], None without any; events of joints newly off their motors or unread.

        Args:
            pucks: pucks at the end of a cycle.
            position: position of the joints by their motors [rad], shape (joints,).

        Returns:
            Positions by the encoders [rad], shape (joints,), NaN for joints without one; None for an arm without any.
            And an event of each joint that has come apart from its motors, or whose puck tells its encoder no more.
        """
        if not self._radians:
            return None, []
        found, told = self._position.copy(), []
        for k, radians in self._radians.items():
            encoder = pucks[k].encoder
            if encoder is None:
                self._without[k] += pucks[k].answered
                if self._without[k] == _CYCLES and pucks[k].answered:
                    words = f"puck {pucks[k].node} tells its position without that of its joint encoder"
                    told.append(AxisEvent(AxisEventCode.JOINT_ENCODER_LOST, k, words))
                continue
            self._without[k] = 0
            self._counts[k] = unwrapped(self._counts[k], encoder, POSITION_BITS)
            found[k] = self._counts[k] * radians + self._origin[k]
            if not all(pucks[motor].answered for motor in (*self._motors_of[k], k)):
                continue  # of different moments
            apart = found[k] - position[k]
            self._beyond[k] = self._beyond[k] + 1 if abs(apart) > self._tolerance else 0
            if self._beyond[k] == _CYCLES:
                words = (
                    f"{self._names[k]}: its encoder has moved {apart:+.3f} rad further than its motors since the arm "
                    f"was opened, {self._tolerance:g} rad are tolerated"
                )
                told.append(AxisEvent(AxisEventCode.TRANSMISSION_SLIPPED, k, words))
        found.setflags(write=False)
        return found, told


LOOK_RATE = 20.0  # Hz
_SETTLED = 5  # cycles in a row with everybody's position before an arm counts as open
_AWAKE = 2.0  # s within which they must come
_TRIES, _AGAIN = 75, 0.001  # s between two tries to stop
_FAREWELL = 20  # cycles, at most, in which pucks report that they are idle
_CLOSING = 1.0  # s, at most, in which a stop that the link does not take is sent again before the arm is left
_RAISED = 0.5  # s that all motors may take to follow the safety puck
_RESET = 1.0  # s
_LOWER_EVERY = 5  # cycles between two commands to an arm that is active while nobody drives it
_EXPLAINED = 4  # cycles, at most, that news of an arm that is not active any more wait for the pendant's reason
_SHIFT_IDLE = "find the cause, then press Shift-Idle on the pendant"

_CODES = BUS_EVENTS | {EventCode.DRIVE_STATE: AxisEventCode.DRIVE_LEFT}


class BarrettArm(Arm):
    """Implement an arm of pucks on one bus, behind one transmission."""

    operator_action = (
        "stand clear, then press Shift-Activate on the pendant (Shift-Idle before, where it shows a fault or blinks)"
    )

    def __init__(
        self, config: ArmConfig, open_bus: Callable[[ArmConfig], list[Link]] = open_links, *, looks: bool = False
    ) -> None:
        """Use the arm's description; nothing is opened.

        Args:
            config: configuration with a driver of pucks and a transmission.
            open_bus: function that opens the link.
            looks: whether the arm is only looked at: no property is set, and no torque sent.

        Raises:
            DriverError: the description lacks the driver, the transmission, or joints.
        """
        if not isinstance(config.driver, BarrettDriver) or config.transmission is None:
            raise DriverError(f"{config.name}: needs a driver of pucks (driver.kind: barrett) and a transmission")
        self._config, self._driver, self._open_bus, self._looks = config, config.driver, open_bus, looks
        self._period_ns = round(1e9 / (min(LOOK_RATE, config.control.rate) if looks else config.control.rate))
        pucks = config.driver.pucks
        self._coordinates: Coordinates = motor_coordinates(
            config.transmission,
            [puck.cts for puck in pucks],
            [puck.torque_scale / puck.ipnm for puck in pucks],
            [puck.mt for puck in pucks],
        )
        if len(config.joints) != len(pucks):
            raise DriverError(f"{config.name}: joints must name all {len(pucks)} joints")
        self._limits = np.array([np.inf if j.torque is None else j.torque for j in config.joints.values()])
        self._home = [joint.home for joint in config.joints.values()]
        joints = len(pucks)
        self._all_fresh = read_only(np.ones(joints, dtype=bool)), read_only(np.zeros(joints, dtype=np.int64))
        self._motors_of = self._coordinates.motors_of
        self._joint_encoders = JointEncoders(config.driver, self._coordinates, list(config.joints))
        joints_of = {k: joints for motors, joints in self._coordinates.groups for k in motors}
        names = list(config.joints)
        self._names = [
            f"{' and '.join(names[j] for j in joints_of[k])}: puck {puck.node}" for k, puck in enumerate(pucks)
        ]
        self._joint_of = {puck.node: joints_of[k][0] for k, puck in enumerate(pucks)}
        self.clock: Clock = VirtualClock() if config.driver.bus.interface == "lock_step" else RealClock()
        self._bus: PuckBus | None = None
        self._found: setup.FoundArm | None = None
        self._session = BusSession(config, open_bus)
        self._reset_state()

    def _reset_state(self) -> None:
        self._enabled = False
        self._untold = False  # whether a stop is still to be sent
        self._counts = [0] * len(self._limits)
        self._acting = read_only(np.zeros(len(self._limits)))
        self._unwrapped: list[int] = []
        self._cycle = 0
        self._stale: set[int] = set()
        self._status: tuple[int, ...] = ()
        self._checks: tuple[SetupCheck, ...] = ()
        self._unconfirmed: tuple[str, ...] = ()

    def look(self) -> Arm:
        """Return a closed arm that only asks the pucks for positions and states; its cycles refuse an active arm.

        What it asks for is seen by the safety puck as well; so it asks no active arm, whose host may be the one that is
        to be missed.
        """
        return BarrettArm(self._config, self._open_bus, looks=True)

    def zero(self) -> tuple[str, ...]:
        """Set the present position of the closed arm as its configured home; return in words what each puck got."""
        if self._bus is not None:
            raise DriverError("the arm is open; close it before it is zeroed")
        if self._looks:
            raise DriverError("an arm that is only looked at is not zeroed")
        home = [value for value in self._home if value is not None]
        if len(home) != len(self._home):
            raise DriverError(f"{self._config.name}: zeroing needs the home of every joint")
        port = self._open_port()
        try:
            found = setup.read_pucks(port, self._driver)
            self._require_reachable(found)
            return setup.write_home(port, found, self._coordinates, home)
        finally:
            self.close()

    def log_frames(self, path: Path) -> None:
        """Have the next session log every frame to a new file; DriverError for its suffix, at `open` if it exists."""
        self._session.log_frames(path)

    def logged(self) -> str:
        """Describe how the log of frames of the last session ended, in words; empty where none was kept."""
        return self._session.logged()

    def open(self) -> None:
        """Lock and open the bus, wake, check, idle and limit the pucks, and find where the arm stands.

        Raises:
            DriverError: the bus is in use, by another host too, or cannot be had; pucks do not answer, or cannot be
                reached by one frame. Nothing stays open.
            PositionUnknown: the arm has not been zeroed since power came; likewise.
        """
        if self._bus is not None:
            raise DriverError("the arm is already open")
        self._reset_state()
        try:
            port = self._open_port()
            found = setup.read_pucks(port, self._driver, wakes=not self._looks)
            self._found = found
            self._checks = setup.checks(found)
            self._require_reachable(found)
            if not self._looks:
                for frame in setup.idle_frames(found):
                    port.link.send(frame)
                setup.write_safety_limits(port, found, self._driver)
            if not setup.is_zeroed(port, found):
                raise PositionUnknown(
                    f"{self._config.name} has not been zeroed since its pucks have power (ZERO is 0): lead it home by "
                    "hand, then `ident set-home ARM`"
                )
            codec = PuckCodec(self._driver, found.motors, found.safety, self._period_ns * 1e-9)
            self._bus = PuckBus(port.link, codec, self._driver, self._period_ns)
            self._bus.looks = self._looks
            if not self._looks:
                setup.ignore_jumps(port, found)
            codec.controller = port.controller
            self._begin(self._bus)
        except BaseException:
            self.close()
            raise

    def describe(self) -> ArmDescription:
        """Return the description of the open arm; raises DriverError when it is not open."""
        self._require_open()
        found = self._coordinates
        pucks = () if self._found is None else self._found.pucks
        return ArmDescription(
            tuple(self._config.joints),
            1e9 / self._period_ns,
            np.minimum(found.torque_limit, self._limits),
            found.torque_resolution,
            found.position_resolution,
            tuple(str(puck) for puck in pucks),
            "drivers.barrett",
            lost_cycles=self._driver.lost_cycles,
            watchdog=self._driver.heartbeat,
            report_delay=self._driver.report_delay,
        )

    def bus_budget(self, rate: float | None = None) -> Budget:
        """Return the load of the bus at `rate` [Hz], by default the configured one; with remedies if it is too much."""
        return budget(self._driver, self._config.control.rate if rate is None else rate)

    def setup_checks(self) -> tuple[SetupCheck, ...]:
        """Return checks of the open arm's pucks and of a CAN controller in trouble; DriverError while not open."""
        return self._checks + controller_checks(self._driver.bus.channel, self._require_open().codec.controller)

    def watchdogs(self) -> tuple[Watchdog, ...]:
        """Return one watchdog for each puck: that of the safety puck, which acts when the bus is silent."""
        seconds, period = self._driver.heartbeat, self._period_ns * 1e-9
        # Meanwhile the safety puck is asked in every cycle whether it has acted.
        return tuple(
            Watchdog(name, "bus_silence", seconds, of_torque=False, report_delay=period) for name in self._names
        )

    def withhold(self, kind: str) -> None:
        """Stop sending torques and position requests, which the safety puck watches, until the next `stop`."""
        self._require_open().silent = True

    def drive_status(self) -> tuple[AxisStatus, ...]:
        """Return the last reported status of each puck of the open arm, in flags common to all fieldbuses."""
        codec = self._require_open().codec
        return tuple(axis_status(puck, codec.safety) for puck in codec.pucks)

    def enable(self) -> None:
        """Wait until a person activates the arm on its pendant, with zero torque; DriverError if nobody does in time.

        Raises:
            DriverError: not open, only looked at, a puck says something else of itself than the description, has a
                fault, the pendant shows one, nobody activates the arm in time, or nobody wants it any more. The arm is
                idle then.
        """
        bus = self._require_open()
        self._require_driven()
        self._no_torque()
        try:
            require_set_up(self.setup_checks())
            self._require_sound()
            if not self._enabled:
                self._wait_until_active(bus)
        except BaseException:
            self.stop(StopKind.TORQUE_OFF)
            raise
        bus.codec.forget_events()
        self._joint_encoders.reset_counts()
        self._enabled = True

    def reset(self) -> None:
        """Clear the errors of motor pucks; DriverError while enabled, if one stays, or the pendant shows a fault.

        Raises:
            DriverError: not open, enabled, an error stays because its cause does, or the pendant shows a fault.
        """
        bus = self._require_open()
        self._require_driven()
        if self._enabled:
            raise DriverError("the arm is enabled; stop it before its faults are cleared")
        self._refresh(bus)
        stat = setup.PropertyPort(bus.link)
        for puck in bus.codec.pucks:
            if puck.stat == Status.ERROR and self._found is not None:
                stat.link.send(set_frame(puck.node, self._found.motors.number("STAT"), Status.READY))
        until_ns = self.clock.now_ns() + round(_RESET * 1e9)
        while any(puck.stat == Status.ERROR for puck in bus.codec.pucks) and self.clock.now_ns() < until_ns:
            bus.cycle(None)
        self._require_sound()
        if bus.codec.safety.pendant.faults:
            raise ActionNeeded(f"the pendant shows {bus.codec.safety.pendant}; {_SHIFT_IDLE}")

    def exchange(self, torque: Vector | None) -> Sample:
        """Wait for the next cycle, send the torque clipped to its limits, or none for None, and return the sample.

        Raises:
            DriverError: as in the contract; also an arm that is looked at and has been activated.
        """
        bus = self._require_open()
        if torque is not None:
            if not self._enabled:
                raise DriverError("a torque was given, but the arm is not enabled")
            wanted = np.asarray(torque, dtype=float)
            if wanted.shape != self._limits.shape or not np.isfinite(wanted).all():
                raise DriverError(f"{len(self._limits)} finite torques are needed, not {torque}")
            wanted = np.minimum(np.maximum(wanted, -self._limits), self._limits)
            self._counts, _ = self._coordinates.torque_counts(wanted)
            self._acting = read_only(self._coordinates.joint_torque(self._counts))
        if not self._enabled:
            self._keep_idle(bus)
        stamp_ns = bus.cycle(None if torque is None else self._counts)
        sample = self._sample(bus, stamp_ns)
        self._cycle += 1
        return sample

    def stop(self, kind: StopKind) -> None:
        """Take all pucks to IDLE, whatever the kind, trying again where no frame could be sent; never raises."""
        self._enabled = False
        self._no_torque()
        if self._bus is None or self._found is None or self._looks:
            return
        self._bus.silent = False
        self._untold = True
        for _ in range(_TRIES):
            self._lower(self._bus)
            if not self._untold:
                break
            with suppress(Exception):
                self.clock.sleep_until_ns(self.clock.now_ns() + round(_AGAIN * 1e9))

    def close(self) -> None:
        """Take all pucks to IDLE, wait until they report it, and close the bus and the log; any number of times."""
        self.stop(StopKind.TORQUE_OFF)
        if self._bus is not None:
            if not self._looks:
                self._wait_until_idle(self._bus)
            self._bus.close()
        elif self._port is not None:
            with suppress(Exception):
                self._port.link.close()
        self._bus = self._found = self._port = None
        self._session.close()

    def unconfirmed(self) -> tuple[str, ...]:
        """Describe pucks that at the last closing were not known to be idle, or had restarted; empty if none."""
        return self._unconfirmed

    def _wait_until_idle(self, bus: PuckBus) -> None:
        """Send IDLE until all pucks say so, or have had their time; never raises."""
        for cycle in range(max(_FAREWELL, round(_CLOSING * 1e9 / self._period_ns))):
            if self._is_idle(bus) or (cycle >= _FAREWELL and not self._untold and not self._disobeys(bus)):
                break
            self._lower(bus)
            with suppress(Exception):
                if self._found is not None and cycle % _LOWER_EVERY == 0:
                    self._ask_whether_idle(bus, self._found.motors)
            with suppress(Exception):
                bus.cycle(None, asks_safety=True)
        pucks, safety = bus.codec.pucks, bus.codec.safety
        left = [name for name, puck in zip(self._names, pucks, strict=True) if puck.mode == Mode.TORQUE]
        left += [f"safety puck {safety.node}"] if safety.mode == SafetyMode.ACTIVE else []
        restarted = [name for name, puck in zip(self._names, pucks, strict=True) if puck.stat == Status.RESET]
        self._unconfirmed = (
            *(f"{name} has not said that it is idle" for name in left if name not in restarted),
            *(f"{name} has restarted" for name in restarted),
        )

    @staticmethod
    def _disobeys(bus: PuckBus) -> bool:
        """Return whether a puck that answers says that it is not idle; of one that does not nothing will be heard."""
        pucks, safety = bus.codec.pucks, bus.codec.safety
        heard = safety.mode == SafetyMode.ACTIVE and safety.status_age <= _LOWER_EVERY
        return heard or any(puck.mode == Mode.TORQUE and puck.answered for puck in pucks)

    @staticmethod
    def _ask_whether_idle(bus: PuckBus, motors: Properties) -> None:
        """Ask all pucks for MODE, and those that have not said IDLE for STAT: one that has restarted knows no MODE."""
        bus.link.send(get_frame(Group.ARM, motors.number("MODE"), group=True))
        for puck in bus.codec.pucks:
            if puck.mode == Mode.TORQUE:
                bus.link.send(get_frame(puck.node, motors.number("STAT")))

    _port: setup.PropertyPort | None = None

    def _open_port(self) -> setup.PropertyPort:
        """Lock and open the bus, and listen whether another host drives this arm before anything is sent."""
        links = self._session.open(locks=not self.clock.lock_step)
        self._port = setup.PropertyPort(links[0])
        self.clock = links[0].clock
        self._port.listen()
        return self._port

    def _begin(self, bus: PuckBus) -> None:
        """Cycle until everybody answers every request in time and has said its state."""
        until_ns = self.clock.now_ns() + round(_AWAKE * 1e9)
        self._refresh(bus)
        settled = 0
        while settled < _SETTLED or self._is_unknown(bus):
            if self.clock.now_ns() > until_ns:
                bad = [puck.node for puck in bus.codec.pucks if not puck.answered or puck.mode is None]
                raise DriverError(f"pucks {', '.join(map(str, bad)) or 'of all kinds'} do not answer in time")
            bus.cycle(None)
            settled = settled + 1 if bus.complete else 0
            if settled == _SETTLED and bus.answers_late():
                settled = 0
        nearest = zip(self._coordinates.zero, bus.codec.pucks, strict=True)
        self._unwrapped = [zero + puck.position for zero, puck in nearest]  # 22 bits are 512 turns: no arm wraps
        self._checks += self._joint_encoders.checks(bus.codec.pucks)
        self._joint_encoders.set_origins(bus.codec.pucks, self._coordinates.positions(self._unwrapped))
        bus.codec.forget_events()
        bus.lost = 0

    @staticmethod
    def _is_unknown(bus: PuckBus) -> bool:
        codec = bus.codec
        return codec.safety.mode is None or any(
            puck.mode is None or (puck.mode != Mode.TORQUE and puck.stat is None) for puck in codec.pucks
        )

    def _refresh(self, bus: PuckBus) -> None:
        """Ask everybody for its state at once, while nothing streams, and hear the answers."""
        for frame in bus.codec.questions():
            bus.link.send(frame)
            until_ns = self.clock.now_ns() + round(setup.TIMEOUT * 1e9)
            while (heard := bus.link.receive(until_ns)) is not None:
                bus.codec.receive(heard)
                if heard.identifier & 0x1F == Group.PROPERTIES:
                    break

    def _wait_until_active(self, bus: PuckBus) -> None:
        """Send zero torques until the safety puck says ACTIVE and all motors follow torques."""
        codec, period = bus.codec, self._period_ns * 1e-9
        zero = [0] * len(self._counts)
        for _ in range(max(_FAREWELL, round(_RAISED / period))):
            if self._is_idle(bus):
                break
            self._lower(bus)  # whoever has activated it has not seen that somebody waits
            bus.cycle(None, asks_safety=True)
        until_ns = self.clock.now_ns() + round(self._driver.activate_within * 1e9)
        while codec.safety.mode != SafetyMode.ACTIVE:
            if not self.still_wanted():
                raise NobodyEnabled("nobody wants the arm to be enabled any more")
            if self.clock.now_ns() > until_ns:
                waited = self._driver.activate_within
                raise NobodyEnabled(
                    f"nobody pressed Shift-Activate for {waited:g} s; the pendant: {codec.safety.pendant}"
                )
            bus.cycle(zero, asks_safety=True)
            self._require_sound()
        if self._found is not None:
            bus.link.send(get_frame(Group.ARM, self._found.motors.number("MODE"), group=True))
        for _ in range(max(_FAREWELL, round(_RAISED / period))):
            if all(status & AxisStatus.POWERED for status in self.drive_status()):
                return
            bus.cycle(zero, asks_safety=True)
            self._require_sound(active=True)
        idle = [name for name, word in zip(self._names, self.drive_status(), strict=True) if not word]
        raise DriverError(f"active, but these pucks do not take torques: {', '.join(idle) or 'some'}")

    def _require_sound(self, *, active: bool = False) -> None:
        """Raise DriverError where a puck has an error or the pendant shows what no heartbeat explains."""
        codec = self._require_open().codec
        bad = [name for name, p in zip(self._names, codec.pucks, strict=True) if p.stat == Status.ERROR]
        if bad:
            raise DriverError(
                f"{', '.join(bad)} has an error (STAT 1), which `ident recover ARM` clears once its cause has gone"
            )
        if codec.safety.mode == SafetyMode.ESTOP:
            raise EmergencyStopped("the emergency stop is pressed, or has been: release it, then press Shift-Idle")
        causes = [cause for cause in codec.safety.pendant.faults if cause not in ("heartbeat", "e-stop")]
        if causes:
            raise ActionNeeded(f"the pendant shows {' and '.join(causes)} fault; {_SHIFT_IDLE}")
        if active and codec.safety.mode != SafetyMode.ACTIVE:
            raise DriverError(f"the arm left ACTIVE at once; the pendant: {codec.safety.pendant}")

    def _is_idle(self, bus: PuckBus) -> bool:
        return bus.codec.safety.mode != SafetyMode.ACTIVE and all(p.mode != Mode.TORQUE for p in bus.codec.pucks)

    def _keep_idle(self, bus: PuckBus) -> None:
        """Lower an arm that nobody drives and that says it is active; repeat a stop that no frame could carry."""
        is_due = self._cycle % _LOWER_EVERY == 0
        if not self._looks and (self._untold or (is_due and not self._is_idle(bus))):
            self._lower(bus)

    def _lower(self, bus: PuckBus) -> None:
        """Send IDLE to everybody, every frame on its own; never raises."""
        self._untold = False
        for frame in () if self._found is None else setup.idle_frames(self._found):
            try:
                bus.link.send(frame)
            except Exception:  # noqa: BLE001 - whatever the link died of, it is tried again
                self._untold = True

    def _require_reachable(self, found: setup.FoundArm) -> None:
        if lost := setup.nodes_without_group(found):
            wrong = [str(one) for one in setup.checks(found) if not one.good]
            nodes = ", ".join(map(str, lost))
            raise DriverError(f"no group frame reaches pucks {nodes}: {'; '.join(wrong)}")

    def _require_open(self) -> PuckBus:
        if self._bus is None:
            raise DriverError("the arm is not open")
        return self._bus

    def _require_driven(self) -> None:
        if self._looks:
            raise DriverError("an arm that is only looked at is neither enabled nor reset")

    def _no_torque(self) -> None:
        self._counts = [0] * len(self._limits)
        self._acting = read_only(np.zeros(len(self._limits)))

    def _sample(self, bus: PuckBus, stamp_ns: int) -> Sample:
        pucks, safety = bus.codec.pucks, bus.codec.safety
        self._unwrapped = [
            unwrapped(before, puck.position, POSITION_BITS) for before, puck in zip(self._unwrapped, pucks, strict=True)
        ]
        position = self._coordinates.positions(self._unwrapped)
        joint_position, slipped = self._joint_encoders.update(pucks, position)
        valid, age = self._all_fresh
        if not bus.complete:
            ages = [max(pucks[k].age for k in needed) for needed in self._motors_of]
            valid = (age := np.array(ages, dtype=np.int64)) == 0
        told: list[AxisEvent] = []
        if bus.codec.unexplained is None or bus.codec.unexplained > _EXPLAINED:
            words = self.drive_status()
            self._status = tuple(int(_joined([words[k] for k in needed])) for needed in self._motors_of)
            told = self._events(bus)
        return Sample(
            self._cycle,
            stamp_ns,
            position,
            None,
            self._acting,
            valid,
            age,
            bus.lost,
            self._status,
            max(safety.status_age, *(puck.status_age for puck in pucks)),
            (*told, *slipped),
            (f"pendant: {safety.pendant}",) if self._looks else (),
            stamp_doubt_ns=bus.stamp_doubt_ns,
            joint_position=joint_position,
        )

    def _events(self, bus: PuckBus) -> list[AxisEvent]:
        taken = [event for event in bus.codec.take_events() if event.code in _CODES]
        if bus.codec.safety.mode != SafetyMode.ACTIVE:  # then no single puck has left it
            taken = [event for event in taken if event.code is not EventCode.DRIVE_STATE]
        found = [self._event(event) for event in taken]
        stale = set(bus.stale)
        for node in sorted(stale - self._stale):
            words = f"puck {node} has not said its MODE for too long"
            found.append(AxisEvent(AxisEventCode.STATUS_STALE, self._joint_of.get(node), words))
        self._stale = stale
        return found

    def _event(self, event: Event) -> AxisEvent:
        channel = self._driver.bus.channel
        words = f"{channel}: {event.words}" if event.node == HOST else f"puck {event.node}: {event.words}"
        return AxisEvent(_CODES[event.code], self._joint_of.get(event.node), words)


def _joined(words: list[AxisStatus]) -> AxisStatus:
    """Return the status of a joint that several pucks move: powered only where all of them are."""
    found = AxisStatus(0)
    for word in words:
        found |= word
    return found if all(word & AxisStatus.POWERED for word in words) else found & ~AxisStatus.POWERED


def from_config(config: ArmConfig, clock: Clock | None = None) -> BarrettArm:
    """Create the closed arm of a configuration with pucks; `clock` is ignored. DriverError for an incomplete one.

    Args:
        config: the arm's.
        clock: ignored: time is that of the link, virtual in lock step.

    Raises:
        DriverError: the description lacks something.
    """
    return BarrettArm(config)
