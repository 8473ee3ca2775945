"""Simulate an arm whose plant lives in a process of its own: started, found, spoken to and ended.

The process is spawned in a session of its own, so that a Ctrl-C meant for its parent does not take the arm away from
under it. It is told what to be on its standard input, whose end later tells it that its parent is gone.

The connection is the lock: a plant serves one client at a time, and the kernel closes a client's connection with its
process, however that dies. In virtual time each exchange moves the plant by one period (lock-step), and gives the same
samples bit for bit as a plant in this process. In real time the plant moves by the machine's clock: a loop that is late
finds periods missing between its stamps, as on a real bus.
"""

from __future__ import annotations

import json
import os
import secrets
import select
import socket
import struct
import subprocess
import sys
import time
import weakref
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from drivers.arm import Arm, ArmDescription, Sample, StopKind, Vector
from drivers.clock import Clock
from ident_service.config.arm import ArmConfig
from ident_service.config.simulation import SimulatedDriver
from ident_service.errors import DriverError
from sim_backend import wire
from sim_backend.build import build_machine
from sim_backend.faults import Fault
from sim_backend.machine import Schedule, Truth, checked_torque, description
from sim_backend.plant_process import start_document
from sim_backend.plant_status import PlantStatus, read_status

START_TIMEOUT = 60.0  # an interpreter, its libraries and a model, on a busy machine [s]
_END_TIMEOUT = 20.0


class PlantLaunch:
    """Manage a plant process that this process has started; it ends with this object, or with this process."""

    def __init__(self, config: ArmConfig, faults: tuple[Fault, ...], address: str, status: str | None) -> None:
        """Prepare; nothing runs yet.

        Args:
            config: of the arm.
            faults: to inject besides those of the configuration.
            address: abstract name to listen on.
            status: file for the plant's status, which outlives it; None for anonymous memory.

        Raises:
            DriverError: the status file cannot be written.
        """
        self._config, self._faults, self._address = config, faults, address
        try:
            if status is None:
                self.status = os.memfd_create("ident-plant-status", os.MFD_CLOEXEC)
            else:
                self.status = os.open(status, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise DriverError(f"driver.status: {status}: {error.strerror}") from None
        self.pid = 0
        self._finalizer: weakref.finalize[..., PlantLaunch] = weakref.finalize(self, os.close, self.status)

    def start(self, *, lock_step: bool) -> bool:
        """Start the process; return True once it listens, False where another plant listens there already.

        Raises:
            DriverError: it cannot be started.
        """
        process = subprocess.Popen(
            # Not from the working directory, where anything may be called sim_backend.
            [sys.executable, "-P", "-m", "sim_backend.plant_process"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=(self.status,),
            start_new_session=True,
            # Several BLAS threads on small matrices only get into each other's way.
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
        )
        self._finalizer.detach()
        self._finalizer = weakref.finalize(self, _end, process, self.status)
        document = start_document(self._config, self._faults, self._address, self.status, lock_step=lock_step)
        said = ""
        if process.stdin is not None and process.stdout is not None:
            with suppress(BrokenPipeError):
                process.stdin.write(json.dumps(document).encode() + b"\n")
                process.stdin.flush()
            if select.select([process.stdout], [], [], START_TIMEOUT)[0]:
                said = process.stdout.readline().decode(errors="replace").strip()
        if said in ("ready", "in use"):
            self.pid = process.pid
            return said == "ready"
        self.end()
        raise DriverError(f"the plant process did not start: {said or 'it said nothing'}")

    def end(self) -> None:
        """Tell the process to end, and wait until its arm rests and it has; it is killed after 20 s."""
        self._finalizer()

    @property
    def status_path(self) -> Path:
        """Return the path to read the status from, valid until this object has ended the plant."""
        return Path(f"/proc/self/fd/{self.status}")


def _end(process: subprocess.Popen[bytes], status: int) -> None:
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with suppress(OSError):
                pipe.close()
    try:
        process.wait(_END_TIMEOUT)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    os.close(status)


def plant_address(bus: str | None) -> str:
    """Return the socket address, without its leading NUL, of this user's plant called `bus`; a random one for None."""
    name = f"{os.getpid()}-{secrets.token_hex(8)}" if bus is None else f"bus-{bus}"
    return f"ident-plant-{os.getuid()}-{name}"


def connect_to_plant(address: str) -> socket.socket | None:
    """Connect to the plant that listens at an address of `plant_address`, and return the socket; None if none does."""
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        sock.connect("\0" + address)
    except OSError:
        sock.close()
        return None
    return sock


# How long an answer may take [s]: in real time the drives have given up long before, in lock-step nothing waits.
_DEADLINE_REAL, _DEADLINE_LOCK_STEP = 0.1, 10.0
_STOP_DEADLINE = 0.1
_REFUSALS = {
    wire.IN_USE: "the arm is in use by pid {pid}",
    wire.OTHER_ARM: "another arm, or another version of its description, is on this bus",
    wire.OTHER_USER: "the plant on this bus is another user's",
}


class _PlantGone(DriverError):
    """Report that the connection to the plant has ended."""


class RemoteArm(Arm):
    """Connect to a plant process as its client, and start the process when there is none.

    Attributes:
        observer: called with the truth of every cycle; for scoring only.
        truth: true state of the last cycle, None before the first.
    """

    def __init__(
        self,
        config: ArmConfig,
        clock: Clock,
        *,
        faults: Sequence[Fault] = (),
        observer: Callable[[Truth], None] | None = None,
    ) -> None:
        """Use the arm's description; nothing is started before `open`.

        Args:
            config: configuration with a simulated driver.
            clock: the loop's; in lock-step with the plant if it is a virtual one.
            faults: to inject besides those of the configuration, by period since the first cycle.
            observer: called with the truth of every cycle.

        Raises:
            DriverError, ModelError, ParameterError: as for a plant in this process.
        """
        driver = config.driver
        if not isinstance(driver, SimulatedDriver):
            raise DriverError(f"{config.name}: the driver is not a simulated one")
        self.clock = clock
        self.observer = observer
        self.truth: Truth | None = None
        # The same construction gives the plant's description, and the errors that would prevent its start.
        twin = build_machine(config, faults)
        self.faults = twin.faults
        self._description = description(twin)
        self._joints = twin.plant.chain.joints
        self._none = np.zeros(self._joints)
        self._config, self._added = config, tuple(faults)
        self._schedule = Schedule(clock, round(twin.plant.period * 1e9), skips=not clock.lock_step)
        self._deadline = driver.deadline or (_DEADLINE_LOCK_STEP if clock.lock_step else _DEADLINE_REAL)
        self._address = plant_address(driver.bus)
        self._status = driver.status
        self._launch: PlantLaunch | None = None
        self._socket: socket.socket | None = None
        self._enabled = False
        self._cycle = self._number = 0
        self.plant_pid = 0

    def open(self) -> None:
        """Open the arm, starting its plant if none listens; cycles count from 0, the plant stays where it was.

        Raises:
            DriverError: open already, in use by another process, of another arm, or the plant cannot be started.
        """
        if self._socket is not None:
            raise DriverError("the simulated arm is already open")
        try:
            found = self._enter()
        except _PlantGone:  # it was just dying
            found = False
        if not found:
            if self._launch is not None:
                self._launch.end()
            self._launch = PlantLaunch(self._config, self._added, self._address, self._status)
            if not self._launch.start(lock_step=self.clock.lock_step):
                self.end_plant()  # another process started its plant first
            if not self._enter():
                raise DriverError("the plant process does not listen")
        self._enabled, self._cycle, self.truth = False, 0, None
        self._schedule.restart()

    def describe(self) -> ArmDescription:
        """Return the description of the simulated arm; raises DriverError when not open."""
        self._require_open()
        return self._description

    def enable(self) -> None:
        """Energise with zero torque; raises DriverError when not open, or when a fault keeps a drive from it."""
        self._require_open()
        self._enabled = False
        self._done(self._ask(wire.Enable(), self._deadline))
        self._enabled = True

    def reset(self) -> None:
        """Clear the faults that the drives have latched; DriverError when not open, enabled, or a cause persists."""
        self._require_open()
        self._done(self._ask(wire.Reset(), self._deadline))

    def exchange(self, torque: Vector | None) -> Sample:
        """Send the torque, or none, to the plant process, and return its sample of the next cycle.

        Raises:
            DriverError: as in the contract; a fault took the bus; or the plant did not answer within the deadline,
                or is gone. But for the first, the cycle is used up.
        """
        self._require_open()
        command = checked_torque(torque, self._enabled, self._joints)
        stamp_ns, cycle = self._schedule.wait(self.faults), self._cycle
        self._cycle += 1
        request = wire.Exchange(stamp_ns, int(command is not None), self._none if command is None else command)
        reply = self._ask(request, self._deadline)
        if not isinstance(reply, wire.Answer):
            self._done(reply)
            raise DriverError("the plant answered a cycle without a sample")
        self._schedule.stamp_ns = reply.stamp_ns  # in real time, the plant may have gone on without us
        for array in (reply.true_position, reply.true_velocity, reply.true_acceleration, reply.true_torque):
            array.setflags(write=False)
        reply.torque.setflags(write=False)
        self.truth = Truth(
            reply.stamp_ns, reply.true_position, reply.true_velocity, reply.true_acceleration, reply.true_torque
        )
        if self.observer is not None:
            self.observer(self.truth)
        return Sample(
            cycle,
            self._schedule.sample_stamp_ns(self.faults),
            reply.position,
            None,
            reply.torque,
            reply.valid,
            reply.age,
            reply.lost,
            reply.status,
            reply.status_age,
        )

    def stop(self, kind: StopKind) -> None:
        """End torque with this period by a message to the plant; drives that miss it stop by their own watchdog."""
        self._enabled = False
        if self._socket is not None:
            with suppress(DriverError):
                deadline = self._deadline if self.clock.lock_step else min(self._deadline, _STOP_DEADLINE)
                self._ask(wire.Stop(int(kind is StopKind.QUICK_STOP)), deadline)

    def close(self) -> None:
        """Take the torque off and release the arm; the plant lives on for the next `open`, until this object ends."""
        self.stop(StopKind.TORQUE_OFF)
        self._disconnect()

    def end_plant(self) -> None:
        """Close, and end the plant process, if this arm started it, once the arm is at rest."""
        self.close()
        if self._launch is not None:
            self._launch.end()
            self._launch = None

    def plant_status(self) -> PlantStatus:
        """Return the status record of the plant, from its configured file or its own memory.

        Raises:
            DriverError: this arm has not started it, and no status file is configured; or it has not said anything.
        """
        if self._status is not None:
            return read_status(self._status)
        if self._launch is None:
            raise DriverError("only who has started a plant, or names a file in driver.status, can read its status")
        return read_status(self._launch.status_path)

    def _enter(self) -> bool:
        """Become the client of the plant at the address; returns False if there is none."""
        sock = connect_to_plant(self._address)
        if sock is None:
            return False
        self._socket = sock
        try:
            self._request_access(sock)
        except BaseException:
            self._disconnect()
            raise
        return True

    def _request_access(self, sock: socket.socket) -> None:
        _, uid, _ = struct.unpack("3i", sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
        if uid != os.getuid():  # any user's process may listen on an abstract address
            raise DriverError(_REFUSALS[wire.OTHER_USER])
        reply = self._ask(wire.Hello(bytes.fromhex(self._config.sha256)), START_TIMEOUT)
        if isinstance(reply, wire.Refused):
            raise DriverError(_REFUSALS.get(reply.reason, "the plant refuses").format(pid=reply.pid))
        if not isinstance(reply, wire.Welcome):
            raise DriverError("the plant does not welcome its client")
        self.plant_pid = reply.pid

    def _ask(self, request: wire.Request, deadline: float) -> wire.Reply:
        """Send a request and return its reply; late replies to earlier requests are discarded."""
        sock = self._require_open()
        self._number += 1
        ends = time.monotonic() + deadline
        try:
            sock.settimeout(deadline)
            sock.send(wire.encode(request, self._number, self._joints))
            while True:
                data = sock.recv(wire.MAX_BYTES)
                if not data:
                    raise _PlantGone("the plant process is gone")
                number, reply = wire.decode_reply(data, self._joints)
                if number == self._number & 0xFFFFFFFF:
                    return reply
                sock.settimeout(max(1e-6, ends - time.monotonic()))
        except TimeoutError:
            raise DriverError(f"the plant did not answer within {deadline:g} s") from None
        except DriverError:
            raise
        except OSError as error:
            raise _PlantGone(f"the plant process is gone: {error.strerror or error}") from None

    def _done(self, reply: wire.Reply) -> None:
        if isinstance(reply, wire.Failed):
            raise DriverError(wire.text_of(reply))

    def _require_open(self) -> socket.socket:
        if self._socket is None:
            raise DriverError("the simulated arm is not open")
        return self._socket

    def _disconnect(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        self._enabled = False
