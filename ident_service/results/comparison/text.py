"""Describe a comparison in text, for a person at a terminal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ident_service.estimation.drift import ALPHA, RELEVANT_RESIDUAL, RELEVANT_TORQUE, relevant
from ident_service.results.comparison.comparison import UNSAID, Comparison, Pair
from ident_service.results.comparison.findings import Finding, findings, joint_name
from ident_service.results.comparison.sides import Side

_WIDTH = 46
_MOST = 8  # parameters that only one side has, of which each is named
LEFT_OUT = (
    "left out: directions that neither motion shows, or that the recordings, being short, cannot tell from noise; of "
    "these the test says nothing"
)


def comparison_text(comparison: Comparison) -> str:
    """Describe a comparison in several lines of plain text, ending with a line break."""
    lines = [f"reference: {_called(comparison.reference)}"]
    for pair in comparison.pairs:
        lines += [f"compared:  {_called(pair.side)}", "", *_pair(comparison, pair)]
    return "\n".join(lines) + "\n"


def _called(side: Side) -> str:
    arm = side.content.get("arm", {}).get("name", "no arm named")
    return f"{side.path} ({arm}, {side.content.get('method', 'method not said')})"


def _pair(comparison: Comparison, pair: Pair) -> list[str]:
    lines = verdict_lines(pair)
    if pair.drift is not None:
        joint = pair.drift.joint
        left = f", {joint.left_out} of {len(pair.places[0])} directions left out" if joint.left_out else ""
        lines += ["", f"all parameters together: {joint.sigma:.3g} sigma in {joint.directions} directions, "]
        lines[-1] += f"p = {joint.p:.2g}{left}"
        lines += [f"  {LEFT_OUT}"] if left else []
    for name, share in _shares(pair):
        lines.append(f"  joint {name}: the differences change its predicted torque by {share:.2%} (root mean squares)")
    if pair.crossed is not None:
        own, other = pair.crossed.own, pair.crossed.reference
        lines += [
            "",
            f"torque error on the recordings of {pair.side.path}: {own.relative_percent:.3f} % with its own "
            f"parameters, {other.relative_percent:.3f} % with the reference's",
        ]
        for number, name in enumerate(pair.side.joints or ()):
            values = own.joint_relative_percent[number], other.joint_relative_percent[number]
            lines.append(f"  joint {name}: {values[0]:.2f} %, {values[1]:.2f} %")
    for what, errors in (("fit", _fits), ("validation", _validations)):
        lines.append(f"torque error of the {what}: {errors(comparison.reference)}; {errors(pair.side)}")
    lines += ["", *_table(comparison.reference, pair)]
    for title, left_out in (("the reference", pair.only_reference), (str(pair.side.path), pair.only_side)):
        if left_out:
            lines += ["", f"left out, only in {title}:", *(f"  {one}" for one in shortened(left_out))]
    if pair.provenance:
        lines += ["", "what differs in how they came about (reference; compared):"]
        said = {key: both for key, both in pair.provenance.items() if UNSAID not in both}
        lines += [f"  {key}: {_short(a, 60)}; {_short(b, 60)}" for key, (a, b) in said.items()]
        if alone := [key for key in pair.provenance if key not in said]:
            lines.append(f"  said of one alone: {', '.join(alone)}")
    lines += [f"note: {note}" for note in pair.notes]
    return [*lines, ""]


def verdict_lines(pair: Pair) -> list[str]:
    """Return the verdict and what it rests on, in lines."""
    if pair.drift is None or pair.verdict == "impossible":
        return [f"NO VERDICT: {pair.reason}"]
    if pair.drift.verdict == "unchanged":
        floor = f"p >= {ALPHA:g} after Holm, or less than {RELEVANT_TORQUE:.0%} of every joint's torque"
        lines = [f"UNCHANGED ({floor} or {RELEVANT_RESIDUAL:.0%} of its residual)"]
        return [*lines, contradiction(pair)] if pair.contradicted else lines
    lines = ["CHANGED"]
    for finding in findings(pair):
        lines += [f"  {finding_line(finding)}", f"    may mean: {finding.meaning}"]
    return lines


def contradiction(pair: Pair) -> str:
    """Return why an unchanged arm has values in use that predict other torques; empty where they do not."""
    worst = pair.in_use.worst()
    if not pair.contradicted or worst is None:
        return ""
    joint, share = worst
    errors = ""
    if pair.crossed is not None:
        own, other = (error.joint_relative_percent[joint] for error in (pair.crossed.own, pair.crossed.reference))
        errors = f" (torque error {own:.3g} % with its own, {other:.3g} % with the reference's)"
    if pair.drift is not None and relevant(pair.drift.shares):
        why = "the tested values differ by as much, which may be chance: their doubt is as large"
    else:
        why = (
            "the unconstrained values, which are tested, do not; what was made of them does (feasible set, "
            "constraints, method, or a file that was edited)"
        )
    return (
        f"BUT the values in use change the torque of joint {joint_name(pair, joint + 1)} by {share:.2%}{errors}: "
        f"{why}. Do not take one set of parameters for the other"
    )


def tested_line(pair: Pair) -> str:
    """Return which values the tests are about, in words; empty where nothing is tested."""
    if pair.compared is None:
        return ""
    if not pair.free:
        return "tested: the values in use"
    line = "tested: unconstrained values, to which the covariances belong"
    return f"{line}; the values in use, held in a feasible set, stand beside them" if pair.in_use.apart else line


def shortened(rows: Sequence[str]) -> list[str]:
    """Return the first few of many rows, and how many more there are."""
    if len(rows) <= _MOST:
        return list(rows)
    return [*rows[:_MOST], f"and {len(rows) - _MOST} more (all of them in the JSON)"]


def finding_line(finding: Finding) -> str:
    """Return one finding in one line."""
    parts = [f"{finding.sigma:.3g} sigma"]
    if finding.torque_share is not None:
        parts.append(f"{finding.torque_share:.2%} of the torque of joint {finding.joint}")
    if finding.size:
        parts.append(finding.size)
    return f"{finding.what}: " + "; ".join(parts)


def _shares(pair: Pair) -> list[tuple[str, float]]:
    if pair.drift is None or pair.drift.torque_share is None:
        return []
    names = pair.side.joints or tuple(str(number + 1) for number in range(len(pair.drift.torque_share)))
    return list(zip(names, pair.drift.torque_share.tolist(), strict=True))


def _fits(side: Side) -> str:
    fit = side.content.get("fit")
    return "not said" if fit is None else f"{fit['relative_error_percent']:.3f} %"


def _validations(side: Side) -> str:
    scores = side.content.get("validation", [])
    return ", ".join(f"{one['relative_error_percent']:.3f} % ({one['recording']})" for one in scores) or "none"


def _table(reference: Side, pair: Pair) -> list[str]:
    apart, use = pair.in_use.apart, pair.in_use
    heads = f"{'reference':>11s} {'compared':>11s} {'difference':>11s} {'z':>8s} {'p (Holm)':>9s}"
    heads += f" {'ref. in use':>11s} {'cmp. in use':>11s}" if apart else ""
    lines = [*filter(None, (tested_line(pair),)), f"{'base parameter':{_WIDTH}s} {heads}"]
    expressions = reference.content["base_parameters"]["expressions"]
    for k, (here, there) in enumerate(zip(*pair.places, strict=True)):
        values = reference.file.values[here], pair.side.file.values[there]
        if pair.compared is not None:
            values = pair.compared[0].values[k], pair.compared[1].values[k]
        z, p = "", ""
        if pair.drift is not None:
            seen = bool(np.isfinite(pair.drift.deviations[k]))
            z, p = (f"{pair.drift.z[k]:.2f}", f"{pair.drift.p[k]:.2g}") if seen else ("unseen", "")
        lines.append(
            f"{_short(expressions[here], _WIDTH):{_WIDTH}s} {values[0]:11.4g} {values[1]:11.4g} "
            f"{pair.difference[k]:11.3g} {z:>8s} {p:>9s}"
            f"{f' {use.reference[k]:11.4g} {use.side[k]:11.4g}' if apart else ''}".rstrip()
        )
    return lines


def _short(text: str, width: int) -> str:
    return text if len(text) <= width else text[: width - 3] + "..."
