"""Every word of the verdict follows from a number."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

from report.conftest import Made

from ident_service.results.evidence.evidence import Evidence
from ident_service.results.parameter_file import ParameterFile
from ident_service.results.report.verdict import verdict


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
    assert "A real body could have these parameters" in words
    assert "proven in exact arithmetic" in words
    assert "held in the feasible set pseudo_inertia" in words
    chosen = good.estimate.candidates[good.estimate.chosen]
    assert f"{chosen.validation[0].error.relative_percent:.3g} %" in words
    assert f"({chosen.moving.relative_percent:.3g} % away from standstill) on what it was fitted to" in words
    assert "about as well as its own" in words


def test_nothing_stands_against_it_only_where_nothing_does(good: Made) -> None:
    verdicts = {"verdicts": ["identified"] * good.estimate.base.size}
    assert said(good, base_parameters=verdicts).endswith("Next: nothing stands against using it.")
    warned = replace(good.evidence, warnings=("x",))
    assert "Next: mend what the warnings name" in said(good, warned, base_parameters=verdicts)
    blind = {"verdicts": ["unidentified", *verdicts["verdicts"][1:]]}
    words = said(good, base_parameters=blind)
    assert f"1 unidentified: {good.estimate.base.expressions[0][:57]}" in words
    assert "design a motion that teaches them" in words


def test_feasible_but_not_proven(good: Made) -> None:
    words = said(good, feasibility={"feasible": False, "certificate": {"kind": "undecided"}})
    assert "proven in exact arithmetic." not in words.replace("not proven in exact arithmetic", "")
    assert "not proven in exact arithmetic" in words


def test_much_worse_on_what_it_never_saw(good: Made) -> None:
    worse = own(good, moving=1.0, moving_validation=(1.6,))
    assert "markedly worse than its own" in said(good, worse)
    assert "identify from a richer one" in said(good, worse)
    # Where the rows of moving joints are not told, all rows decide.
    whole = own(good, identification=1.0, validation=(1.4,), moving=None, moving_validation=())
    assert "about as well as its own" in said(good, whole)


def test_an_infeasible_estimate(bare: Made) -> None:
    words = said(bare)
    assert "No real body has these parameters" in words
    assert "proven in exact arithmetic" in words
    assert "not held in any feasible set" in words
    assert f"What contradicts them: {bare.estimate.tight[0]}" in words
    assert "record a second motion and give it with --validate" in words
    assert "identify within a feasible set" in words


def test_a_file_that_says_less(good: Made) -> None:
    table = {key: good.parameters.content["base_parameters"][key] for key in ("expressions", "values")}
    bare_file = ParameterFile(good.parameters.base, good.parameters.values, None, {"base_parameters": table})
    words = " ".join(verdict(good.evidence, bare_file))
    assert "was not tested" in words
    assert "How sure its parameters are is not known" in words
