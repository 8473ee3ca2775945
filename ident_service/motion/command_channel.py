"""Take commands while a motion runs: stop, pause, finish and leases, from this process or another.

An arm without brakes that has been stopped is held, and waits for a person to say that it is supported.

The loop reads its commands once per cycle, so reading must not wait: a word of shared memory, an attribute, never a
lock. Stop needs no lease. Hold-to-run is nothing but a short lease.

| offset | type | what |
|---|---|---|
| 0 | 8 bytes | `identctl` |
| 8 | uint32 | version |
| 12 | uint32 | pid of the process that moves the arm |
| 16 | uint8 | stop: not 0 for a controlled stop; only a request home takes it back |
| 17 | uint8 | pause: not 0 while the arm shall stand |
| 18 | uint8 | finish: not 0 when the run shall end early, in order; never taken back |
| 19 | uint8 | waiting: not 0 while the arm is held until a person confirms that it is supported; of the loop |
| 20 | uint8 | supported: not 0 when that was confirmed; counts while the arm waits for it |
| 21 | uint8 | homing: 1 when a person asked that the held arm be led home, then the loop's answer (`Homing`) |
| 24 | int64 | when the lease was renewed last [ns of the machine's monotonic clock] |
| 32 | int64 | how long it lasts [ns]; 0 for none |
| 40 | int64 | when a stop was asked for last, whether or not the arm moved then [ns of the same]; 0 for never |
| 48 | int64 | when the lease of the path home was renewed last [ns of the same] |

A motion takes seconds to begin, in which no loop can be reached yet. So a stop writes its time into the file, and a
motion that was asked for before that time begins stopped.

Every word is written by one side at a time and read whole. The process that moves the arm holds an exclusive lock on
the file, which vanishes with the process: a second one is refused, and a file without a lock belongs to no process.

The requester of a motion holds a pipe open to its process. The pipe is closed when the requester dies, however that
happens, and the motion ends within a cycle, in real and in virtual time. The lease is for a requester that lives but
hangs. It is measured on the machine's clock and counts in real time only. In lock step the arm's time waits while the
machine stalls, and a stall would be taken for a requester that hangs. No real arm moves in lock step.

Preflight moves an arm by a few centimetres. Whatever goes wrong in it, and a stop too, ends with torque off.
"""

from __future__ import annotations

import errno
import fcntl
import mmap
import os
import select
import struct
import time
from collections.abc import Callable
from enum import IntEnum
from pathlib import Path
from typing import Protocol, Self

from drivers.arm import Arm, ArmDescription, Sample, SetupCheck, StopKind, Vector, Watchdog
from drivers.axis_status import AxisStatus
from drivers.can.bus_load import Budget
from ident_service.errors import DriverError, UsageError

LEASE_SECONDS = 2.0  # renewed every 0.5 s
HOLD_TO_RUN_SECONDS = 0.25


class Homing(IntEnum):
    """Name the stages of leading home an arm that is held after a stop."""

    NONE = 0
    ASKED = 1
    GOING = 2
    ENDED = 3  # it stands again and is held, at home unless it was stopped
    REFUSED = 4  # it stands where it stood


class Controls(Protocol):
    """Define the controls that the loop reads once per cycle; whatever they raise stops the arm."""

    @property
    def stop(self) -> bool:
        """Return whether the arm is to be brought to a controlled stop; the run ends with it."""

    @property
    def pause(self) -> bool:
        """Return whether the arm is to pause; it goes on when this is False again."""

    @property
    def finish(self) -> bool:
        """Return whether the run is to end early: the arm rests and goes straight back to where it began, if free."""

    @property
    def supported(self) -> bool:
        """Return whether a person has confirmed, since the present hold began, that the arm is supported or home."""

    def announce_hold(self) -> None:
        """Announce that the arm is held until a person confirms that it is supported; called once for each hold."""

    @property
    def homing(self) -> Homing:
        """Return the stage of the last request home: `NONE`, `ASKED`, then what `tell_homing` set; it stays."""

    def tell_homing(self, stage: Homing) -> None:
        """Set the stage of leading the arm home; while it is `GOING`, `lease_ok` checks who requested the way home."""

    def lease_ok(self, now_ns: int) -> bool:
        """Return whether the requester of the motion counts as alive; if not, the loop stops the arm."""


class StopCondition:
    """Provide controls that neither pause nor finish early: the arm stops when a function returns true."""

    pause = False
    finish = False
    supported = False
    homing = Homing.NONE

    def __init__(self, stop_requested: Callable[[], bool] = lambda: False) -> None:
        self._stop_requested = stop_requested

    @property
    def stop(self) -> bool:
        """Return whether the stop function asks for a stop."""
        return self._stop_requested()

    def announce_hold(self) -> None:
        """Do nothing: nobody can say that the arm is supported."""

    def tell_homing(self, stage: Homing) -> None:
        """Do nothing: these controls never ask for the way home."""

    def lease_ok(self, now_ns: int) -> bool:
        """Return True: there is no lease to lose."""
        return True


_MAGIC, _VERSION, _SIZE = b"identctl", 1, 64
_PID, _STOP, _PAUSE, _FINISH, _WAITING, _SUPPORTED, _RENEWED, _LENGTH, _STOPPED = 12, 16, 17, 18, 19, 20, 24, 32, 40
_HOMING, _HOME_RENEWED = 21, 48
_TRIES, _TRY_AGAIN = 20, 0.005  # s; a process that checks whether the file is in use locks it for a moment


class ControlFile:
    """Represent the controls of one arm; the module says how the loop reads them."""

    def __init__(self, fd: int, memory: mmap.mmap, now_ns: Callable[[], int]) -> None:
        self._fd, self._memory, self._now_ns = fd, memory, now_ns
        # Words of 64 bits, each read and written whole: `struct` with a byte order goes byte by byte.
        self._view = memoryview(memory)
        self._words = self._view.cast("q")

    @classmethod
    def take(
        cls,
        control_file: Path,
        lease_seconds: float | None,
        now_ns: Callable[[], int] = time.monotonic_ns,
        motion_requested_ns: int | None = None,
    ) -> Self:
        """Lock the control file for this process, clear its controls, start the lease; DriverError if it is in use.

        Only a stop that was asked for after `motion_requested_ns` is there from the beginning.

        Args:
            control_file: path of the file, which is made where it is missing.
            lease_seconds: how long the arm may move after `renew` [s]; None for a run that needs no lease.
            now_ns: the lease's clock.
            motion_requested_ns: time of the motion's request on that clock [ns]; when None, no earlier stop counts.

        Raises:
            DriverError: another process moves the arm, or the file is there and cannot be opened.
            UsageError: the file cannot be made.
        """
        try:
            control_file.parent.mkdir(parents=True, exist_ok=True)
            fd = os.open(control_file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError as error:
            if os.path.lexists(control_file):
                raise _unreachable(control_file, error) from None
            raise UsageError(f"{control_file}: cannot be made: {error.strerror}; give another state folder") from None
        if not _locked(fd):
            pid = _pid_in(fd)
            os.close(fd)
            raise DriverError(
                f"the arm is in use by process {pid}; `ident stop` stops it, "
                "`ident supported` lets go of one that is held"
            )
        os.ftruncate(fd, _SIZE)
        memory = mmap.mmap(fd, _SIZE)
        length = 0 if lease_seconds is None else round(lease_seconds * 1e9)
        memory[:_STOPPED] = _MAGIC + struct.pack("<IIBB6xqq", _VERSION, os.getpid(), 0, 0, now_ns(), length)
        taken = cls(fd, memory, now_ns)
        # Read last: a stop either finds these controls in place, or has left its time behind before.
        stopped = taken._words[_STOPPED // 8]
        # One that seems yet to come is from before the machine was started.
        if motion_requested_ns is not None and motion_requested_ns <= stopped <= now_ns():
            taken.request_stop()
        return taken

    @classmethod
    def reach(cls, control_file: Path, now_ns: Callable[[], int] = time.monotonic_ns) -> Self:
        """Open the control file of an arm that another process moves, which holds its lock; UsageError if none does.

        Raises:
            UsageError: no process moves the arm.
            DriverError: the file cannot be opened, so that nobody can tell.
        """
        try:
            fd = os.open(control_file, os.O_RDWR | os.O_CLOEXEC)
        except (FileNotFoundError, NotADirectoryError):
            raise UsageError(f"the arm is not moving ({control_file} does not exist)") from None
        except OSError as error:
            raise _unreachable(control_file, error) from None
        try:
            fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError:
            if os.fstat(fd).st_size == _SIZE and os.pread(fd, 8, 0) == _MAGIC:
                return cls(fd, mmap.mmap(fd, _SIZE), now_ns)
        os.close(fd)
        raise UsageError(f"the arm is not moving ({control_file} is left from a run that has ended)")

    @classmethod
    def stop_motions(cls, control_file: Path, now_ns: Callable[[], int] = time.monotonic_ns) -> int | None:
        """Request a stop of the motion under way and of all requested before now; return the moving pid or None.

        Args:
            control_file: path of the file, which is made where it is missing.
            now_ns: the clock of `take`.

        Raises:
            UsageError: the file cannot be written; an arm that moves has been stopped all the same.
            DriverError: the file cannot be opened: an arm that moves has NOT been stopped.
        """
        refusal: OSError | None = None
        try:
            control_file.parent.mkdir(parents=True, exist_ok=True)
            fd = os.open(control_file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            try:
                os.pwrite(fd, struct.pack("<q", now_ns()), _STOPPED)
            finally:
                os.close(fd)
        except OSError as error:
            refusal = error
        try:
            with cls.reach(control_file, now_ns) as controls:
                controls.request_stop()
                return controls.pid
        except UsageError:
            if refusal is not None:
                raise UsageError(
                    f"{control_file}: cannot be written: {refusal.strerror}; the arm is not moving now"
                ) from None
            return None

    @property
    def pid(self) -> int:
        """Return the id of the process that moves the arm."""
        return int(struct.unpack_from("<I", self._memory, _PID)[0])

    @property
    def stop(self) -> bool:
        """Return whether the arm is to be brought to a controlled stop."""
        return self._memory[_STOP] != 0

    def request_stop(self) -> None:
        """Request a controlled stop, without waiting for it; needs no lease; only `request_home` takes it back."""
        self._memory[_STOP] = 1

    @property
    def pause(self) -> bool:
        """Return whether the arm is to pause."""
        return self._memory[_PAUSE] != 0

    def request_pause(self, paused: bool) -> None:
        """Request that the arm pause (True) or go on (False), without waiting for it."""
        self._memory[_PAUSE] = int(paused)

    @property
    def finish(self) -> bool:
        """Return whether the run was asked to end early, by going back to where it began."""
        return self._memory[_FINISH] != 0

    def request_finish(self) -> None:
        """Request that the run end early by going straight back, if free; not revocable; resume a paused arm first."""
        self._memory[_FINISH] = 1

    @property
    def waiting(self) -> bool:
        """Return whether the arm is held for a person to confirm its support; stays True once that is confirmed."""
        return self._memory[_WAITING] != 0

    def announce_hold(self) -> None:
        """Mark in the file that the arm is held until a person confirms its support; clear an earlier confirmation."""
        self._memory[_SUPPORTED] = 0
        self._memory[_WAITING] = 1

    @property
    def supported(self) -> bool:
        """Return whether a person has confirmed, since the present hold began, that the arm is supported or home."""
        return self._memory[_SUPPORTED] != 0

    def confirm_support(self) -> None:
        """Confirm that the held arm is supported or home, so that the loop lowers it; UsageError if none is held.

        Raises:
            UsageError: the arm does not wait for it; confirmed beforehand, it would release an arm that still moves.
        """
        if not self.waiting:
            raise UsageError("the arm is not held after a stop; nothing to confirm")
        self._memory[_SUPPORTED] = 1

    @property
    def homing(self) -> Homing:
        """Return the stage of leading a held arm home; `NONE` where nobody has asked for that."""
        return Homing(self._memory[_HOMING])

    def tell_homing(self, stage: Homing) -> None:
        """Set the stage of leading a held arm home, as the process that moves it; `GOING` ends the wait for support."""
        if stage is Homing.GOING:
            self._memory[_WAITING] = 0
        self._memory[_HOMING] = stage

    def request_home(self) -> None:
        """Request that an arm waiting after a stop be led home, clear stop and pause; UsageError if none waits.

        The requester then calls `renew_home` more often than every `LEASE_SECONDS`.

        Raises:
            UsageError: the arm is not held; one that moves is stopped before it is led elsewhere.
        """
        if not self.waiting:
            raise UsageError("the arm is not held after a stop; stop it first (`ident stop`), or wait for its run")
        begun = self._now_ns()
        self.renew_home()
        self._memory[_STOP] = self._memory[_PAUSE] = 0
        if self._words[_STOPPED // 8] >= begun:  # asked for by another process in this moment
            self._memory[_STOP] = 1
        self._memory[_HOMING] = Homing.ASKED

    def renew_home(self) -> None:
        """Renew the lease of the requester of the motion home."""
        self._words[_HOME_RENEWED // 8] = self._now_ns()

    def home_lease_is_valid(self) -> bool:
        """Return whether the lease of the requester of the motion home was renewed within `LEASE_SECONDS`."""
        return self._now_ns() - self._words[_HOME_RENEWED // 8] <= round(LEASE_SECONDS * 1e9)

    def renew(self) -> None:
        """Renew the lease of the requester of the motion."""
        self._words[_RENEWED // 8] = self._now_ns()

    def lease_is_valid(self) -> bool:
        """Return whether the lease of the motion's requester was renewed within its length; True without a lease."""
        renewed, length = self._words[_RENEWED // 8], self._words[_LENGTH // 8]
        return length == 0 or self._now_ns() - renewed <= length

    def close(self) -> None:
        """Release the memory, and the lock if this process took it; the controls in the file stay as they are."""
        self._words.release()
        self._view.release()
        self._memory.close()
        os.close(self._fd)

    def __enter__(self) -> Self:
        """Return these controls."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the controls."""
        self.close()


def controlling_pid(control_file: Path) -> int | None:
    """Return the id of the process that moves the arm of a control file; None if none does, or it cannot be opened."""
    try:
        with ControlFile.reach(control_file) as controls:
            return controls.pid
    except (UsageError, DriverError):
        return None


def stop_requested_ns(control_file: Path) -> int:
    """Return when a stop of the arm was asked for last [ns of the machine's monotonic clock]; 0 where none is known."""
    try:
        fd = os.open(control_file, os.O_RDONLY | os.O_CLOEXEC)
        try:
            stamp = os.pread(fd, 8, _STOPPED)
        finally:
            os.close(fd)
    except OSError:
        return 0
    return int(struct.unpack("<q", stamp)[0]) if len(stamp) == 8 else 0


def is_control_file_in_use(control_file: Path) -> bool:
    """Return whether a process holds the lock of a control file, as one moving the arm does; DriverError if unreadable.

    Raises:
        DriverError: the file cannot be opened, so that nobody can tell.
    """
    try:
        if control_file.is_dir():  # a folder can be opened for reading
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        fd = os.open(control_file, os.O_RDONLY | os.O_CLOEXEC)
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError as error:
        raise _unreachable(control_file, error) from None
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(fd)
    return False


def _unreachable(path: Path, error: OSError) -> DriverError:
    return DriverError(
        f"{path}: cannot be opened: {error.strerror}; it cannot be told whether the arm moves, and a process that "
        "moves it was not reached over this file: if it moves, use the emergency stop; then make it a file that "
        "the account running ident can read and write"
    )


def _locked(fd: int) -> bool:
    """Take the exclusive lock, unless another process keeps it; returns whether it was taken."""
    for again in range(_TRIES):
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            time.sleep(_TRY_AGAIN if again + 1 < _TRIES else 0.0)
        else:
            return True
    return False


def _pid_in(fd: int) -> int:
    head = os.pread(fd, 16, 0)
    return int(struct.unpack_from("<I", head, _PID)[0]) if len(head) == 16 else 0


class SupervisedCommands:
    """Implement the loop's `Controls` in a process of its own, supervised by pipe and lease."""

    def __init__(self, controls: ControlFile, pipe: int, *, lock_step: bool) -> None:
        """Use the given control file and pipe.

        Args:
            controls: taken by this process.
            pipe: readable end of the pipe that the requester of the motion holds open; a file or a device, too, which
                never ends.
            lock_step: whether the loop's clock waits (a clock's `lock_step`).
        """
        self._controls, self._lock_step = controls, lock_step
        self._poll = select.poll()
        self._poll.register(pipe, 0)  # nothing but its end

    @property
    def stop(self) -> bool:
        """Return whether the arm is to be brought to a controlled stop."""
        return self._controls.stop

    @property
    def pause(self) -> bool:
        """Return whether the arm is to pause."""
        return self._controls.pause

    @property
    def finish(self) -> bool:
        """Return whether the run is to end early."""
        return self._controls.finish

    @property
    def supported(self) -> bool:
        """Return whether a person has confirmed, since the present hold began, that the arm is supported or home."""
        return self._controls.supported

    def announce_hold(self) -> None:
        """Announce that the arm is held until a person confirms that it is supported."""
        self._controls.announce_hold()

    @property
    def homing(self) -> Homing:
        """Return the stage of leading a held arm home, `NONE` where nobody has asked for that."""
        return self._controls.homing

    def tell_homing(self, stage: Homing) -> None:
        """Set the stage of leading a held arm home; while `GOING`, `lease_ok` checks that requester's lease only."""
        self._controls.tell_homing(stage)

    @property
    def requester_gone(self) -> bool:
        """Return whether the requester's end of the pipe is closed, as it is when the requester has died."""
        return bool(self._poll.poll(0))

    def lease_ok(self, now_ns: int) -> bool:
        """Return whether the requester's pipe is open and its lease valid; while led home, only the home lease counts.

        The motion home of a held arm has another requester, whose lease counts instead. In lock step no lease counts.
        """
        if self._controls.homing is Homing.GOING:
            return self._lock_step or self._controls.home_lease_is_valid()
        return not self.requester_gone and (self._lock_step or self._controls.lease_is_valid())


class InterruptibleArm(Arm):
    """Wrap an arm and refuse to enable it, or to send a torque, once a stop was asked for."""

    def __init__(self, arm: Arm, stop_requested: Callable[[], bool]) -> None:
        """Wrap the given arm; `stop_requested` returns whether it is to stop."""
        self._arm, self._stop_requested = arm, stop_requested
        self.clock = arm.clock
        arm.still_wanted = lambda: not stop_requested()

    def open(self) -> None:
        """Open the wrapped arm and use its clock."""
        self._arm.open()
        self.clock = self._arm.clock

    def describe(self) -> ArmDescription:
        """Return the wrapped arm's description."""
        return self._arm.describe()

    def enable(self) -> None:
        """Enable the wrapped arm; raises DriverError instead once a stop was asked for."""
        self._require_no_stop_request()
        self._arm.enable()

    def reset(self) -> None:
        """Clear the faults that the wrapped arm's drives have latched; DriverError while it is enabled."""
        self._arm.reset()

    def exchange(self, torque: Vector | None) -> Sample:
        """Exchange with the wrapped arm; raises DriverError instead of sending a torque once a stop was asked for."""
        if torque is not None:
            self._require_no_stop_request()
        return self._arm.exchange(torque)

    def exchange_position(self, position: Vector) -> Sample:
        """Exchange positions with the wrapped arm; raises DriverError instead once a stop was asked for."""
        self._require_no_stop_request()
        return self._arm.exchange_position(position)

    def watchdogs(self) -> tuple[Watchdog, ...]:
        """Return the wrapped arm's watchdogs."""
        return self._arm.watchdogs()

    def withhold(self, kind: str) -> None:
        """Stop sending what the wrapped arm's watchdogs of one kind watch, until the next `stop`, so that they act."""
        self._arm.withhold(kind)

    def bus_budget(self, rate: float | None = None) -> Budget | None:
        """Return the load of the wrapped arm's frames on its buses at `rate` [Hz]; None where none is known."""
        return self._arm.bus_budget(rate)

    def setup_checks(self) -> tuple[SetupCheck, ...]:
        """Return what the wrapped arm's drives report of their set-up, each value beside the expected one."""
        return self._arm.setup_checks()

    @property
    def operator_action(self) -> str:
        """Return in words what a person must do to enable the wrapped arm; empty where the host enables alone."""
        return self._arm.operator_action

    def unconfirmed(self) -> tuple[str, ...]:
        """Describe drives of the wrapped arm that did not confirm at closing that they are off, or had restarted."""
        return self._arm.unconfirmed()

    def drive_status(self) -> tuple[AxisStatus, ...]:
        """Return the status that each drive of the wrapped arm reported last."""
        return self._arm.drive_status()

    def stop(self, kind: StopKind) -> None:
        """Stop the wrapped arm's drives in the given way."""
        self._arm.stop(kind)

    def close(self) -> None:
        """Close the wrapped arm."""
        self._arm.close()

    def _require_no_stop_request(self) -> None:
        if self._stop_requested():
            raise DriverError("a stop was requested")
