"""Write out an assessment in sentences: feasibility and its certificate, prediction, unknowns, what to do next."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ident_service.config.arm import ArmConfig
from ident_service.config.simulation import SimulatedDriver
from ident_service.estimation.uncertainty import IDENTIFIED_BELOW, WEAK_BELOW
from ident_service.results.assessment import (
    MUCH_WORSE,
    active_constraints,
    generalises_poorly,
    poor_joints,
)
from ident_service.results.evidence.evidence import Evidence
from ident_service.results.parameter_file import ParameterFile
from ident_service.results.plots import format_number, shortened
from ident_service.results.report.figures import relative_deviations

ILL_CONDITIONED = 1000.0  # condition number of the regressor, SI units
NAMED = 5
_LONGEST = 60  # characters of a name in a sentence


def unidentified(parameters: ParameterFile) -> list[tuple[str, float]]:
    """Return expression and relative deviation of every unidentified parameter, the least certain first.

    The deviation is infinite where the data do not see the parameter.
    """
    table = parameters.content["base_parameters"]
    shares = np.nan_to_num(relative_deviations(parameters), nan=np.inf)
    found = [k for k, word in enumerate(table.get("verdicts", [])) if word == "unidentified"]
    return [(table["expressions"][k], float(shares[k])) for k in sorted(found, key=lambda k: -shares[k])]


def active_constraints_text(evidence: Evidence, parameters: ParameterFile) -> str:
    """Return how many constraints are active, in words; empty where none is or the parameters are infeasible."""
    tight = active_constraints(parameters.content)
    if not tight:
        return ""
    known = {one.name for one in evidence.conditions}
    of = f" of {len(known)}" if known.issuperset(tight) else ""
    return f"{len(tight)}{of} constraints are active" if len(tight) > 1 else f"1{of} constraint is active"


def join_first_names(names: Sequence[str]) -> str:
    """Join the first few names, shortened, and say how many more there are."""
    shown = [shortened(name, _LONGEST) for name in names[:NAMED]]
    more = len(names) - len(shown)
    return "; ".join(shown) + (f"; and {more} more" if more > 0 else "")


SIMULATED = "The arm is simulated: this is no commissioning of a real arm."
PERHAPS_SIMULATED = "The description is of a simulated arm; its recordings do not say which arm they are of."
# Anybody may have written the file that the page repeats: only the verifier, with the arm, can tell.
_CERTIFIED = "parameters.json has a certificate of that: `ident verify --arm` checks it in exact arithmetic."


def simulation_notice(evidence: Evidence, config: ArmConfig) -> str:
    """Return the notice that recordings are of a simulated arm, or may be; empty where nothing says so."""
    drivers = {one.driver for one in evidence.recordings}
    if "simulated" in drivers:
        return SIMULATED
    unknown = "" in drivers and isinstance(config.driver, SimulatedDriver)
    return PERHAPS_SIMULATED if unknown else ""


def verdict(evidence: Evidence, parameters: ParameterFile) -> list[str]:
    """Return the verdict in sentences: feasibility, torque prediction, certainty of parameters, condition number.

    Args:
        evidence: evidence that was gathered while the estimate was at hand.
        parameters: the parameter file that it belongs to.
    """
    return [
        *_feasibility(evidence, parameters),
        _prediction(evidence, parameters),
        _knowledge(parameters),
        *_condition_number(parameters),
    ]


def _feasibility(evidence: Evidence, parameters: ParameterFile) -> list[str]:
    found = parameters.content.get("feasibility")
    if found is None:
        return ["Physical feasibility was not tested."]
    margin, kind = format_number(found["margin"]), found.get("certificate", {}).get("kind", "")
    certified = kind in ("witness", "dual")
    tight = join_first_names(found.get("tight", []))
    if parameters.feasible_set == "none":
        how = "They were estimated without a feasible set."
    else:
        how = f"They were constrained to the feasible set {parameters.feasible_set}."
    if found["margin"] > 0.0:
        sentences = [f"They are physically feasible (margin {margin})."]
        if certified and found["feasible"]:
            sentences.append(_CERTIFIED)
        else:
            sentences.append("They lie too close to the boundary for a certificate in exact arithmetic.")
        if (custom := parameters.content.get("custom")) is not None:
            name = shortened(custom["function"], _LONGEST)
            sentences.append(f"They also meet what {name} says, a function that no certificate is about.")
        if tight:
            sentences.append(f"{active_constraints_text(evidence, parameters)}: {tight}.")
        return [*sentences, how]
    sentences = [f"They are not physically feasible (margin {margin})."]
    sentences.append(_CERTIFIED if certified else "There is no certificate of that in exact arithmetic.")
    if tight:
        sentences.append(f"Violated constraints: {tight}.")
    return [*sentences, how]


def _prediction(evidence: Evidence, parameters: ParameterFile) -> str:
    own = evidence.estimates[evidence.chosen]
    fitted = "" if own.identification is None else _error(own.identification, own.moving)
    unseen = [one.name for one in evidence.recordings if one.role == "validation"]
    if not own.validation:
        known = f" On the fitted recordings its torque error is {fitted}." if fitted else ""
        return f"There is no validation recording, so its prediction error is unknown.{known}"
    moving = own.moving_validation or (None,) * len(own.validation)
    errors = ", ".join(
        f"{_error(error, alone)} on {name}" for name, error, alone in zip(unseen, own.validation, moving, strict=True)
    )
    words = f"On validation recordings its torque error is {errors}, against {fitted} on the fitted ones: "
    words += "it predicts other motions " if own.moving is None else "away from standstill it predicts other motions "
    words += "markedly worse than its own" if generalises_poorly(parameters.content) else "about as well as its own"
    if own.moving is None or own.identification is None:
        return f"{words}."
    times = max(own.validation) / max(own.identification, 1e-12)
    return f"{words}{f' (over all rows, {format_number(times, 2)} times its own error)' if times > MUCH_WORSE else ''}."


def _error(whole: float, moving: float | None) -> str:
    return f"{format_number(whole)} %" + (
        "" if moving is None else f" ({format_number(moving)} % away from standstill)"
    )


def _knowledge(parameters: ParameterFile) -> str:
    table = parameters.content["base_parameters"]
    verdicts = table.get("verdicts")
    if verdicts is None:
        return "The uncertainty of its parameters is unknown."
    counts = {word: verdicts.count(word) for word in ("identified", "weak", "unidentified")}
    identified, weak = (f"{counts[word]} {'is' if counts[word] == 1 else 'are'} {word}" for word in list(counts)[:2])
    words = f"Of {len(verdicts)} base parameters {identified} to {100 * IDENTIFIED_BELOW:g} %"
    words += f", {weak} (to {100 * WEAK_BELOW:g} %) and {counts['unidentified']} unidentified"
    unknown = unidentified(parameters)
    if not unknown:
        return words + "."
    shown = "; ".join(
        f"{shortened(name, _LONGEST)} ({'not seen' if np.isinf(share) else format_number(share, 2)})"
        for name, share in unknown[:NAMED]
    )
    more = f"; and {len(unknown) - NAMED} more" if len(unknown) > NAMED else ""
    return f"{words}, the most uncertain first (\u03c3 over the larger of size and reference): {shown}{more}."


def _condition_number(parameters: ParameterFile) -> list[str]:
    """Return a sentence on the regressor's condition number where it matters."""
    fit, verdicts = parameters.content.get("fit"), parameters.content["base_parameters"].get("verdicts", [])
    # A large number by itself is no limitation: it depends on units, and parameters may be identified in spite of it.
    if fit is None or "unidentified" not in verdicts or (fit["condition_number"] or np.inf) <= ILL_CONDITIONED:
        return []
    size = "infinite" if fit["condition_number"] is None else format_number(fit["condition_number"])
    return [
        f"The regressor's condition number is {size}, above {ILL_CONDITIONED:g}: "
        "some combinations of parameters are hardly excited."
    ]


def next_steps(evidence: Evidence, parameters: ParameterFile) -> list[str]:
    """Return what a person should do now, the most urgent thing first."""
    if parameters.content.get("unusable"):
        return ["correct what forbids their use, and identify again"]
    steps = []
    found = parameters.content.get("feasibility")
    if found is not None and found["margin"] <= 0.0:
        steps.append("identify within a feasible set, and look first for wrong signs, units or joint directions")
    own = evidence.estimates[evidence.chosen]
    if not own.validation:
        steps.append("record a second motion and give it with --validate")
    elif generalises_poorly(parameters.content):
        steps.append("see below which joint's residual follows the motion, and identify from a richer motion")
    poor = poor_joints(parameters.content)
    if moving := [one.joint for one in poor if one.poor_in_motion]:
        steps.append(
            f"do not rely on the predicted torque of {', '.join(moving)}: see below whether residual and friction ask "
            "for another friction term, and record a motion that moves and loads them more"
        )
    if still := [one.joint for one in poor if not one.poor_in_motion]:
        steps.append(f"use it where joints move, not for the torque near standstill of {', '.join(still)}")
    if active_constraints_text(evidence, parameters):
        steps.append("find out why constraints are active: signs, units, friction, drive inertia")
    if "unidentified" in parameters.content["base_parameters"].get("verdicts", []):
        steps.append(
            "where the unidentified parameters matter, design a motion that excites them (ident design --after)"
        )
    if evidence.warnings:
        steps.append("correct what the warnings name and record again")
    return steps or ["it can be used"]
