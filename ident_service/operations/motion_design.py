"""Design a motion for an arm and keep everything in one folder: motion, search, preview, drawings."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from ident_service.config.load import load_arm
from ident_service.config.motion_design import Design
from ident_service.config.motion_limits import motion_limits
from ident_service.errors import Stopped, UsageError, plain_mistake
from ident_service.estimation.equations import equations
from ident_service.excitation.described_motion import excitation
from ident_service.excitation.design import Designed, complete_task, design_motion, motion_family
from ident_service.excitation.motion_file import Excitation, read_excitation
from ident_service.excitation.prediction import NoiseModel, described_noise
from ident_service.excitation.search import Budget, Progress, read_search, search_to_json
from ident_service.excitation.trajectory import FourierPath
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.base_parameters import BaseParameters
from ident_service.model.chain import Array
from ident_service.model.information import Information
from ident_service.model.regressor import joint_regressor
from ident_service.motion.clearance import motion_stop_contact
from ident_service.operations.arm_pictures import postures
from ident_service.operations.motion_preview import Preview, preview, preview_document, preview_text, recorded_noise
from ident_service.operations.recordings import open_together
from ident_service.preflight.stability import delay_of, stability
from ident_service.recordings.adapters import overlap
from ident_service.results.manifest import atomic_folder, require_writable_place, write_atomically
from ident_service.results.motion_figures import MotionTraces, joints_over_time
from ident_service.results.parameter_file import read_parameters
from ident_service.results.posture_figure import Closest, Postures, stick_figure

DRAWINGS = ("joints.svg", "arm.svg")
_SAMPLES, _POSTURES = 6000, 400


def drawings(seen: Preview) -> dict[str, str]:
    """Draw a preview, joints over time and postures; return the SVG texts by file name."""
    name = f"{seen.excitation.name} motion of {seen.model.config.name}"
    pictures = (joints_over_time(_traces(seen), name), stick_figure(_postures(seen), name))
    return dict(zip(DRAWINGS, pictures, strict=True))


def _traces(seen: Preview) -> MotionTraces:
    path, model, limits = seen.excitation.path, seen.model, seen.limits
    time = np.linspace(0.0, path.duration, _SAMPLES)
    q, dq, ddq, _ = path.at(time)
    torque: Array | None = None
    if model.prior is not None:
        torque = np.einsum("jps,p->sj", joint_regressor(model.chain, model.layout, q, dq, ddq), model.prior)
    ramps: tuple[tuple[float, float], ...] = ()
    if isinstance(path, FourierPath) and path.ramp:
        ramps = ((0.0, path.ramp), (path.duration - path.ramp, path.duration))
    return MotionTraces(
        names=model.chain.names,
        time=time,
        position=q,
        velocity=dq,
        acceleration=ddq,
        torque=torque,
        lower=limits.lower,
        upper=limits.upper,
        velocity_limit=limits.velocity,
        acceleration_limit=limits.acceleration,
        torque_limit=limits.torque,
        units=tuple("rad" if turns else "m" for turns in model.chain.revolute),
        ramps=ramps,
    )


def _postures(seen: Preview) -> Postures:
    path, nearest = seen.excitation.path, seen.proof.clearance
    time = np.linspace(0.0, path.distinct[-2 if len(path.distinct) > 2 else -1][1], _POSTURES)
    if nearest is None or nearest.pair is None or nearest.time is None:
        return postures(seen.model, path, time)
    time = np.unique(np.append(time, nearest.time))
    first, _, second = nearest.pair.partition(" - ")
    closest = Closest(int(np.searchsorted(time, nearest.time)), (first, second), nearest.sampled)
    return postures(seen.model, path, time, closest)


MOTION, SEARCH, PREVIEW, DOCUMENT = "motion.json", "search.json", "preview.txt", "preview.json"
FILES = (MOTION, SEARCH, PREVIEW, DOCUMENT, *DRAWINGS)


@dataclass(frozen=True)
class PriorData:
    """Data about an arm beside its description: identified parameters, noise, recordings.

    Attributes:
        parameters: a parameter file whose link parameters predict the torques, instead of the prior.
        noise: a parameter file of an earlier identification, whose residuals are the noise to be expected.
        recordings: recordings whose information the new motion adds to.
    """

    parameters: Path | None = None
    noise: Path | None = None
    recordings: tuple[Path, ...] = ()


# Keys of `design` that say nothing about a motion of each kind.
_OF_OTHERS = {
    "fourier": frozenset({"postures", "way", "dwell"}),
    "postures": frozenset({"base_frequency", "harmonics", "periods", "ramp"}),
}


@dataclass(frozen=True)
class DesignRequest:
    """Request to design a motion.

    Attributes:
        arm: description file, or the name of a shipped one.
        changes: keys of the description's `design` section that shall be others.
        knowledge: data beside the description.
        seed: of the random starts.
        budget: of the search.
        resume: a search to go on from.
        length: length of the motion [s]; that of the description's frequency and periods when None.
    """

    arm: str
    changes: dict[str, Any] = field(default_factory=dict)
    knowledge: PriorData = PriorData()
    seed: int = 0
    budget: Budget = field(default_factory=Budget)
    resume: Path | None = None
    length: float | None = None


def design_files(
    request: DesignRequest,
    folder: Path,
    tell: Callable[[Progress], None] = lambda _: None,
    cancelled: Callable[[], bool] = lambda: False,
) -> tuple[Designed, Preview]:
    """Search for a motion until done or cancelled; write the best, the search and a preview; return (motion, preview).

    Args:
        request: description, data and options.
        folder: folder of the files; others in it stay.
        tell: called from time to time.
        cancelled: True ends the search with what it has.

    Raises:
        Stopped: it was cancelled before it had found a motion that teaches anything; nothing is written.
        UsageError, ConfigError: the request or the description is not valid.
        MotionRefused: limits that contradict each other, home in collision, no posture that keeps them.
        RecordingError, ParameterError: a file of the knowledge cannot be used.
    """
    require_writable_place(folder)
    if (folder / MOTION).exists():
        raise UsageError(f"{folder / MOTION}: exists already; give another folder")
    model = known_model(request.arm, request.knowledge)
    design = _changed(model.config.design, request.changes)
    if unused := sorted(request.changes.keys() & _OF_OTHERS[design.motion]):
        options = ", ".join(f"--{key.replace('_', '-')}" for key in unused)
        raise UsageError(f"{options}: not for a motion of the kind {design.motion}; see --motion")
    if request.length is not None:
        design = _of_length(design, request.length, frozenset(request.changes))
    noise = known_noise(model, request.knowledge)
    basis, base = motion_family(design, model)
    limits = motion_limits(model.config)
    whitening = np.ones_like(noise.deviation) if design.criterion == "condition_number" else noise.deviation
    added = known_information(model, base, request.knowledge, whitening)
    task = complete_task(model, design, basis, base, noise.deviation, added)
    earlier = None if request.resume is None else read_search(request.resume, task, request.seed)
    designed = design_motion(
        model,
        design,
        seed=request.seed,
        budget=request.budget,
        torque_deviations=noise.deviation,
        earlier_information=added,
        earlier_search=earlier,
        veto=lambda path: motion_stop_contact(path, limits, model),
        stable=lambda kp, kd: stability(model, replace(limits, kp=kp, kd=kd), delay_of(model.config)).stable,
        tell=tell,
        cancelled=cancelled,
    )
    seen = _previewed(model, designed.excitation, request.knowledge)
    if cancelled() and not np.isfinite(seen.deviations).any():
        raise Stopped("interrupted before a first motion was found; nothing is written")
    with atomic_folder(folder) as staging:
        write_atomically(staging / MOTION, designed.excitation.to_json() + "\n")
        write_atomically(staging / SEARCH, search_to_json(designed.found, task) + "\n")
        write_preview(staging, seen)
    return designed, seen


def preview_files(description: str, motion_file: Path | None, knowledge: PriorData, folder: Path | None) -> Preview:
    """Predict how a motion goes and what it teaches, and return it; write text, values and drawings if given a folder.

    Args:
        description: description file, or the name of a shipped one.
        motion_file: file of the motion; the description's own identification motion when None.
        knowledge: beside the description.
        folder: folder of the text and the drawings; others in it stay.

    Raises:
        UsageError, ConfigError: a file that does not exist or is not valid.
        MotionRefused: the motion was made for another arm.
    """
    model = known_model(description, knowledge)
    chosen = excitation(model, "identification", checked=False) if motion_file is None else read_excitation(motion_file)
    seen = _previewed(model, chosen, knowledge)
    if folder is not None:
        with atomic_folder(folder) as staging:
            write_preview(staging, seen)
    return seen


def write_preview(folder: Path, seen: Preview) -> None:
    """Write a preview's text, its values and its drawings into an existing folder."""
    write_atomically(folder / PREVIEW, preview_text(seen) + "\n")
    write_atomically(folder / DOCUMENT, json.dumps(preview_document(seen), indent=1, allow_nan=False) + "\n")
    for name, text in drawings(seen).items():
        write_atomically(folder / name, text)


def known_model(description: str, knowledge: PriorData) -> ArmModel:
    """Load a description (file or shipped name) into a model, its prior from the knowledge's parameter file if given.

    Raises:
        UsageError: the parameter file has no link parameters of this arm.
    """
    model = arm_model(load_arm(description))
    if knowledge.parameters is None:
        return model
    table = read_parameters(knowledge.parameters, model.layout.names).content.get("link_parameters")
    if table is None or tuple(table["names"]) != model.layout.names:
        raise UsageError(
            f"{knowledge.parameters}: no link parameters of {model.config.name}; give the parameters.json of a "
            "feasible identification of this arm"
        )
    return replace(model, prior=np.array(table["values"], dtype=float))


def known_noise(model: ArmModel, knowledge: PriorData) -> NoiseModel:
    """Return the noise model of the arm's torques, from the knowledge or else from the description."""
    if knowledge.noise is not None:
        return recorded_noise(knowledge.noise, model)
    return described_noise(model, motion_limits(model.config))


def known_information(model: ArmModel, base: BaseParameters, knowledge: PriorData, noise: Array) -> Array | None:
    """Return the information of earlier recordings, whitened by `noise` (joints,), (base, base); None without any."""
    if not knowledge.recordings:
        return None
    opened = open_together(knowledge.recordings, model).recordings
    for index, recording in enumerate(opened):
        if any(overlap(recording, other) for other in opened[:index]):
            raise UsageError(f"{recording.path}: the same recording was given twice")
    parts = [equations(recording, model, base).total for recording in opened]
    R = Information.sum(parts).stacked(1.0 / noise)[:-1, :-1]
    return np.asarray(R.T @ R)


def _previewed(model: ArmModel, motion: Excitation, knowledge: PriorData) -> Preview:
    noise = known_noise(model, knowledge)
    seen = preview(model, motion, noise)
    added = known_information(model, seen.base, knowledge, noise.deviation)
    return seen if added is None else preview(model, motion, noise, added)


def _changed(design: Design, changes: dict[str, Any]) -> Design:
    try:
        return Design.model_validate(design.model_dump() | changes)
    except ValidationError as error:
        wrong = "; ".join(f"{'.'.join(map(str, one['loc']))}: {plain_mistake(one)}" for one in error.errors())
        raise UsageError(f"design: {wrong}") from None


def _of_length(design: Design, length: float, given: frozenset[str]) -> Design:
    """Return a design whose Fourier motion lasts `length` [s], in whole periods near the base frequency.

    Raises:
        UsageError: nothing is left between the ramps, or the length follows from what else was given.
    """
    if design.motion != "fourier":
        raise UsageError("--length is for Fourier motions; a motion through postures has --postures")
    if {"base_frequency", "periods"} <= given:
        raise UsageError("--length follows from --base-frequency, --periods and --ramp; leave one of them out")
    whole = length - 2.0 * design.ramp
    if not whole > 0.0:
        raise UsageError(f"--length {length:g}: the ramps alone take {2.0 * design.ramp:g} s; see --ramp")
    periods = design.periods if "periods" in given else max(1, round(whole * design.base_frequency))
    return _changed(design, {"base_frequency": periods / whole, "periods": periods})
