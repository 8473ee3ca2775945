"""Represent the evidence that a person needs to believe an estimate, beyond `parameters.json`.

The data are gathered in `gathering.py`, kept in `evidence.json`, and drawn by the report. The correlation of
the parameters is not here, because the parameter file has their covariance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Role = Literal["identification", "validation"]


@dataclass(frozen=True)
class Estimated:
    """Estimate among those that stand side by side, with its torque errors.

    Attributes:
        name: name for tables; `CAD` for the arm's prior parameters.
        values: base parameters in SI units, shape (base,).
        margin: margin of the feasibility test, whose sign is the verdict; None where it was not tested.
        identification: relative torque error on the fitted recordings (eq. 84) [percent]; None where it was not
            computed.
        validation: relative torque error on every recording that was never fitted to [percent].
        moving: relative torque error as `identification`, without rows of joints near standstill, whose friction is
            unknown.
        moving_validation: relative torque error as `validation`, without rows of joints near standstill.
    """

    name: str
    values: Array
    margin: float | None
    identification: float | None
    validation: tuple[float, ...]
    moving: float | None = None
    moving_validation: tuple[float, ...] = ()


@dataclass(frozen=True)
class JointTrace:
    """Torque of one joint along a recording, in stretches of time that are equally long.

    Of every stretch the lowest and the highest sample are kept, so that no peak is lost however few stretches there
    are; where a stretch is a single sample the two are the same.

    Attributes:
        torque: lowest and highest measured torque [N m or N], shape (2, stretches).
        predicted: lowest and highest torque predicted by the chosen estimate [N m or N], shape (2, stretches).
        residual: lowest and highest residual, measured less predicted [N m or N], shape (2, stretches).
        velocity: velocity of the stretch's middle sample [rad/s or m/s], shape (stretches,).
        standstill: whether a row of the stretch was left out of the fit, shape (stretches,).
    """

    torque: Array
    predicted: Array
    residual: Array
    velocity: Array
    standstill: Mask


@dataclass(frozen=True)
class Spectrum:
    """Residual of a joint's torque, by frequency and by lag.

    Attributes:
        frequency: frequencies, increasing [Hz], shape (lines,).
        density: power spectral density of the residual [(N m)^2/Hz or N^2/Hz], shape (lines,).
        lag: lags, evenly from zero [s], shape (lags,).
        correlation: autocorrelation of the residual, 1 at lag zero, shape (lags,).
        white: level that the autocorrelation of a white residual of this length stays below in 95 % of the lags.
    """

    frequency: Array
    density: Array
    lag: Array
    correlation: Array
    white: float


@dataclass(frozen=True)
class Spike:
    """Sample of a recording at which a joint in motion has its largest residual.

    Attributes:
        time: time since the recording's first sample [s].
        residual: residual, measured less predicted torque [N m or N].
        position: position of all joints at that time [rad or m], shape (joints,).
    """

    time: float
    residual: float
    position: Array


@dataclass(frozen=True)
class PredictionTrace:
    """Traces and spectra of one recording against the chosen estimate.

    Attributes:
        name: of the file.
        sha256: hash of the file's bytes.
        role: whether it was fitted to.
        time: middle of every stretch since the recording's first sample, increasing [s], shape (stretches,).
        width: length of a stretch [s].
        joints: one per joint.
        spectra: one per joint; empty where the recording is too short for one.
        spikes: one per joint, None of a joint that never moves; empty in files of earlier versions.
        driver: kind of driver that the recording says it was made with; empty for files of others and of earlier
            versions.
    """

    name: str
    sha256: str
    role: Role
    time: Array
    width: float
    joints: tuple[JointTrace, ...]
    spectra: tuple[Spectrum, ...]
    spikes: tuple[Spike | None, ...] = ()
    driver: str = ""


@dataclass(frozen=True)
class Friction:
    """Friction of one drive: torque less everything that the model has of rigid bodies.

    Attributes:
        velocity: velocity of the points [rad/s or m/s], shape (points,).
        torque: torque of the points [N m or N], shape (points,).
        curve_velocity: velocities of the curve, increasing, without zero [rad/s or m/s], shape (samples,).
        curve_torque: the model's friction in steady motion [N m or N], shape (samples,).
        terms: the base parameters that it consists of, as their expressions.
    """

    velocity: Array
    torque: Array
    curve_velocity: Array
    curve_torque: Array
    terms: tuple[str, ...]


@dataclass(frozen=True)
class Condition:
    """Margin of the link parameters in one condition of the feasible set.

    Attributes:
        name: of the condition, for people.
        links: the links that it is about, counted from 0.
        margin: smallest eigenvalue or number of the condition, SI units.
        scaled: margin in units of the condition's reference scales, comparable between conditions.
    """

    name: str
    links: tuple[int, ...]
    margin: float
    scaled: float


@dataclass(frozen=True)
class Body:
    """Link as the solid ellipsoid of uniform density that has its mass, centre and inertia, in the base frame.

    Attributes:
        mass: [kg].
        center: [m], shape (3,).
        axes: half axes as rows [m], shape (3, 3); None where no such ellipsoid exists.
    """

    mass: float
    center: Array
    axes: Array | None


@dataclass(frozen=True)
class PosedArm:
    """Arm in one posture of its recordings, with the bodies of its links.

    Attributes:
        points: origins of base, joint and link frames in the base frame [m], shape (points, 3).
        branches: for every branch of the arm its points from base to end.
        bodies: one per link.
    """

    points: Array
    branches: tuple[tuple[int, ...], ...]
    bodies: tuple[Body, ...]


@dataclass(frozen=True)
class Timing:
    """Regularity of a recording's samples.

    Attributes:
        recording: name of the file.
        source: `cycle` where the loop told how late it began every cycle, `stamps` where only the steps between
            stamps are known.
        edges: edges of the histogram of lateness, or of how far steps are from the usual one, increasing [s], shape
            (bins + 1,).
        counts: cycles or steps per bin, shape (bins,).
        samples: number of cycles or steps.
        rate: usual rate [Hz].
        largest: the largest lateness or distance from the usual step [s].
        compute: longest computing time of a cycle [s]; None where it is not known.
        gaps: per gap, seconds after the first sample and its length [s], the longest first, at most 100.
        gap_count: number of gaps.
        lost: frames lost; None where it is not known.
        invalid: per joint, the cycles in which it did not answer; empty where it is not known.
        oldest: per joint, the most cycles that a position was old; empty where it is not known.
    """

    recording: str
    source: Literal["cycle", "stamps"]
    edges: Array
    counts: NDArray[np.int64]
    samples: int
    rate: float
    largest: float
    compute: float | None
    gaps: tuple[tuple[float, float], ...]
    gap_count: int
    lost: int | None
    invalid: tuple[int, ...]
    oldest: tuple[int, ...]


@dataclass(frozen=True)
class Evidence:
    """Everything of an identification that a report shows beside the parameters.

    Attributes:
        parameters_sha256: hash of the parameter file that it belongs to.
        joints: names of the joints.
        revolute: per joint, whether it turns (N m, rad/s) or slides (N, m/s).
        estimates: side by side; the CAD values first where there are any.
        unconstrained: number of the estimate that no feasible set bends.
        constrained: number of the one inside the arm's feasible set.
        chosen: number of the one that `parameters.json` has.
        bounds: per base parameter, the conditions that its link parameters press against.
        recordings: recordings fitted to, then those that were not.
        friction: one per drive; empty where the model has no friction.
        conditions: every condition, where there are link parameters.
        posed: the arm in one posture; None without link parameters.
        timing: one per recording.
        warnings: what is wrong with the recordings, in words.
    """

    parameters_sha256: str
    joints: tuple[str, ...]
    revolute: tuple[bool, ...]
    estimates: tuple[Estimated, ...]
    unconstrained: int
    constrained: int
    chosen: int
    bounds: tuple[tuple[str, ...], ...]
    recordings: tuple[PredictionTrace, ...]
    friction: tuple[Friction, ...]
    conditions: tuple[Condition, ...]
    posed: PosedArm | None
    timing: tuple[Timing, ...]
    warnings: tuple[str, ...]
