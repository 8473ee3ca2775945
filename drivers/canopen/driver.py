"""Drive an arm of CANopen drives in cyclic synchronous torque mode.

A transmit queue that is full for a moment, or one bus of two that has failed, must not lose the stop of any drive: it
is sent again for 75 ms, and for a second by `close`. Nobody waits for the last try, because the drives' own deadline
for torque frames comes before it.

A drive's torque follows its command within a millisecond or two, and many drives average what they report over some
more. So a measured torque is compared with all that the drive was told within the last `WINDOW`. Only what lies outside
of that, in two reports in a row, is a difference.

A sample has the time at which SYNC was sent: all positions were taken, and the commanded torque began to act, at it.

Torque frames begin with `enable` and then never cease while cycles come, with zero torque once the arm is stopped: a
drive that missed them would rightly report it. `close` restores the drives' power-up settings.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

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
from drivers.can.bus_load import Budget
from drivers.can.bus_state import BUS_EVENTS, HOST, Event, EventCode, controller_checks
from drivers.can.can_link import Link, open_links
from drivers.can.frame_log import BusSession
from drivers.canopen import object_dictionary as od
from drivers.canopen.bus_load import budget
from drivers.canopen.bus_monitor import MonitoringArm
from drivers.canopen.capabilities import require_capabilities
from drivers.canopen.cia402 import (
    DISABLE_VOLTAGE,
    ENABLE,
    FAULTS,
    POWER_OFF,
    QUICK_STOP,
    DriveState,
    NmtCommand,
    is_communication_error,
    joint_status,
    state_of,
)
from drivers.canopen.drive_setup import (
    DriveConfiguration,
    configure,
    disable_supervision,
    identify,
    is_error_passive,
    motor_limits,
    quick_stop_option,
    reset_farewell_fault,
    watchdogs_of,
)
from drivers.canopen.motor_units import coordinates, signed
from drivers.canopen.pdo_codec import BusCodec, Drive, Emergency
from drivers.canopen.pdo_mapping import Write, bus_profiles
from drivers.canopen.sdo import Objects, SdoRefused
from drivers.canopen.stored_zero import zeros_of
from drivers.canopen.sync_cycle import REPEAT, Buses, EnableSequence, Resetting, any_in_quick_stop
from drivers.canopen.zeroing import ZeroingArm
from drivers.clock import Clock, RealClock, VirtualClock
from drivers.motor_units import Coordinates, unwrapped
from ident_service.config.arm import ArmConfig
from ident_service.config.canopen import CanopenDriver
from ident_service.errors import DriverError, PositionUnknown

_TRIES, _AGAIN = 75, 0.001  # s between them
_BRAKING = 1.0  # s that drives may take for a quick stop, or a link for a stop, before the arm is left to its drives
_NOTICED = 0.02  # s within which a drive answers with a fault that it was left
_FAREWELL = 5  # cycles after the last control words, in which drives report that they are off
_ENDING = (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP, DriveState.FAULT_REACTION)


class StopCommand:
    """Hold the last stop command, and the drives that it could not be sent to yet; no method raises.

    Attributes:
        braking: whether the stop is a quick stop.
    """

    def __init__(self) -> None:
        self.braking = False
        self._untold: list[int] = []
        self._deaf: set[int] = set()  # drives that have not obeyed
        self._again_ns: int | None = None  # when drives that have not obeyed are told again; None before a stop

    def give(self, buses: Buses, kind: StopKind) -> None:
        """Send the stop to every drive; for 75 ms again to those whose link has not taken it."""
        self.braking = kind is StopKind.QUICK_STOP
        self._untold = list(range(len(buses.drives)))
        self._again_ns = buses.clock.now_ns() + round(REPEAT * 1e9)
        for _ in range(_TRIES):
            self.repeat(buses)
            if not self._untold:
                break
            with suppress(Exception):
                buses.clock.sleep_until_ns(buses.clock.now_ns() + round(_AGAIN * 1e9))

    def repeat(self, buses: Buses) -> None:
        """Send the stop once more to the drives whose link has not taken it, or that have not obeyed for `REPEAT`."""
        if self._again_ns is not None and (now_ns := buses.clock.now_ns()) >= self._again_ns:
            self._again_ns = now_ns + round(REPEAT * 1e9)
            on = {number for number, drive in enumerate(buses.drives) if drive.state is DriveState.OPERATION_ENABLED}
            self._untold, self._deaf = sorted(on.union(self._untold)), on
        word, drives, self._untold = QUICK_STOP if self.braking else DISABLE_VOLTAGE, self._untold, []
        for number in drives:
            try:
                buses.control_stop(number, word, deaf=number in self._deaf)
            except Exception:  # noqa: BLE001 - whatever the link died of, the other drives must be told
                self._untold.append(number)

    def counts(self, zero_counts: Sequence[int]) -> Sequence[int] | None:
        """Return `zero_counts`; None, for no torque frames, while a drive's link has not taken its stop.

        Drives that get zero torque, but not yet the stop, would let an arm fall that they or their brakes are to hold.

        Args:
            zero_counts: torque of every drive [per mille of rated torque].
        """
        return None if self._untold else zero_counts

    def wait_until_off(self, buses: Buses, zero_counts: Sequence[int] | None, period_ns: int) -> None:
        """Cycle until the drives report that they are off, for a second at most; a lost command is sent again.

        Args:
            buses: open.
            zero_counts: zero torque, as for `counts`; None where no torque frames are sent.
            period_ns: of a cycle [ns].
        """
        for cycle in range(1, max(_FAREWELL, round(_BRAKING * 1e9 / period_ns)) + 1):
            self.repeat(buses)
            with suppress(Exception):  # of one cycle: the next one may be possible
                buses.cycle(None if zero_counts is None else self.counts(zero_counts))
            on = any(drive.state in _ENDING for drive in buses.drives)
            if cycle >= _FAREWELL and not on and not self._untold:
                break
            if on and cycle % _FAREWELL == 0:
                self._untold = list(range(len(buses.drives)))  # what was sent may have been lost
        self._untold = []


WINDOW = 0.01  # s


class MeasuredTorque:
    """Collect the torques that the drives of an arm measure.

    Attributes:
        torque: torque by the newest reports, where one came since the cycle before, else NaN [N m or N], shape
            (joints,); None where no drive has reported.
        last: last reported torque of every joint, 0 before the first report [N m or N], shape (joints,).
        difference: excess of measured over commanded torque in the last two reports of each drive, the smaller of both
            [N m or N], shape (joints,); None where no drive has reported.
    """

    def __init__(self, coordinates: Coordinates, rate: float, *, compares: bool = True) -> None:
        """Start with drives without a commanded torque.

        Args:
            coordinates: of the arm.
            rate: cycles per second.
            compares: whether drives are given torques, with which the measured ones are compared.
        """
        self._coordinates = coordinates
        self._compares = compares
        self.last: Vector = np.zeros(len(coordinates.offset))
        self._told = np.zeros((max(2, round(WINDOW * rate)), len(coordinates.limit)))
        self._cycle = 0
        self._outside, self._before = [0.0] * len(coordinates.limit), [0.0] * len(coordinates.limit)
        self._reports = [0] * len(coordinates.limit)
        self._none = read_only(np.full(len(coordinates.offset), np.nan))
        self.torque: Vector | None = None
        self.difference: Vector | None = None

    def update(self, torque_counts: Sequence[int], drives: Sequence[Drive]) -> None:
        """Take a cycle's sent torques and drives' reports; update measured torque and its excess over what was sent.

        Args:
            torque_counts: sent with its SYNC [per mille of rated torque], by drive.
            drives: drives at the end of the cycle.
        """
        if self._compares:
            self._told[self._cycle % len(self._told)] = torque_counts
        self._cycle += 1
        new = [drive.torques > known for drive, known in zip(drives, self._reports, strict=True)]
        if not any(new):
            if self.torque is not None:
                self.torque = self._none
            return
        least, most = self._told.min(axis=0).tolist(), self._told.max(axis=0).tolist()
        for k, drive in enumerate(drives):
            if new[k]:
                now, before = drive.torque - min(max(drive.torque, least[k]), most[k]), self._before[k]
                self._outside[k] = min(now, before, key=abs) if now * before > 0.0 else 0.0
                self._before[k] = now
        self._reports = [drive.torques for drive in drives]
        torque = self._coordinates.joint_torque([drive.torque for drive in drives])
        for motors, joints in self._coordinates.groups:
            if not (all(self._reports[k] for k in motors) and any(new[k] for k in motors)):
                torque[list(joints)] = np.nan
        self.torque, self.last = torque, read_only(np.where(np.isnan(torque), self.last, torque))
        if self._compares:
            self.difference = self._coordinates.joint_torque(self._outside)


_CODES = BUS_EVENTS | {
    EventCode.NOTICE: AxisEventCode.DRIVE_NOTICE,
    EventCode.LEFT: AxisEventCode.DRIVE_LEFT,
    EventCode.DEAF: AxisEventCode.TORQUE_IGNORED,
    EventCode.TORQUE_LIMITED: AxisEventCode.TORQUE_LIMITED,
}


def axis_events(events: Iterable[Event], codec: BusCodec, joint_of: Mapping[int, int]) -> list[AxisEvent]:
    """Translate the events of one bus to joints' events; states, reset errors and returns to normal are left out.

    Args:
        events: events of the codec. Those of drive states, reset errors and returns to normal are left out.
        codec: of the bus.
        joint_of: first joint that each node moves.
    """
    bus = codec.profile.bus.channel
    found = []
    for event in events:
        code = _CODES.get(event.code)
        if code is not None:
            words = f"{bus}: {event.words}" if event.node == HOST else f"node {event.node}: {event.words}"
            found.append(AxisEvent(code, joint_of.get(event.node), words))
    return found


class Reports:
    """Collect the events of all buses of an arm, cycle by cycle."""

    def __init__(self, driver: CanopenDriver, joints: Mapping[int, int], look_every: int) -> None:
        """Start with nothing reported missing.

        Args:
            driver: the section `driver`.
            joints: first joint that each drive moves, by number.
            look_every: cycles between two checks for missing reports.
        """
        self._joints = [{d.node: joints[k] for k, d in enumerate(driver.drives) if d.bus == bus} for bus in range(4)]
        self._look_every = look_every
        self._missed = MissedReports()

    def forget_missing(self) -> None:
        """Forget which missing reports were told, so that those still missing are reported once more."""
        self._missed = MissedReports()

    def new_events(self, codecs: Iterable[BusCodec], cycle: int, now_ns: int) -> list[AxisEvent]:
        """Return the joints' events since the last call and, in every n-th cycle, reports that have gone missing."""
        found: list[AxisEvent] = []
        look = cycle % self._look_every == 0
        for codec in codecs:
            if (events := codec.take_events()) or look:
                joints = self._joints[codec.profile.number]
                found += axis_events(events, codec, joints)
                found += self._missed.new_events(codec, now_ns, joints) if look else []
        return found


class MissedReports:
    """Report drives whose heartbeat or status report is missing, each once until it is received again."""

    def __init__(self) -> None:
        self._told: set[tuple[int, int, AxisEventCode]] = set()

    def new_events(self, codec: BusCodec, now_ns: int, joint_of: Mapping[int, int]) -> list[AxisEvent]:
        """Return an event for each drive of one bus whose heartbeat or status report has newly gone missing.

        Args:
            codec: of the bus.
            now_ns: present time of the links' clock [ns].
            joint_of: first joint that each node moves.
        """
        bus, profile = codec.profile.number, codec.profile
        missing = {(bus, node, AxisEventCode.DRIVE_SILENT) for node in codec.silent(now_ns)}
        missing |= {(bus, node, AxisEventCode.STATUS_STALE) for node in codec.stale()}
        new = sorted(missing - self._told)
        self._told = {place for place in self._told if place[0] != bus} | missing
        words = {
            AxisEventCode.DRIVE_SILENT: f"no heartbeat for {profile.heartbeat_timeout:g} s",
            AxisEventCode.STATUS_STALE: f"no status report for {profile.status_timeout:g} s",
        }
        return [AxisEvent(code, joint_of[node], f"node {node}: {words[code]}") for _, node, code in new]


# Between two checks of everybody's heartbeats and status reports: share of a status period, and cycles at most.
_LOOK_SHARE, _MOST_UNLOOKED = 0.1, 10


class CanopenArm(Arm):
    """Implement an arm with drives on one or more buses, behind one transmission."""

    def __init__(self, config: ArmConfig, open_bus: Callable[[ArmConfig], list[Link]] = open_links) -> None:
        """Use the arm's description; nothing is opened.

        Args:
            config: configuration with a CANopen driver and a transmission.
            open_bus: function that opens the links, in the order of the buses.

        Raises:
            DriverError: the description lacks the driver, the transmission, or joints.
        """
        if not isinstance(config.driver, CanopenDriver) or config.transmission is None:
            raise DriverError(f"{config.name}: needs a CANopen driver and a transmission")
        self._config, self._driver, self._open_bus = config, config.driver, open_bus
        self._period_ns = round(1e9 / config.control.rate)
        self._profiles = bus_profiles(config.driver, config.control.rate)
        cycles = int(_LOOK_SHARE * config.driver.status.period * config.control.rate)
        self._look_every = min(max(1, cycles), _MOST_UNLOOKED)
        self._coordinates: Coordinates = coordinates(config.driver, config.transmission)
        self._zeros = zeros_of(config)
        self._quick_stop = quick_stop_option(config)
        self._positions = config.driver.streams == "position"
        self._limits = np.array([np.inf if j.torque is None else j.torque for j in config.joints.values()])
        if len(self._limits) != len(config.driver.drives):
            raise DriverError(f"{config.name}: joints must name all {len(config.driver.drives)} joints")
        joints = len(self._limits)
        self._all_fresh = read_only(np.ones(joints, dtype=bool)), read_only(np.zeros(joints, dtype=np.int64))
        # Joints that each drive moves, and drives that each joint needs.
        self._joints_of = {k: joints for motors, joints in self._coordinates.groups for k in motors}
        self._drives_of = self._coordinates.motors_of
        names, drives = list(config.joints), enumerate(config.driver.drives)
        self._names = [f"{' and '.join(names[j] for j in self._joints_of[k])}: drive {one.node}" for k, one in drives]
        # The clock until the buses are open, which have their own.
        in_step = all(bus.interface == "lock_step" for bus in config.driver.buses)
        self.clock: Clock = VirtualClock() if in_step else RealClock()
        self._buses: Buses | None = None
        self._session = BusSession(config, open_bus)
        self._reset_state()

    def _reset_state(self) -> None:
        self._enabled = self._streaming = False
        self._stop = StopCommand()
        self._stops = 0  # stop commands so far
        self._counts = [0] * len(self._limits)
        self._acting = read_only(np.zeros(len(self._limits)))
        self._unwrapped: list[int] | None = None
        self._told: list[tuple[int | None, int | None, Emergency | None]] = []
        self._status: tuple[int, ...] = ()
        self._cycle = self._begun = 0  # drives whose configuration has begun, the first ones
        first = {k: joints[0] for k, joints in self._joints_of.items()}
        self._reports = Reports(self._driver, first, self._look_every)
        self._measured = MeasuredTorque(self._coordinates, 1e9 / self._period_ns, compares=not self._positions)
        self._identities: tuple[str, ...] = ()
        self._unconfirmed: list[str] = []
        self._boots = [0] * len(self._driver.drives)  # of each drive, when its configuration began

    def look(self) -> Arm:
        """Return a closed arm on the same buses that reads the drives' objects by SDO and sends nothing else."""
        return MonitoringArm(self._config, self._open_bus)

    def zero(self) -> tuple[str, ...]:
        """Store the present position in the drives of the closed arm as its home; return in words what each reports."""
        if self._buses is not None:
            raise DriverError("the arm is open; close it before it is zeroed")
        with ZeroingArm(self._config, self._open_bus) as arm:
            return arm.set_home()

    def log_frames(self, path: Path) -> None:
        """Have the next session log every frame to a new file; DriverError for its suffix, at `open` if it exists."""
        self._session.log_frames(path)

    def logged(self) -> str:
        """Describe how the log of frames of the last session ended, in words; empty where none was kept."""
        return self._session.logged()

    def open(self) -> None:
        """Lock and open every bus, and configure every drive; nothing is energised, and what was is quick-stopped.

        Raises:
            DriverError: a bus is in use, also by another host on it, or cannot be had; a drive does not answer, is
                another one, or refuses a part of its configuration. Nothing stays open.
            PositionUnknown: drives have lost their zero (`stored_zero.py`); likewise.
        """
        if self._buses is not None:
            raise DriverError("the arm is already open")
        self._reset_state()
        try:
            links = self._session.open(locks=not self.clock.lock_step)
            buses = Buses(self._profiles, links, self._period_ns)
            self.clock = buses.clock
            try:
                buses.listen()
            except BaseException:
                buses.close()  # without the farewell of `close`, which another host's drives would obey
                raise
            self._buses = buses
            buses.wake_drives()
            self._stop_enabled_drives(buses)
            self._find_zero(buses)
            self._identities = tuple(self._configured(buses))
            buses.start_pdos()
            self._require_no_restart(buses)
        except BaseException:
            self.close()
            raise

    def describe(self) -> ArmDescription:
        """Return the description of the open arm; raises DriverError when it is not open."""
        self._open()
        found = self._coordinates
        return ArmDescription(
            tuple(self._config.joints),
            1e9 / self._period_ns,
            np.minimum(found.torque_limit, self._limits),
            found.torque_resolution,
            found.position_resolution,
            self._identities,
            "drivers.canopen",
            lost_cycles=self._driver.lost_cycles,
            streams_position=self._positions,
            watchdog=self._driver.watchdog,
            report_delay=self._driver.report_delay,
        )

    def bus_budget(self, rate: float | None = None) -> Budget:
        """Return the load of the buses at `rate` [Hz], by default the configured one; with remedies if too much."""
        return budget(self._driver, self._config.control.rate if rate is None else rate)

    def setup_checks(self) -> tuple[SetupCheck, ...]:
        """Return a failed check per host controller that is error-passive or bus-off; DriverError while not open."""
        codecs = self._open().codecs
        return tuple(one for codec in codecs for one in controller_checks(codec.profile.bus.channel, codec.controller))

    def enable(self) -> None:
        """Energise all drives together, with zero torque or in place; DriverError if one does not follow in time.

        Drives that hold the arm in quick stop (605Ah of 5 to 8) go on holding it until all others are ready, too.

        Raises:
            DriverError: not open, the host's controller is error-passive or bus-off, a drive has a fault, has restarted
                since the arm was opened, or does not follow in time. Only drives that held the arm before still do.
        """
        buses = self._open()
        held = any_in_quick_stop(buses.drives)
        self._no_torque()
        self._streaming, self._stop = True, StopCommand()
        try:
            require_set_up(self.setup_checks())
            self._require_no_restart(buses)
            reports = self._driver.report_delay, self._driver.status.period
            now_ns, option = self.clock.now_ns(), self._quick_stop
            buses.forget_modes()
            tell = self._names, self._driver.bring_up, now_ns, reports, option, buses.other_modes
            steps = EnableSequence(buses.drives, *tell)
            self._cycle_until_states(buses, steps)
        except BaseException:
            self.stop(StopKind.QUICK_STOP if held else StopKind.TORQUE_OFF)
            raise
        buses.forget_events()  # of the states that drives went through
        self._reports.forget_missing()
        self._enabled = buses.enabled = True

    def reset(self) -> None:
        """Clear the faults that drives have latched; energises nothing; DriverError while enabled, or if one stays.

        Raises:
            DriverError: not open, enabled, or a fault stays because its cause does.
        """
        buses = self._open()
        if self._enabled:
            raise DriverError("the arm is enabled; stop it before its faults are cleared")
        self._cycle_until_states(
            buses, Resetting(buses.drives, self._names, self._driver.bring_up, self.clock.now_ns())
        )

    def exchange(self, torque: Vector | None) -> Sample:
        """Wait for the next cycle, send the torque clipped to its limits, or none for None, and return the sample.

        Raises:
            DriverError: as in the contract.
        """
        buses = self._open()
        if torque is not None:
            if self._positions:
                raise DriverError("a torque was given, but these drives are given positions (driver.streams)")
            if not self._enabled:
                raise DriverError("a torque was given, but the arm is not enabled")
            wanted = np.asarray(torque, dtype=float)
            if wanted.shape != self._limits.shape or not all(np.isfinite(wanted).tolist()):
                raise DriverError(f"{len(self._limits)} finite torques are needed, not {torque}")
            wanted = np.minimum(np.maximum(wanted, -self._limits), self._limits)  # np.clip takes three times as long
            self._counts, _ = self._coordinates.torque_counts(wanted)
            self._acting = read_only(self._coordinates.joint_torque(self._counts))
        return self._exchanged(buses, sends=torque is not None)

    def exchange_position(self, position: Vector) -> Sample:
        """Wait for the next cycle, send positions, as counts, to drives that are given these; return the sample.

        Raises:
            DriverError: as in the contract.
        """
        buses = self._open()
        if not self._positions:
            raise DriverError("a position was given, but these drives are given torques (driver.streams)")
        if not self._enabled:
            raise DriverError("a position was given, but the arm is not enabled")
        wanted = np.asarray(position, dtype=float)
        if wanted.shape != self._limits.shape or not all(np.isfinite(wanted).tolist()):
            raise DriverError(f"{len(self._limits)} finite positions are needed, not {position}")
        self._counts = [signed(counts) for counts in self._coordinates.counts_at(wanted)]
        return self._exchanged(buses, sends=True)

    def _exchanged(self, buses: Buses, *, sends: bool) -> Sample:
        self._stop.repeat(buses)
        if self._positions and not self._enabled:
            self._no_torque()
        # While enabled, an exchange without a target sends no frame of it: drives that supervise them must notice.
        idle = self._stop.counts(self._counts) if self._streaming and not self._enabled else None
        stamp_ns = buses.cycle(self._counts if sends else idle)
        self._measured.update(self._counts, buses.drives)
        sample = self._sample(buses, stamp_ns)
        self._cycle += 1
        return sample

    def watchdogs(self) -> tuple[Watchdog, ...]:
        """Return the watchdog of each drive: its signal and its time."""
        return watchdogs_of(self._driver, self._names)

    def withhold(self, kind: str) -> None:
        """Stop sending what watchdogs of one kind watch, until the next `stop`, so that they act."""
        self._open().withheld.add(kind)

    def drive_status(self) -> tuple[AxisStatus, ...]:
        """Return the last reported status of each drive of the open arm, in flags common to all fieldbuses."""
        return tuple(drive.axis_status for drive in self._open().drives)

    def stop(self, kind: StopKind) -> None:
        """Command every drive to switch off, or to stop by itself; never raises. The last torque acts until it does.

        A drive that cannot be told is told again for 75 ms, and then before each cycle.
        """
        self._enabled = False
        self._stops += 1
        self._no_torque()
        if self._buses is not None:
            self._buses.withheld.clear()
            self._stop.give(self._buses, kind)

    def close(self) -> None:
        """Stop the drives, end the supervision of the host in those that are off, close the buses; any number of times.

        A quick stop is not cut short by it: drives that are told to let go in the midst of one would let the arm fall.
        The same holds for drives that were found holding the arm in quick stop, unless they have been told to let go.
        """
        if not self._stop.braking:
            held = not self._stops and self._buses is not None and any_in_quick_stop(self._buses.drives)
            self.stop(StopKind.QUICK_STOP if held else StopKind.TORQUE_OFF)
        if self._buses is not None:
            self._leave(self._buses)
            self._buses.close()
        self._buses = None
        self._streaming = False
        self._session.close()

    def unconfirmed(self) -> tuple[str, ...]:
        """Describe drives that at closing were neither off nor in quick stop, did not answer, or had restarted."""
        return tuple(self._unconfirmed)

    def _leave(self, buses: Buses) -> None:
        """Disable the supervision of the host in drives that are off; the others shall miss the host. Never raises."""
        zero = self._counts if self._streaming else None
        self._stop.wait_until_off(buses, zero, self._period_ns)
        # Silent drives are asked for nothing any more: an answer would be taken for one to the requests below.
        buses.enabled = False
        there: dict[int, Objects] = {}  # by bus
        reacting: dict[int, Emergency | None] = {}  # drives that may answer with a fault, and their last emergency
        for number, drive in enumerate(self._driver.drives[: self._begun]):
            with suppress(Exception):
                buses.cycle(zero)  # what was asked before is answered in it
            objects, said = buses.objects_in_cycles(number, zero), ""
            try:
                left = disable_supervision(objects, self._zeros, number, buses.restarted(number))
                state = left.state
                if left.reacts:
                    reacting[number] = buses.drives[number].emergency
                said = "" if state in (*POWER_OFF, DriveState.QUICK_STOP) else f"is in the state {state}"
                there[drive.bus] = buses.objects(number)
            except Exception as error:  # noqa: BLE001 - whatever a drive or its bus died of, the others must be left
                said = str(error) or repr(error)
                if isinstance(error, SdoRefused):
                    there[drive.bus] = buses.objects(number)
            if said:
                self._unconfirmed.append(f"{self._names[number]}: {said}")
        self._unconfirmed += self._restarted(buses)
        for number in range(len(buses.drives)):
            with suppress(Exception):
                buses.command_drive(number, NmtCommand.ENTER_PRE_OPERATIONAL)
        if reacting:
            self._reset_farewell_faults(buses, reacting)
        for objects in there.values():
            with suppress(Exception):  # the answer comes after all commands, which closing a link could cut off
                objects.read(od.DEVICE_TYPE)

    def _reset_farewell_faults(self, buses: Buses, before: Mapping[int, Emergency | None]) -> None:
        """Reset drives to which it is a fault that they were left; `before` has their emergencies before that."""
        with suppress(Exception):
            buses.clock.sleep_until_ns(buses.clock.now_ns() + round(_NOTICED * 1e9))
        for number, known in before.items():

            def unrelated(drive: Drive = buses.drives[number], known: Emergency | None = known) -> bool:
                told = drive.emergency
                return told is not None and told is not known and not is_communication_error(told.code)

            try:
                state = reset_farewell_fault(buses.objects(number), unrelated)
                said = "" if state in POWER_OFF - FAULTS else f"is in the state {state} since it was left"
            except Exception as error:  # noqa: BLE001 - as in `_leave`
                said = str(error) or repr(error)
            if said:
                self._unconfirmed.append(f"{self._names[number]}: {said}")

    def _open(self) -> Buses:
        if self._buses is None:
            raise DriverError("the arm is not open")
        return self._buses

    def _no_torque(self) -> None:
        """Set the targets of drives that are to do nothing: no torque, or the position where each of them is."""
        there = self._positions and self._buses is not None
        self._counts = [drive.position for drive in self._buses.drives] if there else [0] * len(self._limits)  # type: ignore[union-attr]
        self._acting = read_only(np.zeros(len(self._limits)))

    def _stop_enabled_drives(self, buses: Buses) -> None:
        """Quick-stop drives that a host has left enabled: none is to be configured while its last torque acts.

        Raises:
            DriverError: one goes on all the same.
        """
        every, enabled = [buses.objects(number) for number in range(len(buses.drives))], DriveState.OPERATION_ENABLED
        last_ns: int | None = None
        while on := [k for k, objects in enumerate(every) if state_of(objects.read(od.STATUS_WORD)) is enabled]:
            now_ns = self.clock.now_ns()
            if last_ns is None:
                self._stops, self._stop.braking = self._stops + 1, True  # closing does not cut it short
                last_ns = now_ns + round(_BRAKING * 1e9)
            elif now_ns > last_ns:
                names = ", ".join(self._names[k] for k in on)
                raise DriverError(f"{names}: left enabled by another host, and goes on although told to stop")
            for k in on:
                with suppress(DriverError):  # the others must be told; what it says next time counts
                    every[k].write(Write(od.CONTROL_WORD, QUICK_STOP))
            self.clock.sleep_until_ns(now_ns + round(REPEAT * 1e9))

    def _find_zero(self, buses: Buses) -> None:
        """Find the zero that the drives confirm, before they are configured, which may make them forget it."""
        if self._zeros is not None:
            held = [self._zeros.stored_counts(buses.objects(number), number) for number in range(len(buses.drives))]
            self._coordinates = self._coordinates.zeroed(self._zeros.home_counts(held), self._zeros.home)

    def _configured(self, buses: Buses) -> Iterator[str]:
        """Identify and configure all drives one by one; yields the identity of each in words."""
        motors = motor_limits(self._config, self._coordinates)
        for number, drive in enumerate(self._driver.drives):
            objects = buses.objects(number)
            self._boots[number] = buses.drives[number].boots
            identity = identify(objects, drive.identity)
            can = require_capabilities(objects, self._driver, number)
            identity += f"; {can.summary}"  # a preflight ticket is for what was found of the drive
            own = self._driver.reactions, self._quick_stop, motors[number], can
            self._begun = number + 1
            mode = configure(objects, DriveConfiguration(drive, buses.profile(number), *own))
            buses.modes[number] = mode
            buses.drives[number].error_passive |= is_error_passive(objects)
            identity += ", its targets act when they come, not at SYNC" if mode.at_once else ""
            if self._zeros is not None:
                counts = self._coordinates.zero[number]
                if not self._zeros.restore_mark(objects, number, counts, buses.restarted(number)):
                    raise PositionUnknown(self._zeros.lost_text([drive.node]))
                identity += f", home at {counts} counts"  # a preflight ticket is for this zero
            yield identity

    def _require_no_restart(self, buses: Buses) -> None:
        """Raise DriverError where a drive has restarted since it was configured (PositionUnknown: it had a zero)."""
        if self._zeros is not None and (lost := [drive.node for drive in buses.drives if drive.boots]):
            raise PositionUnknown(self._zeros.lost_text(lost))
        if restarted := self._restarted(buses):
            raise DriverError(f"{'; '.join(restarted)}: what it was configured with is lost; open the arm again")

    def _restarted(self, buses: Buses) -> list[str]:
        """Return the drives that have sent a boot-up message since they were configured, in words."""
        drives = list(zip(self._names, buses.drives, self._boots, strict=True))[: self._begun]
        return [f"{name} has restarted" for name, drive, boots in drives if drive.boots > boots]

    def _cycle_until_states(self, buses: Buses, steps: EnableSequence | Resetting) -> None:
        """Cycle with zero torque until the drives have gone through the given states; a stop meanwhile wins."""
        stops, held = self._stops, False
        while not steps.done:
            if not held:  # where positions are given, the one from which a drive is enabled is the one that it holds
                self._no_torque()
            buses.cycle(self._counts if self._streaming else None)
            for number, word in steps.commands(self.clock.now_ns()):
                held = held or word == ENABLE
                if self._stops == stops:
                    buses.control(number, word)
            if self._stops != stops:
                raise DriverError("the arm was stopped while its drives changed state")

    def _sample(self, buses: Buses, stamp_ns: int) -> Sample:
        drives = buses.drives
        if self._unwrapped is None:
            nearest = zip(self._coordinates.zero, drives, strict=True)
            self._unwrapped = [unwrapped(zero, drive.position) for zero, drive in nearest]
        else:
            self._unwrapped = [
                unwrapped(before, drive.position) for before, drive in zip(self._unwrapped, drives, strict=True)
            ]
        valid, age = self._all_fresh
        if not buses.complete:
            ages = [max(drives[k].age for k in needed) for needed in self._drives_of]
            valid = (age := np.array(ages, dtype=np.int64)) == 0
        return Sample(
            self._cycle,
            stamp_ns,
            self._coordinates.positions(self._unwrapped),
            None,
            self._measured.last if self._positions else self._acting,
            valid,
            age,
            buses.lost,
            self._statuses(drives),
            max(drive.status_age for drive in drives),
            tuple(self._reports.new_events(buses.codecs, self._cycle, self.clock.now_ns())),
            measured_torque=self._measured.torque,
            torque_difference=self._measured.difference if self._enabled else None,
            stamp_doubt_ns=buses.stamp_doubt_ns,
        )

    def _statuses(self, drives: Sequence[Drive]) -> tuple[int, ...]:
        """Return the status of each joint; computed again only when a drive has reported something new."""
        told = [(drive.status, drive.let_go, drive.emergency) for drive in drives]
        if told != self._told:
            self._told = told
            self._status = tuple(int(joint_status(drives[k].axis_status for k in needed)) for needed in self._drives_of)
            for drive in drives:
                drive.let_go = None
        return self._status


def from_config(config: ArmConfig, clock: Clock | None = None) -> CanopenArm:
    """Create the closed arm of a CANopen configuration; `clock` is ignored. DriverError for an incomplete one.

    Args:
        config: the arm's.
        clock: ignored: time is that of the link, virtual in lock step.

    Raises:
        DriverError: the description lacks something.
    """
    return CanopenArm(config)
