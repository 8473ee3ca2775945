"""Run the simulated arm's plant as a process of its own, and keep the extremes of its life.

Time. The plant is always computed to the end of the period whose torque is known. In real time it moves by the
machine's clock: a frame may come up to one period after its stamp; after that the period has been silent, the last
torque acts on and the drives' watchdog counts. In lock-step each exchange is one period, and wall time means nothing:
only a cycle without a torque, or a connection that ends, is silence.

When the client is gone, silence goes on until the idle drives have braked the arm to rest, or `PATIENCE` has passed: at
the machine's pace while a client may come back in real time, otherwise as fast as it can be computed. When client and
parent are gone the process ends after that. It knows its client's end by the connection and its parent's by the end of
its standard input, so that it outlives neither for long, however they died.
"""

from __future__ import annotations

import gc
import json
import mmap
import os
import select
import socket
import struct
import sys
import time
from contextlib import suppress
from typing import Any

import numpy as np

from drivers.arm import StopKind
from ident_service.config.arm import ArmConfig
from ident_service.errors import DriverError
from sim_backend import wire
from sim_backend.build import build_machine
from sim_backend.faults import Fault, FaultKind
from sim_backend.machine import SimulatedHardware
from sim_backend.plant_status import PlantState, PlantStatus, encode_status, status_size

_EVERY = 20  # periods between two writings, when nothing happens


class PlantStatistics:
    """Collect and write the status record of one machine."""

    def __init__(self, machine: SimulatedHardware, descriptor: int) -> None:
        """Start, and write the first record.

        Args:
            machine: machine whose status is recorded.
            descriptor: descriptor of the file or anonymous memory to write into; it is made as long as needed.
        """
        joints = machine.plant.chain.joints
        os.ftruncate(descriptor, status_size(joints))
        self._map = mmap.mmap(descriptor, status_size(joints))
        self._machine = machine
        self.state = PlantState.WAITING
        self.silent_ticks = 0
        self._ticks = self._clients = self._client_pid = self._unwritten = 0
        self._lowest, self._highest = machine.plant.position.copy(), machine.plant.position.copy()
        self._velocity, self._torque = np.zeros(joints), np.zeros(joints)
        self._silent_velocity, self._silent_torque = np.zeros(joints), np.zeros(joints)
        self.write()

    def client_came(self, pid: int) -> None:
        """Record that a client with this pid has connected, and enter SERVING."""
        self._clients, self._client_pid = self._clients + 1, pid
        self.frame_came()
        self.enter(PlantState.SERVING)

    def client_left(self) -> None:
        """Record that the client is gone: enter AT_REST where the arm is supported, else SETTLING."""
        self._client_pid = 0
        self.enter(PlantState.AT_REST if self._machine.supported else PlantState.SETTLING)

    def enter(self, state: PlantState, *, quiet: int = 0) -> None:
        """Enter a state and write the record; take `quiet` periods, in which the arm rested, off the silent ones."""
        self.state = state
        self.silent_ticks -= quiet
        self.write()

    def end(self) -> None:
        """Record that the process ends, and whether the arm is at rest or moves then."""
        resting = self.state is PlantState.AT_REST or self._machine.supported
        self.enter(PlantState.ENDED_AT_REST if resting else PlantState.ENDED_MOVING)

    def frame_came(self) -> None:
        """Record that a frame has come; silence is counted from here."""
        if self.silent_ticks:
            self.silent_ticks = 0
        self._silent_velocity[:] = 0.0
        self._silent_torque[:] = 0.0

    def period_ended(self, *, silent: bool) -> None:
        """Record the extremes of a period that is over, as silent if no frame came; write them now and then."""
        plant = self._machine.plant
        speed, torque = np.abs(plant.velocity), np.abs(self._machine.torque)
        np.minimum(self._lowest, plant.position, out=self._lowest)
        np.maximum(self._highest, plant.position, out=self._highest)
        np.maximum(self._velocity, speed, out=self._velocity)
        np.maximum(self._torque, torque, out=self._torque)
        if silent:
            self.silent_ticks += 1
            np.maximum(self._silent_velocity, speed, out=self._silent_velocity)
            np.maximum(self._silent_torque, torque, out=self._silent_torque)
        self._ticks += 1
        self._unwritten += 1
        if self._unwritten >= _EVERY:
            self.write()

    def write(self) -> None:
        """Write the record into the status memory now."""
        plant = self._machine.plant
        record = encode_status(
            PlantStatus(
                self.state,
                os.getpid(),
                self._client_pid,
                self._clients,
                self._ticks,
                self.silent_ticks,
                plant.period,
                plant.position,
                plant.velocity,
                self._lowest,
                self._highest,
                self._velocity,
                self._torque,
                self._silent_velocity,
                self._silent_torque,
            )
        )
        self._map[: len(record)] = record
        self._unwritten = 0


PATIENCE = 60.0  # simulated seconds that an abandoned arm is given; sinking against its brakes takes its time
# rad/s or m/s. An arm without brakes sinks as fast as gravity drives it against its idle drives, ever more slowly
# towards its lowest place; slower than this counts as at rest. Near its highest place that may be before it sinks.
REST_SPEED = 1e-2
REST_TIME = 0.1  # simulated seconds that nothing may be faster
_AT_ONCE = 100  # periods to catch up between two polls of the sockets
_MOST_WAITING = 8  # connections that have not sent their Hello
_LONGEST_FUTURE_NS = 1_000_000_000


class PlantProcess:
    """Serve one client at a time on a listening socket."""

    def __init__(
        self,
        machine: SimulatedHardware,
        listener: socket.socket,
        lifeline: int,
        sha256: bytes,
        story: PlantStatistics,
        lock_step: bool,
    ) -> None:
        """Use the given machine and socket.

        Args:
            machine: machine to simulate.
            listener: bound and listening, non-blocking.
            lifeline: a descriptor that ends with the parent.
            sha256: hash of the configuration, which a client must share.
            story: recorder of the status.
            lock_step: whether exchanges move time, instead of the machine's clock.
        """
        self._machine = machine
        self._joints = machine.plant.chain.joints
        self._period = machine.plant.period
        self._period_ns = round(self._period * 1e9)
        self._listener = listener
        self._lifeline: int | None = lifeline
        self._sha256 = sha256
        self._story = story
        self._lock_step = lock_step
        self._client: socket.socket | None = None
        self._client_pid = 0
        self._strangers: list[socket.socket] = []
        self._next_ns = 0  # stamp of the state that the plant has been moved to
        self._begun = False  # whether this client has had a cycle
        self._error: DriverError | None = None
        self._quiet = self._abandoned = 0  # periods at rest, and without a client

    def run(self) -> None:
        """Serve until parent and client are gone and the arm rests, or has moved for `PATIENCE` simulated seconds."""
        try:
            while self._client is not None or self._lifeline is not None:
                self._turn()
                if self._lock_step or self._lifeline is None:
                    self._simulate_until_rest()
            self._simulate_until_rest()
        finally:
            self._story.end()
            for sock in (self._client, self._listener, *self._strangers):
                if sock is not None:
                    sock.close()

    def _turn(self) -> None:
        """Wait for an event and handle it: frames of the client first, then newcomers, then time."""
        sources: list[Any] = [self._listener, *self._strangers]
        sources += [source for source in (self._client, self._lifeline) if source is not None]
        readable, _, _ = select.select(sources, [], [], self._poll_timeout())
        if self._client is not None and self._client in readable:
            self._serve()
        if self._lifeline is not None and self._lifeline in readable and not os.read(self._lifeline, 4096):
            self._lifeline = None
        for stranger in [sock for sock in self._strangers if sock in readable]:
            self._strangers.remove(stranger)
            self._accept_client(stranger)
        if self._listener in readable:
            with suppress(OSError):  # the connecting process may be gone already
                self._strangers.append(self._listener.accept()[0])
                self._strangers[-1].setblocking(False)
            for stranger in self._strangers[:-_MOST_WAITING]:
                stranger.close()
            del self._strangers[:-_MOST_WAITING]
        if self._moves_by_clock():
            for _ in range(_AT_ONCE):
                if time.monotonic_ns() < self._next_ns + self._period_ns:
                    break
                self._silent_period()

    def _moves_by_clock(self) -> bool:
        return not self._lock_step and (self._client is not None or self._story.state is PlantState.SETTLING)

    def _poll_timeout(self) -> float | None:
        """Return how long to wait for events [s]; None for ever."""
        if not self._moves_by_clock():
            return None
        return max(0, self._next_ns + self._period_ns - time.monotonic_ns()) * 1e-9

    def _accept_client(self, stranger: socket.socket) -> None:
        """Accept a newcomer as the client, or send it the reason of the refusal."""
        try:
            number, hello = wire.decode_request(stranger.recv(wire.MAX_BYTES), self._joints)
            if not isinstance(hello, wire.Hello):
                raise wire.MalformedFrame("malformed frame: a newcomer says hello first")
            pid, uid, _ = struct.unpack("3i", stranger.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
            refused = None
            if uid != os.getuid():
                refused = wire.Refused(wire.OTHER_USER, 0)
            elif self._client is not None:
                refused = wire.Refused(wire.IN_USE, self._client_pid)
            elif hello.sha256 != self._sha256:
                refused = wire.Refused(wire.OTHER_ARM, 0)
            stranger.send(wire.encode(refused or wire.Welcome(os.getpid()), number, self._joints))
        except OSError:  # malformed frames are such
            stranger.close()
            return
        if refused is not None:
            stranger.close()
            return
        self._client, self._client_pid = stranger, pid
        self._machine.restart()
        self._begun, self._error = False, None
        self._next_ns = time.monotonic_ns()
        self._story.client_came(pid)

    def _serve(self) -> None:
        """Serve one request of the client; its end, or a malformed frame, ends the connection."""
        client = self._client
        if client is None:
            return
        try:
            data = client.recv(wire.MAX_BYTES)
            if not data:
                raise ConnectionResetError
            number, request = wire.decode_request(data, self._joints)
            client.send(wire.encode(self._reply(request), number, self._joints))
        except OSError:  # malformed frames are such
            client.close()
            self._client, self._client_pid = None, 0
            self._quiet = self._abandoned = 0
            self._story.client_left()
        else:
            if isinstance(request, wire.Exchange):
                self._advance()

    def _reply(self, request: wire.Request) -> wire.Reply:
        machine = self._machine
        try:
            if isinstance(request, wire.Exchange):
                return self._cycle(request)
            if isinstance(request, wire.Enable):
                machine.enable()
            elif isinstance(request, wire.Reset):
                machine.reset()
            elif isinstance(request, wire.Stop):
                machine.stop(StopKind.QUICK_STOP if request.brakes else StopKind.TORQUE_OFF)
            else:
                raise wire.MalformedFrame("malformed frame: a client says hello once")
        except wire.MalformedFrame:
            raise
        except DriverError as error:
            return wire.failure_of(error)
        return wire.Done()

    def _cycle(self, request: wire.Exchange) -> wire.Reply:
        machine = self._machine
        if not self._begun or self._lock_step:
            if not self._begun:
                machine.tick = 0
            self._begun, self._next_ns = True, request.stamp_ns
        if request.stamp_ns > time.monotonic_ns() + _LONGEST_FUTURE_NS and not self._lock_step:
            raise wire.MalformedFrame(f"malformed frame: a stamp of {request.stamp_ns} has not come yet")
        while request.stamp_ns >= self._next_ns + self._period_ns:
            self._silent_period()
        if self._error is not None:
            machine.hold()
            raise self._error
        if request.sends and not machine.enabled:
            raise DriverError("a torque for an arm that is not enabled")
        reading = machine.cycle(request.torque if request.sends else None)
        truth = machine.truth(self._next_ns)
        self._story.frame_came()
        return wire.Answer(
            self._next_ns,
            reading.lost,
            reading.status_age,
            reading.position,
            reading.torque,
            reading.valid,
            reading.age,
            reading.status,
            truth.position,
            truth.velocity,
            truth.acceleration,
            truth.torque,
        )

    def _silent_period(self) -> None:
        machine = self._machine
        stopped = machine.watchdog_expired  # the period in which it expires is not yet one of rest
        machine.hold()
        self._advance(silent=True)
        slow = bool((np.abs(machine.plant.velocity) <= REST_SPEED).all())
        self._quiet = self._quiet + 1 if slow and stopped else 0
        if self._story.state is not PlantState.SETTLING:
            return
        self._abandoned += 1
        if self._error is not None:
            self._story.enter(PlantState.RAN_AWAY)
        elif machine.supported or self._quiet * self._period >= REST_TIME:
            self._story.enter(PlantState.AT_REST, quiet=self._quiet)
        elif self._abandoned * self._period >= PATIENCE:
            self._story.enter(PlantState.STILL_MOVING)

    def _simulate_until_rest(self) -> None:
        """Let an abandoned arm come to rest, as fast as it can be computed."""
        while self._client is None and self._story.state is PlantState.SETTLING:
            self._silent_period()

    def _advance(self, *, silent: bool = False) -> None:
        self._error = None
        try:
            self._machine.advance()
        except DriverError as error:
            self._error = error
        self._next_ns += self._period_ns
        self._story.period_ended(silent=silent)


def start_document(
    config: ArmConfig, faults: tuple[Fault, ...], address: str, status_descriptor: int, *, lock_step: bool
) -> dict[str, object]:
    """Return the JSON object that a plant process reads from its standard input; see `main`."""
    listed = [[f.at_cycle, f.kind.value, f.joint, f.duration, f.size, f.offset] for f in faults]
    return {
        "address": address,
        "status": status_descriptor,
        "lock_step": lock_step,
        "sha256": config.sha256,
        "faults": listed,
        "config": json.loads(config.model_dump_json()),
    }


def _leave_the_core() -> None:
    """Leave the loop's core to it: a plant that inherits the core would stand still whenever the loop computes."""
    inherited, others = os.sched_getaffinity(0), set(range(os.cpu_count() or 1))
    others -= inherited
    if len(inherited) == 1 and others:
        with suppress(OSError):
            os.sched_setaffinity(0, others)


def main() -> int:
    """Serve the plant that JSON on standard input describes; return 0 after it or if its address is in use, else 1.

    Says `ready`, `in use` (of the address) or an error, in one line on standard output.
    """
    _leave_the_core()
    line = b""
    while not line.endswith(b"\n"):
        if not (more := os.read(0, 65536)):
            return 1
        line += more
    start = json.loads(line)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        # An abstract address has no file that could be left behind, and binding it is the lock.
        listener.bind("\0" + start["address"])
    except OSError:
        listener.close()
        _say("in use")
        return 0
    try:
        config = ArmConfig.model_validate_json(json.dumps(start["config"]))
        faults = [
            Fault(at, FaultKind(kind), joint, duration, size, (offset[0], offset[1], offset[2]))
            for at, kind, joint, duration, size, offset in start["faults"]
        ]
        machine = build_machine(config, faults)
        story = PlantStatistics(machine, start["status"])
    except Exception as error:  # noqa: BLE001 - the parent must learn why this process cannot begin
        listener.close()
        _say(f"{type(error).__name__}: {error}")
        return 1
    listener.setblocking(False)
    listener.listen(_MOST_WAITING)
    _say("ready")
    gc.collect()
    gc.freeze()
    PlantProcess(machine, listener, 0, bytes.fromhex(start["sha256"]), story, start["lock_step"]).run()
    return 0


def _say(text: str) -> None:
    with suppress(OSError):
        os.write(1, text.replace("\n", " ").encode() + b"\n")


if __name__ == "__main__":
    sys.exit(main())
