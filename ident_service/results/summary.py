"""What a person at a terminal wants to know of an estimate: verdict, errors (table 8), parameters (table 6)."""

from __future__ import annotations

from ident_service.estimation.doubt import IDENTIFIED_BELOW, WEAK_BELOW
from ident_service.estimation.identify import Estimate


def summary(estimate: Estimate) -> str:
    """Several lines of plain text, no wider than a terminal."""
    names = estimate.model.chain.names
    own = estimate.candidates[estimate.chosen]
    lines = [
        f"{estimate.model.config.name}: {estimate.base.size} base parameters of {len(estimate.base.names)} link "
        f"parameters, from {estimate.samples} samples",
        f"condition number of the regressor: {estimate.fit.condition_number:.1f}",
        "",
        _feasibility(estimate),
        "",
        "relative torque error in percent (eq. 84)",
        _row(f"  verdict by {estimate.conditions.kind}", ["identification", *(s.recording for s in own.validation)]),
    ]
    for candidate in estimate.candidates:
        errors = [candidate.identification, *(score.error for score in candidate.validation)]
        mark = "*" if candidate is own else " "
        verdict = "feasible" if candidate.margin > 0.0 else "infeasible"
        label = f"{mark} {candidate.name} ({verdict})"
        lines.append(_row(label, [f"{error.relative_percent:.3f}" for error in errors]))
    lines += [
        "",
        "per joint, the estimate marked *",
        _row("", ["identification", *(s.recording for s in own.validation)]),
    ]
    for k, name in enumerate(names):
        errors = [own.identification, *(score.error for score in own.validation)]
        cells = [f"{error.joint_relative_percent[k]:.2f} % {error.joint_rms[k]:.4f}" for error in errors]
        lines.append(_row(f"  {name}", cells))
    counts = {word: estimate.verdicts.count(word) for word in ("identified", "weak", "unidentified")}
    lines += [
        "",
        ", ".join(f"{count} {word}" for word, count in counts.items())
        + f" (standard deviation below {IDENTIFIED_BELOW:.0%}, below {WEAK_BELOW:.0%}, above)",
    ]
    doubtful = [i for i, verdict in enumerate(estimate.verdicts) if verdict != "identified"]
    for i in doubtful:
        lines.append(
            f"  {estimate.verdicts[i]:12s} {_short(estimate.base.expressions[i])} = {estimate.beta[i]:.4g} "
            f"+- {estimate.standard_deviations[i]:.2g} {estimate.base.units[i]}"
        )
    return "\n".join(lines) + "\n"


def parameter_table(estimate: Estimate) -> str:
    """Every base parameter: estimate, standard deviation, verdict (table 6)."""
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
        text = f"feasible ({kind}): margin {estimate.margin:.3g}, a real body could have these parameters"
        if estimate.tight:
            text += "\nthe data pull against:\n" + "\n".join(f"  {name}" for name in estimate.tight)
        return text
    text = f"INFEASIBLE ({kind}): margin {estimate.margin:.3g}; no body has these parameters\ncontradicted by:\n"
    return text + "\n".join(f"  {name}" for name in estimate.tight)


def _short(expression: str, width: int = 58) -> str:
    return expression if len(expression) <= width else expression[: width - 3] + "..."


def _row(label: str, cells: list[str]) -> str:
    return f"{label:40s}" + "".join(f" {cell:>22s}" for cell in cells)
