"""Link values that no such link has are named, with the bound, and change no verdict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ident_service.estimation.identify import Estimate
from ident_service.estimation.plausibility import reasons_against
from ident_service.model.likely_bodies import likely_bodies
from ident_service.results.parameter_file import parameters_document, require_schema
from ident_service.results.summary import implausible_links, summary

LAST = 1


def with_body(estimate: Estimate, times: float = 1.0, aside: float = 0.0, larger: float = 1.0) -> Estimate:
    """Give every link its likely body, and the last one `times` its mass, its centre `aside` [m], and `larger`."""
    delta = likely_bodies(estimate.model).delta.copy()
    place = estimate.model.layout.inertial(LAST)
    m = delta[place][-1] * times
    c = delta[place][6:9] / delta[place][-1]
    about = delta[place][:6] * times - m * steiner(c)
    c = c + np.array([0.0, aside, 0.0])
    delta[place] = [*(about * larger**2 + m * steiner(c)), *(m * c), m]
    return replace(estimate, delta=delta, nearest_to="geometry")


def steiner(c: np.ndarray) -> np.ndarray:
    x, y, z = c
    return np.array([y * y + z * z, -x * y, -x * z, x * x + z * z, -y * z, x * x + y * y])


def test_likely_bodies_are_not_named(feasible_estimate: Estimate) -> None:
    assert implausible_links(with_body(feasible_estimate)) == ()
    assert implausible_links(with_body(feasible_estimate, times=5.0)) == ()
    assert implausible_links(replace(with_body(feasible_estimate, times=50.0), nearest_to=None)) == ()
    assert implausible_links(replace(feasible_estimate, delta=None)) == ()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"times": 20.0}, "kg are likely"),
        ({"times": 0.05}, "kg are likely"),
        ({"aside": 30.0}, "m from a likely place"),
        ({"larger": 50.0}, "an inertia as of a body that reaches"),
    ],
)
def test_a_value_that_no_such_link_has_is_named(
    feasible_estimate: Estimate, changes: dict[str, float], words: str
) -> None:
    strange = with_body(feasible_estimate, **changes)
    (line,) = implausible_links(strange)
    assert line.startswith(f"{strange.model.chain.names[LAST]}: its link has ")
    assert words in line
    assert ";" not in line  # nothing else is wrong with it


def test_it_is_information_and_no_verdict(feasible_estimate: Estimate) -> None:
    strange = with_body(feasible_estimate, times=20.0)
    assert "implausible, " in summary(strange)
    assert "one choice of many with the same torques" in summary(strange).replace("\n  ", " ")
    document = parameters_document(strange)
    assert document["link_parameters"]["implausible"] == list(implausible_links(strange))
    require_schema(document, "parameters", "here", "parameters")
    assert "implausible" not in parameters_document(with_body(feasible_estimate))["link_parameters"]
    assert reasons_against(strange) == reasons_against(feasible_estimate)
