"""Which rows a torque error is computed on and what both torques went through, so that two figures can be compared."""

from __future__ import annotations

import textwrap

from ident_service.config.schema import Identification


def rows_and_filter(options: Identification) -> tuple[str, ...]:
    """Describe the rows and the filters behind relative torque errors (eq. 84), one sentence each.

    Args:
        options: with which the equations were made.
    """
    smoothing, reversal = options.smoothing, options.reversal
    thinned = f", every {_said(smoothing.decimate)}th" if smoothing.decimate != 1 else ""
    rows = f"All rows: every sample of a recording but {options.edge:g} s at its ends and at gaps{thinned}."
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


def rows_and_filter_text(options: Identification) -> list[str]:
    """Wrap the sentences of `rows_and_filter` into lines for a terminal."""
    return [
        line for sentence in rows_and_filter(options) for line in textwrap.wrap(sentence, 100, subsequent_indent="  ")
    ]


def _said(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:g}"
