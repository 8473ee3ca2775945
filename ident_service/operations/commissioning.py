"""Commission an arm: move it twice, identify from one motion, validate on the other, score where the truth is known."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from drivers.arm import Arm
from drivers.clock import utc_offset_of_recording_ns
from ident_service.config.arm import ArmConfig
from ident_service.config.motion_limits import motion_limits
from ident_service.config.simulation import SimulatedDriver
from ident_service.errors import ArmError, MotionRefused, UsageError
from ident_service.estimation.custom import CustomFunction
from ident_service.estimation.equations import Equations, equations
from ident_service.estimation.feasible.feasible_set import SetName
from ident_service.estimation.identify import Estimate, identify
from ident_service.estimation.least_squares import torque_error
from ident_service.estimation.plausibility import Objections, remarks_on_limits
from ident_service.excitation.described_motion import excitation
from ident_service.excitation.motion_file import Excitation
from ident_service.model.appearance import visible_bodies
from ident_service.model.arm_model import ArmModel, arm_model, with_payload
from ident_service.model.chain import Array
from ident_service.model.regressor import joint_regressor
from ident_service.model.urdf import urdf_text
from ident_service.motion.arm_factory import make_arm
from ident_service.motion.command_channel import StopCondition
from ident_service.motion.run import RunReport, run
from ident_service.motion.run_plan import ExcitationPlan
from ident_service.motion.state_machine import State
from ident_service.operations.identification import Step, unusable_because
from ident_service.operations.recordings import recording_quality
from ident_service.recordings.cached_recording import CachedRecording
from ident_service.recordings.open import open_recording
from ident_service.recordings.recorder import RecorderProcess
from ident_service.results.manifest import atomic_folder, write_atomically
from ident_service.results.report_files import write_report
from ident_service.results.run_folder import write_manifest, write_results
from sim_backend.arm import SimulatedArm, Truth
from sim_backend.remote_arm import RemoteArm

_BLOCK = 4096
_MOTIONS = 0.75  # share of a commissioning's time that its motions take, as a rule


@dataclass(frozen=True)
class Score:
    """Comparison of an estimate with the truth.

    Attributes:
        deviations: error of each base parameter in units of its own standard deviation, shape (base,).
        worst_identified: largest of them among the parameters with verdict `identified`, absolute.
        worst_expression: the parameter it belongs to.
        noise_free_percent: relative error (eq. 84) of the predicted torque against the plant's noise-free torque, at
            the plant's true motion on the validation run, where each joint moves.
        residual_ratio: residual RMS on the validation recording over what the true parameters leave there under the
            same processing.
    """

    deviations: Array
    worst_identified: float
    worst_expression: str
    noise_free_percent: float
    residual_ratio: float


def true_parameters(config: ArmConfig, model: ArmModel) -> Array | None:
    """Return the simulated plant's link parameters, shape (layout.size,); None without a simulated driver."""
    if not isinstance(config.driver, SimulatedDriver):
        return None
    if config.driver.truth is None:
        return model.prior
    return with_payload(config, model.chain.names, model.layout, model.layout.vector(config.driver.truth))


def score(
    estimate: Estimate, true_delta: Array, plant_motion: Sequence[Truth], validation_equations: Equations
) -> Score:
    """Compare an estimate with the truth: deviations in sigma, noise-free torque error [%], residual over the truth's.

    Args:
        estimate: identified estimate.
        true_delta: the plant's link parameters, shape (layout.size,).
        plant_motion: true motion of the plant in the validation run.
        validation_equations: equations of the validation recording.
    """
    true_beta = estimate.base.K @ true_delta
    deviations = (estimate.beta - true_beta) / estimate.standard_deviations
    identified = np.array([verdict == "identified" for verdict in estimate.verdicts])
    sizes = np.where(identified, np.abs(deviations), -1.0)
    worst = int(np.argmax(sizes))
    left = torque_error(validation_equations.total, true_beta).rms
    return Score(
        deviations=deviations,
        worst_identified=float(max(sizes[worst], 0.0)),
        worst_expression=estimate.base.expressions[worst],
        noise_free_percent=_noise_free_percent(estimate, true_beta, plant_motion),
        residual_ratio=torque_error(validation_equations.total, estimate.beta).rms / left,
    )


def _noise_free_percent(estimate: Estimate, true_beta: Array, plant_motion: Sequence[Truth]) -> float:
    # A plant's acceleration is the mean over the period before its stamp; at the stamp it is the mean of two.
    means = np.array([sample.acceleration for sample in plant_motion])
    acceleration = 0.5 * (means[:-1] + means[1:])
    position = np.array([sample.position for sample in plant_motion[:-1]])
    velocity = np.array([sample.velocity for sample in plant_motion[:-1]])
    model, error, size = estimate.model, 0.0, 0.0
    for start in range(0, len(position), _BLOCK):
        part = slice(start, start + _BLOCK)
        H = joint_regressor(
            model.chain, model.layout, position[part], velocity[part], acceleration[part], estimate.base.base
        )
        # A joint that sticks holds any torque inside its friction; no model predicts it.
        moving = (velocity[part] != 0.0).T
        wanted = np.einsum("jps,p->js", H, true_beta)
        given = np.einsum("jps,p->js", H, estimate.beta)
        error += float(np.sum((given - wanted)[moving] ** 2))
        size += float(np.sum(wanted[moving] ** 2))
    return 100.0 * float(np.sqrt(error / size))


Tell = Callable[[str], None]


@dataclass(frozen=True)
class Commissioning:
    """Result of a commissioning.

    Attributes:
        folder: folder of the results.
        estimate: identified estimate.
        runs: reports of the two motions.
        score: score of the estimate against the truth.
        objections: reasons why the estimate must not be used; empty where nothing says so.
        warnings: what is wrong with the recordings, in words.
    """

    folder: Path
    estimate: Estimate
    runs: tuple[RunReport, RunReport]
    score: Score
    objections: Objections
    warnings: tuple[str, ...]


def record_motion(
    arm: Arm,
    model: ArmModel,
    motion: Excitation,
    recording_file: Path,
    stop_requested: Callable[[], bool] = lambda: False,
) -> RunReport:
    """Open an arm, run one motion, record it into a new MCAP file, and return the report, also after a stop.

    Args:
        arm: the arm, not yet open.
        model: of the arm.
        motion: motion to run.
        recording_file: the MCAP file; it must not exist.
        stop_requested: called every cycle; True stops the motion.

    Raises:
        MotionRefused, ArmFault, DriverError: from the motion; what was recorded until then is kept.
        RecordingError: the file cannot be written.
    """
    attachments = {
        "arm.json": model.config.model_dump_json(indent=1).encode(),
        "excitation.json": motion.to_json().encode(),
    }
    metadata = {"arm": model.config.name, "arm_sha256": model.config.sha256, "motion": motion.name}
    description = urdf_text(model, model.prior, visible_bodies(model))
    metadata["clock"] = "virtual" if arm.clock.lock_step else "monotonic"
    metadata["driver"] = "" if model.config.driver is None else model.config.driver.kind
    recorder = RecorderProcess(
        recording_file,
        model.chain.names,
        description,
        utc_offset_of_recording_ns(arm.clock),
        attachments,
        metadata,
        lock_step=arm.clock.lock_step,
    )
    with arm, recorder:
        return run(arm, model, motion, recorder, StopCondition(stop_requested))


def require_clear_from_home(model: ArmModel, motion: Excitation) -> None:
    """Raise MotionRefused unless an arm at home may go along a motion and back within limits and clear.

    Raises:
        MotionRefused: it would leave limits, or come too near to something.
    """
    limits, plan = motion_limits(model.config), ExcitationPlan(motion)
    plan.require_possible(model, limits)
    plan.legs(model, limits.home, limits)


def _counted(
    stop_requested: Callable[[], bool], rate: float, planned: Excitation, before: float, each: float, step: Step
) -> Callable[[], bool]:
    """Return `stop_requested`, which is asked every cycle, with a step told every quarter of a second of the motion.

    Args:
        stop_requested: function that is wrapped.
        rate: cycles per second.
        planned: the motion.
        before: share of all motions that precede this one.
        each: share of all motions that one second of motion is.
        step: called with the progress.
    """
    cycles, every = 0, max(round(0.25 * rate), 1)

    def counted_stop() -> bool:
        nonlocal cycles
        cycles += 1
        if cycles % every == 0:
            seconds = min(cycles / rate, planned.duration)
            step(f"{planned.name} motion", _MOTIONS * before + each * seconds)
        return stop_requested()

    return counted_stop


def simulate(
    config: ArmConfig,
    folder: Path,
    *,
    motion: Excitation | None = None,
    set_name: SetName | None = None,
    config_as_read: ArmConfig | None = None,
    custom: CustomFunction | None = None,
    tell: Tell = lambda _: None,
    step: Step = lambda words, share: None,
    stop_requested: Callable[[], bool] = lambda: False,
) -> Commissioning:
    """Run both motions on the simulated arm, identify it, write the run folder, and score it against the truth.

    Args:
        config: configuration with a simulated driver.
        folder: the run folder; it appears when everything is in it, and must not exist.
        motion: motion to identify from, a designed one for example; the description's when None.
        set_name: feasible set, the configuration's when None.
        config_as_read: the configuration as it was read, where it was changed since; `config` when None.
        custom: the function that its `constraints.custom` names.
        tell: called with a line at each step.
        step: called with what is being done and how much of all is done, from 0 to 1.
        stop_requested: called every cycle, and between the steps of identification; True stops.

    Raises:
        UsageError: the folder exists, or the arm is not simulated.
        ArmError: a stop was requested.
        IdentError: anything the steps raise; no folder is left behind.
    """
    if folder.exists():
        raise UsageError(f"{folder}: exists already; give a folder that does not")
    model = arm_model(config)
    truth = true_parameters(config, model)
    if truth is None:
        raise UsageError(f"{config.name} has no simulated driver; use a description that has one")
    first = excitation(model, "identification") if motion is None else replace(motion, name="identification")
    motions = [first, excitation(model, "validation")]
    for planned in motions[1:]:  # the first is checked when it begins; a later refusal would waste it
        require_clear_from_home(model, planned)
    reports, observed = list[RunReport](), list[Truth]()
    whole = sum(planned.duration for planned in motions)
    with atomic_folder(folder) as staging:
        paths = [staging / f"{planned.name}.mcap" for planned in motions]
        for planned, path in zip(motions, paths, strict=True):
            tell(f"{planned.name} motion: {planned.duration:g} s at {config.control.rate:g} Hz")
            observed = []
            arm = make_arm(config)
            if isinstance(arm, SimulatedArm | RemoteArm):
                arm.observer = observed.append
            driven = sum(one.duration for one in motions[: len(reports)])
            counted_stop = _counted(
                stop_requested, config.control.rate, planned, driven / whole, _MOTIONS / whole, step
            )
            stopped = _stopped(f"{planned.name} motion")
            try:
                report = record_motion(arm, model, planned, path, counted_stop)
            except MotionRefused:
                if not reports or not stop_requested():
                    raise
                raise stopped from None  # what refuses says that nothing has moved, which the first motion did
            if report.state is not State.DONE:
                raise stopped  # after a requested stop the arm must not move again
            reports.append(report)
            write_atomically(staging / f"{planned.name}.excitation.json", planned.to_json() + "\n")

        def go_on(words: str, share: float) -> None:
            if stop_requested():
                raise _stopped("identifying")
            step(words, share)

        tell("identifying")
        go_on("identifying", _MOTIONS)
        recordings = [CachedRecording(open_recording(path, model.chain.names)) for path in paths]
        estimate = identify(
            *(model, recordings[:1], recordings[1:]),
            set_name=set_name,
            custom=custom,
            step=lambda words, share: go_on(words, _MOTIONS + 0.6 * share * (1.0 - _MOTIONS)),
        )
        go_on("scoring, and writing the report", _MOTIONS + 0.6 * (1.0 - _MOTIONS))
        scored = score(estimate, truth, observed, equations(recordings[1], model, estimate.base))
        found = [(one, recording_quality(one, model)) for one in recordings]
        objections = unusable_because(estimate, found)
        warnings = [f"{one.path.name}: {line}" for one, seen in found for line in seen.warnings()]
        warnings += [line for one, seen in found for line in remarks_on_limits(one.path.name, seen.joints, model)]
        warnings += estimate.remarks
        write_results(
            staging,
            estimate,
            {"warnings": warnings},
            objections.reasons,
            described=config if config_as_read is None else config_as_read,
        )
        write_atomically(staging / "score.json", json.dumps(score_document(scored), indent=1) + "\n")
        write_report(staging, estimate, recordings[:1], recordings[1:], warnings)
        write_manifest(staging)
    return Commissioning(folder, estimate, (reports[0], reports[1]), scored, objections, tuple(warnings))


def _stopped(during: str) -> ArmError:
    return ArmError(f"{during}: stopped on request; nothing was kept")


def score_document(scored: Score) -> dict[str, object]:
    """Return a score as JSON values."""
    return {
        "worst_identified_sigma": scored.worst_identified,
        "worst_identified_parameter": scored.worst_expression,
        "noise_free_torque_error_percent": scored.noise_free_percent,
        "validation_residual_ratio": scored.residual_ratio,
        "deviations_sigma": scored.deviations.tolist(),
    }
