"""Check that the requester of a motion is still alive: by a pipe that it holds, and a lease that it renews.

The pipe ends with the process at its other end, however that dies, and within a cycle; so does the motion, in real and
in virtual time. The lease is for one that lives but hangs. It is measured on the machine's clock, because that is where
a process hangs, and counts in real time only: in lock step the arm's time waits for nobody but the plant and the
recorder, seconds of it pass while the machine stalls for none, and a stall would be taken for a silence. No real arm
moves in lock step.
"""

from __future__ import annotations

import select

from ident_service.motion.control_file import ControlFile
from ident_service.motion.controls import Homing


class Lifeline:
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
        """Return whether a person has confirmed that the waiting arm is supported or home."""
        return self._controls.supported

    def wait_for_support(self) -> None:
        """Announce that the arm is held until a person confirms that it is supported."""
        self._controls.wait_for_support()

    @property
    def homing(self) -> Homing:
        """Return the stage of leading a held arm home."""
        return self._controls.homing

    def tell_homing(self, stage: Homing) -> None:
        """Set the stage of leading a held arm home."""
        self._controls.tell_homing(stage)

    @property
    def cut(self) -> bool:
        """Return whether the other end of the pipe is closed."""
        return bool(self._poll.poll(0))

    def lease_ok(self, now_ns: int) -> bool:
        """Return whether the requester of the motion is still alive; a system call that does not wait.

        The motion home of a held arm has another requester, whose lease counts instead.
        """
        if self._controls.homing is Homing.GOING:
            return self._lock_step or self._controls.home_lease_ok()
        return not self.cut and (self._lock_step or self._controls.lease_ok(now_ns))
