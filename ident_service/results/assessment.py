"""Assess an estimate: one word, the reasons for it, and a row per joint, by rules on the content of a parameter file.

`do not use`: something forbids it (the process then ends with exit code 3). `use with care`: a limitation that a user
of the values must know. `use`: neither. The command line, `report.txt`, `report.html` and the daemon show the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:  # the list of runs assesses files, and is not to wait for what estimates need
    from ident_service.estimation.identify import Estimate
    from ident_service.estimation.least_squares import TorqueError

Word = Literal["use", "use with care", "do not use"]

POOR = 15.0  # torque error of a joint [percent of its own torque], above which it is predicted poorly
USELESS = 50.0  # likewise, above which its predicted torque is of no use
MUCH_WORSE = 1.5  # error on unseen motion over that on the fitted one
REASONS = 3
_SMALL = 1.0  # torque error [percent] that is no limitation, whatever the fitted one is


@dataclass(frozen=True)
class JointAssessment:
    """Prediction of one joint's torque.

    Attributes:
        place: number of the joint, from 0.
        joint: name of the joint.
        unit: unit of the joint's torque, `N m` or `N`; empty where the file does not say.
        fitted: relative torque error (eq. 84) on the fitted recordings, all rows [percent of the joint's own torque].
        fitted_moving: relative torque error as `fitted`, without rows near standstill.
        unseen: relative torque error as `fitted`, on the worst recording that was not fitted to; None where there is
            none.
        unseen_moving: relative torque error as `fitted_moving`, on the worst recording that was not fitted to; None
            where there is none.
        torque: root mean square of the measured torque [N m or N], on the recording that decides.
        residual: root mean square of the residual [N m or N], on the recording that decides.
        word: verdict on the use of the joint's predicted torque.
    """

    place: int
    joint: str
    unit: str
    fitted: float | None
    fitted_moving: float | None
    unseen: float | None
    unseen_moving: float | None
    torque: float | None
    residual: float | None
    word: Word

    @property
    def whole(self) -> float:
        """Return the torque error over all rows [percent]: the largest on unseen data, else that on the fitted data."""
        return self.unseen if self.unseen is not None else self.fitted or 0.0

    @property
    def moving(self) -> float | None:
        """Return the torque error without rows near standstill [percent], unseen or else fitted; None if not known."""
        return self.unseen_moving if self.unseen is not None else self.fitted_moving

    @property
    def poor_in_motion(self) -> bool:
        """Return whether the torque error away from standstill is above `POOR` percent, or not known."""
        return self.moving is None or self.moving > POOR


@dataclass(frozen=True)
class Assessment:
    """Verdict on an estimate.

    Attributes:
        word: verdict on the use of its values.
        line: the verdict in one sentence.
        reasons: the three that matter most, those against it first.
        further: all others.
        joints: one row per joint, the worst first.
    """

    word: Word
    line: str
    reasons: tuple[str, ...]
    further: tuple[str, ...]
    joints: tuple[JointAssessment, ...]

    def document(self) -> dict[str, Any]:
        """Return the assessment as JSON values."""
        return {
            "verdict": self.word,
            "line": self.line,
            "reasons": list(self.reasons),
            "further": list(self.further),
            "per_joint": [asdict(joint) for joint in self.joints],
        }


def assess(content: Mapping[str, Any]) -> Assessment:
    """Assess a parameter file: verdict `use`, `use with care` or `do not use`, its reasons, errors of each joint.

    Args:
        content: of `parameters.json`; a table of values alone can be assessed, too.
    """
    joints = joint_assessments(content)
    found = [
        *((2, reason) for reason in forbidden_because(content)),
        *_prediction(content, joints),
        *_feasibility(content),
        *_knowledge(content),
        *_warnings(content),
    ]
    found.sort(key=lambda one: -one[0])  # stable: within a weight by subject
    word: Word = ("use", "use with care", "do not use")[max(weight for weight, _ in found)]
    sentences = tuple(sentence for _, sentence in found)
    return Assessment(word, _line(content, word), sentences[:REASONS], sentences[REASONS:], joints)


def forbidden_because(content: Mapping[str, Any]) -> tuple[str, ...]:
    """Return why the values of a parameter file must not be used, infeasibility left out; empty where nothing says so.

    Args:
        content: of `parameters.json`.
    """
    return (*content.get("unusable", ()), *_second_opinion(content))


def assess_estimate(estimate: Estimate, unusable: Sequence[str] = (), warnings: Sequence[str] = ()) -> Assessment:
    """Assess an estimate as its parameter file will be, before there is one.

    Args:
        estimate: estimate to assess.
        unusable: reasons why it must not be used.
        warnings: what is wrong with the recordings, in words.
    """
    second = estimate.second
    return assess(
        {
            "unusable": list(unusable),
            "warnings": list(warnings),
            "feasibility": {"margin": estimate.margin, "tight": list(estimate.tight)},
            "base_parameters": {"verdicts": list(estimate.verdicts)},
            **error_document(estimate),
            **(
                {} if second is None else {"second_opinion": {"agrees": second.agrees, "conclusive": second.conclusive}}
            ),
        }
    )


def error_document(estimate: Estimate) -> dict[str, Any]:
    """Return `fit` and `validation` of a parameter file as far as they are torque errors of the chosen estimate."""
    chain, own = estimate.model.chain, estimate.candidates[estimate.chosen]
    units = ["N m" if turns else "N" for turns in chain.revolute]

    def errors(whole: TorqueError, moving: TorqueError) -> dict[str, Any]:
        rows = zip(
            chain.names,
            units,
            whole.joint_relative_percent.tolist(),
            moving.joint_relative_percent.tolist(),
            whole.joint_rms.tolist(),
            strict=True,
        )
        return {
            "relative_error_percent": whole.relative_percent,
            "moving_relative_error_percent": moving.relative_percent,
            "per_joint": [
                {
                    "joint": name,
                    "unit": unit,
                    "relative_error_percent": relative,
                    "moving_relative_error_percent": alone,
                    "rms": rms,
                }
                for name, unit, relative, alone, rms in rows
            ],
        }

    return {
        "fit": errors(own.identification, own.moving),
        "validation": [
            {"recording": score.recording, "sha256": score.sha256, **errors(score.error, score.moving)}
            for score in own.validation
        ],
    }


def joint_assessments(content: Mapping[str, Any]) -> tuple[JointAssessment, ...]:
    """Return the torque errors of each joint, fitted and unseen, the largest first; none where the file has none."""
    if "fit" not in content:
        return ()
    fitted, unseen = content["fit"]["per_joint"], [one["per_joint"] for one in content.get("validation", [])]
    found = []
    for k, own in enumerate(fitted):
        others = [joints[k] for joints in unseen]
        worst = max(others, key=lambda one: one["relative_error_percent"], default=None)
        decides = own if worst is None else worst
        relative, rms = decides["relative_error_percent"], decides["rms"]
        moving = [one.get("moving_relative_error_percent") for one in others]
        one = JointAssessment(
            place=k,
            joint=own["joint"],
            unit=own.get("unit", ""),
            fitted=own["relative_error_percent"],
            fitted_moving=own.get("moving_relative_error_percent"),
            unseen=None if worst is None else relative,
            unseen_moving=max((value for value in moving if value is not None), default=None),
            torque=100.0 * rms / relative if relative > 0.0 else None,
            residual=rms,
            word="use",
        )
        found.append(JointAssessment(**{**asdict(one), "word": _word(one)}))
    return tuple(sorted(found, key=lambda one: -one.whole))


def _word(joint: JointAssessment) -> Word:
    if joint.whole <= POOR:
        return "use"
    return "do not use" if (joint.whole if joint.moving is None else joint.moving) > USELESS else "use with care"


def poor_joints(content: Mapping[str, Any]) -> list[JointAssessment]:
    """Return joints off by more than 15 % of their own torque on unseen data, or else on the fitted data."""
    return [one for one in joint_assessments(content) if one.whole > POOR]


def generalises_poorly(content: Mapping[str, Any]) -> bool:
    """Return whether the worst unseen error is above 1 % and 1.5 times the fitted one; without standstill, if known."""
    fit, unseen = content.get("fit"), content.get("validation", [])
    if fit is None or not unseen:
        return False
    key = "moving_relative_error_percent"
    if not all(key in one for one in (fit, *unseen)):
        key = "relative_error_percent"
    worst = max(one[key] for one in unseen)
    return bool(worst > _SMALL and worst > MUCH_WORSE * fit[key])


def active_constraints(content: Mapping[str, Any]) -> list[str]:
    """Return the names of the active constraints; empty where no body can have the parameters."""
    found = content.get("feasibility", {})
    return list(found.get("tight", [])) if found.get("margin", 0.0) > 0.0 else []


def joints_in_words(joints: Sequence[JointAssessment]) -> str:
    """Format each joint with its torque error in percent, and that away from standstill where it is small there."""
    return ", ".join(
        f"{one.joint} ({_percent(one.whole)}"
        + (")" if one.poor_in_motion or one.moving is None else f"; {_percent(one.moving)} away from standstill)")
        for one in joints
    )


def _percent(value: float) -> str:
    return f"{value:.3g} %" if value < 1000.0 else f"{value:.0f} %"


Weighted = list[tuple[int, str]]  # 0: speaks for it, 1: a limitation, 2: forbids it


def _feasibility(content: Mapping[str, Any]) -> Weighted:
    found = content.get("feasibility")
    if found is None:
        return [(1, "Physical feasibility was not tested.")]
    if found["margin"] <= 0.0:
        return [(2, "Not physically feasible: no real body has these parameters.")]
    if count := len(active_constraints(content)):
        active = (
            "1 constraint is active: it determines" if count == 1 else f"{count} constraints are active: they determine"
        )
        return [(1, f"Physically feasible, but {active} values that the recordings do not.")]
    return [(0, "Physically feasible, and no constraint is active.")]


def _second_opinion(content: Mapping[str, Any]) -> tuple[str, ...]:
    second = content.get("second_opinion", {})
    if second.get("conclusive") and not second.get("agrees", True):
        return ("A second solution of the constrained problem predicts other torques: use neither.",)
    return ()


def _prediction(content: Mapping[str, Any], joints: Sequence[JointAssessment]) -> Weighted:
    if "fit" not in content:
        return [(1, "How well it predicts torque is unknown.")]
    found: Weighted = []
    poor = [one for one in joints if one.whole > POOR]
    if moving := [one for one in poor if one.poor_in_motion]:
        found.append((1, f"Off by more than {POOR:g} % of their own torque: {joints_in_words(moving)}."))
    if still := [one for one in poor if not one.poor_in_motion]:
        said = f"Off by more than {POOR:g} % of their own torque, near standstill only: {joints_in_words(still)}."
        found.append((1, said))
    if not content.get("validation") and (held_out := content.get("fleet", {}).get("held_out_percent")) is not None:
        whole = content["fit"]["relative_error_percent"]
        said = f"torque error {_percent(held_out)}, {_percent(whole)} on the fitted"
        if held_out > _SMALL and held_out > MUCH_WORSE * whole:
            return [*found, (1, f"Predicts recordings held out markedly worse than the fitted ones: {said}.")]
        return [*found, (0, f"Predicts recordings that were held out from an estimate of the others: {said}.")]
    if not content.get("validation"):
        return [*found, (1, "No motion but the fitted one was predicted; give a second recording with --validate.")]
    if generalises_poorly(content):
        return [*found, (1, f"Predicts other motions markedly worse than the fitted one: {_errors(content)}.")]
    if poor:
        return found
    return [(0, f"Predicts motions that were not fitted: {_errors(content)}; no joint is off by more than {POOR:g} %.")]


def _errors(content: Mapping[str, Any]) -> str:
    unseen = max(content["validation"], key=lambda one: one["relative_error_percent"])
    return (
        f"torque error {_percent(unseen['relative_error_percent'])}, "
        f"{_percent(content['fit']['relative_error_percent'])} on the fitted"
    )


def _knowledge(content: Mapping[str, Any]) -> Weighted:
    verdicts = content.get("base_parameters", {}).get("verdicts")
    if verdicts is None:
        return [(1, "How uncertain its parameters are is unknown.")]
    count, weak = verdicts.count("unidentified"), verdicts.count("weak")
    if count:
        are = "is" if count == 1 else "are"
        said = f"{count} of {len(verdicts)} base parameters {are} unidentified: these recordings do not determine them."
        return [(1, said)]
    and_weak = f", {weak} {'is' if weak == 1 else 'are'} weak" if weak else ""
    return [(0, f"{len(verdicts) - weak} of {len(verdicts)} base parameters are identified{and_weak}.")]


def _warnings(content: Mapping[str, Any]) -> Weighted:
    warnings = content.get("warnings", [])
    if not warnings:
        return []
    more = f" (and {len(warnings) - 1} more)" if len(warnings) > 1 else ""
    return [(1, f"The recordings have warnings: {warnings[0]}{more}.")]


def _line(content: Mapping[str, Any], word: Word) -> str:
    parts = []
    if "fit" in content:
        unseen = [one["relative_error_percent"] for one in content.get("validation", [])]
        whose = "of unseen motion" if unseen else "of the fitted motion alone"
        parts.append(f"torque {whose} to {_percent(max(unseen or [content['fit']['relative_error_percent']]))}")
    if (found := content.get("feasibility")) is not None:
        parts.append("feasible" if found["margin"] > 0.0 else "infeasible")
    if (verdicts := content.get("base_parameters", {}).get("verdicts")) is not None:
        parts.append(f"{verdicts.count('identified')} of {len(verdicts)} parameters identified")
    about = "; ".join(parts)
    return f"{word[0].upper()}{word[1:]}{': ' if about else ''}{about}."
