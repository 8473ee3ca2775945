"""Check position scales: compare drives' positions with angles by which a person has turned each joint by hand.

A control loop works with a wrong gear ratio or encoder scale as if nothing were wrong, and the response of a joint to
torque reveals it only where its inertia is known. A turn by hand, measured with a protractor, reveals it directly.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from drivers.arm import Arm
from ident_service.config.schema import ArmConfig
from ident_service.errors import DriverError, UsageError
from ident_service.model.arm_model import arm_model
from ident_service.motion.control_file import ControlFile
from ident_service.motion.factory import make_arm
from ident_service.operations.arm_state import arm_folder, control_path
from ident_service.results.files import write_atomically

FILE = "scale.json"  # in the arm's folder
LEAST = math.radians(20.0)  # a tenth of it in m for prismatic joints: less cannot be judged well enough by eye
WRONG, SLACK = 0.1, math.radians(3.0)  # allowed share of the angle, and error of a person's eye [rad]
_SAMPLES = 5


@dataclass(frozen=True)
class Turned:
    """Scale check of one joint that was turned by hand.

    Attributes:
        joint: its name.
        typed: by how much, as a person says [rad or m].
        measured: by how much, as the drives say, likewise.
        good: whether they agree.
        words: about it, for people.
    """

    joint: str
    typed: float
    measured: float
    good: bool
    words: str


def check_scale(config: ArmConfig, state: Path, ask: Callable[[str], str], arm: Arm | None = None) -> list[Turned]:
    """Ask for a turn of each joint, compare it with the drives' positions, and keep the answers in `scale.json`.

    Args:
        config: of the arm; nothing is energised.
        state: the state folder.
        ask: shows a question and returns what a person typed.
        arm: not open; the configured one when None.

    Returns:
        What was found of the joints that were turned; an empty answer leaves one out.

    Raises:
        UsageError: an answer that is no angle, or too small a one.
        DriverError: the arm does not answer, or another process has it.
    """
    chain = arm_model(config).chain
    found = []
    with (
        ControlFile.take(control_path(state, config.name), None),
        (make_arm(config) if arm is None else arm).look() as seen,
    ):
        for number, (name, revolute) in enumerate(zip(chain.names, chain.revolute, strict=True)):
            unit, scale = ("degrees", math.pi / 180.0) if revolute else ("mm", 1e-3)
            before = _position(seen, number)
            act = "turn it by hand, by 90 degrees or to its stop" if revolute else "push it by hand, by 100 mm or more"
            question = f"{name}: {act}, and leave it there. By how many {unit}, signed (empty: leave this joint out)?"
            answer = ask(question).strip()
            if answer:
                found.append(_turned(name, answer, scale, revolute, _position(seen, number) - before))
    if found:
        _keep(arm_folder(state, config.name) / FILE, config, found)
    return found


def _turned(name: str, answer: str, scale: float, revolute: bool, measured: float) -> Turned:
    try:
        typed = float(answer) * scale
    except ValueError:
        raise UsageError(f"{name}: {answer!r} is no number; nothing of this joint was kept") from None
    least = LEAST if revolute else 0.1 * LEAST
    if not math.isfinite(typed) or abs(typed) < least:
        raise UsageError(
            f"{name}: {answer} is too little to tell a scale by, or no number; at least {least / scale:.0f}"
        )
    ratio = measured / typed
    good = abs(measured - typed) <= WRONG * abs(typed) + (SLACK if revolute else 0.1 * SLACK)
    words = f"{name}: the drives saw {ratio:.3g} times what was turned"
    if good:
        words += ", as they should"
    elif ratio < 0.0:
        words += ": the sign of transmission.ratios is wrong"
    else:
        words += (
            f": the scale is wrong; transmission.ratios is {1.0 / ratio:.3g} times too large, or drives.counts"
            if ratio > 1e-3
            else ": its encoder does not count, or is another joint's"
        )
    return Turned(name, typed, measured, good, words)


def _position(arm: Arm, number: int) -> float:
    for _ in range(_SAMPLES):
        sample = arm.exchange(None)
    if not sample.valid[number] or not math.isfinite(float(sample.position[number])):
        raise DriverError("the joint's drive does not answer; check its power and its cable")
    return float(sample.position[number])


def _keep(path: Path, config: ArmConfig, found: list[Turned]) -> None:
    """Write the results, together with earlier ones of other joints of the same description."""
    kept: dict[str, object] = {}
    try:
        before = json.loads(path.read_text(encoding="utf-8"))
        kept = dict(before["joints"]) if before.get("arm_sha256") == config.sha256 else {}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        pass  # no file yet, or an unreadable one, which the present results replace
    when = datetime.now(UTC).isoformat(timespec="seconds")
    kept |= {one.joint: asdict(one) | {"when": when} for one in found}
    write_atomically(path, json.dumps({"arm_sha256": config.sha256, "joints": kept}, indent=1) + "\n")
