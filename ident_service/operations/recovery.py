"""Tell what stands between an arm and its next motion, reset what may be reset, and set the zero at home.

Looking sends no torque and changes no state. When every latched fault has been acknowledged by name, drives that have
latched something are reset (`Arm.reset`), which energises nothing.

A person must move the arm to its home and compare it with the displayed posture. Everything that a program can check is
checked first: another process that moves the arm, another host, powered drives, an arm that moves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import degrees
from pathlib import Path

import numpy as np

from drivers.arm import Arm, StopKind
from drivers.axis_status import TRIPPED, AxisStatus
from ident_service.config.arm import ArmConfig
from ident_service.config.motion_limits import MotionLimits, motion_limits
from ident_service.errors import ActionNeeded, DriverError, MotionRefused, PositionUnknown, UsageError
from ident_service.model.arm_model import arm_model
from ident_service.motion.arm_factory import make_arm
from ident_service.motion.clearance import position_limit_violations, require_near
from ident_service.motion.command_channel import ControlFile, controlling_pid
from ident_service.motion.control_loop import REST_SPEED
from ident_service.motion.fault_store import StoredFault
from ident_service.motion.last_position import PositionFile
from ident_service.motion.read_only_monitor import Watched, watch
from ident_service.operations.moving_arms import is_held
from ident_service.recordings.files import require_writable
from ident_service.registry.state_folder import arm_fault_store, control_path, ticket_path

LOOK = 0.3  # s
AT_HOME = 0.05  # rad or m
_SUPPORT = "Support the arm, or make sure that it rests on something: {} it now."
_BRAKED = "Support the arm, or see that its brakes hold it."
_HELD = "Support the arm, then `ident supported {}`: its drives hold it in quick stop, and release it then."
_SEEN = 20  # cycles until the drives' status has arrived


@dataclass(frozen=True)
class Recovery:
    """Findings about an arm after a fault or a stop, and the next steps.

    Attributes:
        arm: name.
        faults: unacknowledged faults, the earliest first.
        moved_by: process that moves the arm, or None.
        seen: what was seen at the arm, after a reset if there was one; None where it could not be read.
        unreachable: reason why it could not be read, or empty.
        zero_lost: reason why the arm does not know its position, or empty; nothing else is then seen of it.
        reset: axes whose drives were reset just now.
        tripped: faults that drives still have latched, by axis.
        outside: joints outside their position limits, in words.
        steps: next steps, one sentence each, in order; the last one is what a usable arm needs as well.
        usable: whether `ident preflight` can be run.
    """

    arm: str
    faults: tuple[StoredFault, ...]
    moved_by: int | None
    seen: Watched | None
    unreachable: str
    zero_lost: str
    reset: tuple[str, ...]
    tripped: dict[str, str]
    outside: tuple[str, ...]
    steps: tuple[str, ...]
    usable: bool


def recover(config: ArmConfig, state: Path, arm: Arm | None = None, name_in_commands: str | None = None) -> Recovery:
    """Watch an arm that no process has, reset tripped drives if all faults are acknowledged; return what to do next.

    Args:
        config: of the arm.
        state: the state folder.
        arm: the arm, not open; the configured one when None.
        name_in_commands: the arm as commands are to name it, its file for example; its name when None.

    Raises:
        UsageError: the file of faults is damaged.
        MotionRefused: the description has no position limits.
        DriverError: nothing is installed that can reach such an arm.
    """
    limits, name_in_commands = motion_limits(config), name_in_commands or config.name
    faults = arm_fault_store(state, config.name).remembered()
    pid = controlling_pid(control_path(state, config.name))
    if pid is not None:
        first: tuple[str, ...] = (
            f"`ident stop {name_in_commands}` stops it; process {pid} moves it, or holds it after a stop.",
            f"`ident supported {name_in_commands}`, if it is held: once it is supported, or at home.",
        )
        if is_held(state, config.name):
            first = (f"Support the arm, then `ident supported {name_in_commands}`: process {pid} holds it until then.",)
        steps = (*first, f"`ident recover {name_in_commands}` again, when it is at rest.")
        return Recovery(config.name, faults, pid, None, "", "", (), {}, (), steps, False)
    arm = make_arm(config) if arm is None else arm
    seen, unreachable, zero_lost = None, "", ""
    refusal: DriverError | None = None
    reset: tuple[str, ...] = ()
    try:
        seen = watch(arm, LOOK)
        if (latched := _tripped(seen)) and not faults:
            refusal = _reset(arm)
            seen = watch(arm, LOOK)
            reset = tuple(name for name in latched if name not in _tripped(seen))
    except PositionUnknown as error:
        seen, zero_lost = None, str(error)
    except DriverError as error:
        unreachable = str(error)
    tripped = {} if seen is None else _tripped(seen)
    out = [] if seen is None else position_limit_violations(seen.position, limits, seen.joint_names)
    support, holds = _support(config), False
    if seen is not None and config.idle_drives_hold and any(w & AxisStatus.IDLE for w in seen.status):
        support, holds = _HELD.format(name_in_commands), True
    before = _before(name_in_commands, faults, seen, unreachable, zero_lost, tripped, refusal, limits)
    before = [support, *before] if before or holds else before
    usable = not before
    steps = (*before, _last_step(name_in_commands, seen, limits, bool(out)))
    return Recovery(config.name, faults, None, seen, unreachable, zero_lost, reset, tripped, tuple(out), steps, usable)


def release_held_drives(config: ArmConfig, state: Path) -> tuple[str, ...]:
    """Switch off drives that hold an arm in quick stop; a person must have confirmed its support; return the axes.

    Args:
        config: of the arm.
        state: the state folder.

    Returns:
        Names of the axes that were held.

    Raises:
        UsageError: the drives do not hold it.
        DriverError: the arm cannot be had, or another process has it.
    """
    arm = make_arm(config)
    with ControlFile.take(control_path(state, config.name), None), arm:
        for _ in range(_SEEN):
            status = arm.exchange(None).status
        names = arm.describe().joint_names
        held = tuple(name for name, word in zip(names, status, strict=True) if word & AxisStatus.IDLE)
        if not held:
            raise UsageError(f"{config.name}: not held: no process has the arm, and its drives do not hold it")
        arm.stop(StopKind.TORQUE_OFF)
    return held


def _tripped(seen: Watched) -> dict[str, str]:
    """Return what drives have latched, in words, by axis."""
    words = {name: AxisStatus(word) & TRIPPED for name, word in zip(seen.joint_names, seen.status, strict=False)}
    return {
        name: " and ".join(str(bit.name).lower().replace("_", " ") for bit in AxisStatus if bit in word)
        for name, word in words.items()
        if word
    }


def _reset(arm: Arm) -> DriverError | None:
    """Reset the drives; return why they refuse, or None."""
    with arm:
        arm.exchange(None)
        try:
            arm.reset()
            arm.exchange(None)
        except DriverError as error:
            return error
    return None


def _before(
    name: str,
    faults: tuple[StoredFault, ...],
    seen: Watched | None,
    unreachable: str,
    zero_lost: str,
    tripped: dict[str, str],
    refusal: DriverError | None,
    limits: MotionLimits,
) -> list[str]:
    """Return what must be done before the arm is usable, in order, but for supporting it."""
    steps = [f"`ident acknowledge {name} {one.code}`, when you know the cause: {one.cause}." for one in faults]
    zero_lost = zero_lost.replace(" ARM`", f" {name}`")
    if unreachable:
        steps.append(f"Check power, cables, emergency stop, and that no other program uses the arm: {unreachable}.")
    if zero_lost:
        steps.append(f"Set its home: {zero_lost}.")
    if seen is None:
        return [*steps, f"`ident recover {name}` again."]
    silent = [joint for joint, q in zip(seen.joint_names, seen.position, strict=True) if not np.isfinite(q)]
    if silent:
        steps.append(f"Check power and cables of the axes that do not answer: {', '.join(silent)}.")
    if bool((np.abs(seen.velocity) > REST_SPEED * limits.velocity).any()):
        steps.append("Keep out of its reach until it rests: the arm moves without a command.")
    if tripped and refusal:
        steps.append(_to_mend(tripped, refusal).replace(" ARM`", f" {name}`"))
    if tripped or (faults and steps):
        steps.append(f"`ident recover {name}` again: it resets the drives when every fault is acknowledged.")
    if not silent and (out := position_limit_violations(seen.position, limits, seen.joint_names)):
        try:
            require_near(seen.position, limits, seen.joint_names)
            steps.append(
                f"`ident preflight {name} --home`, then `ident recover {name} --leave-limit` moves it back inside, "
                f"slowly; or push it by hand: {'; '.join(out)}."
            )
        except MotionRefused as error:
            steps.append(f"Bring it back by hand: {error}.")
    return steps


def _support(config: ArmConfig) -> str:
    """Return what keeps an arm without power from sinking, and what a person must do about it."""
    braked = [name for name, joint in config.joints.items() if joint.brake]
    if len(braked) == len(config.joints):
        return _BRAKED
    return _SUPPORT.format(f"only the brakes of {', '.join(braked)} hold" if braked else "nothing holds")


def _to_mend(tripped: dict[str, str], refusal: DriverError) -> str:
    """Return what must be done before drives that refuse to be reset can be."""
    words = str(refusal)
    if isinstance(refusal, ActionNeeded):
        return f"{words[0].upper()}{words[1:]}."
    stopped = any("emergency stop" in words for words in tripped.values())
    what = "Release the emergency stop" if stopped else "Read the drive's own fault code and mend its cause"
    return f"{what}: {words}."


def _last_step(name: str, seen: Watched | None, limits: MotionLimits, out: bool) -> str:
    away = seen is None or out or bool((np.abs(seen.position - limits.home) > AT_HOME).any())
    home = f"`ident preflight {name} --home`, then `ident home {name}` moves it home; then " if away else ""
    return f"{home}`ident preflight {name}` for the next motion."


@dataclass(frozen=True)
class JointPosture:
    """One joint of a posture: its name, position [rad or m], and the unit of that."""

    joint: str
    position: float
    unit: str

    def __str__(self) -> str:
        """Format the joint's position, for a revolute joint in degrees too."""
        turned = f" ({degrees(self.position):.1f} degrees)" if self.unit == "rad" else ""
        return f"{self.joint} at {self.position:g} {self.unit}{turned}"


@dataclass(frozen=True)
class ZeroingResult:
    """Result of zeroing an arm.

    Attributes:
        arm: name.
        posture: posture of the arm, of all joints.
        drives: message of each drive about its zero.
        faults: unacknowledged faults; zeroing is possible with them and leaves them as they are.
        ticket_removed: whether there was a preflight ticket, which was about another zero.
    """

    arm: str
    posture: tuple[JointPosture, ...]
    drives: tuple[str, ...]
    faults: tuple[StoredFault, ...]
    ticket_removed: bool


def home_posture(config: ArmConfig) -> tuple[JointPosture, ...]:
    """Return each joint's home position, where the arm must stand for set-home; UsageError unless `zero: at_home`.

    Raises:
        UsageError: its description does not say `zero: at_home`, or has no home of every joint.
    """
    if not config.zeroed_at_home:
        raise UsageError(
            f"{config.name}: needs no home: only drives with `driver: {{zero: at_home}}`, whose encoders count "
            "from where they were when power came, need one"
        )
    chain = arm_model(config).chain
    found = []
    for name, revolute in zip(chain.names, chain.revolute, strict=True):
        joint = config.joints.get(name)
        if joint is None or joint.home is None:
            raise UsageError(f"{config.name}: joints.{name}.home is missing: the posture in which the arm is zeroed")
        found.append(JointPosture(name, joint.home, "rad" if revolute else "m"))
    return tuple(found)


def set_home(config: ArmConfig, state: Path, confirm: Callable[[str], str], arm: Arm | None = None) -> ZeroingResult:
    """Set an arm's present position as its home in the drives, delete its ticket; MotionRefused if nobody confirms.

    Args:
        config: of the arm.
        state: the state folder.
        confirm: function that asks a person, who has seen the posture, for the arm's name.
        arm: the arm, not open; the configured one when None.

    Raises:
        UsageError: as `home_posture`.
        MotionRefused: nobody confirmed it; nothing has changed.
        DriverError: a process moves the arm, or as `Arm.zero`.
    """
    posture = home_posture(config)
    ticket = ticket_path(state, config.name)
    require_writable(ticket.parent)
    with ControlFile.take(control_path(state, config.name), None):
        typed = confirm(f"type the arm's name, {config.name}, if it stands in this posture and at rest:")
        if typed.strip() != config.name:
            raise MotionRefused(f"{config.name}: home not set: the arm's name was not typed; nothing has changed")
        # Removed before zeroing: a ticket that outlived it would be for another zero.
        existed = ticket.exists()
        ticket.unlink(missing_ok=True)
        PositionFile(ticket.parent, config).forget()  # of the zero that is about to be replaced
        drives = (make_arm(config) if arm is None else arm).zero()
    return ZeroingResult(config.name, posture, drives, arm_fault_store(state, config.name).remembered(), existed)
