"""Describe changes of parameters as findings that a person can act on.

A body that explains the change stands for the effects on all links that it has in the base parameters; friction and
drive inertia are base parameters of their own joint, and are findings beside it.
"""

from __future__ import annotations

from dataclasses import dataclass

from ident_service.estimation.drift import Drift, Effect, Identified
from ident_service.estimation.drift_causes import Cause, friction_ratio, meaning_of_cause, meaning_of_effect
from ident_service.results.comparison.comparison import Pair

_OF_JOINTS = ("friction", "drive inertia")
EXPLAINS = 0.9  # of the squared change of torque; a single cause that explains less is not the whole story


@dataclass(frozen=True)
class Finding:
    """Description of one change, for a person.

    Attributes:
        what: name of the changed quantity, and of its joint or link.
        sigma: length of the change in standard deviations.
        joint: the one whose torque changes most for its size; empty where no motion is known.
        torque_share: of that joint's torque, by which its prediction changes; None likewise.
        residual_share: of what is unexplained of it; None likewise.
        size: of the change, in words; may be empty.
        meaning: possible meaning, in words.
    """

    what: str
    sigma: float
    joint: str
    torque_share: float | None
    residual_share: float | None
    size: str
    meaning: str


def findings(pair: Pair) -> tuple[Finding, ...]:
    """Return the changes between the reference and a side; empty where nothing has changed."""
    found, compared = pair.drift, pair.compared
    if found is None or compared is None or found.verdict != "changed":
        return ()
    links = _links(pair)
    changes = found.changes
    best = pair.causes[0] if pair.causes and pair.causes[0].explained >= EXPLAINS else None
    whole: tuple[Finding, ...] = ()
    if best is not None and best.kind == "body":
        whole = (_whole(pair, found, best, links),)
        changes = tuple(effect for effect in changes if effect.kind in _OF_JOINTS)
    single = tuple(_single(pair, found, compared, effect, links) for effect in changes)
    return (*whole, *single) or (_whole(pair, found, best, links),)


def joint_name(pair: Pair, number: int) -> str:
    """Return the name of a joint counted from 1, or its number where the side knows no name."""
    names = pair.side.joints
    return names[number - 1] if names is not None and number <= len(names) else str(number)


def _links(pair: Pair) -> int:
    names = pair.side.file.base.names
    return max(int(name[1:]) for name in names if name.startswith("m") and name[1:].isdigit())


def _whole(pair: Pair, found: Drift, cause: Cause | None, links: int) -> Finding:
    """Return the change of all parameters together, as a finding."""
    joint, torque, residual = "", None, None
    if found.torque_share is not None and found.residual_share is not None:
        worst = int(found.residual_share.argmax())
        joint = joint_name(pair, worst + 1)
        torque, residual = float(found.torque_share[worst]), float(found.residual_share[worst])
    if cause is None:
        what, size, meaning = (
            "all parameters together",
            "",
            "no single joint or link; look at conditions that all share",
        )
    else:
        owner = f"link {cause.number}" if cause.kind == "body" else f"joint {joint_name(pair, cause.number)}"
        what, meaning = f"{cause.kind} of {owner}", meaning_of_cause(cause, links)
        size = f"explains {cause.explained:.1%} of the change"
        if (mass := cause.changes.get(f"m{cause.number}")) and cause.kind == "body" and cause.number == links:
            size += f"; about {mass:+.3g} kg"
    return Finding(what, found.joint.sigma, joint, torque, residual, size, meaning)


def _single(pair: Pair, found: Drift, compared: tuple[Identified, Identified], effect: Effect, links: int) -> Finding:
    owner = f"joint {joint_name(pair, effect.number)}" if effect.kind in _OF_JOINTS else f"link {effect.number}"
    return Finding(
        what=f"{effect.kind} of {owner}",
        sigma=effect.test.sigma,
        joint="" if effect.joint is None else joint_name(pair, effect.joint + 1),
        torque_share=effect.torque_share,
        residual_share=effect.residual_share,
        size=_ratio(compared, effect.number) if effect.kind == "friction" else "",
        meaning=meaning_of_effect(effect, found, compared[0].leading, links),
    )


def _ratio(compared: tuple[Identified, Identified], joint: int) -> str:
    found = friction_ratio(*compared, joint)
    return "" if found is None else f"{found[0] - 1.0:+.0%} at {found[1]:.2g} rad/s"
