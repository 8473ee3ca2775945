"""Write a first description of an arm from its URDF, MJCF or DH table, complete enough to simulate.

Values of the file are taken over; missing ones are guessed cautiously, and marked as guesses beside each. The
simulated arm differs from the prior: its links, drives and friction are drawn at random about it, so that identifying
it shows what identification does. Before anything is written, the description is loaded, and home and both motions are
checked to be clear; gains that are not stable are reported.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ident_service.config.kinematics import angles_barely_rounded
from ident_service.config.load import load_arm
from ident_service.config.motion_design import BASE, Capsule
from ident_service.config.motion_limits import motion_limits
from ident_service.config.quantities import TextFile
from ident_service.config.yaml_source import MODELINE, SCHEMA, arm_schema_file
from ident_service.errors import ModelError, MotionRefused, UsageError
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import ArmModel, arm_model, control_model
from ident_service.model.base_parameters import base_parameters, remarks_on_angles
from ident_service.model.chain import Array
from ident_service.model.collision import CollisionModel, shares_touching
from ident_service.model.likely_bodies import likely_bodies, link_rods, perturbed_body, with_file_bodies
from ident_service.model.mechanism import read_mechanism
from ident_service.model.outline import FileLimits, Source, arm_capsules, arm_part, read_source
from ident_service.model.pinocchio_models import InverseDynamics
from ident_service.model.xml_elements import parse_xml
from ident_service.motion.safety_monitor import TORQUE_RATE, TORQUE_RATE_SHARE
from ident_service.operations.commissioning import require_clear_from_home
from ident_service.preflight.stability import LEAST_GAIN_MARGIN, delay_of, stability
from ident_service.recordings.files import write_atomically
from ident_service.results.manifest import require_writable_place

RATE = 500.0  # Hz, at which most arms' gains are stable and a simulation is quick
CLEARANCE = 0.02  # m
FRICTION_GUESS = 0.04  # of the torque limits, what the description expects
ENCODER = 2e-5  # rad or m, of the simulated arm
_DRAFT_SECONDS = 20.0  # of a motion
LARGEST_USE = 0.6  # share of the limits of the first motion that is tried


_DOWN = (0.0, 0.0, -9.81)  # m/s^2


@dataclass
class Draft:
    """Decided content of a description, to be written as YAML.

    Attributes:
        name: of the arm.
        source: name of the file that it is made from.
        part: the keys of its kinematics.
        gravity: gravity in the base frame [m/s^2].
        gravity_origin: origin of that gravity, in words.
        joints: keys of each joint.
        origins: origins of the values of each joint's keys.
        geometry: capsules of links whose meshes are replaced.
        may_touch: pairs that always touch.
        prior: names and values where the file's bodies are not those of real links; empty where they are.
        use: share of the limits that the motions take.
        seeds: seeds of the two motions.
        frequency: frequency of the two motions [Hz].
        cutoff: cut-off of the velocity's low-pass of each joint [Hz].
        encoder: resolution of the simulated arm's encoders [rad or m], of each joint.
        standstill: speed below which a joint counts as standing [rad/s or m/s]; 0 for what is usual.
        total_mass: largest total mass of the arm [kg].
        truth: true parameters of the simulated arm.
        remarks: what was guessed, for people.
    """

    name: str
    source: str
    part: dict[str, Any]
    gravity: list[float] = field(default_factory=lambda: [*_DOWN])
    gravity_origin: str = "the base stands upright"
    joints: dict[str, dict[str, Any]] = field(default_factory=dict)
    origins: dict[str, dict[str, str]] = field(default_factory=dict)
    geometry: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    may_touch: list[tuple[str, str]] = field(default_factory=list)
    prior: dict[str, float] = field(default_factory=dict)
    use: float = LARGEST_USE
    seeds: tuple[int, int] = (1, 2)
    frequency: float = 0.1
    cutoff: list[float] = field(default_factory=list)
    encoder: list[float] = field(default_factory=list)
    standstill: float = 0.0
    total_mass: float = 0.0
    truth: dict[str, float] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)


def round_significant(value: float, significant_digits: int = 4) -> float:
    """Round a number to some significant digits."""
    return float(f"{value:.{significant_digits}g}")


_UNITS = {
    "position": "rad", "velocity": "rad/s", "acceleration": "rad/s^2", "jerk": "rad/s^3", "torque": "N m",
    "following_error": "rad", "home": "rad", "kp": "1/s^2", "kd": "1/s", "drive_inertia": "kg m^2",
}  # fmt: skip
_SLIDE_UNITS = {
    "position": "m", "velocity": "m/s", "acceleration": "m/s^2", "jerk": "m/s^3", "torque": "N",
    "following_error": "m", "home": "m", "kp": "1/s^2", "kd": "1/s", "drive_inertia": "kg",
}  # fmt: skip


def description_yaml(draft: Draft, revolute: Mapping[str, bool] | None = None) -> str:
    """Return the description as YAML with comments.

    Args:
        draft: content of the description.
        revolute: whether each joint is revolute, by name; all are when None.
    """
    guessed = "\n".join(f"#   {line}" for line in draft.remarks)
    parts = [
        f"""\
{MODELINE}
# {draft.name}, begun by `ident new` from {draft.source}. Check it before a real arm moves with it.
# Guessed or chosen:
{guessed}
format: ident-arm
version: 1
name: {_flow(draft.name)}

{_kinematics(draft.part)}

gravity: {_flow(draft.gravity)} # m/s^2 in the base frame; {draft.gravity_origin}
terms: [drive_inertia, viscous, coulomb, offset]
"""
    ]
    if draft.joints:
        rows = ["joints:"]
        for name, keys in draft.joints.items():
            units, origins = _UNITS if (revolute or {}).get(name, True) else _SLIDE_UNITS, draft.origins.get(name, {})
            rows.append(f"  {_flow(name)}:")
            for key, value in keys.items():
                rows.append(f"    {key}: {_flow(value)} # {units[key]}; {origins.get(key, 'guessed')}")
        parts.append("\n".join([*rows, ""]))
    if draft.prior:
        parts.append(f"prior: # SI units, in the link frames; guessed ones are listed above\n  {_flow(draft.prior)}\n")
    if draft.total_mass:
        parts.append(f"constraints: {{total_mass: {{upper: {draft.total_mass:g}}}}} # kg, twice what its links have\n")
    cutoff = _common(draft.cutoff)
    filtered = "" if cutoff in ([], 30.0) else f", velocity_cutoff: {_flow(cutoff)}"
    parts.append(
        f"control: {{rate: {RATE:g}{filtered}, after_stop: brake}} # Hz\n"
        "# After a stop drives are switched off: simulated ones are taken to have brakes. Of a real arm say at\n"
        "# each joint `brake: true` or `brake: false`; one without brakes has `after_stop: hold` above.\n"
    )
    if draft.geometry:
        rows = [f"  {_flow(name)}: {_flow(each)}\n" for name, each in draft.geometry.items()]
        parts.append(f"geometry: # m, in the link frames; around the file's meshes\n{''.join(rows)}")
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
    parts.append(
        f"motions: # Hz; shares of the limits\n  identification: {_flow(first)}\n  validation: {_flow(second)}\n"
    )
    torque = [keys["torque"] for keys in draft.joints.values()]
    noise, step = ([round_significant(share * value, 2) for value in torque] for share in (2e-3, 2e-4))
    driver = {
        "kind": ("simulated", "real arms: canopen, barrett or your own (docs/drivers.md)"),
        "time": ("virtual", "as fast as it can; `real` keeps the clock"),
        "seed": (1, "of the noise"),
        "truth": (draft.truth, "SI units; what identification should find, and the arm's model does not know"),
        "encoder_resolution": (_common(draft.encoder) or ENCODER, "rad or m at the joints"),
        "torque_resolution": (step, "N m or N at the joints"),
        "torque_noise": (noise, "N m or N, standard deviation in each cycle"),
        "delay_cycles": (1, "from a sample to its torque"),
    }
    rows = [f"  {key}: {_flow(value)} # {said}\n" for key, (value, said) in driver.items() if value]
    parts.append(
        f"driver: # a simulated arm whose links, drives and friction are drawn about the prior's\n{''.join(rows)}"
    )
    return "\n".join(parts)


def _kinematics(part: Mapping[str, Any]) -> str:
    if (table := part.get("dh")) is None:
        return f"kinematics: {_flow(part)}"
    rows = "".join(f"\n      {_flow(name)}: {_flow(row)}" for name, row in table["joints"].items())
    return f"kinematics:\n  dh:\n    convention: {table['convention']}\n    joints: # rad, m{rows}"


def _common(values: list[float]) -> list[float] | float:
    """Return one number where all joints have the same."""
    return values[0] if values and len(set(values)) == 1 else values


def _flow(value: Any) -> str:
    """Return a value in YAML's flow style on one line."""
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10**6).strip()
    return text.removesuffix("\n...").removesuffix("...").strip()


_MOST_TURNS = 8.0 * np.pi  # rad; a larger range is taken for degrees
_TURN, _SLIDE = 3.14, 0.5  # rad and m either way, of joints without limits
_VELOCITY = {True: 2.0, False: 0.3}  # rad/s, m/s
_PLACEHOLDER = 5.0  # times the largest torque that any joint needs, at all joints alike: no maker's number
_WRIST = 0.05  # least guess of a torque limit, of the largest of any joint
_SLOWEST_REVERSAL = 0.5  # s that friction may take to reverse at the torque rate that the guard lets through
_SECONDS = 0.25  # s in which a joint reaches its velocity limit at its acceleration limit
_FOLLOWS = {True: 0.2, False: 0.05}  # rad, m
_GAINS = ((400.0, 40.0), (225.0, 30.0), (100.0, 20.0), (49.0, 14.0))  # all of damping 1
_LIGHT = 0.3  # share of the torque limits that holding the home posture may take
_ROOM = (3.0, 2.0, 1.5)  # distance from itself of a posture to begin in, in clearances
_HEAVY = 1.5  # smallest torque limit in units of the largest gravity torque
_FRICTION = 0.03  # of the torque limit, Coulomb, and viscous at the velocity limit
_DRIVE = 0.02  # s in which a geared drive alone would reach its velocity limit with its torque limit
_RATE_SHARE = 0.15  # share of the guard's torque-rate limit that a motion's jerk may use
_POSTURES, _SEED = 300, 20140101
_COUNT_SHARE = 0.4  # of the torque rate that the guard lets through, that one count of the encoder may make
_CUTOFFS = (30.0, 20.0, 15.0, 10.0)  # Hz, of the velocity's low-pass: slow where a count makes much torque
_FINEST_ENCODER = 5e-7  # rad or m; 23 bits of a turn
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
    source: Path,
    description_file: Path | None = None,
    name: str | None = None,
    base_link: str | None = None,
    tip_link: str | None = None,
    tell: Callable[[str], None] = lambda _: None,
    convention: str | None = None,
) -> tuple[Path, tuple[str, ...]]:
    """Write an arm's description begun from a URDF, MJCF or DH table, a copy and the schema; return (path, guesses).

    Args:
        source: a URDF, an MJCF, or a DH table as CSV or YAML.
        description_file: path of the new description; `NAME.yaml` in the present folder when None.
        name: name of the arm; that of the file when None.
        base_link: link that the arm stands on; found when None.
        tip_link: link that it ends at; before the gripper of the longest branch when None.
        tell: called with a line at each step.
        convention: convention of a DH table that does not name its own, `standard` or `modified`.

    Raises:
        UsageError: no such file, or something is there where it would be written.
        ModelError: not a file that holds an arm.
        ConfigError: mistakes in a DH table.
        MotionRefused: no posture or motion is free of collisions, or none can be held.
    """
    read = read_source(source, convention)
    if read.kind == "dh" and (base_link or tip_link):
        raise UsageError(f"{source}: --base and --tip are of URDF and MJCF; a DH table lists the joints that move")
    if read.kind != "dh" and convention is not None:
        raise UsageError(f"{source}: --convention is of DH tables; a URDF or MJCF says where its frames are")
    called = _plain(source.stem if name is None else name)
    path = Path(f"{called}.yaml") if description_file is None else description_file
    if path.exists() and path.samefile(source):
        path = path.with_name(f"{path.stem}-arm.yaml")
    beside = None if read.kind == "dh" else path.parent / source.name
    require_writable_place(path.parent)
    if path.exists():
        raise UsageError(f"{path}: {'is a folder' if path.is_dir() else 'exists already'}; give another file by --out")
    if beside is not None and beside.exists() and beside.read_bytes() != source.read_bytes():
        raise UsageError(f"{beside}: exists already, and differs from {source}; give --out a file in another folder")
    part: dict[str, Any] = (
        {read.kind: source.name, **arm_part(read.outline, source.name, base_link, tip_link)} if beside else {}
    )
    if read.table is not None:
        part = {"dh": read.table.model_dump(mode="json")}
    draft = Draft(called, source.name, part)
    with tempfile.TemporaryDirectory() as staging:
        trial = Path(staging) / "arm.yaml"
        if beside is not None:
            shutil.copyfile(source, trial.with_name(source.name))

        def loaded() -> ArmModel:
            trial.write_text(description_yaml(draft), encoding="utf-8")
            return arm_model(load_arm(trial), require_masses=False)  # what is none is guessed

        draft.remarks += _part_remark(loaded(), draft)
        _gravity(draft, loaded())
        tell("joints and bodies")
        _joints(draft, loaded(), read.limits)
        _bodies(draft, loaded, read)
        tell("a posture to begin in")
        model = _home(draft, loaded)
        _drives(draft, model)
        tell("gains and motions")
        _gains(draft, loaded)
        _motions(draft, loaded)
        model = loaded()
    draft.remarks += _always_guessed(draft)
    path.parent.mkdir(parents=True, exist_ok=True)
    if beside is not None and not beside.exists():
        write_atomically(beside, read.text)
    if not (schema := path.parent / SCHEMA).exists():
        write_atomically(schema, arm_schema_file().read_text(encoding="utf-8"))
    write_atomically(path, description_yaml(draft, dict(zip(model.chain.names, model.chain.revolute, strict=True))))
    return path, tuple(draft.remarks)


def _always_guessed(draft: Draft) -> list[str]:
    """Return remarks on what no file says."""
    pairs = sorted({(joint["kp"], joint["kd"]) for joint in draft.joints.values()}, reverse=True)
    gains = " and ".join(f"kp {kp:g} with kd {kd:g}" for kp, kd in pairs)
    mass = f"constraints.total_mass: at most {draft.total_mass:g} kg, twice what the links have"
    return [
        f"gravity: {draft.gravity_origin}" if draft.gravity == [*_DOWN] else _said_gravity(draft),
        "terms: each joint has drive inertia, viscous and Coulomb friction, and an offset",
        "joints: acceleration, jerk and following_error from the velocity and torque limits; drive_inertia from them, "
        f"too; gains, {gains}, for the simulated arm; home, where the arm is clear of itself",
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
    """Return a remark on which part of the file is the arm, where it holds more."""
    kinematics = model.config.kinematics
    file = kinematics.urdf or kinematics.mjcf
    if file is None or "tip" not in draft.part:
        return []
    held = read_mechanism(file, "mjcf" if kinematics.urdf is None else "urdf", kinematics).held
    ends = f"from {draft.part.get('base', 'the root')} to {draft.part['tip']}, {model.chain.joints} joints"
    more = f"; held: {', '.join(list(held)[:8])}{' ...' if len(held) > 8 else ''}" if held else ""
    return [f"the arm: {ends}{more} (change it with --base and --tip)"]


def _gravity(draft: Draft, model: ArmModel) -> None:
    """Set gravity in the base frame: an MJCF's, or downwards in the frame of a URDF's root."""
    kinematics = model.config.kinematics
    file = kinematics.urdf or kinematics.mjcf
    if file is None:
        return
    of_mjcf = kinematics.mjcf is not None
    gravity = read_mechanism(file, "mjcf" if of_mjcf else "urdf", kinematics).gravity
    if of_mjcf:
        draft.gravity_origin += f", as in {draft.source}"
    if not np.allclose(gravity, _DOWN, rtol=0.0, atol=1e-9):
        draft.gravity = [round(float(value), 9) + 0.0 for value in gravity]
        draft.gravity_origin = f"of {draft.source}" if of_mjcf else f"the root of {draft.source} stands upright"


def _said_gravity(draft: Draft) -> str:
    return (
        f"gravity: {' '.join(f'{value:g}' for value in draft.gravity)} m/s^2 in the base frame; {draft.gravity_origin}"
    )


def _joint_angles(urdf: TextFile) -> Iterator[float]:
    """Yield the angles [rad] of the joints' frames of a URDF that was read."""
    for origin in parse_xml(urdf.text).iterfind("joint/origin"):
        yield from (float(angle) for angle in origin.get("rpy", "").split())


def _joints(draft: Draft, model: ArmModel, file_limits: Mapping[str, FileLimits]) -> None:
    """Set the limits of every joint: the file's, else guesses; torque limits that can hold the arm."""
    chain = model.chain
    likely = likely_bodies(with_file_bodies(model))
    if likely.guessed:
        draft.prior = _named(model, likely.delta)
        why = (
            "a DH table has none"
            if model.config.kinematics.dh
            else "the file's have no mass, that of a mesh, or an unphysical inertia"
        )
        draft.remarks.append(f"bodies of {', '.join(likely.guessed)}: rods; {why}")
    model = replace(model, prior=likely.delta)
    masses = [float(likely.delta[model.layout.inertial(link)][-1]) for link in range(chain.joints)]
    draft.total_mass = round_significant(2.0 * sum(masses), 3)
    urdf = model.config.kinematics.urdf
    if urdf is not None and (
        angles_barely_rounded(_joint_angles(urdf)) or remarks_on_angles(base_parameters(chain, model.layout))
    ):
        draft.part["snap"] = True
        draft.remarks.append(
            "kinematics: the URDF's angles are rounded multiples of 15 degrees; they are taken as exact"
        )
    known = [file_limits.get(name, FileLimits()) for name in chain.names]
    ranges = [
        one.position or ((-_TURN, _TURN) if turns else (-_SLIDE, _SLIDE))
        for one, turns in zip(known, chain.revolute, strict=True)
    ]
    for name, (low, high), turns in zip(chain.names, ranges, chain.revolute, strict=True):
        if turns and high - low > _MOST_TURNS:
            raise ModelError(f"{draft.source}: {name} turns from {low:g} to {high:g} rad: its limits are to be radians")
    gravity, inertia = _worst(model, ranges)
    velocity = np.array(
        [one.velocity or _VELOCITY[turns] for one, turns in zip(known, chain.revolute, strict=True)], dtype=float
    )
    needed = _HEAVY * (gravity + 2.0 * inertia * velocity / _SECONDS)
    # Wrists carry little beside their own drives: no maker's is so much weaker than the shoulder.
    turning = np.array(chain.revolute)
    strongest = float(needed[turning].max(initial=0.0))
    needed = np.where(turning, np.maximum(needed, _WRIST * strongest), needed)
    efforts = {one.effort for one in known}
    placeholder = len(efforts) == 1 and chain.joints > 1 and (efforts.pop() or 0.0) > _PLACEHOLDER * needed.max()
    if placeholder:
        draft.remarks.append(
            f"torque limits: guessed; {known[0].effort:g} at every joint of the file is more than {_PLACEHOLDER:g}"
            f" times what any of them needs ({needed.max():.3g})"
        )
    armature = _armature(model)
    lacking: dict[str, list[str]] = {}
    for k, name in enumerate(chain.names):
        turns, one = chain.revolute[k], known[k]
        effort = None if placeholder else one.effort
        acceleration = velocity[k] / _SECONDS
        torque = effort or needed[k]
        if torque < _HEAVY * gravity[k]:
            holds = "cannot hold" if torque < gravity[k] else "hardly holds"
            draft.remarks.append(
                f"{name}: its effort limit of {torque:g} {holds} the arm, which needs {gravity[k]:.3g}"
            )
        drive = armature[k] or _DRIVE * torque / velocity[k]
        acceleration = min(acceleration, max(0.3 * torque / (inertia[k] + drive), 0.1 * velocity[k] / _SECONDS))
        rate = min(TORQUE_RATE, TORQUE_RATE_SHARE * torque)
        if (reversal := 2.0 * _FRICTION * torque / rate) > _SLOWEST_REVERSAL:
            raise MotionRefused(
                f"{draft.name}: {name} has a torque limit of {torque:.4g} by its {'file' if effort else 'masses'}:"
                f" friction alone would take {reversal:.1f} s to reverse, because no torque may change faster than"
                f" {rate:g} per second; is the file in metres, radians and kilograms? Arms of this size cannot be moved"
            )
        jerk = min(10.0 * acceleration, _RATE_SHARE * rate / (inertia[k] + drive))
        given = {"position": one.position, "velocity": one.velocity, "torque": effort}
        if missing := [key for key, value in given.items() if value is None and not (placeholder and key == "torque")]:
            lacking.setdefault(", ".join(missing), []).append(name)
        draft.joints[name] = {
            # The file's exact values: a rounded limit may be wider than the arm's.
            "position": list(ranges[k]),
            "velocity": float(velocity[k]),
            "acceleration": round_significant(acceleration),
            "jerk": round_significant(jerk),
            "torque": float(torque) if effort else round_significant(torque),
            "following_error": _FOLLOWS[turns],
            "home": min(max(0.0, ranges[k][0]), ranges[k][1]),
            "kp": _GAINS[0][0],
            "kd": _GAINS[0][1],
            "drive_inertia": round_significant(drive, 3),
        }
        none = {"torque": "guessed: the file's is of no drive"} if placeholder else {}
        draft.origins[name] = {
            key: f"of {draft.source}" if value is not None else none.get(key, "guessed: the file has none")
            for key, value in given.items()
        } | {
            "acceleration": f"guessed: {velocity[k] / acceleration:.2g} s to full speed",
            "jerk": "guessed: slow enough for the torque's rate",
            "following_error": "guessed: a motion is stopped beyond it",
            "home": "chosen: clear of itself and light to hold",
            "drive_inertia": f"of {draft.source}" if armature[k] else "guessed: of a geared drive",
        }
    draft.remarks += [
        f"{', '.join(names)}: {keys} limit guessed; the file has none, or an implausible one"
        for keys, names in lacking.items()
    ]


def _armature(model: ArmModel) -> list[float]:
    """Return the drive inertia that an MJCF states for each joint [kg m^2 or kg]; 0 where none is stated."""
    kinematics = model.config.kinematics
    if kinematics.mjcf is None:
        return [0.0] * model.chain.joints
    return [float(value) for value in read_mechanism(kinematics.mjcf, "mjcf", kinematics).armature]


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


def _guessed_capsules(model: ArmModel, link: int) -> list[Capsule]:
    """Return capsules of a link whose mesh cannot be read; of the last one as far as its body or its tool reaches."""
    found = list(link_rods(model, link))
    kinematics = model.config.kinematics
    if len(found) != 1 or found[0].start != found[0].end or kinematics.urdf is None:
        return found
    mechanism = read_mechanism(kinematics.urdf, "urdf", kinematics)
    joint = mechanism.names.index(model.chain.names[link])
    body = mechanism.bodies[joint]
    # Links that are fixed to it, and as much behind its centre of mass as before it.
    ends = [place for carrier, _, place in mechanism.frames.values() if carrier == joint]
    ends += [2.0 * body[6:9] / body[9]] if body[9] > 0.0 else []
    end = max(ends, key=lambda one: float(np.linalg.norm(one)), default=np.zeros(3))
    return [found[0].model_copy(update={"end": tuple(np.round(end, 4).tolist())})]


def _bodies(draft: Draft, loaded: Callable[[], ArmModel], read: Source) -> None:
    """Set capsules in place of meshes, and list the pairs of links that touch in most postures."""
    model = loaded()
    chain = model.chain
    capsules, unread = arm_capsules(read.outline, model.config.kinematics, chain)
    for owner in unread:
        if owner not in capsules:
            capsules[owner] = _guessed_capsules(model, chain.names.index(owner)) if owner != BASE else []
    if read.kind == "dh" or not (capsules or draft.part.get("urdf")):
        capsules = {name: list(link_rods(model, link)) for link, name in enumerate(chain.names)}
        draft.remarks.append("geometry: rods along the links, because the file has none")
    draft.geometry = {
        owner: [one.model_dump(by_alias=True, mode="json") for one in found]
        for owner, found in capsules.items()
        if found or owner in unread  # none instead of the mesh
    }
    if unread:
        draft.remarks.append(
            f"geometry: a mesh of {', '.join(unread)} could not be read; capsules are guessed where none of a link was,"
            " and the base has none then"
        )
    model = loaded()
    inner = (BASE, *chain.names)
    for (moving, other), share in shares_touching(model, 2.0 * CLEARANCE, _POSTURES, _SEED).items():
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
    # With most room first, and light before heavy: the first posture of those, or the lightest.
    for room, most in ((room, most) for most in (_LIGHT, 1.0 / _HEAVY, np.inf) for room in _ROOM):
        good = (free >= room * CLEARANCE) & (held <= most)
        if good.any():
            place = int(np.argmax(good)) if most == _LIGHT else int(np.argmin(np.where(good, held, np.inf)))
            break
    else:
        place = int(np.argmax(free))
    if not free[place] > CLEARANCE:
        pair = collision.pairs[int(np.argmin(distances[place]))]
        raise MotionRefused(
            f"{draft.name}: none of {len(postures)} postures is clear of itself ({pair} come nearest); is the file in"
            " metres and radians? If a large part stands beside the arm, begin with the arm's own --base"
        )
    if not held[place] <= 1.0 / _HEAVY:
        torque = np.abs(dynamics.torque(postures[place], still, still))
        weak = int(np.argmax(torque / limits.torque))
        raise MotionRefused(
            f"{draft.name}: of {len(postures)} postures none that is clear can be held: {list(draft.joints)[weak]} has"
            f" a limit of {limits.torque[weak]:g}, and the lightest needs {torque[weak]:.3g}; give it the effort that"
            " the drive has, and is the file in metres and kilograms?"
        )
    for name, value in zip(draft.joints, postures[place], strict=True):
        draft.joints[name]["home"] = round_significant(float(value), 3)
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
    draft.truth = _named(model, delta)


def _gains(draft: Draft, loaded: Callable[[], ArmModel]) -> None:
    """Choose each joint's stiffest gains that are stable, and by which a count of the encoder makes no jump of torque.

    The loop of a joint with mass matrix M_kk has the stiffness M_kk kp, so what a count does follows from the prior's
    largest inertia; where even the softest gains make too much of it, the simulated encoder is a finer one.
    """
    draft.cutoff, draft.encoder = [_CUTOFFS[0]] * len(draft.joints), [ENCODER] * len(draft.joints)
    model = loaded()
    limits = motion_limits(model.config)
    inertia = _worst(control_model(model), list(zip(limits.lower.tolist(), limits.upper.tolist(), strict=True)))[1]
    rate = np.minimum(TORQUE_RATE, TORQUE_RATE_SHARE * limits.torque)

    def allowed(kp: float, kd: float, cutoff: float) -> Array:
        """Return the counts of the encoder that jump no more than a share of the rate, by K_p and low-passed K_d."""
        passed = (1.0 - np.exp(-2.0 * np.pi * cutoff / RATE)) * RATE
        return np.asarray(_COUNT_SHARE * rate / (inertia * (kp + kd * passed) * RATE))

    every = [(kp, kd, cutoff) for kp, kd in _GAINS for cutoff in _CUTOFFS]
    fitting = [[one for one in every if allowed(*one)[k] >= ENCODER] or [every[-1]] for k in range(len(inertia))]
    while True:
        for k, joint in enumerate(draft.joints.values()):
            kp, kd, draft.cutoff[k] = fitting[k][0]
            joint.update(kp=kp, kd=kd)
            finest = max(float(allowed(*fitting[k][0])[k]), _FINEST_ENCODER)
            draft.encoder[k] = min(ENCODER, round_significant(finest, 2))
        model = loaded()
        report = stability(model, motion_limits(model.config), delay_of(model.config))
        if report.stable:
            break
        bad = [not one.radius < 1.0 or one.gain_margin < LEAST_GAIN_MARGIN for one in report.joints]
        # Joints that are stable by themselves and not together all become softer.
        softer = [k for k, found in enumerate(fitting) if (bad[k] or not any(bad)) and len(found) > 1]
        if not softer:
            said = "; ".join(report.objections())
            draft.remarks.append(f"gains: not stable at {RATE:g} Hz even so soft; see `ident config check`: {said}")
            break
        for k in softer:
            fitting[k] = fitting[k][1:]
    home = np.diag(InverseDynamics(model.chain, model.layout, _prior(control_model(model))).mass_matrix(limits.home))
    for k, (name, joint) in enumerate(draft.joints.items()):
        unit = "N m/rad" if model.chain.revolute[k] else "N/m"
        draft.origins[name] |= {
            "kp": f"chosen: stable; {round_significant(joint['kp'] * home[k], 3):g} {unit} with the inertia at home",
            "kd": "chosen: critically damped",
        }
    if finer := [name for name, one in zip(draft.joints, draft.encoder, strict=True) if one < ENCODER]:
        draft.remarks.append(
            f"driver.encoder_resolution: finer at {', '.join(finer)}: a count of {ENCODER:g} would jump the torque by"
            " more than the guard lets through"
        )


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
    draft.standstill = round_significant(0.5 * float(np.median(_joint_speeds(loaded()), axis=1).min()), 2)
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


def _named(model: ArmModel, delta: Array) -> dict[str, float]:
    return {
        name: round_significant(value, 7)
        for name, value in zip(model.layout.names, delta.tolist(), strict=True)
        if value
    }
