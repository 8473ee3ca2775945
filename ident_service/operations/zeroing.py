"""Zero an arm with incremental encoders: a person confirms that the arm stands at its home posture.

A person must move the arm to its home and compare it with the displayed posture. Everything that a program can check is
checked first: another process that moves the arm, another host, powered drives, an arm that moves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import degrees
from pathlib import Path

from drivers.arm import Arm
from ident_service.config.canopen import CanopenDriver
from ident_service.config.schema import ArmConfig
from ident_service.errors import MotionRefused, UsageError
from ident_service.model.arm_model import arm_model
from ident_service.motion.control_file import ControlFile
from ident_service.motion.factory import make_arm
from ident_service.motion.fault_file import Remembered
from ident_service.motion.last_position import PositionFile
from ident_service.operations.arm_state import control_path, fault_file, ticket_path
from ident_service.recordings.files import require_writable


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
class Zeroed:
    """Result of zeroing an arm.

    Attributes:
        arm: name.
        posture: that the arm stands in, of all joints.
        drives: message of each drive about its zero.
        faults: that nobody has acknowledged; zeroing is possible with them and leaves them as they are.
        ticket_removed: whether there was a preflight ticket, which was about another zero.
    """

    arm: str
    posture: tuple[JointPosture, ...]
    drives: tuple[str, ...]
    faults: tuple[Remembered, ...]
    ticket_removed: bool


def home_posture(config: ArmConfig) -> tuple[JointPosture, ...]:
    """Return the posture in which an arm is zeroed.

    Raises:
        UsageError: its description does not say `zero: at_home`, or has no home of every joint.
    """
    if not isinstance(config.driver, CanopenDriver) or config.driver.zero != "at_home":
        raise UsageError(
            f"{config.name}: has no zero to be set: only drives with `driver: {{zero: at_home}}`, whose encoders count "
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


def take_home(config: ArmConfig, state: Path, confirm: Callable[[str], str], arm: Arm | None = None) -> Zeroed:
    """Set an arm's present position as its home in the drives, once a person has confirmed the posture.

    Args:
        config: of the arm.
        state: the state folder.
        confirm: asks a person, who has seen the posture, for the arm's name.
        arm: not open; the configured one when None.

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
            raise MotionRefused(f"{config.name}: not zeroed: the arm's name was not typed; nothing has changed")
        # Removed before zeroing: a ticket that outlived it would be for another zero.
        existed = ticket.exists()
        ticket.unlink(missing_ok=True)
        PositionFile(ticket.parent, config).forget()  # what drives tell is about another zero from now on
        drives = (make_arm(config) if arm is None else arm).zero()
    return Zeroed(config.name, posture, drives, fault_file(state, config.name).remembered(), existed)
