"""Summarise an estimate for a person at a terminal: verdict, errors, implausible link values.

Motion shows base parameters; of the bodies behind them one near to likely bodies is chosen (`model/likely_bodies.py`).
Where data press against the feasible set, little is left to choose from, and a link may come out as heavy as the arm or
as a point beside it. Readers of a mass in a URDF should know.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ident_service.config.arm import Identification
from ident_service.estimation.equations import motors_of_torques
from ident_service.estimation.identify import Candidate, Estimate
from ident_service.estimation.least_squares import TorqueError
from ident_service.estimation.uncertainty import IDENTIFIED_BELOW, NEGLIGIBLE_TORQUE, WEAK_BELOW
from ident_service.model.chain import Array
from ident_service.model.likely_bodies import IN_WORDS, likely_bodies, link_rods
from ident_service.model.parameter_layout import NO_STRIBECK
from ident_service.results.assessment import Assessment, assess_estimate
from ident_service.results.evidence.gathering import ellipsoid
from ident_service.results.plots import shortened


def rows_and_filter(options: Identification) -> tuple[str, ...]:
    """Describe the rows and the filters behind relative torque errors (eq. 84), one sentence each.

    Args:
        options: options that the equations were made with.
    """
    smoothing, reversal = options.smoothing, options.reversal
    if "choose" in (smoothing.cutoff, smoothing.decimate, options.edge):
        chosen = "Rows and filter: chosen for each recording from the spectra of its positions; its ends are left out."
        return (chosen,)
    thinned = f", thinned out to one of {_words(smoothing.decimate)}" if smoothing.decimate != 1 else ""
    rows = f"All rows: every sample of a recording but {_words(options.edge)} s at its ends and at gaps{thinned}."
    slow = f"is not faster than {reversal.speed:g} rad/s (or m/s)" if reversal.speed else "stands still"
    near = f", and without those within {reversal.window:g} s of them" if reversal.window else ""
    rows_moving = f"Away from standstill: without rows in which a drive of that joint {slow}{near}."
    if smoothing.method == "butterworth":
        low_pass = f"a zero-phase Butterworth low-pass of order {smoothing.order} at {_words(smoothing.cutoff)} Hz"
    else:
        low_pass = f"Savitzky-Golay polynomials of degree {smoothing.order}, cut-off {_words(smoothing.cutoff)} Hz"
    position = f"Position, velocity and acceleration: through {low_pass}."
    if options.period is not None:
        return rows, rows_moving, position, f"Position and torque: averaged over periods of {options.period:g} s."
    if smoothing.filter_torque:
        other = f"a zero-phase Butterworth low-pass of order {smoothing.order} at {_words(smoothing.cutoff)} Hz"
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
        noise_and_model(estimate.noise_deviations, np.diag(estimate.covariance)),
    )


def noise_and_model(noise_deviations: Array | None, variances: Array) -> str:
    """Describe how much of the parameters' variances is noise, given its deviations, and how much error of the model.

    Args:
        noise_deviations: standard deviations by what differs between repetitions of the motion, shape (base,); None
            where most of the motion is not repeated.
        variances: variances of the parameters, shape (base,); infinite or NaN where unknown.
    """
    if noise_deviations is None:
        return "Most of the motion is not repeated, so noise and model error cannot be separated."
    known = np.isfinite(noise_deviations) & np.isfinite(variances) & (variances > 0.0)
    share = np.clip(noise_deviations[known] ** 2 / variances[known], 0.0, 1.0)
    return (
        f"The motion is repeated: {np.median(share):.0%} of a parameter's variance is noise (median; "
        f"{share.min():.0%} to {share.max():.0%}), the rest is model error, which more periods do not reduce."
    )


def wrapped(sentences: Iterable[str]) -> list[str]:
    """Wrap each sentence into lines of at most 100 characters, all but its first indented."""
    return [line for sentence in sentences for line in textwrap.wrap(sentence, 100, subsequent_indent="  ")]


def _words(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:g}"


_WIDTH = 58  # columns of an expression

MASSES = 10.0  # factor above or below a likely mass
_REACH = 1.0 / 3.0  # of the arm's, from a likely centre, or the link's own length
_SIZE, _TIMES = 0.5, 3.0  # of the arm's reach, and times a likely size

WHAT_THEN = (
    "Link values are one choice of many with the same torques, and these are not the arm's. Bounds in joints.*.body and"
    " constraints.total_mass, or a prior, improve the choice."
)


def implausible_links(estimate: Estimate) -> tuple[str, ...]:
    """Return a sentence per link with implausible values and bounds; none if a prior or custom knowledge chose them.

    Args:
        estimate: estimate with link values; one without, or with values that a prior or custom knowledge asked for, has
            none to name.
    """
    if estimate.delta is None or estimate.nearest_to is None:
        return ()
    model = estimate.model
    chain, layout = model.chain, model.layout
    likely = likely_bodies(model).delta
    reach = float(np.linalg.norm([*chain.translation[1:], *chain.link_translation], axis=1).sum())
    found = []
    for link, name in enumerate(chain.names):
        place = layout.inertial(link)
        (mass, center, axes), (usual, middle, shape) = ellipsoid(estimate.delta[place]), ellipsoid(likely[place])
        wrong = []
        if not usual / MASSES <= mass <= usual * MASSES:
            wrong.append(f"{mass:.2g} kg, where {usual / MASSES:.2g} to {usual * MASSES:.2g} kg are likely")
        own = max(float(np.linalg.norm(np.subtract(line.end, line.start))) for line in link_rods(model, link))
        away, most = float(np.linalg.norm(center - middle)), max(own, _REACH * reach)
        if away > most:
            wrong.append(f"its centre {away:.2g} m from a likely place, where {most:.2g} m would be much")
        if axes is not None and shape is not None:
            size, most = (float(np.linalg.norm(one, axis=1).max()) for one in (axes, shape))
            most = max(_SIZE * reach, _TIMES * most)
            if size > most:
                wrong.append(f"an inertia as of a body that reaches {size:.2g} m, where {most:.2g} m would be much")
        if wrong:
            found.append(f"{name}: its link has {'; '.join(wrong)}")
    return tuple(found)


def summary(
    estimate: Estimate, unusable: Sequence[str] = (), torque_kind: str = "commanded", warnings: Sequence[str] = ()
) -> str:
    """Describe an estimate in lines no wider than a terminal: verdict, reasons, a row per joint, then details.

    Args:
        estimate: estimate to describe.
        unusable: reasons why it must not be used, which come first.
        torque_kind: kind of torque in the recordings: `measured`, `commanded`, or `recorded` by another program.
        warnings: what is wrong with the recordings, in words.
    """
    own = estimate.candidates[estimate.chosen]
    columns = ["identification", *(score.recording for score in own.validation)]
    lines = [
        *assessment_lines(assess_estimate(estimate, unusable, warnings)),
        "",
        "Details",
        f"{estimate.model.config.name}: {estimate.base.size} base parameters of {len(estimate.base.names)} link "
        f"parameters, from {estimate.samples} samples of {torque_kind} torque",
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
    if len(own.validation) > 1:
        # The table on top has the worst of them.
        lines += ["", "per joint, the estimate marked *", _row("", columns)]
        for k, name in enumerate(estimate.model.chain.names):
            cells = [
                f"{whole.joint_relative_percent[k]:.2f}  {moving.joint_relative_percent[k]:.2f}"
                for whole, moving in _errors(own)
            ]
            lines.append(_row(f"  {name}", cells))
    lines += ["", *wrapped(how_fitted(estimate))]
    lines += _preliminary_findings(estimate)
    counts = {word: estimate.verdicts.count(word) for word in ("identified", "weak", "unidentified")}
    lines += [
        "",
        ", ".join(f"{count} {word}" for word, count in counts.items())
        + f" (standard deviation below {IDENTIFIED_BELOW:.0%} of the parameter, below {WEAK_BELOW:.0%}, above;",
        f"  or below {NEGLIGIBLE_TORQUE * IDENTIFIED_BELOW:.0%}, {NEGLIGIBLE_TORQUE * WEAK_BELOW:.0%} of the torque of"
        " every joint concerned; widened by Student's t where few stretches of motion determine it)",
    ]
    doubtful = [i for i, verdict in enumerate(estimate.verdicts) if verdict != "identified"]
    for i in doubtful:
        lines.append(
            f"  {estimate.verdicts[i]:12s} {shortened(estimate.base.expressions[i], _WIDTH)} = {estimate.beta[i]:.4g} "
            f"+- {estimate.standard_deviations[i]:.2g} {estimate.base.units[i]}"
        )
    return "\n".join(lines) + "\n"


def assessment_lines(assessment: Assessment) -> list[str]:
    """Return the verdict, its reasons and a row per joint, as lines for a terminal.

    Args:
        assessment: assessment to show.
    """
    head = assessment.word.upper() + assessment.line[len(assessment.word) :]
    if assessment.word == "do not use":
        head = "DO NOT USE these parameters:"
    lines = [*wrapped([head]), *(line for reason in assessment.reasons for line in _bullet(reason))]
    if assessment.further:
        lines += ["further:", *(line for reason in assessment.further for line in _bullet(reason))]
    if not assessment.joints:
        return lines
    unseen = any(joint.unseen is not None for joint in assessment.joints)
    heads = ["fitted", "moving", *(["unseen", "moving"] if unseen else []), "residual rms"]
    width = max(len("torque error [%]"), *(len(joint.joint) for joint in assessment.joints))
    lines += ["", f"{'torque error [%]':{width}s}" + "".join(f" {head:>14s}" for head in heads) + "  verdict"]
    for joint in assessment.joints:
        values = [joint.fitted, joint.fitted_moving, *([joint.unseen, joint.unseen_moving] if unseen else [])]
        cells = ["" if value is None else f"{value:.2f}" for value in values]
        cells.append("" if joint.residual is None else f"{joint.residual:.3g} {joint.unit}")
        lines.append(f"{joint.joint:{width}s}" + "".join(f" {cell:>14s}" for cell in cells) + f"  {joint.word}")
    return lines


def _bullet(words: str) -> list[str]:
    return textwrap.wrap(words, 100, initial_indent="  - ", subsequent_indent="    ")


def _errors(candidate: Candidate) -> list[tuple[TorqueError, TorqueError]]:
    scores = [(score.error, score.moving) for score in candidate.validation]
    return [(candidate.identification, candidate.moving), *scores]


def _preliminary_findings(estimate: Estimate) -> list[str]:
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
        lines.append("pre-sliding distance [rad or m]: " + " ".join(f"{value:.2g}" for value in presliding))
    if model.layout.stribeck_velocity:
        velocities = " ".join(
            f"{value:.2g}" if value > NO_STRIBECK else "none" for value in model.layout.stribeck_velocity
        )
        lines.append(f"Stribeck velocity [rad/s or m/s]: {velocities}")
    if (prepared.torque_scales != 1.0).any():
        lines.append("measured torques multiplied by: " + " ".join(f"{value:.4g}" for value in prepared.torque_scales))
    lines += _torque_constants(estimate)
    if estimate.prior is not None:
        lines.append(f"regularised towards the {estimate.prior.kind} prior with weight {estimate.prior.weight:g}")
    return ["", *lines] if lines else []


def torque_constants_document(estimate: Estimate) -> dict[str, Any]:
    """Return the identified torque constants of the motors as JSON values; an empty dict if they were not."""
    found = estimate.prepared.torque_constants
    if found is None:
        return {}
    names = estimate.model.chain.names
    motors = enumerate(motors_of_torques(estimate.model))
    return {
        "torque_constants": [
            {
                "motor": number + 1,
                "joints": [names[joint] for joint in np.flatnonzero(row)],
                "factor": float(found.factors[number]),
                "standard_deviation": None if np.isinf(found.deviations[number]) else float(found.deviations[number]),
                "verdict": found.verdicts[number],
            }
            for number, row in motors
        ]
    }


def _torque_constants(estimate: Estimate) -> list[str]:
    found = estimate.prepared.torque_constants
    if found is None:
        return []
    lines = ["torque that each motor gives for one by its description (multiply the torque_scale of its drive by it):"]
    for one in torque_constants_document(estimate)["torque_constants"]:
        whose = f"  motor {one['motor']} ({', '.join(one['joints'])}): "
        if one["verdict"] == "unidentified":
            lines.append(f"{whose}not shown by these recordings, taken as described")
        else:
            lines.append(f"{whose}{one['factor']:.4f} +- {one['standard_deviation']:.4f}  {one['verdict']}")
    lines.append(
        f"  error of the motors' torques with them {found.error_percent:.2f} %, without {found.error_before:.2f} %"
    )
    return lines


def parameter_table(estimate: Estimate) -> str:
    """Return a text table of all base parameters in the estimate's order: value, standard deviation, verdict, unit."""
    lines = [f"{'base parameter':{_WIDTH}s} {'estimate':>12s} {'deviation':>10s}  verdict"]
    for expression, value, deviation, unit, verdict in zip(
        estimate.base.expressions,
        estimate.beta,
        estimate.standard_deviations,
        estimate.base.units,
        estimate.verdicts,
        strict=True,
    ):
        lines.append(f"{shortened(expression, _WIDTH):{_WIDTH}s} {value:12.5g} {deviation:10.2g}  {verdict} [{unit}]")
    return "\n".join(lines) + "\n"


def _feasibility(estimate: Estimate) -> str:
    kind = estimate.conditions.kind
    if estimate.feasible:
        text = f"feasible ({kind}): margin {estimate.margin:.3g}, physically feasible\n"
        of_many = "" if estimate.nearest_to is None else f", the nearest to {IN_WORDS[estimate.nearest_to]}"
        text += f"(motion shows base parameters only; the link values behind them are one body of many{of_many})"
        if strange := implausible_links(estimate):
            text += "\n" + "\n".join(wrapped([f"implausible, {line}" for line in strange] + [WHAT_THEN]))
        if estimate.tight:
            text += "\nactive constraints:\n" + "\n".join(f"  {name}" for name in estimate.tight)
        return text
    text = f"INFEASIBLE ({kind}): margin {estimate.margin:.3g}; not physically feasible\nviolated constraints:\n"
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
            "(verdict, margin and certificate are about the other constraints of the description alone)",
        ]
    if (second := estimate.second) is not None:
        one, other = second.objectives
        first_by, second_by = second.solvers
        if second.agrees:
            word = "the two agree"
        elif second.conclusive:
            word = "THE TWO DIFFER: use neither before the reason is known"
        else:
            word = f"it stopped early; try another --solver than {second_by}"
        lines += [
            "",
            f"second opinion, {second_by} through cvxpy ({second.status}): " + word,
            f"  objective {one:.9g} by {first_by}, {other:.9g} by {second_by}"
            + (f", which misses the set by {-second.margin:.1g}" if second.margin <= 0.0 else ""),
            f"  predicted torques differ by {second.torque_percent:.2g} %, base parameters by at most "
            f"{second.deviations:.2g} deviations: {shortened(second.expression, _WIDTH)}",
        ]
    return lines


def _row(label: str, cells: list[str]) -> str:
    return f"{label:40s}" + "".join(f" {cell:>22s}" for cell in cells)
