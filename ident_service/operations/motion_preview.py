"""Preview what a motion asks of an arm and what it will teach, before anything moves; in numbers and in words."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ident_service.config.motion_limits import MotionLimits, motion_limits
from ident_service.errors import MotionRefused, UsageError
from ident_service.estimation.uncertainty import negligible, verdicts
from ident_service.excitation.limit_proof import Proof, proof_of, violations
from ident_service.excitation.motion_file import Excitation
from ident_service.excitation.optimal_design import condition_number
from ident_service.excitation.prediction import (
    NoiseModel,
    described_noise,
    expected_deviations,
    information,
    predict_following_error,
)
from ident_service.excitation.trajectory import FourierPath, PosturePath
from ident_service.model.arm_model import ArmModel
from ident_service.model.base_parameters import BaseParameters, base_parameters
from ident_service.model.chain import Array
from ident_service.model.collision import CollisionModel, scene
from ident_service.model.expected_friction import expected_friction
from ident_service.model.information import information_of, sparsity
from ident_service.model.regressor import joint_regressor
from ident_service.motion.clearance import Nearest, motion_stop_clearance
from ident_service.motion.stop_trajectory import stop_extent
from ident_service.motion.trajectory import Setpoint, plan_reduced_trajectory, rest
from ident_service.results.parameter_file import finite_or_none, read_parameters

_LOOKED_AT = 2000  # samples of each part of a motion for the forecast of the following error
_USED = 0.25  # share of the torque limits used by an arm without a prior
KINDS = ("velocity", "acceleration", "jerk", "torque")


@dataclass(frozen=True)
class Preview:
    """Prediction of a motion: demands, clearances, expected deviations.

    Attributes:
        model: of the arm.
        excitation: the motion.
        limits: of the arm.
        proof: verified bounds of the motion's demands at every instant.
        objections: limits that are not kept, in words; empty for a motion that may run.
        stops: lowest and highest positions that a stop from anywhere on the motion reaches, each of shape (joints,).
        stop_clearance: smallest distance on stops out of the motion.
        following: following error of the simulated arm, or its forecast where the reference leaves limits and
            nothing was simulated [rad or m], shape (joints,).
        approach: duration of the way from home to its beginning [s], and of that back from its end.
        base: grouping of the parameters.
        noise: noise of the torques, as far as known.
        deviations: expected standard deviations of the base parameters [SI], shape (base,).
        negligible: sizes below which parameters are as good as zero on this motion, shape (base,).
        condition_number: condition number of the stacked regressor.
        warnings: warnings of what nobody can prove or forbid, in words.
    """

    model: ArmModel
    excitation: Excitation
    limits: MotionLimits
    proof: Proof
    objections: tuple[str, ...]
    stops: tuple[Array, Array]
    stop_clearance: Nearest
    following: Array
    approach: tuple[float, float]
    base: BaseParameters
    noise: NoiseModel
    deviations: Array
    negligible: Array
    condition_number: float
    warnings: tuple[str, ...]


def preview(
    model: ArmModel, excitation: Excitation, noise: NoiseModel | None = None, earlier_information: Array | None = None
) -> Preview:
    """Predict peaks, clearances, stops and deviations of a motion, and list what forbids it; nothing moves.

    Args:
        model: of the arm, with prior parameters.
        excitation: motion that was made for this arm.
        noise: noise of the torques; the description's when None.
        earlier_information: information from earlier recordings, whitened by `noise`, shape (base, base).

    Raises:
        MotionRefused: the motion was made for another arm, or the arm's description lacks limits.
    """
    if excitation.arm_sha256 != model.config.motion_sha256:
        raise MotionRefused(
            f"the {excitation.name} motion was made for another description of the arm than {model.config.name} as it "
            "is now; design it again"
        )
    if excitation.path.joints != model.chain.joints:
        raise MotionRefused(f"a motion of {excitation.path.joints} joints for an arm of {model.chain.joints}")
    limits = motion_limits(model.config)
    path = excitation.path
    margin = excitation.made.get("torque_margin")  # a designed motion's own
    proof = proof_of(path, model, limits, CollisionModel(model), margin if isinstance(margin, float) else None)
    lowest, highest = stop_extent(path, limits)
    found = violations(proof, model, limits)
    for k, name in enumerate(model.chain.names):
        if lowest[k] < limits.lower[k] or highest[k] > limits.upper[k]:
            found.append(
                f"{name}: a stop out of the motion reaches {lowest[k]:.3f}..{highest[k]:.3f}, "
                f"outside {limits.lower[k]:g}..{limits.upper[k]:g}"
            )
    nearest = motion_stop_clearance(path, limits, model)
    if nearest.distance <= 0.0:
        found.append(f"a stop out of the motion at {nearest.time:.2f} s would touch: {nearest.pair}")
    home = rest(limits.home)
    begin, end = (Setpoint(*path.at(time)[:3]) for time in (0.0, path.duration))
    durations = []
    for leg in ((home, begin), (end, home)):
        try:
            durations.append(plan_reduced_trajectory(leg[0], leg[1], limits).duration)
        except MotionRefused as error:
            durations.append(float("nan"))
            found.append(str(error))
    base = base_parameters(model.chain, model.layout)
    noise = described_noise(model, limits) if noise is None else noise
    following = _following(model, excitation, limits) if proof.tracking is None else proof.tracking.error
    return Preview(
        model=model,
        excitation=excitation,
        limits=limits,
        proof=proof,
        objections=tuple(found),
        stops=(lowest, highest),
        stop_clearance=nearest,
        following=following,
        approach=(durations[0], durations[1]),
        base=base,
        noise=noise,
        deviations=expected_deviations(path, model, base, noise, earlier_information),
        negligible=_negligible(path, model, base, limits),
        condition_number=condition_number(information(path, model, base, np.ones(model.chain.joints))),
        warnings=tuple(_warnings(model, limits, None if proof.tracking is not None else following)),
    )


def _negligible(path: FourierPath | PosturePath, model: ArmModel, base: BaseParameters, limits: MotionLimits) -> Array:
    """Return the sizes below which parameters are as good as zero, shape (base,).

    The torques are those of the arm's prior; without one, a quarter of what the joints may have.
    """
    time = np.concatenate([np.linspace(begin, end, _LOOKED_AT) for begin, end in path.distinct])
    H = joint_regressor(model.chain, model.layout, *path.at(time)[:3], base.base)
    torque = np.tile(_USED * limits.torque, (len(time), 1))
    if model.prior is not None:
        torque = np.einsum("jps,p->sj", H, base.K @ model.prior)
    felt = sparsity(model.chain, model.layout, base.base)
    return negligible(information_of(H, torque, np.ones(torque.shape, dtype=bool), felt))


def _warnings(model: ArmModel, limits: MotionLimits, forecast_error: Array | None) -> list[str]:
    """Return warnings on what can neither be proven nor forbidden; on following errors only from a forecast."""
    names, found = model.chain.names, []
    ahead = np.zeros_like(limits.following_error) if forecast_error is None else forecast_error
    if late := [name for k, name in enumerate(names) if ahead[k] > limits.following_error[k]]:
        found.append(
            f"{', '.join(late)} may exceed its following error, if friction is as guessed "
            "(design.friction_guess); the safety monitor would stop the motion"
        )
    owners = {body.owner for body in scene(model).bodies}
    if bare := [name for name in names if name not in owners]:
        found.append(f"no body is known of {', '.join(bare)}: its clearance cannot be checked; see geometry")
    return found


def _following(model: ArmModel, excitation: Excitation, limits: MotionLimits) -> Array:
    path = excitation.path
    time = np.concatenate([np.linspace(begin, end, _LOOKED_AT) for begin, end in path.distinct])
    position, velocity, *_ = path.at(time)
    friction = expected_friction(model, limits, model.config.design.friction_guess)
    return predict_following_error(model, limits, friction, position, velocity)


def recorded_noise(parameter_file: Path, model: ArmModel) -> NoiseModel:
    """Return the torque noise of each joint, from the residuals of an earlier identification of the arm.

    Per joint the residual's root mean square; and by how much the deviations found in blocks exceed those that white
    noise would give, in the geometric mean.

    Raises:
        UsageError, ParameterError: no such file, not a parameter file, or one of another arm or without a fit.
    """
    content = read_parameters(parameter_file, model.layout.names).content
    try:
        rows = {row["joint"]: float(row["rms"]) for row in content["fit"]["per_joint"]}
        deviation = np.array([rows[name] for name in model.chain.names])
        table = content["base_parameters"]
        pairs = zip(table["standard_deviations"], table["white_standard_deviations"], strict=True)
        ratios = [blocks / white for blocks, white in pairs if blocks is not None and white]
    except (KeyError, TypeError):
        raise UsageError(
            f"{parameter_file}: no residual per joint and no standard deviations of the joints "
            f"{', '.join(model.chain.names)}; "
            "give the parameters.json of an identification of this arm"
        ) from None
    if not ratios or not (deviation > 0.0).all():
        raise UsageError(
            f"{parameter_file}: its residuals or standard deviations are zero, so nothing can be predicted from it"
        )
    return NoiseModel(deviation, float(np.exp(np.mean(np.log(ratios)))), f"the residuals in {parameter_file.name}")


def preview_document(seen: Preview) -> dict[str, Any]:
    """Return the preview as JSON values."""
    asked = seen.proof.demands
    clearances = {"clearance": seen.proof.clearance, "approach_clearance": seen.proof.approach}
    return {
        "arm": seen.model.config.name,
        "motion": seen.excitation.name,
        "duration": seen.excitation.duration,
        "approach": [value if np.isfinite(value) else None for value in seen.approach],
        "joints": [
            {
                "joint": name,
                "position": [float(asked.lowest[k]), float(asked.highest[k])],
                "following_error": float(seen.following[k]),
                "stops": [float(seen.stops[0][k]), float(seen.stops[1][k])],
                **{kind: None if (peak := getattr(asked, kind)) is None else float(peak[k]) for kind in KINDS},
                "limits": {
                    "position": [float(seen.limits.lower[k]), float(seen.limits.upper[k])],
                    "following_error": float(seen.limits.following_error[k]),
                    **{kind: float(getattr(seen.limits, kind)[k]) for kind in KINDS},
                },
            }
            for k, name in enumerate(seen.model.chain.names)
        ],
        "power": asked.power,
        **{
            key: None
            if one is None or one.pair is None
            else {"lower_bound": one.lower_bound, "sampled": one.sampled, "pair": one.pair, "time": one.time}
            for key, one in clearances.items()
        },
        "stop_clearance": None
        if seen.stop_clearance.pair is None
        else {
            "sampled": seen.stop_clearance.distance,
            "pair": seen.stop_clearance.pair,
            "time": seen.stop_clearance.time,
        },
        "condition_number": seen.condition_number if np.isfinite(seen.condition_number) else None,
        "noise": {"deviation": seen.noise.deviation.tolist(), "inflation": seen.noise.inflation},
        "base_parameters": {
            "expressions": list(seen.base.expressions),
            "units": list(seen.base.units),
            "expected_standard_deviations": finite_or_none(seen.deviations),
        },
        "objections": list(seen.objections),
        "warnings": list(seen.warnings),
    }


def preview_text(seen: Preview) -> str:
    """Format the preview as text."""
    path, asked, limits = seen.excitation.path, seen.proof.demands, seen.limits
    names = seen.model.chain.names
    width = max(5, *(len(name) for name in names))
    kind = (
        f"{path.periods} periods of {path.series.period:g} s, {path.series.a.shape[1]} harmonics, "
        f"ramps of {path.ramp:g} s"
        if isinstance(path, FourierPath)
        else f"{len(path.points)} postures, {path.dwell:g} s at each"
    )
    lines = [
        f"{seen.excitation.name} motion for {seen.model.config.name}: {path.duration:g} s ({kind})",
        f"path to the motion {seen.approach[0]:.1f} s and back {seen.approach[1]:.1f} s, from and to home",
        *([] if (load := seen.model.config.payload) is None else [f"payload: {load.words}"]),
        "",
        "peaks at every instant, not only at samples; in brackets: share of the limit",
        f"  {'joint':<{width}} {'position':>17} {'(range)':>8} {'velocity':>14} {'acceleration':>14} {'jerk':>14} "
        f"{'torque':>15} {'following error':>17} {'stops reach':>17}",
    ]
    shares = _position_shares(asked.lowest, asked.highest, limits)
    for k, name in enumerate(names):
        cells = [f"{asked.lowest[k]:8.3f}{asked.highest[k]:9.3f} {_percent(shares[k]):>8}"]
        for quantity, space in zip(KINDS, (14, 14, 14, 15), strict=True):
            peak = getattr(asked, quantity)
            share = "" if peak is None else _percent(peak[k] / getattr(limits, quantity)[k])
            cells.append(f"{'unknown' if peak is None else f'{peak[k]:.3g} {share}':>{space}}")
        following = seen.following[k]
        cells.append(f"{f'{following:.3f} {_percent(following / limits.following_error[k])}':>17}")
        cells.append(f"{seen.stops[0][k]:8.3f}{seen.stops[1][k]:9.3f}")
        lines.append(f"  {name:<{width}} " + " ".join(cells))
    lines.append("")
    if asked.power is not None and seen.model.config.supply is not None:
        budget = seen.model.config.supply.budget
        lines.append(f"supply: {asked.power:.1f} W {_percent(asked.power / budget)} of {budget:g} W")
    for what, clearance in (("motion", seen.proof.clearance), ("path to the motion and back", seen.proof.approach)):
        if clearance is not None and clearance.pair is not None:
            lines.append(
                f"smallest clearance of the {what}: {clearance.sampled:.4f} m at {clearance.pair}, "
                f"{clearance.time:.2f} s; never below {clearance.lower_bound:.4f} m "
                f"({seen.model.config.workspace.clearance:g} m asked)"
            )
    if seen.stop_clearance.pair is not None:
        near = seen.stop_clearance
        lines.append(f"stops out of the motion: {near.distance:.4f} m at {near.pair}, when begun at {near.time:.2f} s")
    lines += [f"WARNING: {line}" for line in seen.warnings]
    lines += ["", *_teaching(seen), ""]
    if seen.objections:
        lines += ["NOT ALLOWED:", *(f"  {line}" for line in seen.objections), ""]
    else:
        lines += ["all limits are kept", ""]
    return "\n".join(lines)


def _teaching(seen: Preview) -> list[str]:
    """Format the table of expected parameter deviations."""
    prior = np.zeros(len(seen.base.names)) if seen.model.prior is None else seen.model.prior
    values = seen.base.K @ prior
    words = verdicts(values, seen.deviations, seen.negligible)
    width = max(len(expression) for expression in seen.base.expressions)
    counts = ", ".join(f"{words.count(word)} {word}" for word in ("identified", "weak", "unidentified"))
    head = [
        f"expected of {seen.base.size} base parameters: {counts} "
        f"(condition number {seen.condition_number:.1f}; noise: {seen.noise.source})",
        f"  {'parameter':<{width}} {'prior':>11} {'deviation':>11} {'':<8} verdict",
    ]
    rows = zip(seen.base.expressions, seen.base.units, values, seen.deviations, words, strict=True)
    return head + [
        f"  {expression:<{width}} {value:>11.4g} {deviation:>11.2g} {unit:<8} {word}"
        for expression, unit, value, deviation, word in rows
    ]


def _percent(share: float) -> str:
    return f"({share:.0%})"


def _position_shares(lowest: Array, highest: Array, limits: MotionLimits) -> Array:
    """Return the used share of the way from the middle of a position range to its ends, shape (joints,)."""
    middle, half = 0.5 * (limits.lower + limits.upper), 0.5 * (limits.upper - limits.lower)
    return np.asarray(np.maximum(highest - middle, middle - lowest) / half)
