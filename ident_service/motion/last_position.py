"""Keep where an arm stood when it was closed, for an encoder that is a whole turn off when its power comes back.

An absolute encoder on the motor's side knows its angle within a turn. How many turns there were it counts, or keeps
with a battery. Where that fails, every joint limit and every gravity torque is off by as much, and nothing that moves a
little shows it: loops close, directions are right. So what the drives tell when the arm is opened is compared with what
they told last (`whole_turns_text`). Positions are looked at without a command and after the arm has been closed.
"""

from __future__ import annotations

import hashlib
import json
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np

from drivers.arm import Arm, Vector
from ident_service.config.arm import ArmConfig
from ident_service.errors import IdentError, MotionRefused, UsageError
from ident_service.motion.read_only_monitor import watch
from ident_service.recordings.files import write_atomically

FILE: Final = "position.json"  # in the arm's folder
TURN: Final = 0.03  # of a motor turn by which one that is lost may differ from a whole number
STILL: Final = 0.01  # rad/s or m/s, at most, where a position is worth keeping
LOOK_AT_IT: Final = (
    "Look at the arm: if it does not stand as `ident watch` says, an encoder has lost turns, which the maker's tool or "
    "`ident set-home` sets; if it does, move that joint a little by hand, and check again."
)
_LOOK = 0.5  # s


@dataclass(frozen=True)
class LastPosition:
    """Position in which an arm was closed, with nobody moving it any more.

    Attributes:
        position: [rad or m], shape (joints,).
        when: UTC.
    """

    position: Vector
    when: datetime


class PositionFile:
    """The last position of one arm, as its description was then."""

    def __init__(self, folder: Path, config: ArmConfig) -> None:
        """`folder` of the arm, below the state folder."""
        self._path, self._config = folder / FILE, config

    def forget(self) -> None:
        """Delete the stored position, before the arm moves."""
        self._path.unlink(missing_ok=True)

    def keep(self, arm: Arm) -> None:
        """Open a closed arm read-only for 0.5 s, store where it stands; store none if it moves, fails or is simulated.

        Arms that are new whenever they are opened, simulated ones, have no such position.
        """
        with suppress(IdentError, OSError):  # what ended the motion, or was found of the arm, counts more
            self.forget()
            if is_new_every_time(arm, self._config):
                return
            seen = watch(arm, _LOOK)
            still = np.isfinite(seen.position).all() and (np.abs(seen.velocity) <= STILL).all()
            if still and not seen.missing.any():
                document = {
                    "scale_sha256": _scale(self._config),
                    "when": datetime.now(UTC).isoformat(timespec="seconds"),
                    "position": seen.position.tolist(),
                }
                write_atomically(self._path, json.dumps(document, indent=1) + "\n")

    def require_no_lost_turns(self, arm: Arm) -> None:
        """Read an open arm's position; MotionRefused where its motors turned by whole turns only since it was closed.

        Raises:
            MotionRefused: they did.
            UsageError: as `read`.
            DriverError: the arm does not answer.
        """
        last = self.read()
        if last is not None and (words := whole_turns_text(last, arm.exchange(None).position, self._config)):
            raise MotionRefused(f"{words}; {LOOK_AT_IT}")

    def read(self) -> LastPosition | None:
        """Return the stored position; None without one or for other joints, gears or counts; UsageError if damaged.

        Raises:
            UsageError: the file was damaged by somebody.
        """
        try:
            document = json.loads(self._path.read_text(encoding="utf-8"))
            if document["scale_sha256"] != _scale(self._config):
                return None
            position = np.array(document["position"], dtype=float)
            if position.shape != (len(self._config.joints),) or not np.isfinite(position).all():
                raise ValueError("not a number for each joint")
            return LastPosition(position, datetime.fromisoformat(document["when"]))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UsageError(f"{self._path}: cannot be read ({error}); check the arm, then remove the file") from None


def is_new_every_time(arm: Arm, config: ArmConfig) -> bool:
    """Return whether an arm starts anew at each opening: a lock-step clock, no driver, or a simulated one."""
    return arm.clock.lock_step or config.driver is None or config.driver.kind == "simulated"


def whole_turns_text(stored: LastPosition, position: Vector, config: ArmConfig) -> str:
    """Describe motors that made whole turns while an arm was closed; empty if none, one by a fraction, or no gears.

    Somebody may have moved the arm by hand. That all motors have turned by whole turns, and one by more than none, is
    what lost turns look like, and hardly what a hand does.

    Args:
        stored: position of the arm when it was closed.
        position: present position, as the drives report it [rad or m], shape (joints,).
        config: of the arm.
    """
    gears = config.transmission
    if gears is None:
        return ""
    turns = np.array(gears.ratios) * (gears.coupling_matrix @ (position - stored.position)) / (2.0 * np.pi)
    whole = np.rint(turns)
    if not whole.any() or (np.abs(turns - whole) > TURN).any():
        return ""
    motors = [
        f"motor {number + 1} stands {abs(count):.0f} whole turn{'s' if abs(count) > 1 else ''} from where it stood"
        for number, count in enumerate(whole)
        if count
    ]
    moved = zip(config.joints, position - stored.position, strict=True)
    joints = ", ".join(f"{name} {away:+.4g}" for name, away in moved if abs(away) > 1e-3)
    return f"{', '.join(motors)} when the arm was closed at {stored.when:%Y-%m-%d %H:%M} UTC ({joints} rad or m)"


def _scale(config: ArmConfig) -> str:
    """Return a hash of what a position in the file depends on: joints, gears, and counts of the drives."""
    gears = None if config.transmission is None else config.transmission.model_dump(mode="json")
    drives = [getattr(drive, "counts", None) for drive in getattr(config.driver, "drives", ())]
    return hashlib.sha256(json.dumps([list(config.joints), gears, drives]).encode()).hexdigest()
