"""Gather the evidence of a report while an estimate is at hand: one more pass over each recording, nothing fitted.

Memory does not grow with a recording: what is kept of it is an envelope, averaged spectra and a scatter.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from ident_service.estimation.equations import Rows, equation_rows
from ident_service.estimation.identify import Candidate, Estimate
from ident_service.model.threads import one_blas_thread
from ident_service.recordings.recording import Recording
from ident_service.results.evidence.bodies import bounds_of, conditions_of, posed
from ident_service.results.evidence.evidence import (
    Array,
    Estimated,
    Evidence,
    JointTrace,
    Role,
    Spectrum,
    Timing,
    Traced,
)
from ident_service.results.evidence.friction import FrictionSeen
from ident_service.results.evidence.series import Envelope, Scatter, Welch
from ident_service.results.evidence.timing import timing

_STRETCHES = 8000  # of all recordings together; a screen has some thousand columns
_FEWEST_STRETCHES = 400
_POSTURES = 256
CAD = "CAD"


@one_blas_thread()
def gather_evidence(
    estimate: Estimate,
    recordings: Sequence[Recording],
    validation: Sequence[Recording],
    parameters_sha256: str,
    warnings: Sequence[str] = (),
) -> Evidence:
    """Return everything that a report shows of an estimate and its recordings.

    Args:
        estimate: made from `recordings` and judged on `validation`.
        recordings: those fitted to.
        validation: those that were not.
        parameters_sha256: of the parameter file that holds the estimate.
        warnings: what is wrong with the recordings, in words.

    Raises:
        RecordingError: a recording can no longer be read.
    """
    everyone: list[tuple[Recording, Role]] = [(one, "identification") for one in recordings]
    everyone += [(one, "validation") for one in validation]
    most = max(_STRETCHES // len(everyone), _FEWEST_STRETCHES)
    friction = FrictionSeen(estimate)
    traced: list[Traced] = []
    times: list[Timing] = []
    postures = Scatter(_POSTURES)
    for recording, role in everyone:
        seen = _Seen(estimate, most)
        for rows in equation_rows(recording, estimate.model, estimate.base):
            seen.add(rows)
            if role == "identification":
                friction.add(rows, seen.torque)
                postures.add(rows.position)
        traced.append(seen.traced(recording, role))
        times.append(timing(recording))
    kind = estimate.conditions.kind
    estimates = _estimates(estimate)
    offset = len(estimates) - len(estimate.candidates)
    return Evidence(
        parameters_sha256=parameters_sha256,
        joints=estimate.model.chain.names,
        revolute=estimate.model.chain.revolute,
        estimates=estimates,
        unconstrained=offset,
        constrained=[one.name for one in estimates].index(f"FBPE-{estimate.method.upper()} {kind}"),
        chosen=offset + estimate.chosen,
        bounds=bounds_of(estimate.tight, estimate.conditions, estimate.base),
        recordings=tuple(traced),
        friction=friction.found(),
        conditions=conditions_of(estimate),
        posed=posed(estimate.model, estimate.delta, postures.rows()),
        timing=tuple(times),
        warnings=tuple(warnings),
    )


def _estimates(estimate: Estimate) -> tuple[Estimated, ...]:
    def of(candidate: Candidate) -> Estimated:
        scores = candidate.validation
        return Estimated(
            name=candidate.name,
            values=candidate.beta,
            margin=candidate.margin,
            identification=candidate.identification.relative_percent,
            validation=tuple(score.error.relative_percent for score in scores),
            moving=candidate.moving.relative_percent,
            moving_validation=tuple(score.moving.relative_percent for score in scores),
            moving_joints=tuple(
                tuple(error.joint_relative_percent.tolist())
                for error in (candidate.moving, *(score.moving for score in scores))
            ),
        )

    found = [of(candidate) for candidate in estimate.candidates]
    prior = estimate.model.prior
    if prior is not None:
        found.insert(0, Estimated(CAD, estimate.base.K @ prior, None, None, ()))
    return tuple(found)


class _Seen:
    """Collector of one recording's traces, chunk after chunk, against the chosen estimate."""

    def __init__(self, estimate: Estimate, most: int) -> None:
        self._estimate, self._most = estimate, most
        self._envelope: Envelope | None = None
        self._welch: Welch | None = None
        self._velocity = Scatter(4 * most)
        self._last = -np.inf
        self._period = 0.0
        self.torque: Array = np.zeros((0, 0))

    def add(self, rows: Rows) -> None:
        """Add the next equations; `torque` then holds their torques in the units of the estimate, (samples, joints)."""
        self.torque = rows.torque * self._estimate.prepared.torque_scales
        if not len(rows.time):
            return
        joints = self.torque.shape[1]
        if self._envelope is None or self._welch is None:
            self._period = float(np.median(np.diff(rows.time))) if len(rows.time) > 1 else 1e-3
            self._envelope = Envelope(3 * joints, self._most, self._period)
            self._welch = Welch(joints, 1.0 / self._period)
        predicted = np.tensordot(self._estimate.beta, rows.H_b, axes=(0, 1))
        measured = self.torque.T
        residual = measured - predicted
        values = np.concatenate([measured, predicted, residual])
        self._envelope.add(rows.time, values, np.tile(~rows.keep.T, (3, 1)))
        self._velocity.add(np.column_stack([rows.time, rows.velocity]))
        # Spectra are of stretches without a gap.
        breaks = np.flatnonzero(np.diff(rows.time, prepend=self._last) > 1.5 * self._period).tolist()
        for begin, end in pairwise(sorted({0, *breaks, len(rows.time)})):
            self._welch.add(residual[:, begin:end], opens=begin in breaks)
        self._last = float(rows.time[-1])

    def traced(self, recording: Recording, role: Role) -> Traced:
        """Return the recording's traces and spectra."""
        if self._envelope is None or self._welch is None:
            raise AssertionError("a recording that was identified from has equations")
        joints = len(self._envelope.extremes) // 3
        extremes, marked, time = self._envelope.extremes, self._envelope.marked, self._envelope.time
        rows = self._velocity.rows()
        middle = np.clip(np.searchsorted(rows[:, 0], time), 0, len(rows) - 1)
        velocity = rows[middle, 1:]
        traces = tuple(
            JointTrace(
                torque=extremes[k],
                predicted=extremes[joints + k],
                residual=extremes[2 * joints + k],
                velocity=velocity[:, k],
                standstill=marked[k],
            )
            for k in range(joints)
        )
        return Traced(
            name=recording.path.name,
            sha256=recording.sha256,
            role=role,
            time=time,
            width=self._envelope.width,
            joints=traces,
            spectra=self._spectra(),
        )

    def _spectra(self) -> tuple[Spectrum, ...]:
        if self._welch is None or not self._welch.ready:
            return ()
        frequency, density = self._welch.density()
        lag, correlation = self._welch.correlation()
        white = self._welch.white
        return tuple(Spectrum(frequency, density[k], lag, correlation[k], white) for k in range(len(density)))
