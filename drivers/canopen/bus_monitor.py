"""Look at CANopen drives without commanding them, and hear what others say on their buses.

No NMT command, no SYNC, no PDO, no write, no heartbeat leaves the host, so that drives stay in whatever state they are,
pre-operational or operational, with their watchdogs as they were. Each cycle asks all drives for position (6064h),
status word (6041h) and error register (1001h), and those with an error for its code (603Fh). Four uploads cost far
more than a cycle of torques, and stopped drives answer none: hence `look_rate`, and drives that do not answer are
shown as such.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from drivers.arm import Arm, ArmDescription, Sample, StopKind, Vector
from drivers.axis_status import AxisStatus
from drivers.can.bus_load import most_bits
from drivers.can.can_frame import Frame
from drivers.can.can_link import BusLock, Link
from drivers.canopen import object_dictionary as od
from drivers.canopen.cia402 import NmtState, axis_status, drive_words, joint_status, nmt_words
from drivers.canopen.drive_setup import identify
from drivers.canopen.motor_units import coordinates
from drivers.canopen.pdo_mapping import HEARTBEAT, SDO_REPLY, SYNC
from drivers.canopen.sdo import TIMEOUT, Answers, Objects, Place, poll
from drivers.canopen.stored_zero import zeros_of
from drivers.clock import Clock, RealClock
from drivers.motor_units import unwrapped
from ident_service.config.arm import ArmConfig
from ident_service.config.canopen import CanopenDriver
from ident_service.errors import DriverError, PositionUnknown

LONGER = 1.2  # times a heartbeat's period, in which one must come


class BusListener:
    """Listen on every bus of an arm.

    Attributes:
        nmt: state of each node's last heartbeat, and when it came [ns of the links' clock].
        booted: nodes whose last heartbeat was a boot-up message, which makes them pre-operational.
        restarted: nodes that sent a boot-up message since this was last cleared.
        answered: nodes that sent an SDO reply for which no request waited.
        streaming: buses on which another host sends SYNC.
    """

    def __init__(self) -> None:
        self.nmt: dict[Place, tuple[int, int]] = {}
        self.booted: set[Place] = set()
        self.restarted: set[Place] = set()
        self.answered: set[Place] = set()
        self.streaming: set[int] = set()

    def take(self, bus: int, frame: Frame) -> None:
        """Note what a received frame tells: SYNC on its bus, a node's NMT state or boot-up, or that it answers SDO."""
        if frame.error or frame.remote or frame.extended:
            return
        node = frame.identifier - HEARTBEAT
        if frame.identifier == SYNC:
            self.streaming.add(bus)
        elif 1 <= node <= 127 and len(frame.data) == 1:
            state = frame.data[0] & 0x7F  # bit 7 belongs to node guarding
            self.booted.discard((bus, node))
            if state == NmtState.BOOT_UP:
                self.booted.add((bus, node))
                self.restarted.add((bus, node))
                state = NmtState.PRE_OPERATIONAL
            self.nmt[bus, node] = state, frame.stamp_ns
        elif 1 <= frame.identifier - SDO_REPLY <= 127:
            self.answered.add((bus, frame.identifier - SDO_REPLY))

    def listen(self, links: Sequence[Link], period: float) -> None:
        """Take frames on every bus for somewhat longer than a heartbeat period [s]; DriverError when a bus is gone."""
        until_ns = links[0].clock.now_ns() + round(LONGER * period * 1e9)
        for bus, link in enumerate(links):
            while (frame := link.receive(until_ns)) is not None:
                self.take(bus, frame)

    def drain(self, links: Sequence[Link]) -> None:
        """Take the frames that wait on every bus, without waiting; raises DriverError when a bus is gone."""
        for bus, link in enumerate(links):
            for frame in link.drain():
                self.take(bus, frame)

    def nmt_words(self, bus_and_node: Place, now_ns: int, heartbeat_timeout_ns: int) -> str:
        """Describe a node's NMT state as heard last, and whether its heartbeat is missing by now, in words.

        Args:
            bus_and_node: bus and node number.
            now_ns: present time of the links' clock [ns].
            heartbeat_timeout_ns: time without a heartbeat that was there after which it is missed [ns].
        """
        if bus_and_node not in self.nmt:
            return "sends no heartbeat"
        state, stamp_ns = self.nmt[bus_and_node]
        if bus_and_node in self.booted:
            return f"{nmt_words(state)} since it booted"
        words = nmt_words(state)
        return f"{words}, heartbeat missing" if now_ns - stamp_ns > heartbeat_timeout_ns else words


RATE = 20.0  # Hz
SHARE = 0.25  # of the bus in the worst case; below, the rate is lower
AWAKE = 2.0  # s within which a drive must have answered once, or it counts as silent
_QUESTIONS = (od.POSITION, od.STATUS_WORD, od.ERROR_REGISTER, od.LAST_EMERGENCY)
_UNTIL = (0.4, 0.6, 0.8, 0.95)  # of a period: when the answer to each counts as missing
_SDO_BYTES = 8


@dataclass
class _LastAnswers:
    """Hold what is known of one drive: last answers, and cycles since its last position."""

    position: int | None = None
    unwrapped: int = 0
    age: int = 0
    status: int | None = None
    emergency: int = 0


def look_rate(driver: CanopenDriver) -> float:
    """Return the rate at which all drives are asked [Hz]: `RATE`, or less where that takes `SHARE` of a bus."""
    frames = 2 * len(_QUESTIONS) * sum(most_bits(_SDO_BYTES))
    loads = [
        frames * sum(drive.bus == number for drive in driver.drives) / bus.bitrate
        for number, bus in enumerate(driver.buses)
    ]
    return min(RATE, SHARE / max(loads))


class MonitoringArm(Arm):
    """Implement an arm whose drives, on one or more buses, are only observed."""

    def __init__(self, config: ArmConfig, open_bus: Callable[[ArmConfig], list[Link]]) -> None:
        """Use the arm's description; nothing is opened.

        Args:
            config: configuration with a CANopen driver and a transmission.
            open_bus: function that opens the links, in the order of the buses.

        Raises:
            DriverError: the description lacks the driver or the transmission.
        """
        if not isinstance(config.driver, CanopenDriver) or config.transmission is None:
            raise DriverError(f"{config.name}: needs a CANopen driver and a transmission")
        self._config, self._driver, self._open_bus = config, config.driver, open_bus
        self._coordinates = coordinates(config.driver, config.transmission)
        self._zeros = zeros_of(config)
        self._places: tuple[Place, ...] = tuple((drive.bus, drive.node) for drive in config.driver.drives)
        self._period_ns = round(1e9 / look_rate(config.driver))
        self.clock: Clock = RealClock()
        self._links: list[Link] = []
        self._locks: list[BusLock] = []
        self._begin()

    def _begin(self) -> None:
        self._heard = BusListener()
        self._seen = [_LastAnswers() for _ in self._places]
        self._identities: tuple[str, ...] = ()
        self._missing: set[int] = set()  # drives that did not answer when the arm was opened, so that no zero is known
        self._cycle, self._lost = 0, 0
        self._next_ns: int | None = None

    def open(self) -> None:
        """Lock and open every bus, listen for a moment, and ask every drive for its identity.

        Raises:
            DriverError: a bus is in use, by another host too, or cannot be had; no drive answers, or one is another
                than the configured one. Nothing stays open.
            PositionUnknown: drives have lost their zero (`stored_zero.py`); likewise.
        """
        if self._links:
            raise DriverError("the arm is already open")
        self._begin()
        try:
            if all(bus.interface != "lock_step" for bus in self._driver.buses):
                self._locks = [BusLock(bus) for bus in self._driver.buses]
            self._links = self._open_bus(self._config)
            self.clock = self._links[0].clock
            self._heard.listen(self._links, self._driver.heartbeats.drives)
            self._require_alone()
            self._identities = self._identified()
            self._find_zero()
        except BaseException:
            self.close()
            raise

    def describe(self) -> ArmDescription:
        """Return the description of the open arm; raises DriverError when it is not open."""
        self._require_open()
        found = self._coordinates
        limits = np.array([np.inf if joint.torque is None else joint.torque for joint in self._config.joints.values()])
        return ArmDescription(
            tuple(self._config.joints),
            1e9 / self._period_ns,
            np.minimum(found.torque_limit, limits),
            found.torque_resolution,
            found.position_resolution,
            self._identities,
            "drivers.canopen, SDO uploads only",
        )

    def zero(self) -> tuple[str, ...]:
        """Refuse to set a zero; raises DriverError."""
        raise DriverError("a read-only arm cannot be zeroed")

    def enable(self) -> None:
        """Refuse to enable the arm; raises DriverError."""
        raise DriverError("a read-only arm cannot be enabled")

    def reset(self) -> None:
        """Refuse to reset the drives; raises DriverError."""
        raise DriverError("a read-only arm cannot be reset")

    def exchange(self, torque: Vector | None) -> Sample:
        """Wait for a cycle, ask every drive for position, status, errors, return the sample; DriverError for a torque.

        Raises:
            DriverError: not open, a torque, a bus is gone, or another host has begun to stream: it must not be delayed.
            PositionUnknown: a drive restarted, and its zero is lost.
        """
        self._require_open()
        if torque is not None:
            raise DriverError("a read-only arm takes no torque")
        stamp_ns = self._wait()
        self._heard.drain(self._links)
        deadlines = [stamp_ns + round(share * self._period_ns) for share in _UNTIL]
        position, status, register = (
            self._ask(self._places, entry, until) for entry, until in zip(_QUESTIONS[:3], deadlines[:3], strict=True)
        )
        troubled = [place for place, bits in register.values.items() if bits]
        codes = self._ask(troubled, _QUESTIONS[3], deadlines[3]).values
        self._require_alone()
        self._require_no_restart()
        for place, seen in zip(self._places, self._seen, strict=True):
            _take(seen, position.values.get(place), status.values.get(place))
            if place in register.values:
                seen.emergency = codes.get(place, seen.emergency) if register.values[place] else 0
        sample = self._sample(stamp_ns)
        self._cycle += 1
        return sample

    def stop(self, kind: StopKind) -> None:
        """Do nothing: an arm that is only observed was not started here."""

    def close(self) -> None:
        """Close the buses; drives stay as they are."""
        for link in self._links:
            with suppress(Exception):
                link.close()
        for lock in self._locks:
            lock.close()
        self._links, self._locks = [], []

    def _require_open(self) -> None:
        if not self._links:
            raise DriverError("the arm is not open")

    def _require_alone(self) -> None:
        if self._heard.streaming:
            buses = ", ".join(self._driver.buses[bus].channel for bus in sorted(self._heard.streaming))
            raise DriverError(f"another host sends SYNC on {buses}; reading would delay its frames: stop it first")

    def _ask(self, places: tuple[Place, ...] | list[Place], entry: od.Entry, deadline_ns: int) -> Answers:
        return poll(self._links, places, entry, deadline_ns, self._heard.take)

    def _identified(self) -> tuple[str, ...]:
        """Return the identity of every drive; DriverError when none answers, or one is another than configured."""
        missing, last = set(self._places), self.clock.now_ns() + round(AWAKE * 1e9)
        while missing and (now_ns := self.clock.now_ns()) < last:
            answers = self._ask(sorted(missing), od.DEVICE_TYPE, now_ns + round(TIMEOUT * 1e9))
            missing -= answers.values.keys() | answers.aborts.keys()
        if len(missing) == len(self._places):
            raise DriverError(
                f"no drive answers within {AWAKE:g} s; check power, cable and bit rate (`ident bus scan`)"
            )
        words = []
        for number, drive in enumerate(self._driver.drives):
            if (drive.bus, drive.node) in missing:
                self._missing.add(number)
                words.append(f"node {drive.node}: no answer")
                continue
            words.append(identify(self._objects(number), drive.identity))
        return tuple(words)

    def _find_zero(self) -> None:
        """Find the zero that the drives confirm, where their encoders need it."""
        if self._zeros is None:
            return
        self._heard.restarted.clear()
        answers = [k for k in range(len(self._places)) if k not in self._missing]
        held = {k: self._zeros.stored_counts(self._objects(k), k) for k in answers}
        if lost := [self._places[k][1] for k, counts in held.items() if counts is None]:
            raise PositionUnknown(self._zeros.lost_text(lost))
        counts = [held.get(k) or 0 for k in range(len(self._places))]
        self._coordinates = self._coordinates.zeroed(counts, self._zeros.home)

    def _require_no_restart(self) -> None:
        ours = self._heard.restarted.intersection(self._places)
        if self._zeros is not None and ours:
            raise PositionUnknown(self._zeros.lost_text([node for _, node in ours]))

    def _objects(self, number: int) -> Objects:
        bus, node = self._places[number]
        return Objects(self._links[bus], node, self._frame_handler_of(bus))

    def _frame_handler_of(self, bus: int) -> Callable[[Frame], None]:
        return lambda frame: self._heard.take(bus, frame)

    def _wait(self) -> int:
        """Wait until the next cycle; periods that are over are skipped. Returns the time [ns]."""
        now_ns = self.clock.now_ns()
        begin_ns = now_ns if self._next_ns is None else self._next_ns
        self.clock.sleep_until_ns(begin_ns)
        begin_ns += max(0, self.clock.now_ns() - begin_ns) // self._period_ns * self._period_ns
        self._next_ns = begin_ns + self._period_ns
        return self.clock.now_ns()

    def _sample(self, stamp_ns: int) -> Sample:
        seen, joints = self._seen, self._coordinates.motors_of
        age = np.array([max(seen[k].age for k in motors) for motors in joints], dtype=np.int64)
        unknown = self._missing if self._zeros is not None else set()
        never = [any(seen[k].position is None or k in unknown for k in motors) for motors in joints]
        # A count that came round its 32 bits since the drive was zeroed lies nearest to the zero.
        counts = [unwrapped(zero, one.unwrapped) for zero, one in zip(self._coordinates.zero, seen, strict=True)]
        position = self._coordinates.positions(counts)
        self._lost += sum(one.age > 0 for one in seen)
        status = [AxisStatus(0) if one.status is None else axis_status(one.status, one.emergency) for one in self._seen]
        now_ns, patience_ns = self.clock.now_ns(), round(self._driver.heartbeats.timeout * 1e9)
        return Sample(
            self._cycle,
            stamp_ns,
            np.where(never, np.nan, position),
            None,
            np.zeros(len(joints)),
            age == 0,
            age,
            self._lost,
            tuple(int(joint_status(status[k] for k in motors)) for motors in joints),
            drives=tuple(
                f"node {place[1]}: {_status_words(one)}, {self._heard.nmt_words(place, now_ns, patience_ns)}"
                for place, one in zip(self._places, seen, strict=True)
            ),
        )


def _take(seen: _LastAnswers, position: int | None, status: int | None) -> None:
    """Store the answers of one drive in one cycle; None for a missing answer."""
    seen.age += 1
    if position is not None:
        seen.unwrapped = position if seen.position is None else unwrapped(seen.unwrapped, position)
        seen.position, seen.age = position, 0
    seen.status = status if status is not None else seen.status


def _status_words(seen: _LastAnswers) -> str:
    words = "no status word" if seen.status is None else drive_words(seen.status, seen.emergency)
    return words if seen.age == 0 else f"{words} (no answer for {seen.age} cycles)"
