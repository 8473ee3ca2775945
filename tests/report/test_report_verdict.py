"""Every word of the verdict follows from a number."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

from report.conftest import Made

from ident_service.results.evidence.evidence import Evidence
from ident_service.results.parameter_file import ParameterFile
from ident_service.results.report.verdict import limitations, unidentified, verdict

CERTIFIED = "has a certificate of that: `ident verify --arm` checks it in exact arithmetic"


def said(made: Made, evidence: Evidence | None = None, **changes: Any) -> str:
    content = json.loads(json.dumps(made.parameters.content))
    for key, value in changes.items():
        content[key] |= value
    return " ".join(verdict(evidence or made.evidence, replace(made.parameters, content=content)))


def own(made: Made, **changes: Any) -> Evidence:
    estimates = list(made.evidence.estimates)
    estimates[made.evidence.chosen] = replace(estimates[made.evidence.chosen], **changes)
    return replace(made.evidence, estimates=tuple(estimates))


def test_a_good_estimate(good: Made) -> None:
    words = said(good)
    assert "They are physically feasible" in words
    assert CERTIFIED in words
    assert "proven" not in words
    assert "constrained to the feasible set pseudo_inertia" in words
    chosen = good.estimate.candidates[good.estimate.chosen]
    assert f"{chosen.validation[0].error.relative_percent:.3g} %" in words
    assert f"({chosen.moving.relative_percent:.3g} % away from standstill) on the fitted ones" in words
    assert "about as well as its own" in words


def test_nothing_stands_against_it_only_where_nothing_does(good: Made) -> None:
    verdicts = {"verdicts": ["identified"] * good.estimate.base.size}
    assert said(good, base_parameters=verdicts).endswith("Next: it can be used.")
    warned = replace(good.evidence, warnings=("x",))
    assert "Next: correct what the recordings' warnings name" in said(good, warned, base_parameters=verdicts)
    first = good.estimate.base.expressions[0][:57]
    blind = {"verdicts": ["unidentified", *verdicts["verdicts"][1:]]}
    words = said(good, base_parameters=blind)
    assert f"1 unidentified, the most uncertain first (\u03c3 over the larger of size and reference): {first}" in words
    assert "design a motion that excites them" in words


def test_feasible_without_a_certificate(good: Made) -> None:
    words = said(good, feasibility={"feasible": False, "certificate": {"kind": "undecided"}})
    assert CERTIFIED not in words
    assert "too close to the boundary for a certificate in exact arithmetic" in words


def test_much_worse_on_what_it_never_saw(good: Made) -> None:
    worse = own(good, moving=1.0, moving_validation=(1.6,))
    assert "markedly worse than its own" in said(good, worse)
    assert "identify from a richer motion" in said(good, worse)
    # Where the rows of moving joints are not told, all rows decide.
    whole = own(good, identification=1.0, validation=(1.4,), moving=None, moving_validation=())
    assert "about as well as its own" in said(good, whole)


def joints_of(made: Made, *errors: float) -> list[dict[str, Any]]:
    (score,) = made.parameters.content["validation"]
    rows = zip(score["per_joint"], errors, strict=True)
    return [score | {"per_joint": [row | {"relative_error_percent": error} for row, error in rows]}]


def with_validation(made: Made, validation: list[dict[str, Any]]) -> Made:
    return replace(
        made, parameters=replace(made.parameters, content=made.parameters.content | {"validation": validation})
    )


def test_a_joint_that_the_whole_arm_s_error_hides_is_named(good: Made) -> None:
    assert "No joint's error exceeds 15 % of its own torque on the validation recordings." in said(good)
    first, second = good.evidence.joints
    poor = with_validation(good, joints_of(good, 14.9, 84.7))
    # Poor where it moves, too.
    words = said(poor, own(good, moving_joints=((1.0, 1.0), (14.0, 80.0))))
    assert f"the error exceeds 15 % of the joint's own torque at {second} (84.7 %)." in words
    assert f"Next: do not rely on the predicted torque of {second}: " in words
    assert first not in words
    # Poor only near standstill.
    words = said(poor, own(good, moving_joints=((1.0, 1.0), (1.0, 0.9))))
    assert f"exceeds 15 % of the joint's own torque at {second} (84.7 %; 0.9 % away from standstill)." in words
    assert f"Next: use it where joints move, not for the torque near standstill of {second}" in words
    # Evidence that does not tell: all rows decide.
    assert f"do not rely on the predicted torque of {second}" in said(poor, own(good, moving_joints=()))


def test_without_a_second_recording_the_joints_of_the_fit_are_judged(alone: Made) -> None:
    assert "No joint's error exceeds 15 % of its own torque on the fitted recordings." in said(alone)
    rows = [row | {"relative_error_percent": 40.0} for row in alone.parameters.content["fit"]["per_joint"]]
    words = said(alone, own(alone, moving_joints=((40.0, 40.0),)), fit={"per_joint": rows})
    assert "on the fitted recordings, the error exceeds 15 %" in words


def test_the_verdict_and_the_warnings_agree(good: Made, alone: Made, bare: Made) -> None:
    for one in (good, alone, bare):
        against = limitations(one.evidence, one.parameters)
        judged = bool(one.evidence.estimates[one.evidence.chosen].validation)
        clean = judged and not against and not one.evidence.warnings
        assert said(one).endswith("Next: it can be used.") is clean


def test_active_conditions_are_counted(good: Made) -> None:
    names = [one.name for one in good.evidence.conditions][:2]
    words = said(good, feasibility={"tight": names})
    count = len({one.name for one in good.evidence.conditions})
    assert f"2 of {count} constraints are active: {names[0]}; {names[1]}." in words
    assert "find out why constraints are active" in words


def test_unidentified_parameters_come_with_the_least_sure_first(good: Made) -> None:
    size = good.estimate.base.size
    deviations: list[float | None] = [1e-6] * size
    deviations[1], deviations[4], deviations[7] = 3.0 * abs(good.parameters.values[1]) + 3.0, None, 1e4
    verdicts = ["unidentified" if k in (1, 4, 7) else "identified" for k in range(size)]
    content = good.parameters.content | {
        "base_parameters": good.parameters.content["base_parameters"]
        | {"verdicts": verdicts, "standard_deviations": deviations}
    }
    found = unidentified(replace(good.parameters, content=content))
    assert [name for name, _ in found] == [good.estimate.base.expressions[k] for k in (4, 7, 1)]
    assert found[0][1] == float("inf")
    assert found[1][1] > found[2][1] > 0.5


def test_the_comparison_says_which_rows_it_is_of(good: Made) -> None:
    evidence = own(good, identification=2.67, validation=(4.61,), moving=0.73, moving_validation=(0.84,))
    words = said(good, evidence)
    assert "away from standstill it predicts other motions about as well as its own" in words
    assert "its own (over all rows, 1.7 times its own error)." in words


def test_an_infeasible_estimate(bare: Made) -> None:
    words = said(bare)
    assert "They are not physically feasible" in words
    assert CERTIFIED in words
    assert "proven" not in words
    assert "estimated without a feasible set" in words
    assert f"Violated constraints: {bare.estimate.tight[0]}" in words
    assert "record a second motion and give it with --validate" in words
    assert "identify within a feasible set" in words


def test_a_file_that_says_less(good: Made) -> None:
    table = {key: good.parameters.content["base_parameters"][key] for key in ("expressions", "values")}
    bare_file = ParameterFile(good.parameters.base, good.parameters.values, None, {"base_parameters": table})
    words = " ".join(verdict(good.evidence, bare_file))
    assert "was not tested" in words
    assert "The uncertainty of its parameters is unknown" in words
