"""Every word of the verdict follows from a number."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from report.conftest import Made

from ident_service.results.assessment import Assessment, assess, assess_estimate
from ident_service.results.evidence.evidence import Evidence
from ident_service.results.parameter_file import ParameterFile
from ident_service.results.report.verdict import next_steps, unidentified, verdict
from ident_service.results.summary import assessment_lines, noise_and_model, summary

CERTIFIED = "has a certificate of that: `ident verify --arm` checks it in exact arithmetic"


def content_of(made: Made, **changes: Any) -> dict[str, Any]:
    """The parameter file's content, with other entries in its sections."""
    content: dict[str, Any] = json.loads(json.dumps(made.parameters.content))
    for key, value in changes.items():
        content[key] = content.get(key, {}) | value if isinstance(value, dict) else value
    return content


def file_of(made: Made, **changes: Any) -> ParameterFile:
    return replace(made.parameters, content=content_of(made, **changes))


def said(made: Made, evidence: Evidence | None = None, **changes: Any) -> str:
    return " ".join(verdict(evidence or made.evidence, file_of(made, **changes)))


def steps(made: Made, evidence: Evidence | None = None, **changes: Any) -> str:
    return "; ".join(next_steps(evidence or made.evidence, file_of(made, **changes)))


def sound(made: Made) -> dict[str, Any]:
    """Changes that leave nothing to say against an estimate that predicts well."""
    return {
        "base_parameters": {"verdicts": ["identified"] * made.estimate.base.size},
        "feasibility": {"tight": []},
        "validation": [errors(made, whole=0.9, joints=((0.9, 0.8), (1.0, 0.9)))],
        "fit": {"relative_error_percent": 0.8, "moving_relative_error_percent": 0.7},
    }


def errors(made: Made, whole: float, joints: tuple[tuple[float, float], ...]) -> dict[str, Any]:
    """An entry of `validation`: the error of all rows and of moving joints, joint by joint."""
    (score,) = made.parameters.content["validation"]
    rows = [
        row | {"relative_error_percent": one, "moving_relative_error_percent": moving}
        for row, (one, moving) in zip(score["per_joint"], joints, strict=True)
    ]
    moving = max(moving for _, moving in joints)
    return score | {"relative_error_percent": whole, "moving_relative_error_percent": moving, "per_joint": rows}


def judged(made: Made, **changes: Any) -> Assessment:
    return assess(content_of(made, **(sound(made) | changes)))


def test_use_is_reported_only_where_nothing_stands_against_it(good: Made) -> None:
    found = judged(good)
    assert found.word == "use"
    assert found.line == (
        f"Use: torque of unseen motion to 0.9 %; feasible; {good.estimate.base.size} of "
        f"{good.estimate.base.size} parameters identified."
    )
    assert found.reasons == (
        "Predicts motions that were not fitted: torque error 0.9 %, 0.8 % on the fitted; no joint is off by more than "
        "15 %.",
        "Physically feasible, and no constraint is active.",
        f"{good.estimate.base.size} of {good.estimate.base.size} base parameters are identified.",
    )
    assert found.further == ()
    assert {one.word for one in found.joints} == {"use"}
    assert steps(good, **sound(good)) == "it can be used"


@pytest.mark.parametrize(
    ("changes", "word", "reason"),
    [
        ({"unusable": ["it is upside down"]}, "do not use", "it is upside down"),
        ({"feasibility": {"margin": -0.1, "tight": ["m1"]}}, "do not use", "Not physically feasible: no real body"),
        ({"second_opinion": {"conclusive": True, "agrees": False}}, "do not use", "A second solution of the constr"),
        ({"second_opinion": {"conclusive": False, "agrees": False}}, "use", "Predicts motions"),
        ({"feasibility": {"tight": ["m1", "m2"]}}, "use with care", "Physically feasible, but 2 constraints are act"),
        ({"validation": []}, "use with care", "No motion but the fitted one was predicted"),
        (
            {"warnings": ["stamps jitter", "torn"]},
            "use with care",
            "The recordings have warnings: stamps jitter (",
        ),
    ],
)
def test_what_stands_against_it_comes_first(good: Made, changes: dict[str, Any], word: str, reason: str) -> None:
    base = sound(good)
    merged = {key: base.get(key, {}) | value if isinstance(value, dict) else value for key, value in changes.items()}
    found = assess(content_of(good, **(base | merged)))
    assert found.word == word
    assert found.line.lower().startswith(word)
    assert found.reasons[0].startswith(reason)
    assert len(found.reasons) <= 3


def test_all_reasons_are_kept_and_three_stand_on_top(good: Made) -> None:
    found = judged(good, unusable=["a", "b", "c", "d"], warnings=["torn"])
    assert found.reasons == ("a", "b", "c")
    assert found.further[0] == "d"
    assert found.further[1].startswith("The recordings have warnings: torn")
    assert len(found.further) == 5
    document = json.loads(json.dumps(found.document()))
    assert set(document) == {"verdict", "line", "reasons", "further", "per_joint"}
    assert document["verdict"] == "do not use"


def test_joints_are_judged_one_by_one_the_worst_first(good: Made) -> None:
    first, second = good.evidence.joints
    found = judged(good, validation=[errors(good, 9.0, ((14.9, 14.0), (84.7, 80.0)))])
    assert [(one.joint, one.word, one.place) for one in found.joints] == [(second, "do not use", 1), (first, "use", 0)]
    assert found.word == "use with care"
    assert found.reasons[0] == f"Off by more than 15 % of their own torque: {second} (84.7 %)."
    # The same near standstill only.
    found = judged(good, validation=[errors(good, 9.0, ((14.9, 14.0), (84.7, 0.9)))])
    assert found.joints[0].word == "use with care"
    near = f"near standstill only: {second} (84.7 %; 0.9 % away from standstill)."
    assert found.reasons[0] == f"Off by more than 15 % of their own torque, {near}"
    # The worst of several recordings decides.
    several = [errors(good, 1.0, ((0.9, 0.8), (1.0, 0.9))), errors(good, 9.0, ((20.0, 19.0), (2.0, 1.5)))]
    worst = judged(good, validation=several).joints[0]
    assert (worst.joint, worst.unseen, worst.unseen_moving, worst.word) == (first, 20.0, 19.0, "use with care")
    assert worst.torque == pytest.approx(100.0 * several[1]["per_joint"][0]["rms"] / 20.0)


def test_without_a_second_recording_the_joints_of_the_fit_are_judged(alone: Made) -> None:
    rows = [row | {"relative_error_percent": 40.0} for row in alone.parameters.content["fit"]["per_joint"]]
    found = assess(content_of(alone, fit={"per_joint": rows}))
    assert found.joints[0].unseen is None
    assert found.joints[0].whole == 40.0
    assert any(reason.startswith("No motion but the fitted one") for reason in (*found.reasons, *found.further))
    assert "of the fitted motion alone" in found.line


def test_the_numbers_are_those_of_the_estimate(good: Made) -> None:
    found = assess(good.parameters.content)
    chosen = good.estimate.candidates[good.estimate.chosen]
    for one in found.joints:
        k = good.evidence.joints.index(one.joint)
        assert one.fitted == chosen.identification.joint_relative_percent[k]
        assert one.fitted_moving == chosen.moving.joint_relative_percent[k]
        assert one.unseen == chosen.validation[0].error.joint_relative_percent[k]
        assert one.unseen_moving == chosen.validation[0].moving.joint_relative_percent[k]
        assert one.residual == chosen.validation[0].error.joint_rms[k]
        assert one.unit == "N m"
    # Before there is a file, the answer of the command is the same.
    assert assess_estimate(good.estimate) == found


def test_a_file_that_says_less_is_assessed(good: Made) -> None:
    table = {key: good.parameters.content["base_parameters"][key] for key in ("expressions", "values")}
    found = assess({"base_parameters": table})
    assert (found.word, found.joints, found.line) == ("use with care", (), "Use with care.")
    bare_file = ParameterFile(good.parameters.base, good.parameters.values, None, {"base_parameters": table})
    words = " ".join(verdict(good.evidence, bare_file))
    assert "was not tested" in words
    assert "The uncertainty of its parameters is unknown" in words
    # Files of earlier versions have neither units nor errors of moving joints.
    old = content_of(good, validation=[])
    for row in old["fit"]["per_joint"]:
        del row["unit"], row["moving_relative_error_percent"]
        row["relative_error_percent"] = 60.0
    assert {(one.word, one.unit) for one in assess(old).joints} == {("do not use", "")}


def test_lines_for_a_terminal_are_the_assessment(good: Made, bare: Made) -> None:
    lines = assessment_lines(judged(good))
    assert lines[0].startswith("USE: torque of unseen motion to 0.9 %")
    assert lines[1].startswith("  - Predicts motions")
    assert [line for line in lines if line.startswith("  - ")][2].startswith(f"  - {good.estimate.base.size} of")
    head = next(k for k, line in enumerate(lines) if line.startswith("torque error [%]"))
    assert [line.split()[0] for line in lines[head + 1 :]] == [one.joint for one in judged(good).joints]
    assert all(line.endswith(" use") for line in lines[head + 1 :])
    refused = assessment_lines(judged(good, unusable=["turned round"]))
    assert refused[:2] == ["DO NOT USE these parameters:", "  - turned round"]
    text = summary(bare.estimate)
    assert text.startswith("DO NOT USE these parameters:\n  - Not physically feasible")
    assert text.index("torque error [%]") < text.index("\nDetails\n")
    assert max(map(len, assessment_lines(assess(good.parameters.content)))) <= 112


def test_how_much_is_noise_and_how_much_model_error() -> None:
    variances = np.array([4.0, 1.0, 100.0, np.inf, np.nan])
    words = noise_and_model(np.array([1.0, 0.5, 2.0, 3.0, 1.0]), variances)
    # 25 %, 25 % and 4 %; what is not known does not count.
    assert "25% of a parameter's variance is noise (median; 4% to 25%), the rest is model error" in words
    assert "cannot be separated" in noise_and_model(None, variances)
    # Rounding cannot make more noise than there is variance.
    assert "100% of a parameter's variance is noise (median; 100% to 100%)" in noise_and_model(
        np.array([2.0]), np.array([1.0])
    )


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


def test_the_next_step_is_the_most_urgent_one(good: Made, bare: Made) -> None:
    warned = replace(good.evidence, warnings=("x",))
    assert steps(good, warned, **sound(good)) == "correct what the warnings name and record again"
    blind = {"verdicts": ["unidentified", *["identified"] * (good.estimate.base.size - 1)]}
    assert "design a motion that excites them" in steps(good, base_parameters=blind)
    assert next_steps(bare.evidence, bare.parameters)[0].startswith("identify within a feasible set")
    assert "record a second motion and give it with --validate" in steps(bare)
    assert steps(good, unusable=["x"]) == "correct what forbids their use, and identify again"
    _, second = good.evidence.joints
    moving = {"validation": [errors(good, 9.0, ((14.9, 14.0), (84.7, 80.0)))]}
    first, then, *_ = next_steps(good.evidence, file_of(good, **(sound(good) | moving)))
    assert first.endswith("identify from a richer motion")
    assert then.startswith(f"do not rely on the predicted torque of {second}: ")
    still = {"validation": [errors(good, 0.9, ((14.9, 0.8), (84.7, 0.9)))]}
    assert steps(good, **(sound(good) | still)).startswith(
        f"use it where joints move, not for the torque near standstill of {second}"
    )


def test_feasible_without_a_certificate(good: Made) -> None:
    words = said(good, feasibility={"feasible": False, "certificate": {"kind": "undecided"}})
    assert CERTIFIED not in words
    assert "too close to the boundary for a certificate in exact arithmetic" in words


def test_much_worse_on_what_it_never_saw(good: Made) -> None:
    fit = {"relative_error_percent": 1.0, "moving_relative_error_percent": 1.0}
    worse = {"fit": fit, "validation": [errors(good, 1.0, ((1.6, 1.6), (1.6, 1.6)))]}
    assert "markedly worse than its own" in said(good, **worse)
    assert "identify from a richer motion" in steps(good, **worse)
    assert any(reason.startswith("Predicts other motions markedly worse") for reason in judged(good, **worse).reasons)
    small = {"relative_error_percent": 1e-9, "moving_relative_error_percent": 1e-9}
    tiny = {"fit": small, "validation": [errors(good, 0.5, ((0.4, 0.4), (0.4, 0.4)))]}
    assert "about as well as its own" in said(good, **tiny)
    # Where the rows of moving joints are not told, all rows decide.
    untold = content_of(good, fit=fit, validation=[errors(good, 1.4, ((1.6, 1.6), (1.6, 1.6)))])
    del untold["validation"][0]["moving_relative_error_percent"]
    assert "about as well as its own" in " ".join(verdict(good.evidence, replace(good.parameters, content=untold)))


def test_active_conditions_are_counted(good: Made) -> None:
    names = [one.name for one in good.evidence.conditions][:2]
    words = said(good, feasibility={"tight": names})
    count = len({one.name for one in good.evidence.conditions})
    assert f"2 of {count} constraints are active: {names[0]}; {names[1]}." in words
    assert "find out why constraints are active" in steps(good, feasibility={"tight": names})


def test_unidentified_parameters_come_with_the_least_sure_first(good: Made) -> None:
    size = good.estimate.base.size
    deviations: list[float | None] = [1e-6] * size
    deviations[1], deviations[4], deviations[7] = 3.0 * abs(good.parameters.values[1]) + 3.0, None, 1e4
    verdicts = ["unidentified" if k in (1, 4, 7) else "identified" for k in range(size)]
    changed = file_of(good, base_parameters={"verdicts": verdicts, "standard_deviations": deviations})
    found = unidentified(changed)
    assert [name for name, _ in found] == [good.estimate.base.expressions[k] for k in (4, 7, 1)]
    assert found[0][1] == float("inf")
    assert found[1][1] > found[2][1] > 0.5
    words = " ".join(verdict(good.evidence, changed))
    assert "3 unidentified, the most uncertain first (\u03c3 over the larger of size and reference): " in words


def test_a_large_condition_number_counts_where_something_is_unidentified(good: Made) -> None:
    blind = {"verdicts": ["unidentified", *["identified"] * (good.estimate.base.size - 1)]}
    sentence = "The regressor's condition number is 2500, above 1000: some combinations of parameters are hardly"
    fit = {"condition_number": 2500.0}
    assert sentence in said(good, fit=fit, base_parameters=blind)
    assert sentence not in said(good, fit=fit, base_parameters={"verdicts": ["identified"] * good.estimate.base.size})


def test_the_comparison_says_which_rows_it_is_of(good: Made) -> None:
    estimates = list(good.evidence.estimates)
    chosen = good.evidence.chosen
    estimates[chosen] = replace(
        estimates[chosen], identification=2.67, validation=(4.61,), moving=0.73, moving_validation=(0.84,)
    )
    words = said(good, replace(good.evidence, estimates=tuple(estimates)))
    assert "away from standstill it predicts other motions about as well as its own" in words
    assert "its own (over all rows, 1.7 times its own error)." in words


def test_an_infeasible_estimate(bare: Made) -> None:
    words = said(bare)
    assert "They are not physically feasible" in words
    assert CERTIFIED in words
    assert "proven" not in words
    assert "estimated without a feasible set" in words
    assert f"Violated constraints: {bare.estimate.tight[0]}" in words
