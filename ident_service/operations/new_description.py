"""Write a first description of an arm from its URDF, complete enough to simulate.

Values of the URDF are taken over; missing ones are guessed cautiously, and marked as guesses in a comment. The
simulated arm differs from the prior: its links, drives and friction are drawn at random about it, so that identifying
it shows what identification does. Before anything is written, the description is loaded, and home and both motions are
checked to be clear; gains that are not stable are reported.
"""

from __future__ import annotations

import shutil
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ident_service.config.load import load_arm
from ident_service.config.motion_design import BASE
from ident_service.config.motion_limits import motion_limits
from ident_service.config.quantities import TextFile
from ident_service.errors import ModelError, MotionRefused, UsageError
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import ArmModel, arm_model, control_model
from ident_service.model.base_parameters import base_parameters, remarks_on_angles
from ident_service.model.chain import Array
from ident_service.model.collision import CollisionModel, share_touching
from ident_service.model.likely_bodies import likely_bodies, lines_of, perturbed_body, with_urdf_bodies
from ident_service.model.mechanism import count_mechanism, read_mechanism, require_urdf
from ident_service.model.outline import mesh_capsules
from ident_service.model.pinocchio_models import InverseDynamics
from ident_service.motion.safety_monitor import TORQUE_RATE, TORQUE_RATE_SHARE
from ident_service.motion.ticket import Verdict
from ident_service.operations.commissioning import require_clear_from_home
from ident_service.preflight.static_checks import stability_check
from ident_service.recordings.files import write_atomically

_ARM = 3  # joints that make a branch an arm and not a gripper


@dataclass(frozen=True)
class UrdfLimits:
    """Limits of a joint in a URDF; None where it has none that is plausible."""

    position: tuple[float, float] | None
    velocity: float | None
    effort: float | None


def arm_part(text: str, file: str, base: str | None, tip: str | None) -> dict[str, Any]:
    """Return which part of a URDF is the arm: from the root along the branch with most joints to its gripper.

    Args:
        text: of the file, whose elements were counted.
        file: its name.
        base: link that the arm stands on; the root when None.
        tip: link that it ends at; found when None.

    Returns:
        The keys of `kinematics`.

    Raises:
        ModelError: not well-formed, or several roots.
    """
    try:
        robot = ET.fromstring(text)  # noqa: S314 - counted before
    except ET.ParseError as error:
        raise ModelError(f"{file}: not well-formed XML: {error}") from None
    part: dict[str, Any] = {"urdf": file}
    if base is not None:
        part["base"] = base
    if tip is not None:
        return part | {"tip": tip}
    children: dict[str, list[tuple[str, str, bool]]] = {}
    carried, leaders = set(), set()
    for joint in robot.findall("joint"):
        parent, child = (joint.find(role) for role in ("parent", "child"))
        if parent is None or child is None:
            continue
        mimic = joint.find("mimic")
        moves = joint.get("type") in ("revolute", "continuous", "prismatic") and mimic is None
        if mimic is not None:
            leaders.add(mimic.get("joint", ""))
        children.setdefault(parent.get("link", ""), []).append((child.get("link", ""), joint.get("name", ""), moves))
        carried.add(child.get("link", ""))
    roots = [link.get("name", "") for link in robot.findall("link") if link.get("name", "") not in carried]
    if base is None and len(roots) != 1:
        raise ModelError(f"{file}: {len(roots)} links have no parent joint; name the arm's --base")

    def depth(link: str) -> int:
        return max((moves + depth(child) for child, _, moves in children.get(link, [])), default=0)

    link, branched = roots[0] if base is None else base, False
    while True:
        ways = [(moves + depth(child), child, name, moves) for child, name, moves in children.get(link, [])]
        ways = [way for way in ways if way[0] > 0]
        if not ways:
            break
        longest = max(ways, key=lambda way: way[0])
        count, onward, joint_name, moves = longest
        # The gripper begins where branches too short for an arm part, or at a joint that others mimic.
        if count < _ARM and (len(ways) > 1 or (moves and joint_name in leaders)):
            branched = True
            break
        branched = branched or len(ways) > 1 or len(children.get(link, [])) > 1
        link = onward
    return part | {"tip": link} if branched else part


def urdf_limits(text: str) -> dict[str, UrdfLimits]:
    """Return the limits of every joint of a URDF whose elements were counted, by its name."""
    found = {}
    for joint in ET.fromstring(text).findall("joint"):  # noqa: S314 - counted before
        limit = joint.find("limit")

        def number(key: str, limit: ET.Element | None = limit) -> float | None:
            try:
                value = float(limit.get(key, "nan")) if limit is not None else float("nan")
            except ValueError:
                return None
            return value if np.isfinite(value) else None

        lower, upper = number("lower"), number("upper")
        ranged = lower is not None and upper is not None and lower < upper and joint.get("type") != "continuous"
        position = (float(lower or 0.0), float(upper or 0.0)) if ranged else None
        velocity, effort = number("velocity"), number("effort")
        found[joint.get("name", "")] = UrdfLimits(
            position,
            velocity if velocity is not None and 0.0 < velocity < 100.0 else None,
            effort if effort is not None and 0.0 < effort < 1e5 else None,
        )
    return found


RATE = 500.0  # Hz, at which most arms' gains are stable and a simulation is quick
CLEARANCE = 0.02  # m
FRICTION_GUESS = 0.04  # of the torque limits, what the description expects
ENCODER = 2e-5  # rad or m, of the simulated arm
_DRAFT_SECONDS = 20.0  # of a motion
LARGEST_USE = 0.6  # share of the limits of the first motion that is tried


@dataclass
class Draft:
    """Decided content of a description, to be written as YAML.

    Attributes:
        name: of the arm.
        urdf: name of the file beside the description.
        part: the keys of its kinematics.
        joints: keys of each joint.
        geometry: capsules of links whose meshes are replaced.
        may_touch: pairs that always touch.
        prior: names and values where the URDF's bodies are not those of real links; empty where they are.
        use: share of the limits that the motions take.
        seeds: of the two motions.
        frequency: of the two motions [Hz].
        cutoff: of the velocity's low-pass [Hz].
        standstill: speed below which a joint counts as standing [rad/s or m/s]; 0 for what is usual.
        total_mass: largest of the arm [kg].
        truth: of the simulated arm.
        remarks: what was guessed, for people.
    """

    name: str
    urdf: str
    part: dict[str, Any]
    joints: dict[str, dict[str, Any]] = field(default_factory=dict)
    geometry: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    may_touch: list[tuple[str, str]] = field(default_factory=list)
    prior: dict[str, float] = field(default_factory=dict)
    use: float = LARGEST_USE
    seeds: tuple[int, int] = (1, 2)
    frequency: float = 0.1
    cutoff: float = 30.0
    standstill: float = 0.0
    total_mass: float = 0.0
    truth: dict[str, float] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)


def short(value: float, digits: int = 4) -> float:
    """Round a number to some significant digits."""
    return float(f"{value:.{digits}g}")


def in_yaml(draft: Draft) -> str:
    """Return the description as YAML with comments."""
    guessed = "\n".join(f"#   {line}" for line in draft.remarks)
    head = f"""\
# {draft.name}, begun by `ident new` from {draft.urdf}. Check it before a real arm moves with it.
# Guessed or chosen:
{guessed}
format: ident-arm
version: 1
name: {_flow(draft.name)}

kinematics: {_flow(draft.part)}

gravity: [0, 0, -9.81] # m/s^2 in the base frame: the arm stands upright
terms: [drive_inertia, viscous, coulomb, offset]
"""
    units = "# rad, rad/s, rad/s^2, rad/s^3, N m; for slides m, m/s, m/s^2, m/s^3, N"
    parts = [head]
    if draft.joints:
        rows = "".join(f"  {_flow(name)}:\n    {_flow(keys)}\n" for name, keys in draft.joints.items())
        parts.append(f"{units}\njoints:\n{rows}")
    if draft.prior:
        parts.append(f"prior: # SI units, in the link frames; guessed ones are listed above\n  {_flow(draft.prior)}\n")
    if draft.total_mass:
        parts.append(f"constraints: {{total_mass: {{upper: {draft.total_mass:g}}}}} # kg, twice what its links have\n")
    cutoff = "" if draft.cutoff == 30.0 else f", velocity_cutoff: {draft.cutoff:g}"
    parts.append(
        f"control: {{rate: {RATE:g}{cutoff}, after_stop: brake}} # Hz\n"
        "# After a stop drives are switched off: simulated ones are taken to have brakes. Of a real arm say in\n"
        "# the braces of each joint `brake: true` or `brake: false`; one without brakes has `after_stop: hold` above.\n"
    )
    if draft.geometry:
        rows = "".join(f"  {_flow(name)}: {_flow(each)}\n" for name, each in draft.geometry.items())
        parts.append(f"geometry: # m, in the link frames; around the URDF's meshes\n{rows}")
    space: dict[str, Any] = {"clearance": CLEARANCE}
    if draft.may_touch:
        space["may_touch"] = [list(pair) for pair in draft.may_touch]
    parts.append(
        f"workspace: {_flow(space)} # m\n"
        "# Obstacles go into the braces above; then design motions that avoid them (`ident design`):\n"
        "#   obstacles: {table: {half_space: {normal: [0, 0, 1], offset: -0.1}}}\n"
    )
    parts.append(
        f"design: {{friction_guess: [{FRICTION_GUESS:g}, {FRICTION_GUESS:g}]}} # shares of the torque limits\n"
    )
    if draft.standstill:
        parts.append(f"identification: {{reversal: {{speed: {draft.standstill:g}}}}} # rad/s or m/s\n")
    periods = round(_DRAFT_SECONDS * draft.frequency)
    motion = {
        "kind": "seeded", "about": "home", "base_frequency": draft.frequency, "harmonics": 5, "periods": periods,
        "use": draft.use,
    }  # fmt: skip
    first, second = ({**motion, "seed": seed} for seed in draft.seeds)
    parts.append(f"motions:\n  identification: {_flow(first)}\n  validation: {_flow(second)}\n")
    torque = [keys["torque"] for keys in draft.joints.values()]
    noise, step = ([short(share * value, 2) for value in torque] for share in (2e-3, 2e-4))
    driver: dict[str, Any] = {
        "kind": "simulated", "time": "virtual", "seed": 1, "truth": draft.truth, "encoder_resolution": ENCODER,
        "torque_resolution": step, "torque_noise": noise, "delay_cycles": 1,
    }  # fmt: skip
    rows = "".join(f"  {key}: {_flow(value)}\n" for key, value in driver.items() if value or key == "seed")
    parts.append(f"driver: # a simulated arm whose links, drives and friction are drawn about the prior's\n{rows}")
    return "\n".join(parts)


def _flow(value: Any) -> str:
    """Return a value in YAML's flow style on one line."""
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10**6).strip()
    return text.removesuffix("\n...").removesuffix("...").strip()


_MOST_TURNS = 8.0 * np.pi  # rad; a larger range is taken for degrees
_TURN, _SLIDE = 3.14, 0.5  # rad and m either way, of joints without limits
_VELOCITY = {True: 2.0, False: 0.3}  # rad/s, m/s
_SECONDS = 0.25  # s in which a joint reaches its velocity limit at its acceleration limit
_FOLLOWS = {True: 0.2, False: 0.05}  # rad, m
_GAINS = ((400.0, 40.0), (225.0, 30.0), (100.0, 20.0), (49.0, 14.0))  # all of damping 1
_LIGHT = 0.3  # share of the torque limits that holding the home posture may take
_HEAVY = 1.5  # smallest torque limit in units of the largest gravity torque
_FRICTION = 0.03  # of the torque limit, Coulomb, and viscous at the velocity limit
_DRIVE = 0.02  # s in which a geared drive alone would reach its velocity limit with its torque limit
_RATE_SHARE = 0.15  # share of the guard's torque-rate limit that a motion's jerk may use
_POSTURES, _SEED = 300, 20140101
_COUNT_SHARE = 0.4  # of the torque rate that the guard lets through, that one count of the encoder may make
_CUTOFFS = (30.0, 20.0, 15.0, 10.0)  # Hz, of the velocity's low-pass: slow where a count makes much torque
_FREQUENCIES = (0.1, 0.2, 0.4)  # Hz, of the motions: faster where joints with little room would be too slow
_MOVES = 0.3  # share of a motion in which a joint should be faster than what counts as standstill
_USES = (LARGEST_USE, 0.4, 0.25, 0.15, 0.08)  # shares of the limits that motions are tried with
_SEEDS = range(1, 9)
_PACES = 2000  # samples of a motion in which speeds are counted
_GLANCES, _GLANCE = 200, 1.3  # postures of a motion that are looked at first, and clearances they must have
# Share of postures from which links that touch are no collision, by the joints between them: capsules of links around a
# shoulder or a wrist reach into each other.
_TOUCHES, _ALWAYS = {2: 0.3, 3: 0.6}, 0.95


def new_description(
    urdf: Path,
    out: Path | None = None,
    name: str | None = None,
    base: str | None = None,
    tip: str | None = None,
    tell: Callable[[str], None] = lambda _: None,
) -> tuple[Path, tuple[str, ...]]:
    """Write the description of an arm, and a copy of its URDF beside it.

    Args:
        urdf: the file.
        out: where the description goes; `NAME.yaml` in the present folder when None.
        name: of the arm; that of the file when None.
        base: link that the arm stands on; the root when None.
        tip: link that it ends at; before the gripper of the longest branch when None.
        tell: called with a line at each step.

    Returns:
        The description's path, and what was guessed.

    Raises:
        UsageError: no such file, or something is there where it would be written.
        ModelError: not a URDF that holds an arm.
        MotionRefused: no posture or motion is free of collisions.
    """
    if not urdf.is_file():
        raise UsageError(f"{urdf}: no such file")
    called = _plain(urdf.stem if name is None else name)
    path = Path(f"{called}.yaml") if out is None else out
    beside = path.parent / urdf.name
    for there in (path, beside):
        if there.exists() and not (there == beside and there.samefile(urdf)):
            raise UsageError(f"{there}: exists already; give --out another place")
    try:
        text = urdf.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{urdf}: cannot be read: {error}") from None
    file = TextFile(name=urdf.name, text=text)
    count_mechanism(file, "urdf")
    require_urdf(file)
    draft = Draft(called, urdf.name, arm_part(text, file.name, base, tip))
    with tempfile.TemporaryDirectory() as staging:
        trial = Path(staging) / "arm.yaml"
        shutil.copyfile(urdf, trial.with_name(urdf.name))

        def loaded() -> ArmModel:
            trial.write_text(in_yaml(draft), encoding="utf-8")
            return arm_model(load_arm(trial), bodies=False)  # what is none is guessed

        draft.remarks += _part_remark(loaded(), draft)
        tell("joints and bodies")
        _joints(draft, loaded(), urdf_limits(text))
        _bodies(draft, loaded, urdf.parent)
        tell("a posture to begin in")
        model = _home(draft, loaded)
        _drives(draft, model)
        tell("gains and motions")
        _gains(draft, loaded)
        _motions(draft, loaded)
        loaded()
    draft.remarks += _always_guessed(draft)
    path.parent.mkdir(parents=True, exist_ok=True)
    if not beside.exists():
        write_atomically(beside, text)
    write_atomically(path, in_yaml(draft))
    return path, tuple(draft.remarks)


def _always_guessed(draft: Draft) -> list[str]:
    """Return remarks on what no URDF says."""
    kp, kd = next(((joint["kp"], joint["kd"]) for joint in draft.joints.values()), _GAINS[0])
    mass = f"constraints.total_mass: at most {draft.total_mass:g} kg, twice what the links have"
    return [
        "gravity: the base stands upright",
        "terms: each joint has drive inertia, viscous and Coulomb friction, and an offset",
        "joints: acceleration, jerk and following_error from the velocity and torque limits; drive_inertia from them, "
        f"too; gains, kp {kp:g} and kd {kd:g}, for the simulated arm; home, where the arm is clear of itself",
        *([mass] if draft.total_mass else []),
        f"control: {RATE:g} Hz; after_stop: brakes hold the arm, because simulated drives are assumed to have brakes; "
        "enter what the real ones have",
        f"design.friction_guess: friction is {FRICTION_GUESS:.0%} of the torque limits",
        f"motions: {draft.use:.0%} of the limits, {draft.frequency:g} Hz, about home",
        "driver: a simulated arm; its links, drives and friction are drawn at random about the prior's",
        f"workspace: clearance {CLEARANCE:g} m; only the arm itself is avoided; add the obstacles around it",
    ]


def _plain(name: str) -> str:
    found = "".join(letter if letter.isalnum() or letter in "_-" else "_" for letter in name).strip("_-")
    return found or "arm"


def _part_remark(model: ArmModel, draft: Draft) -> list[str]:
    """Return a remark on which part of the URDF is the arm, where the file holds more."""
    file = model.config.kinematics.urdf
    if file is None or "tip" not in draft.part:
        return []
    held = read_mechanism(file, "urdf", model.config.kinematics).held
    ends = f"from {draft.part.get('base', 'the root')} to {draft.part['tip']}, {model.chain.joints} joints"
    more = f"; held: {', '.join(list(held)[:8])}{' ...' if len(held) > 8 else ''}" if held else ""
    return [f"the arm: {ends}{more} (change it with --base and --tip)"]


def _joints(draft: Draft, model: ArmModel, said: Mapping[str, UrdfLimits]) -> None:
    """Set the limits of every joint: the URDF's, else guesses; torque limits that can hold the arm."""
    chain = model.chain
    likely = likely_bodies(with_urdf_bodies(model))
    if likely.guessed:
        draft.prior = _table(model, likely.delta)
        draft.remarks.append(
            f"bodies of {', '.join(likely.guessed)}: rods; the URDF's have no mass, or an unphysical inertia"
        )
    model = replace(model, prior=likely.delta)
    masses = [float(likely.delta[model.layout.inertial(link)][-1]) for link in range(chain.joints)]
    draft.total_mass = short(2.0 * sum(masses), 3)
    if remarks_on_angles(base_parameters(model.chain, model.layout)):
        draft.part["snap"] = True
        draft.remarks.append(
            "kinematics: the URDF's angles are rounded multiples of 15 degrees; they are taken as exact"
        )
    ranges = [
        (said[name].position if name in said else None) or ((-_TURN, _TURN) if turns else (-_SLIDE, _SLIDE))
        for name, turns in zip(chain.names, chain.revolute, strict=True)
    ]
    for name, (low, high), turns in zip(chain.names, ranges, chain.revolute, strict=True):
        if turns and high - low > _MOST_TURNS:
            raise ModelError(f"{draft.urdf}: {name} turns from {low:g} to {high:g} rad: limits of a URDF are radians")
    gravity, inertia = _worst(model, ranges)
    for k, name in enumerate(chain.names):
        turns, one = chain.revolute[k], said.get(name, UrdfLimits(None, None, None))
        velocity = one.velocity or _VELOCITY[turns]
        acceleration = velocity / _SECONDS
        torque = one.effort or _HEAVY * (gravity[k] + 2.0 * inertia[k] * acceleration)
        if torque < _HEAVY * gravity[k]:
            holds = "cannot hold" if torque < gravity[k] else "hardly holds"
            draft.remarks.append(
                f"{name}: its effort limit of {torque:g} {holds} the arm, which needs {gravity[k]:.3g}"
            )
        drive = _DRIVE * torque / velocity
        acceleration = min(acceleration, max(0.3 * torque / (inertia[k] + drive), 0.1 * velocity / _SECONDS))
        rate = min(TORQUE_RATE, TORQUE_RATE_SHARE * torque)
        jerk = min(10.0 * acceleration, _RATE_SHARE * rate / (inertia[k] + drive))
        missing = [
            key
            for key, value in (("position", one.position), ("velocity", one.velocity), ("torque", one.effort))
            if value is None
        ]
        if missing:
            draft.remarks.append(
                f"{name}: {', '.join(missing)} limit guessed; the URDF has none, or an implausible one"
            )
        draft.joints[name] = {
            # The URDF's exact values: a rounded limit may be wider than the arm's.
            "position": list(ranges[k]),
            "velocity": velocity,
            "acceleration": short(acceleration),
            "jerk": short(jerk),
            "torque": torque if one.effort else short(torque),
            "following_error": _FOLLOWS[turns],
            "home": min(max(0.0, ranges[k][0]), ranges[k][1]),
            "kp": _GAINS[0][0],
            "kd": _GAINS[0][1],
            "drive_inertia": short(drive, 3),
        }


def _prior(model: ArmModel) -> Array:
    if model.prior is None:
        raise ModelError(f"{model.config.name}: no bodies")
    return model.prior


def _worst(model: ArmModel, ranges: list[tuple[float, float]]) -> tuple[Array, Array]:
    """Return the largest gravity torque and the largest inertia of each joint over random postures."""
    low, high = np.array(ranges).T
    dynamics = InverseDynamics(model.chain, model.layout, _prior(model))
    still, gravity, inertia = np.zeros(model.chain.joints), np.zeros(model.chain.joints), np.zeros(model.chain.joints)
    for q in np.random.default_rng(_SEED).uniform(low, high, size=(_POSTURES, model.chain.joints)):
        gravity = np.maximum(gravity, np.abs(dynamics.torque(q, still, still)))
        inertia = np.maximum(inertia, np.diag(dynamics.mass_matrix(q)))
    return gravity, inertia


def _bodies(draft: Draft, loaded: Callable[[], ArmModel], folder: Path) -> None:
    """Set capsules in place of meshes, and list the pairs of links that touch in most postures."""
    model = loaded()
    chain = model.chain
    capsules, unread = mesh_capsules(model.config.kinematics, chain, folder)
    for owner in unread:
        if owner not in capsules:
            capsules[owner] = list(lines_of(model, chain.names.index(owner))) if owner != BASE else []
    for owner, found in capsules.items():
        draft.geometry[owner] = [one.model_dump(by_alias=True, mode="json") for one in found]
    if unread:
        draft.remarks.append(
            f"geometry: a mesh of {', '.join(unread)} could not be read; capsules are guessed where none of a link was,"
            " and the base has none then"
        )
    model = loaded()
    inner = (BASE, *chain.names)
    for (moving, other), share in share_touching(model, 2.0 * CLEARANCE, _POSTURES, _SEED).items():
        path = [0, *(joint + 1 for joint in chain.ancestors(chain.names.index(moving)))]
        between = len(path) - 1 - path.index(inner.index(other)) if inner.index(other) in path else None
        if share >= (_ALWAYS if between is None else _TOUCHES.get(between, _ALWAYS)):
            draft.may_touch.append((moving, other))
    if draft.may_touch:
        pairs = ", ".join(" and ".join(pair) for pair in draft.may_touch)
        draft.remarks.append(f"geometry: {pairs} touch in most postures, as their capsules are; they are not checked")


def _home(draft: Draft, loaded: Callable[[], ArmModel]) -> ArmModel:
    """Choose where motions begin: zero, the middle, or what is most free of random postures; and keep it.

    A joint that has no room about zero begins in its middle: motions are about home.
    """
    model = loaded()
    limits = motion_limits(model.config)
    low, high = limits.lower, limits.upper
    margin = 0.15 * (high - low)
    middle = 0.5 * (low + high)
    drawn = np.random.default_rng(_SEED).uniform(low + margin, high - margin, size=(_POSTURES, len(low)))
    zero = np.where((low + margin <= 0.0) & (high - margin >= 0.0), 0.0, middle)
    postures = np.vstack([zero, middle, 0.5 * (drawn + middle), drawn])
    collision = CollisionModel(model)
    distances = collision.distances(postures)
    free = distances.min(axis=1) if distances.shape[1] else np.full(len(postures), np.inf)
    dynamics, still = InverseDynamics(model.chain, model.layout, _prior(model)), np.zeros(len(low))
    held = np.array([np.max(np.abs(dynamics.torque(q, still, still)) / limits.torque) for q in postures])
    good = (free >= 3.0 * CLEARANCE) & (held <= _LIGHT)
    if good.any():
        place = int(np.argmax(good))
    else:  # the least torque among postures with clearance, or the one with most clearance
        roomy = free >= min(3.0 * CLEARANCE, float(free.max()))
        place = int(np.argmin(np.where(roomy, held, np.inf)))
    if not (free[place] > CLEARANCE and held[place] <= 1.0 / _HEAVY):
        clear = free[place] > CLEARANCE
        pair = "torque limits" if clear else collision.pairs[int(np.argmin(distances[place]))]
        raise MotionRefused(
            f"{draft.name}: none of {len(postures)} postures is clear and can be held ({pair}); is the URDF in metres"
            " and radians, and does its root stand on the ground?"
        )
    for name, value in zip(draft.joints, postures[place], strict=True):
        draft.joints[name]["home"] = short(float(value), 3)
    return loaded()


def _drives(draft: Draft, model: ArmModel) -> None:
    """Draw the true parameters of the simulated arm at random: links about the prior's, drives and friction."""
    rng = np.random.default_rng(_SEED)
    chain, layout, prior = model.chain, model.layout, _prior(model)
    limits = motion_limits(model.config)
    drives = np.array([joint["drive_inertia"] for joint in draft.joints.values()])
    delta = prior.copy()
    for link in range(chain.joints):
        place = layout.inertial(link)
        delta[place] = perturbed_body(prior[place], rng)
    shares = 1.0 + 0.3 * rng.uniform(-1.0, 1.0, size=(3, chain.joints))
    delta[layout.term_columns("drive_inertia")] = drives * shares[0]
    delta[layout.term_columns("viscous")] = _FRICTION * limits.torque / limits.velocity * shares[1]
    delta[layout.term_columns("coulomb")] = _FRICTION * limits.torque * shares[2]
    delta[layout.term_columns("offset")] = 0.1 * _FRICTION * limits.torque * rng.uniform(-1.0, 1.0, chain.joints)
    draft.truth = _table(model, delta)


def _gains(draft: Draft, loaded: Callable[[], ArmModel]) -> None:
    """Choose the stiffest gains that are stable, and by which a count of the encoder makes no jump of the torque."""
    model = loaded()
    limits = motion_limits(model.config)
    _, inertia = _worst(control_model(model), list(zip(limits.lower.tolist(), limits.upper.tolist(), strict=True)))
    rate = np.minimum(TORQUE_RATE, TORQUE_RATE_SHARE * limits.torque)
    quietest = np.inf
    for kp, kd in _GAINS:
        for joint in draft.joints.values():
            joint.update(kp=kp, kd=kd)
        for cutoff in _CUTOFFS:
            # Torque of one count, by K_p and by K_d through the low-pass, as a share of what a cycle may change.
            passed = (1.0 - np.exp(-2.0 * np.pi * cutoff / RATE)) * RATE
            share = float((inertia * (kp + kd * passed) * ENCODER * RATE / rate).max())
            quietest = min(quietest, share)
            if share > _COUNT_SHARE:
                continue
            draft.cutoff = cutoff
            model = loaded()
            if stability_check(model, motion_limits(model.config), None).verdict is Verdict.PASSED:
                return
    if quietest > _COUNT_SHARE:
        draft.remarks.append(
            f"gains: one count of the encoder changes a torque by {quietest:.0%} of what the guard lets through, even"
            f" at kp {kp:g}; the simulated arm's encoder may have to be finer (driver.encoder_resolution)"
        )
        return
    draft.remarks.append(f"gains: not stable at {RATE:g} Hz even at kp {kp:g}; see `ident config check`")


def _motions(draft: Draft, loaded: Callable[[], ArmModel]) -> None:
    """Choose the largest motions about home that keep limits and clearance, and in which every joint really moves."""
    found: list[tuple[float, float, float, tuple[int, int]]] = []
    for draft.frequency in _FREQUENCIES:
        try:
            _clear_motions(draft, loaded)
        except MotionRefused:
            if found:
                break
            raise
        paces = _joint_speeds(loaded())
        standstill = loaded().config.identification.reversal.speed
        moves = float((paces > standstill).mean(axis=1).min())
        found.append((moves, draft.frequency, draft.use, draft.seeds))
        if moves >= _MOVES:
            return
    moves, draft.frequency, draft.use, draft.seeds = max(found)
    # Half of the time each joint is faster than the median of its speeds.
    draft.standstill = short(0.5 * float(np.median(_joint_speeds(loaded()), axis=1).min()), 2)
    draft.remarks.append(
        f"identification.reversal.speed: {draft.standstill:g} rad/s or m/s; a joint with a small range is never fast"
    )


def _joint_speeds(model: ArmModel) -> Array:
    """Return speeds of every joint in each of both motions, shape (2 joints, samples)."""
    found = []
    for which in ("identification", "validation"):
        path = excitation(model, which, checked=False).path
        found.append(np.abs(path.at(np.linspace(0.0, path.duration, _PACES))[1]).T)
    return np.vstack(found)


def _clear_motions(draft: Draft, loaded: Callable[[], ArmModel]) -> None:
    refused: MotionRefused | None = None
    collision = CollisionModel(loaded())
    for use in _USES:
        draft.use, found = use, list[int]()
        for seed in _SEEDS:
            draft.seeds = (seed, seed)
            model = loaded()
            try:
                # A quick check of a few postures, before the whole path is verified.
                path = excitation(model, "identification", checked=False).path
                seen = collision.distances(path.at(np.linspace(0.0, path.duration, _GLANCES))[0])
                if seen.min(initial=np.inf) < _GLANCE * CLEARANCE:
                    raise MotionRefused(f"{collision.pairs[int(seen.min(axis=0).argmin())]} come too near")
                require_clear_from_home(model, excitation(model, "identification"))
            except MotionRefused as error:
                refused = error
                continue
            found.append(seed)
            if len(found) == 2:
                draft.seeds = (found[0], found[1])
                return
    raise MotionRefused(f"{draft.name}: no motion of {len(_SEEDS)} keeps its limits and clearance; the last: {refused}")


def _table(model: ArmModel, delta: Array) -> dict[str, float]:
    return {name: short(value, 7) for name, value in zip(model.layout.names, delta.tolist(), strict=True) if value}
