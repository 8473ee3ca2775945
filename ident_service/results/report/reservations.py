"""List the limitations of an estimate, each by a rule that the page states: verdict and warnings say the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ident_service.results.drawing import number
from ident_service.results.evidence.evidence import Evidence
from ident_service.results.parameter_file import ParameterFile
from ident_service.results.report.doubt_figures import relative_deviations

POOR = 15.0  # torque error of a joint [percent of its own torque], above which it is predicted poorly
ILL_CONDITIONED = 1000.0  # condition number of the regressor, SI units
NAMED = 5
_LONGEST = 60  # characters of a name in a sentence


@dataclass(frozen=True)
class PoorJoint:
    """Joint whose torque is predicted poorly.

    Attributes:
        name: of the joint.
        whole: its relative torque error over all rows (eq. 84), of the worst recording [percent].
        moving: the same without rows near standstill; None where it was not told.
    """

    name: str
    whole: float
    moving: float | None

    @property
    def in_motion(self) -> bool:
        """Return whether the joint's torque is predicted poorly in motion, too."""
        return self.moving is None or self.moving > POOR


def poor_joints(evidence: Evidence, parameters: ParameterFile) -> list[PoorJoint]:
    """Return joints off by more than 15 % of their own torque on unseen data, or else on the fitted data."""
    content = parameters.content
    unseen = content.get("validation", [])
    scores = unseen or ([content["fit"]] if "fit" in content else [])
    moving = evidence.estimates[evidence.chosen].moving_joints
    moving = moving[1:] if unseen else moving[:1]
    found = []
    for joint, name in enumerate(evidence.joints):
        whole = max((score["per_joint"][joint]["relative_error_percent"] for score in scores), default=0.0)
        if whole > POOR:
            found.append(PoorJoint(name, whole, max((row[joint] for row in moving), default=None)))
    return found


def unidentified(parameters: ParameterFile) -> list[tuple[str, float]]:
    """Return expression and relative deviation of every unidentified parameter, the least certain first.

    The deviation is infinite where the data do not see the parameter.
    """
    table = parameters.content["base_parameters"]
    shares = np.nan_to_num(relative_deviations(parameters), nan=np.inf)
    found = [k for k, word in enumerate(table.get("verdicts", [])) if word == "unidentified"]
    return [(table["expressions"][k], float(shares[k])) for k in sorted(found, key=lambda k: -shares[k])]


def active_conditions(evidence: Evidence, parameters: ParameterFile) -> str:
    """Return the number of active conditions, in words; empty where there are none or no body has the parameters."""
    found = parameters.content.get("feasibility", {})
    tight = found.get("tight", [])
    if not tight or found["margin"] <= 0.0:
        return ""
    known = {one.name for one in evidence.conditions}
    of = f" of {len(known)}" if known.issuperset(tight) else ""
    return f"{len(tight)}{of} conditions are active" if len(tight) > 1 else f"1{of} condition is active"


def reservations(evidence: Evidence, parameters: ParameterFile) -> list[str]:
    """Return the limitations of the estimate, in sentences; empty where there are none."""
    found = [f"Must not be used: {reason}." for reason in parameters.content.get("unusable", [])]
    if parameters.content.get("feasibility", {}).get("margin", 1.0) <= 0.0:
        found.append("No real body has these parameters.")
    second = parameters.content.get("second_opinion", {})
    if second.get("conclusive") and not second.get("agrees", True):
        found.append("A second solution of the constrained problem predicts other torques (report.txt).")
    poor = poor_joints(evidence, parameters)
    if moving := [one for one in poor if one.in_motion]:
        found.append(f"Off by more than {POOR:g} % of their own torque: {joints_in_words(moving)}.")
    if still := [one for one in poor if not one.in_motion]:
        found.append(
            f"Off by more than {POOR:g} % of their own torque, near standstill only: {joints_in_words(still)}."
        )
    if words := active_conditions(evidence, parameters):
        found.append(f"{words}: there the values follow from the conditions, not from the recordings.")
    verdicts = parameters.content["base_parameters"].get("verdicts", [])
    if count := verdicts.count("unidentified"):
        found.append(f"{count} of {len(verdicts)} base parameters are unidentified: these recordings do not tell them.")
    fit = parameters.content.get("fit")
    # A large number by itself is no limitation: it depends on units, and parameters may be identified in spite of it.
    if fit is not None and "unidentified" in verdicts and (fit["condition_number"] or np.inf) > ILL_CONDITIONED:
        size = "infinite" if fit["condition_number"] is None else number(fit["condition_number"])
        found.append(
            f"The regressor's condition number is {size}, above {ILL_CONDITIONED:g}: "
            "some sums of parameters hardly show."
        )
    return found


def joints_in_words(joints: Sequence[PoorJoint]) -> str:
    """List every joint with its errors, in words."""
    return ", ".join(
        f"{one.name} ({number(one.whole)} %"
        + (")" if one.in_motion or one.moving is None else f"; {number(one.moving)} % away from standstill)")
        for one in joints
    )


def listed(names: Sequence[str]) -> str:
    """Join the first few names, shortened, and say how many more there are."""
    shown = [shortened(name) for name in names[:NAMED]]
    more = len(names) - len(shown)
    return "; ".join(shown) + (f"; and {more} more" if more > 0 else "")


def shortened(name: str) -> str:
    """Return a name that fits into a sentence."""
    return name if len(name) <= _LONGEST else name[: _LONGEST - 3] + "..."
