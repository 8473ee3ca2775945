"""Summarise an estimate for a person at a terminal: verdict, errors (table 8), parameters (table 6)."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import numpy as np

from ident_service.estimation.doubt import IDENTIFIED_BELOW, NEGLIGIBLE_TORQUE, WEAK_BELOW
from ident_service.estimation.identify import Candidate, Estimate
from ident_service.estimation.least_squares import TorqueError
from ident_service.model.layout import NO_STRIBECK
from ident_service.model.likely_bodies import IN_WORDS
from ident_service.results.link_values import WHAT_THEN, implausible_links
from ident_service.results.rows_and_filter import how_fitted, wrapped


def summary(estimate: Estimate, unusable: Sequence[str] = (), torque: str = "commanded") -> str:
    """Describe an estimate in lines no wider than a terminal.

    Args:
        estimate: to describe.
        unusable: why it must not be used; that comes first.
        torque: that the recordings give: `measured`, `commanded`, or `recorded` by another program.
    """
    names = estimate.model.chain.names
    own = estimate.candidates[estimate.chosen]
    columns = ["identification", *(score.recording for score in own.validation)]
    lines = [
        *_refusal(unusable),
        f"{estimate.model.config.name}: {estimate.base.size} base parameters of {len(estimate.base.names)} link "
        f"parameters, from {estimate.samples} samples of {torque} torque",
        f"condition number of the regressor: {estimate.fit.condition_number:.1f}",
        "",
        _feasibility(estimate),
        *_convex(estimate),
        "",
        "relative torque error in percent (eq. 84): of all rows, and of joints away from standstill",
        _row(f"  verdict by {estimate.conditions.kind}", columns),
    ]
    for candidate in estimate.candidates:
        mark = "*" if candidate is own else " "
        verdict = "feasible" if candidate.margin > 0.0 else "infeasible"
        cells = [f"{whole.relative_percent:.3f}  {moving.relative_percent:.3f}" for whole, moving in _errors(candidate)]
        lines.append(_row(f"{mark} {candidate.name} ({verdict})", cells))
    lines += ["", "per joint, the estimate marked *", _row("", columns)]
    for k, name in enumerate(names):
        cells = [
            f"{whole.joint_relative_percent[k]:.2f}  {moving.joint_relative_percent[k]:.2f}"
            for whole, moving in _errors(own)
        ]
        lines.append(_row(f"  {name}", cells))
    lines += ["", *wrapped(how_fitted(estimate))]
    lines += _found_before(estimate)
    counts = {word: estimate.verdicts.count(word) for word in ("identified", "weak", "unidentified")}
    lines += [
        "",
        ", ".join(f"{count} {word}" for word, count in counts.items())
        + f" (standard deviation below {IDENTIFIED_BELOW:.0%} of the parameter, below {WEAK_BELOW:.0%}, above;",
        f"  or below {NEGLIGIBLE_TORQUE * IDENTIFIED_BELOW:.0%}, {NEGLIGIBLE_TORQUE * WEAK_BELOW:.0%} of the torque of"
        " every joint that feels it; widened by Student's t where few stretches of motion tell it)",
    ]
    doubtful = [i for i, verdict in enumerate(estimate.verdicts) if verdict != "identified"]
    for i in doubtful:
        lines.append(
            f"  {estimate.verdicts[i]:12s} {_short(estimate.base.expressions[i])} = {estimate.beta[i]:.4g} "
            f"+- {estimate.standard_deviations[i]:.2g} {estimate.base.units[i]}"
        )
    return "\n".join(lines) + "\n"


def _refusal(unusable: Sequence[str]) -> list[str]:
    if not unusable:
        return []
    paragraphs = [textwrap.fill(reason, 100, initial_indent="  - ", subsequent_indent="    ") for reason in unusable]
    return ["DO NOT USE these parameters:", *paragraphs, ""]


def _errors(candidate: Candidate) -> list[tuple[TorqueError, TorqueError]]:
    scores = [(score.error, score.moving) for score in candidate.validation]
    return [(candidate.identification, candidate.moving), *scores]


def _found_before(estimate: Estimate) -> list[str]:
    """Describe what was found before the parameters: delay, shape of the friction, torque constants, prior."""
    model, prepared = estimate.model, estimate.prepared
    lines = []
    if (payload := model.config.payload) is not None:
        lines.append(f"payload, by the description: {payload.words}; these are parameters of the arm with it")
    if prepared.delay is not None:
        seconds, deviation = 1e3 * prepared.delay.seconds, 1e3 * prepared.delay.deviation
        lines.append(f"torque is stamped {seconds:.3f} +- {deviation:.3f} ms later than the position")
    presliding = np.atleast_1d(np.asarray(model.config.identification.friction.presliding, dtype=float))
    if presliding.any():
        lines.append("pre-sliding way [rad or m]: " + " ".join(f"{value:.2g}" for value in presliding))
    if model.layout.stribeck_velocity:
        velocities = " ".join(
            f"{value:.2g}" if value > NO_STRIBECK else "none" for value in model.layout.stribeck_velocity
        )
        lines.append(f"Stribeck velocity [rad/s or m/s]: {velocities}")
    if (prepared.torque_scales != 1.0).any():
        lines.append("measured torques multiplied by: " + " ".join(f"{value:.4g}" for value in prepared.torque_scales))
    if estimate.prior is not None:
        lines.append(f"drawn to the {estimate.prior.kind} prior with weight {estimate.prior.weight:g}")
    return ["", *lines] if lines else []


def parameter_table(estimate: Estimate) -> str:
    """Return every base parameter as text: estimate, standard deviation, verdict (table 6)."""
    lines = [f"{'base parameter':58s} {'estimate':>12s} {'deviation':>10s}  verdict"]
    for expression, value, deviation, unit, verdict in zip(
        estimate.base.expressions,
        estimate.beta,
        estimate.standard_deviations,
        estimate.base.units,
        estimate.verdicts,
        strict=True,
    ):
        lines.append(f"{_short(expression):58s} {value:12.5g} {deviation:10.2g}  {verdict} [{unit}]")
    return "\n".join(lines) + "\n"


def _feasibility(estimate: Estimate) -> str:
    kind = estimate.conditions.kind
    if estimate.feasible:
        text = f"feasible ({kind}): margin {estimate.margin:.3g}, a real body could have these parameters\n"
        of_many = "" if estimate.nearest_to is None else f", the nearest to {IN_WORDS[estimate.nearest_to]}"
        text += f"(motion shows base parameters only; the link values behind them are one body of many{of_many})"
        if strange := implausible_links(estimate):
            text += "\n" + "\n".join(wrapped([f"implausible, {line}" for line in strange] + [WHAT_THEN]))
        if estimate.tight:
            text += "\nthe data pull against:\n" + "\n".join(f"  {name}" for name in estimate.tight)
        return text
    text = f"INFEASIBLE ({kind}): margin {estimate.margin:.3g}; no body has these parameters\ncontradicted by:\n"
    return text + "\n".join(f"  {name}" for name in estimate.tight)


def _convex(estimate: Estimate) -> list[str]:
    """Describe custom knowledge and the second opinion, where there are."""
    lines = []
    if (known := estimate.custom) is not None:
        function = known.function
        lines += [
            "",
            f"with {function.name} ({function.file}) by {known.solver}: torque error {known.error:.4f} % where joints "
            f"move, {known.error_without:.4f} % without it",
            "(verdict, margin and certificate are about the other conditions of the description alone)",
        ]
    if (second := estimate.second) is not None:
        one, other = second.objectives
        first_by, second_by = second.solvers
        if second.agrees:
            word = "the two agree"
        elif second.conclusive:
            word = "THE TWO DIFFER, use neither before you know why"
        else:
            word = f"it stopped early, which says little; try another --solver than {second_by}"
        lines += [
            "",
            f"second opinion, {second_by} through cvxpy ({second.status}): " + word,
            f"  objective {one:.9g} by {first_by}, {other:.9g} by {second_by}"
            + (f", which misses the set by {-second.margin:.1g}" if second.margin <= 0.0 else ""),
            f"  predicted torques differ by {second.torque_percent:.2g} %, base parameters by at most "
            f"{second.deviations:.2g} deviations: {_short(second.expression)}",
        ]
    return lines


def _short(expression: str, width: int = 58) -> str:
    return expression if len(expression) <= width else expression[: width - 3] + "..."


def _row(label: str, cells: list[str]) -> str:
    return f"{label:40s}" + "".join(f" {cell:>22s}" for cell in cells)
