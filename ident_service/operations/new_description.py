"""Draft an arm's description from its URDF, with all that a simulated run needs, guessed where unknown.

Values of the URDF are taken over; missing ones are guessed cautiously, and marked as guesses in a comment. The
simulated arm differs from the prior: its links, drives and friction are drawn at random about it, so that identifying
it shows what identification does. Before anything is written, the description is loaded, and home and both motions are
checked to be clear; gains that are not stable are reported.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from ident_service.config.limits import motion_limits
from ident_service.config.load import load_arm
from ident_service.config.quantities import TextFile
from ident_service.config.workspace import BASE
from ident_service.errors import ModelError, MotionRefused, UsageError
from ident_service.excitation.plan import excitation
from ident_service.model.arm_model import ArmModel, arm_model, control_model
from ident_service.model.base import base_parameters, remarks_on_angles
from ident_service.model.chain import Array
from ident_service.model.collision import CollisionModel, share_touching
from ident_service.model.likely_bodies import drawn_about, likely_bodies, lines_of, with_urdf_bodies
from ident_service.model.mechanism import count_mechanism, read_mechanism
from ident_service.model.outline import mesh_capsules
from ident_service.model.rigid_body import InverseDynamics
from ident_service.motion.guard import TORQUE_RATE, TORQUE_RATE_SHARE
from ident_service.motion.preflight_check import Verdict
from ident_service.operations.commission import require_clear_from_home
from ident_service.operations.draft import CLEARANCE, ENCODER, LARGEST_USE, RATE, Draft, in_yaml, short
from ident_service.operations.urdf_says import Said, arm_part, said_of
from ident_service.preflight.static_checks import stability_check
from ident_service.recordings.files import write_atomically

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
    draft = Draft(called, urdf.name, arm_part(text, file.name, base, tip))
    with tempfile.TemporaryDirectory() as staging:
        trial = Path(staging) / "arm.yaml"
        shutil.copyfile(urdf, trial.with_name(urdf.name))

        def loaded() -> ArmModel:
            trial.write_text(in_yaml(draft), encoding="utf-8")
            return arm_model(load_arm(trial), bodies=False)  # what is none is guessed

        draft.remarks += _which(loaded(), draft)
        tell("joints and bodies")
        _joints(draft, loaded(), said_of(text))
        _bodies(draft, loaded, urdf.parent)
        tell("a posture to begin in")
        model = _home(draft, loaded)
        _drives(draft, model)
        tell("gains and motions")
        _gains(draft, loaded)
        _motions(draft, loaded)
        loaded()
    draft.remarks.append("workspace: nothing but the arm itself is kept clear of; add what stands around it")
    path.parent.mkdir(parents=True, exist_ok=True)
    if not beside.exists():
        write_atomically(beside, text)
    write_atomically(path, in_yaml(draft))
    return path, tuple(draft.remarks)


def _plain(name: str) -> str:
    found = "".join(letter if letter.isalnum() or letter in "_-" else "_" for letter in name).strip("_-")
    return found or "arm"


def _which(model: ArmModel, draft: Draft) -> list[str]:
    """Return a remark on which part of the URDF is the arm, where the file holds more."""
    file = model.config.kinematics.urdf
    if file is None or "tip" not in draft.part:
        return []
    held = read_mechanism(file, "urdf", model.config.kinematics).held
    ends = f"from {draft.part.get('base', 'the root')} to {draft.part['tip']}, {model.chain.joints} joints"
    more = f"; held: {', '.join(list(held)[:8])}{' ...' if len(held) > 8 else ''}" if held else ""
    return [f"the arm: {ends}{more} (--base and --tip say otherwise)"]


def _joints(draft: Draft, model: ArmModel, said: Mapping[str, Said]) -> None:
    """Set the limits of every joint: the URDF's, else guesses; torque limits that can hold the arm."""
    chain = model.chain
    likely = likely_bodies(with_urdf_bodies(model))
    if likely.guessed:
        draft.prior = _table(model, likely.delta)
        draft.remarks.append(
            f"bodies of {', '.join(likely.guessed)}: rods; the URDF's have no mass, or an inertia that no body has"
        )
    model = replace(model, prior=likely.delta)
    masses = [float(likely.delta[model.layout.inertial(link)][-1]) for link in range(chain.joints)]
    draft.total_mass = short(2.0 * sum(masses), 3)
    if remarks_on_angles(base_parameters(model.chain, model.layout)):
        draft.part["snap"] = True
        draft.remarks.append(
            "kinematics: the URDF's angles are rounded multiples of 15 degrees; they are taken for exact"
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
        turns, one = chain.revolute[k], said.get(name, Said(None, None, None))
        velocity = one.velocity or _VELOCITY[turns]
        acceleration = velocity / _SECONDS
        torque = one.effort or _HEAVY * (gravity[k] + 2.0 * inertia[k] * acceleration)
        if torque < _HEAVY * gravity[k]:
            holds = "cannot hold" if torque < gravity[k] else "hardly holds"
            draft.remarks.append(
                f"{name}: its effort limit of {torque:g} {holds} the arm, which asks for {gravity[k]:.3g}"
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
            draft.remarks.append(f"{name}: {', '.join(missing)} limit guessed; the URDF has none that could be meant")
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
        delta[place] = drawn_about(prior[place], rng)
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
        paces = _paces(loaded())
        standstill = loaded().config.identification.reversal.speed
        moves = float((paces > standstill).mean(axis=1).min())
        found.append((moves, draft.frequency, draft.use, draft.seeds))
        if moves >= _MOVES:
            return
    moves, draft.frequency, draft.use, draft.seeds = max(found)
    # Half of the time each joint is faster than the median of its speeds.
    draft.standstill = short(0.5 * float(np.median(_paces(loaded()), axis=1).min()), 2)
    draft.remarks.append(
        f"identification.reversal.speed: {draft.standstill:g} rad/s or m/s; a joint with little room is never fast"
    )


def _paces(model: ArmModel) -> Array:
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
