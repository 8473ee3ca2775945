"""Run emulated drives on real interfaces in real time: the work of `ident emulate`.

Hosting them here saves a hop: the drives' frames reach the host in one packet, without a third process. A wire keeps
the pace of its bit rates where the description says `options: {pace: true}`. Where it says `data_bitrate`, all data
frames of drives are CAN FD's.

The arm behind them goes on falling or braking when the host is gone. While it runs, lines on `commands` inject faults:
a fault as `parse_fault` has it, `clear` to end all of them, `state` to be told everything again, `quit`;
`activate` and `idle` are keys of a pendant, where the arm has one.
"""

from __future__ import annotations

import gc
import heapq
import queue
import select
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import can
import numpy as np

from drivers.can.can_frame import Frame
from drivers.clock import RealClock
from ident_service.config.arm import ArmConfig
from ident_service.config.can_bus import WIRE_INTERFACE, CanBus
from ident_service.errors import DriverError, UsageError
from sim_backend.can_bus.host import LocalPort
from sim_backend.can_bus.hub import CanBusServer
from sim_backend.emulator.build import build_emulator
from sim_backend.emulator.emulator import Emulator
from sim_backend.emulator.faults import DriveFault, Sent, parse_fault
from sim_backend.emulator.lock_step import INTERFACE

# Names that python-can has for interfaces of a driver.
_NAMES = {"raw": "socketcan"}


class PythonCanBuses:
    """Connect to the buses of one arm."""

    def __init__(self, buses: Sequence[CanBus]) -> None:
        """Open all buses.

        Args:
            buses: buses of the arm's description.

        Raises:
            DriverError: an interface that cannot be had; none stays open then.
        """
        self._buses: list[can.BusABC] = []
        self._fd = [bus.data_bitrate is not None for bus in buses]
        self._heard: queue.SimpleQueue[tuple[int, can.Message | DriverError]] = queue.SimpleQueue()
        self._closing = False
        self.unsent = 0
        for number, bus in enumerate(buses):
            try:
                self._buses.append(_opened(bus))
            except BaseException as error:
                self.close()
                if isinstance(error, (can.CanError, OSError, ValueError, ImportError, NotImplementedError)):
                    raise DriverError(f"bus {number}: {bus.interface} {bus.channel}: {error}") from None
                raise
        # One bus is waited for here, several are by a thread each.
        self._threads = [
            threading.Thread(target=self._listen, args=(number,), daemon=True)
            for number in (range(len(self._buses)) if len(self._buses) > 1 else ())
        ]
        for thread in self._threads:
            thread.start()

    @property
    def waits(self) -> bool:
        """Return whether a received frame is queued already, so that `receive` returns at once; False with one bus."""
        return not self._heard.empty()

    def receive(self, timeout: float) -> tuple[int, Frame] | None:
        """Return the number of a bus and the next frame on it; None when none comes in time.

        Args:
            timeout: how long to wait [s].

        Raises:
            DriverError: an interface is gone.
        """
        item = self._take(timeout)
        return None if item is None else (item[0], _frame(item[1]))

    def send(self, frames: Iterable[tuple[int, Frame]]) -> None:
        """Send frames; one that an interface does not take counts as `unsent`, as on a bus that is off."""
        for number, frame in frames:
            try:
                self._buses[number].send(
                    can.Message(
                        arbitration_id=frame.identifier,
                        data=frame.data,
                        is_extended_id=frame.extended,
                        is_remote_frame=frame.remote,
                        is_error_frame=frame.error,
                        is_fd=self._fd[number] and not frame.remote,
                        bitrate_switch=self._fd[number] and not frame.remote,
                    )
                )
            except (can.CanError, OSError):
                self.unsent += 1

    def close(self) -> None:
        """Close all buses; any number of times."""
        self._closing = True
        for thread in getattr(self, "_threads", ()):
            thread.join()
        for bus in self._buses:
            bus.shutdown()
        self._buses.clear()

    def _take(self, timeout: float) -> tuple[int, can.Message] | None:
        if self._threads:
            try:
                number, message = self._heard.get(timeout > 0.0, timeout or None)
            except queue.Empty:
                return None
            if isinstance(message, DriverError):
                raise message
        else:
            number, message = 0, self._received(0, timeout)
        return None if message is None else (number, message)

    def _received(self, number: int, timeout: float) -> Any:
        try:
            return self._buses[number].recv(timeout)
        except (can.CanError, OSError) as error:
            raise DriverError(f"bus {number} is gone: {error}") from None

    def _listen(self, number: int) -> None:
        while not self._closing:
            try:
                message = self._received(number, 0.05)
            except DriverError as error:
                self._heard.put((number, error))
                return
            if message is not None:
                self._heard.put((number, message))


def _opened(bus: CanBus) -> can.BusABC:
    options: dict[str, Any] = dict(bus.options)
    if bus.data_bitrate is not None:
        options |= {"fd": True, "data_bitrate": bus.data_bitrate}
    name = _NAMES.get(bus.interface, bus.interface)
    return can.Bus(interface=name, channel=bus.channel, bitrate=bus.bitrate, **options)


def _frame(message: can.Message) -> Frame:
    return Frame(
        message.arbitration_id,
        bytes(message.data),
        message.is_remote_frame,
        message.is_error_frame,
        message.is_extended_id,
        fd=message.is_fd,
    )


class HostedBuses:
    """Host the buses of one arm, all of them wires.

    Attributes:
        unsent: frames that a wire did not take.
    """

    def __init__(self, buses: Sequence[CanBus]) -> None:
        """Open all wires.

        Args:
            buses: buses of the arm's description.

        Raises:
            DriverError: a wire that another process runs, or that cannot be had; none stays then.
        """
        self.unsent = 0
        self._wires: list[CanBusServer] = []
        self._ports: list[LocalPort] = []
        self._heard: deque[tuple[int, Frame]] = deque()
        try:
            for bus in buses:
                bitrate = bus.bitrate if bus.options.get("pace", False) else 0
                self._wires.append(CanBusServer(bus.channel, bitrate, bus.data_bitrate).__enter__())
                self._ports.append(LocalPort(self._wires[-1], "drives"))
        except BaseException:
            self.close()
            raise

    @property
    def waits(self) -> bool:
        """Return whether a received frame is queued already, so that `receive` returns at once."""
        return bool(self._heard)

    def receive(self, timeout: float) -> tuple[int, Frame] | None:
        """Return the number of a bus and the next frame on it; None when none comes in time.

        Args:
            timeout: how long to wait [s].

        Raises:
            DriverError: a wire is closed.
        """
        if not self._heard:
            self._listen(time.monotonic_ns() + round(timeout * 1e9))
        return self._heard.popleft() if self._heard else None

    def send(self, frames: Iterable[tuple[int, Frame]]) -> None:
        """Send frames, those of one bus together; frames that a bus does not take count as `unsent`."""
        of: dict[int, list[Frame]] = {}
        for number, frame in frames:
            of.setdefault(number, []).append(frame)
        for number, some in of.items():
            self.unsent += len(some) - self._ports[number].offer(some)

    def close(self) -> None:
        """Close all hosted buses and their connections; any number of times."""
        for wire in self._wires:
            wire.close()
        self._wires.clear()
        self._ports.clear()

    def _listen(self, deadline_ns: int) -> None:
        """Move all wires until a frame is received or the deadline has passed."""
        while True:
            if len(self._wires) > 1:
                self._wait(deadline_ns)
            for number, (wire, port) in enumerate(zip(self._wires, self._ports, strict=True)):
                wire.poll(deadline_ns if len(self._wires) == 1 else 0)
                self._heard.extend((number, frame) for frame, _ in port.port.take())
            if self._heard or time.monotonic_ns() >= deadline_ns:
                return

    def _wait(self, deadline_ns: int) -> None:
        """Wait until one of several wires has something to do."""
        watched: list[int] = []
        for wire in self._wires:
            descriptors, end_ns = wire.watched()
            watched += descriptors
            deadline_ns = deadline_ns if end_ns is None else min(deadline_ns, end_ns)
        select.select(watched, [], [], max(0, deadline_ns - time.monotonic_ns()) * 1e-9)


_POLL_NS = 20_000_000  # commands, stop and states are looked at this often
_GIVEN_UP = 0.9  # of a period after SYNC, when a host hardly waits for positions any more
_SLACK = 0.05  # of a period, by which a cycle may be early or late and the arm's step is still a nominal one
_AT_ONCE = 256  # frames handled before time is looked at again
# Speed below which an arm is said to rest when it has been so for a while, and above which to move [rad/s or m/s].
_RESTS, _MOVES = 1e-2, 3e-2  # closed brakes creep by some 1e-3
_RESTING_NS = 500_000_000


@dataclass(frozen=True)
class Emulated:
    """Summarise an emulation.

    Attributes:
        seconds: duration of the emulation [s].
        heard: frames received.
        sent: frames sent.
        unsent: frames that an interface did not take.
        states: states of the drives at the end, in words.
        at_rest: whether the arm stood still.
    """

    seconds: float
    heard: int
    sent: int
    unsent: int
    states: tuple[str, ...]
    at_rest: bool


def emulated_buses(config: ArmConfig) -> tuple[CanBus, ...]:
    """Return the buses of an arm's configuration; raises UsageError where no emulator process can serve them.

    Raises:
        UsageError: drives that are not on a CAN bus, or in the process that moves them.
    """
    buses = config.can_buses
    if not buses:
        raise UsageError(f"{config.name}: the driver has no CAN bus, so there is no drive to emulate")
    if any(bus.interface == INTERFACE for bus in buses):
        raise UsageError(
            f"{config.name}: {INTERFACE} drives live in the process that moves them; "
            "name an interface such as socketcan, udp_multicast or ident_wire"
        )
    return buses


def emulate(
    config: ArmConfig,
    *,
    faults: Sequence[str] = (),
    seconds: float | None = None,
    tell: Callable[[str], None] = lambda line: None,
    stop_requested: Callable[[], bool] = lambda: False,
    commands: Callable[[], str | None] = lambda: None,
) -> Emulated:
    """Run the drives of an arm on its configured interfaces for `seconds` or until told to stop; return a summary.

    Args:
        config: of the arm.
        faults: to inject besides those of the configuration, as people write them; they count from the first SYNC.
        seconds: duration [s]; None until asked to stop.
        tell: called with a line whenever a drive changes its state, a fault comes or goes, or the arm comes to rest.
        stop_requested: called all the time; True ends the emulation.
        commands: function that returns the next line of commands, None while there is none; never waits.

    Raises:
        UsageError: as `emulated_buses`; a malformed fault.
        DriverError: as `build_emulator`, an interface that cannot be had or is lost.
    """
    buses = emulated_buses(config)
    emulator = build_emulator(config)
    try:
        emulator.add_configured(parse_fault(text, emulator.names) for text in faults)
    except DriverError as error:
        raise UsageError(str(error)) from None
    ours = {bus.interface == WIRE_INTERFACE for bus in buses}
    if len(ours) > 1:
        raise DriverError(
            f"{config.name}: either all buses are {WIRE_INTERFACE} or none is, for one loop to serve them"
        )
    station = HostedBuses(buses) if ours == {True} else PythonCanBuses(buses)
    try:
        return _Run(emulator, station, tell, commands).until(seconds, stop_requested)
    finally:
        station.close()


class _Run:
    def __init__(
        self,
        emulator: Emulator,
        station: PythonCanBuses | HostedBuses,
        tell: Callable[[str], None],
        commands: Callable[[], str | None],
    ) -> None:
        self._emulator, self._station = emulator, station
        self._stamps = isinstance(station, HostedBuses)  # whether frames say when they were on the wire
        self._given_up_ns = round(_GIVEN_UP * 1e9 * emulator.body.plant.period)
        emulator.body.slack_ns = round(_SLACK * 1e9 * emulator.body.plant.period)
        self._tell, self._commands = tell, commands
        self._clock = RealClock()
        self._later: list[tuple[int, int, Sent]] = []
        self._heard = self._sent = 0
        self._told: tuple[str, ...] = ("",) * len(emulator.labels)
        self._faults: tuple[DriveFault, ...] = ()
        self._rested = True
        self._stirred_ns = 0
        self._quit = False
        self._streaming = False  # whether a host sends cycles

    def until(self, seconds: float | None, stop_requested: Callable[[], bool]) -> Emulated:
        emulator, clock = self._emulator, self._clock
        begun = looked = heard_ns = clock.now_ns()
        end = None if seconds is None else begun + round(seconds * 1e9)
        # What has been built stays; the garbage collector need not scan it again in the middle of a cycle.
        collecting = gc.isenabled()
        gc.collect()
        gc.freeze()
        gc.disable()
        emulator.power_up(begun)
        try:
            while not self._quit:
                now = clock.now_ns()
                if now - looked >= _POLL_NS:
                    looked = now
                    self._look(now)
                    if stop_requested() or (end is not None and now >= end):
                        break
                heard, at_once = self._station.receive(max(0, self._next_due(looked) - now) * 1e-9), 0
                while at_once < _AT_ONCE:
                    if heard is None:
                        # The drives' time is moved to `now` below: what was sent until then comes before.
                        now = clock.now_ns()
                        heard = self._station.receive(0.0)
                    if heard is None:
                        break
                    at_once += 1
                    bus, frame = heard
                    # Drives act when a frame is on the wire, not when this process comes to it.
                    at_ns = frame.stamp_ns if self._stamps else clock.now_ns()
                    answer = partial(self._send_ready_frames, requested_ns=at_ns)
                    answer(emulator.receive(bus, frame, at_ns, answer=answer))
                    heard = self._station.receive(0.0) if self._station.waits else None
                if at_once:
                    self._heard += at_once
                    heard_ns = clock.now_ns()
                # What was due while frames waited comes after them: a drive's firmware would have had them in time.
                self._send_ready_frames(emulator.tick(now))
                self._streaming = now - heard_ns < _POLL_NS
                if self._streaming:
                    emulator.compute_ahead(now)
        finally:
            gc.unfreeze()
            if collecting:
                gc.enable()
        now = clock.now_ns()
        self._look(now)
        return Emulated(
            (now - begun) * 1e-9, self._heard, self._sent, self._station.unsent, emulator.states, self._is_at_rest(now)
        )

    def _next_due(self, looked_ns: int) -> int:
        """Return when there is something to do although no frame comes [ns]."""
        due = [looked_ns + _POLL_NS, *(item[0] for item in self._later[:1])]
        if (deadline := self._emulator.next_deadline_ns) is not None:
            due.append(deadline)
        if self._streaming and (overdue := self._emulator.body.overdue_ns) is not None:
            due.append(overdue)
        return min(due)

    def _send_ready_frames(self, sent: Sequence[Sent], requested_ns: int | None = None) -> None:
        """Send what is ready, the lowest identifiers first, as a bus would, but no position too late."""
        now = self._clock.now_ns()
        too_late = requested_ns is not None and now - requested_ns > self._given_up_ns
        ready = []
        for item in sent:
            if too_late and self._emulator.is_feedback(item):
                continue  # a drive would have sent it in its own cycle; in this one it would be taken for its own
            if item.ready_ns <= now:
                ready.append(item)
            else:
                heapq.heappush(self._later, (item.ready_ns, id(item), item))
        while self._later and self._later[0][0] <= now:
            ready.append(heapq.heappop(self._later)[2])
        if ready:
            ready.sort(key=lambda item: item.frame.identifier)
            self._station.send([(item.bus, item.frame) for item in ready])
            self._sent += len(ready)

    def _look(self, now_ns: int) -> None:
        while (line := self._commands()) is not None:
            self._obey(line.strip(), now_ns)
        emulator = self._emulator
        states = emulator.states
        for label, state, told in zip(emulator.labels, states, self._told, strict=True):
            if state != told:
                self._tell(f"{label}: {state}")
        self._told = states
        if emulator.active != self._faults:
            self._faults = emulator.active
            self._tell("faults: " + (", ".join(self._named(fault) for fault in emulator.active) or "none"))
        if (resting := self._is_at_rest(now_ns)) != self._rested:
            self._rested = resting
            self._tell("the arm is at rest" if resting else "the arm moves")

    def _named(self, fault: DriveFault) -> str:
        return fault.kind if fault.drive is None else f"{fault.kind} of {self._emulator.names[fault.drive]}"

    def _is_at_rest(self, now_ns: int) -> bool:
        fastest = float(np.abs(self._emulator.body.plant.velocity).max())
        if fastest > _RESTS:
            self._stirred_ns = now_ns
        if self._rested:
            return fastest < _MOVES
        return now_ns - self._stirred_ns > _RESTING_NS

    def _obey(self, line: str, now_ns: int) -> None:
        match line:
            case "":
                pass
            case "quit":
                self._quit = True
            case "clear":
                self._emulator.clear(now_ns)
            case "state":
                self._told = ("",) * len(self._told)
            case "activate" | "idle":
                self._emulator.press(line, now_ns)
            case _:
                try:
                    self._emulator.inject([parse_fault(line, self._emulator.names)], now_ns)
                except DriverError as error:
                    self._tell(f"not understood: {error}")
        # A line must have had its effect before the next one is read.
        self._send_ready_frames(self._emulator.tick(now_ns))
