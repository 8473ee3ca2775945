"""Define the Arm contract: the interface of every arm, real or simulated, to the motion loop.

One blocking call per cycle for all axes, in joint space and SI units. This package knows nothing of identification, and
a driver does no mathematics beyond units and transmission.

Timing. `exchange(torque)` of cycle k waits for the start of cycle k, hands the torque over and returns the sample of
that cycle: positions at its stamp, and in `Sample.torque` the torque that acts from that stamp until the next one,
after clipping and quantisation. Sample-to-actuation is therefore exactly one period.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any, Final, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from drivers.axis_status import AxisEvent, AxisStatus
from drivers.can.bus_load import Budget
from drivers.clock import Clock
from ident_service.errors import DriverError

Vector = NDArray[np.float64]
Flags = NDArray[np.bool_]
Counts = NDArray[np.int64]
AT_CLOSING: Final = "when the arm was closed:"  # begins what is told of `Arm.unconfirmed`
_Numbers = TypeVar("_Numbers", bound=NDArray[Any])


class StopKind(Enum):
    """Name the ways in which drives end torque; a coordinated stop is planned by the motion loop, not by the driver."""

    TORQUE_OFF = "torque_off"  # no torque; an arm without brakes falls, or sinks where idle drives brake (pucks)
    QUICK_STOP = "quick_stop"  # the drives decelerate on their own, then hold or release as configured


def read_only(array: _Numbers) -> _Numbers:
    """Make an array read-only in place, and return it."""
    array.setflags(write=False)
    return array


@dataclass(frozen=True)
class ArmDescription:
    """Describe an open arm: joints, rate, limits, resolutions and identities.

    Attributes:
        joint_names: names of the joints, in the order of every vector.
        rate: cycles per second.
        torque_limit: clip of the driver [N m or N], shape (joints,).
        torque_resolution: smallest step of the torque [N m or N], shape (joints,); 0 where continuous.
        position_resolution: smallest step of the position [rad or m], shape (joints,); 0 where continuous.
        identities: per axis, what hardware answered (vendor, product, serial, firmware), for the record.
        software: name and version of the driver.
        scheduled_stamps: whether stamps are those of a schedule, whole periods apart, as of a plant that moves by whole
            periods; how late a cycle came only the loop's clock says then. Otherwise stamps are the clock's.
        lost_cycles: number of cycles in a row without an axis' position after which the axis counts as gone.
        streams_position: whether drives close the position loop: `exchange_position` is what moves the arm, and
            `Sample.torque` is what they measured last, in place of what they are given.
        watchdog: time without its host after which the slowest drive gives up torque [s]; None where unknown, or where
            `Arm.watchdogs` says it of each drive.
        report_delay: longest delay with which a change of a drive's status shows in a sample [s].
        delay_cycles: delay from a sample to the torque that is computed from it [cycles]; 1 where a torque acts from
            the next stamp.
    """

    joint_names: tuple[str, ...]
    rate: float
    torque_limit: Vector
    torque_resolution: Vector
    position_resolution: Vector
    identities: tuple[str, ...]
    software: str
    scheduled_stamps: bool = False
    lost_cycles: int = 3
    streams_position: bool = False
    watchdog: float | None = None
    report_delay: float = 0.0
    delay_cycles: int = 1


@dataclass(frozen=True, slots=True)
class Sample:
    """Hold the result of one cycle.

    Attributes:
        cycle: number of the cycle since `open`.
        stamp_ns: monotonic time at which the positions were sampled [ns] (of the request, not of the replies).
        position: [rad or m], shape (joints,).
        velocity: velocity measured by the drive [rad/s or m/s], shape (joints,), or None where the drive gives none.
        torque: the torque that acts from this stamp to the next one, clipped and quantised [N m or N], (joints,).
        valid: mask of the axes whose positions are of this cycle, shape (joints,).
        age: how many cycles old each position is, shape (joints,); 0 where `valid`.
        lost: frames lost since `open`.
        status: slow per-axis status words, with `status_age` cycles since they were read.
        events: events of the bus since the sample before.
        drives: status of each drive in words of its fieldbus, for people; empty where there is nothing to add
            to `status`.
        measured_torque: torque measured by the drives until this stamp [N m or N], shape (joints,), NaN where none
            reported in this cycle; None where none ever did.
        stamp_doubt_ns: time before `stamp_ns` at which the positions may have been sampled [ns], where the computer
            stalled between the request and its stamp; else 0.
        torque_difference: excess of the drives' last reported torque over the torque they were told [N m or N], shape
            (joints,), less what a healthy drive may deviate; None where nothing is to be compared.
        joint_position: position measured by encoders behind the transmission, which have the motors' positions where
            the arm was opened [rad or m], shape (joints,), NaN for joints without one; None for an arm without any.
    """

    cycle: int
    stamp_ns: int
    position: Vector
    velocity: Vector | None
    torque: Vector
    valid: Flags
    age: Counts
    lost: int = 0
    status: tuple[int, ...] = field(default=())
    status_age: int = 0
    events: tuple[AxisEvent, ...] = ()
    drives: tuple[str, ...] = ()
    measured_torque: Vector | None = None
    torque_difference: Vector | None = None
    stamp_doubt_ns: int = 0
    joint_position: Vector | None = None


@dataclass(frozen=True)
class Watchdog:
    """Describe how one drive stops by itself when its host is gone.

    Attributes:
        drive: name of the drive, for people.
        kind: the signal it watches: `rpdo_timer` and the like.
        seconds: time for which that signal may stay away before the drive acts [s]; None where unknown.
        of_torque: whether that signal is the torque frames, so that a cycle without torque withholds it.
        report_delay: longest delay with which its reaction shows while its signal is withheld [s]; None where that is
            `ArmDescription.report_delay`.
    """

    drive: str
    kind: str
    seconds: float | None
    of_torque: bool = True
    report_delay: float | None = None


@dataclass(frozen=True)
class SetupCheck:
    """Represent one value that a drive reports of itself, compared with what the description expects.

    Attributes:
        what: the value, and whose it is: `IPNM of puck 3`.
        found: value or state that the drive reports, in words.
        expected: required value or state; empty where it is only told.
        remedy: remedy where the two differ.
    """

    what: str
    found: str
    expected: str = ""
    remedy: str = ""

    @property
    def good(self) -> bool:
        """Return whether the value is the expected one, or none is expected."""
        return not self.expected or self.found == self.expected

    def __str__(self) -> str:
        return f"{self.what} is {self.found}" + ("" if self.good else f", expected {self.expected}")


def require_set_up(checks: Iterable[SetupCheck]) -> None:
    """Raise DriverError, with the remedies, where a check's value is not the expected one."""
    if wrong := [one for one in checks if not one.good]:
        remedies = dict.fromkeys(one.remedy for one in wrong if one.remedy)
        raise DriverError(". ".join((f"cannot be enabled: {'; '.join(map(str, wrong))}", *remedies)))


class Arm(ABC):
    """Define an arm as a context manager: entering opens it, leaving closes it; closing stops torque first."""

    clock: Clock
    # Asked while `enable` waits for a person; when it says no, `enable` gives up and raises DriverError.
    still_wanted: Callable[[], bool] = staticmethod(lambda: True)

    def look(self) -> Arm:
        """Return a closed arm to observe the same hardware with, without any command; this arm itself by default.

        Of what is returned only `open`, `describe`, `exchange(None)` and `close` are used, and none of them sends a
        command, changes what a drive does or is configured to do, or keeps its watchdog quiet. It may be slower
        (`ArmDescription.rate`). By default it is this arm itself, which is right where opening changes nothing.
        """
        return self

    def zero(self) -> tuple[str, ...]:
        """Make the closed arm take its present position as its home until power is lost; return each drive's report.

        For a person who has led the arm there, and only where encoders count from where they were when power came.
        Nothing is energised and nothing moves; until the encoders lose their power, `open` finds its positions by it.

        Raises:
            DriverError: open, an arm that needs no zero, one that moves, is powered or led by another host, or that
                cannot be had; or a drive does not keep its zero. Then none has one, or all have the one before.
        """
        raise DriverError("this arm knows where it stands whenever it is opened; there is no zero to be set")

    def log_frames(self, path: Path) -> None:
        """Have the next session, `open` to `close`, log every fieldbus frame to a new file; DriverError if it cannot.

        Args:
            path: of the file, which must not exist when the arm is opened; its suffix says its format.

        Raises:
            DriverError: this arm has no frames, or no such format is known.
        """
        raise DriverError("this arm has no fieldbus whose frames could be logged")

    def logged(self) -> str:
        """Describe how the log of frames of the last session ended, in words; empty where none was kept."""
        return ""

    def watchdogs(self) -> tuple[Watchdog, ...]:
        """Return the watchdog of each drive; empty where all watch the torque frames and show in `status`."""
        return ()

    def withhold(self, kind: str) -> None:  # noqa: B027 - nothing to do where watchdogs watch torque frames
        """Starve the watchdogs of one kind until the next `stop`, so that they act; no-op for torque frames.

        Watchdogs of torque frames need none of it: `exchange(None)` withholds those.
        """

    def bus_budget(self, rate: float | None = None) -> Budget | None:
        """Return the load of this arm's frames on its buses at `rate`, open or not; None where no load is known.

        Args:
            rate: cycles per second; by default the description's.
        """
        return None

    def setup_checks(self) -> tuple[SetupCheck, ...]:
        """Return what drives and buses of the open arm report of themselves, each value beside the expected one.

        An arm of which one is not `good` refuses to be enabled.
        """
        return ()

    @property
    def operator_action(self) -> str:
        """Return in words what a person must do to let `enable` succeed; empty where the host enables alone."""
        return ""

    def drive_status(self) -> tuple[AxisStatus, ...]:
        """Return the status that each drive has reported last, in the order of `watchdogs`; empty where none does."""
        return ()

    def unconfirmed(self) -> tuple[str, ...]:
        """Describe drives that did not confirm at closing that they are off, or had restarted; empty if unknown.

        One that is not off may have power, or will miss its host; a restart while the arm was open may have shown as
        silence only. Empty where nothing is to be told, and for drivers that cannot tell; a drive that was told to hold
        the arm in quick stop is left out.
        """
        return ()

    @abstractmethod
    def open(self) -> None:
        """Open the arm exclusively and check that it answers; raises DriverError where that fails."""

    @abstractmethod
    def describe(self) -> ArmDescription:
        """Return the description of the open arm; raises DriverError when it is not open."""

    @abstractmethod
    def enable(self) -> None:
        """Energise all axes with zero torque, waiting for a person where one must; ends watchdog and quick-stop states.

        Where a person enables the arm (`operator_action`), it waits for that; the arm may have moved meanwhile, and
        whoever has planned from where it stood looks again.

        Raises:
            DriverError: a drive has latched a fault of its own (`DriveFaulted`, where the driver tells) or an emergency
                stop, which only `reset` clears, or refuses for another reason; no axis stays energised.
            EmergencyStopped: the emergency stop is pressed, or is while a person is waited for; likewise.
            NobodyEnabled: the person who enables the arm did not in time, or `still_wanted` said no; likewise.
        """

    @abstractmethod
    def reset(self) -> None:
        """Clear latched faults, emergency stops and watchdogs of drives; energises nothing; DriverError while enabled.

        For a person who knows why; no loop calls it. Nothing is energised by it, and an axis that is braked stays
        braked: an arm without brakes must not fall because a fault is forgotten. Without anything latched it does
        nothing. The status of the next sample says what came of it.

        Raises:
            DriverError: not open, enabled, or a drive keeps its fault, because the cause is still there.
        """

    @abstractmethod
    def exchange(self, torque: Vector | None) -> Sample:
        """Wait for the next cycle of all axes, send the torque, or none for None, and return the cycle's sample.

        Args:
            torque: torque that acts from this cycle's stamp on [N m or N], shape (joints,); None reads without a
                torque, and is the only value an arm that is not enabled accepts; on an enabled arm it lets the last
                torque act on.

        Returns:
            The sample of this cycle.

        Raises:
            DriverError: not open, a torque while not enabled, a torque that is not finite or of the wrong shape,
                or the bus is gone. A torque that raises has not been sent.
        """

    def exchange_position(self, position: Vector) -> Sample:
        """Wait for the next cycle, send joint positions, and return the sample; DriverError for an arm given torques.

        Args:
            position: position of each joint one cycle from here [rad or m], shape (joints,).

        Returns:
            The sample of this cycle; its torque is the one measured last.

        Raises:
            DriverError: as `exchange`, and for arms that are given torques (`ArmDescription.streams_position`).
        """
        raise DriverError("this arm is given torques, not positions")

    @abstractmethod
    def stop(self, kind: StopKind) -> None:
        """Stop the drives by torque off or a quick stop, from any state, any number of times; never raises.

        The torque of the last sample ends with its period at the latest.
        """

    @abstractmethod
    def close(self) -> None:
        """Take the torque off and release the arm; safe from any state, any number of times."""

    def __enter__(self) -> Self:
        """Open the arm."""
        self.open()
        return self

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        """Close the arm, whatever happened; an error that ends it says which drives have not confirmed that."""
        self.close()
        if error is not None and (left := self.unconfirmed()):
            error.add_note(f"{AT_CLOSING} {'; '.join(left)}")
