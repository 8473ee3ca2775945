"""Describe the rows and filters that a torque error is computed with, so that two figures can be compared."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable

import numpy as np

from ident_service.config.schema import Identification
from ident_service.estimation.identify import Estimate


def rows_and_filter(options: Identification) -> tuple[str, ...]:
    """Describe the rows and the filters behind relative torque errors (eq. 84), one sentence each.

    Args:
        options: with which the equations were made.
    """
    smoothing, reversal = options.smoothing, options.reversal
    if "choose" in (smoothing.cutoff, smoothing.decimate, options.edge):
        chosen = "Rows and filter: chosen for each recording from the spectra of its positions; its ends are left out."
        return (chosen,)
    thinned = f", every {_said(smoothing.decimate)}th" if smoothing.decimate != 1 else ""
    rows = f"All rows: every sample of a recording but {_said(options.edge)} s at its ends and at gaps{thinned}."
    slow = f"is not faster than {reversal.speed:g} rad/s (or m/s)" if reversal.speed else "stands still"
    near = f", and without those within {reversal.window:g} s of them" if reversal.window else ""
    rows_moving = f"Away from standstill: without rows in which a drive of that joint {slow}{near}."
    if smoothing.method == "butterworth":
        low_pass = f"a zero-phase Butterworth low-pass of order {smoothing.order} at {_said(smoothing.cutoff)} Hz"
    else:
        low_pass = f"Savitzky-Golay polynomials of degree {smoothing.order}, cut-off {_said(smoothing.cutoff)} Hz"
    position = f"Position, velocity and acceleration: through {low_pass}."
    if options.period is not None:
        return rows, rows_moving, position, f"Position and torque: averaged over periods of {options.period:g} s."
    if smoothing.filter_torque:
        other = f"a zero-phase Butterworth low-pass of order {smoothing.order} at {_said(smoothing.cutoff)} Hz"
        torque = f"Measured torque: through {'the same low-pass' if smoothing.method == 'butterworth' else other}."
    else:
        torque = "Measured torque: as recorded, so that its noise counts as error."
    if smoothing.regressor_cutoff is None:
        return rows, rows_moving, position, torque
    both = f"Then measured and predicted torque: through a low-pass at {smoothing.regressor_cutoff:g} Hz."
    return rows, rows_moving, position, torque, both


def how_fitted(estimate: Estimate) -> tuple[str, ...]:
    """Describe how an estimate's rows and filters came about, one sentence each: what was given, chosen and weighed."""
    shares = estimate.standstill_shares
    low, high = (f"{share:.2g}" for share in (shares.min(), shares.max()))
    weighed = f"{low} to {high}" if low != high else low
    return (
        *rows_and_filter(estimate.model.config.identification),
        f"Rows near standstill: multiplied in the fit by {weighed}, as their own residuals have it.",
        *(f"Chosen: {choice}." for choice in estimate.choices),
        _noise_and_model(estimate),
    )


def _noise_and_model(estimate: Estimate) -> str:
    """Describe how much of the deviations is noise and how much error of the model, as far as repetitions tell."""
    if estimate.noise_deviations is None:
        return "Most of the motion is not repeated, so that noise and error of the model cannot be told apart."
    variances = np.diag(estimate.covariance)
    known = np.isfinite(variances) & (variances > 0.0)
    share = np.clip(estimate.noise_deviations[known] ** 2 / variances[known], 0.0, 1.0)
    return (
        f"The motion is repeated: {np.median(share):.0%} of a parameter's variance is noise (median; "
        f"{share.min():.0%} to {share.max():.0%}), the rest is error of the model, which more periods do not diminish."
    )


def wrapped(sentences: Iterable[str]) -> list[str]:
    """Wrap sentences into lines for a terminal."""
    return [line for sentence in sentences for line in textwrap.wrap(sentence, 100, subsequent_indent="  ")]


def _said(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:g}"
