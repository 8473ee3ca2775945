"""Causes: a changed link or joint explains its own change, and the last link's body comes back as the body added."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.random_arms import model_around, random_body, random_chain, random_delta

from ident_service.estimation.change_detection import (
    Cause,
    ComparedEstimate,
    Motion,
    causes,
    detect_change,
    friction_ratio,
    meaning_of_cause,
    meaning_of_effect,
)
from ident_service.model.base_parameters import base_parameters
from ident_service.model.information import information_of, sparsity
from ident_service.model.regressor import joint_regressor

ARM = model_around(random_chain(np.random.default_rng(3), 4, branches=False, prismatic=False))
BASE = base_parameters(ARM.chain, ARM.layout)
DELTA = random_delta(np.random.default_rng(4), ARM.layout)
LEADING = tuple(BASE.names[column] for column in BASE.base)


def motion_of(delta: np.ndarray) -> Motion:
    rng = np.random.default_rng(5)
    q, dq, ddq = rng.uniform(-2.0, 2.0, size=(3, 300, 4))
    H = joint_regressor(ARM.chain, ARM.layout, q, dq, ddq, BASE.base)
    torque = np.einsum("jps,p->sj", H, BASE.K @ delta) + 0.1 * rng.normal(size=q.shape)
    keep = np.ones(q.shape, dtype=bool)
    information = information_of(H, torque, keep, sparsity(ARM.chain, ARM.layout, BASE.base))
    return Motion.of(information, BASE.K @ delta)


def changed(**by_name: float) -> tuple[np.ndarray, Motion]:
    delta = DELTA.copy()
    for name, value in by_name.items():
        delta[ARM.layout.names.index(name)] += value
    return BASE.K @ (delta - DELTA), motion_of(delta)


def test_a_motion_says_what_a_difference_does_to_torques() -> None:
    difference, motion = changed(fo2=0.7)
    np.testing.assert_allclose(motion.torque_change(difference), [0.0, 0.7, 0.0, 0.0], atol=1e-9)
    assert motion.residual == pytest.approx(np.full(4, 0.1), rel=0.2)


def test_friction_explains_friction() -> None:
    difference, motion = changed(fv3=0.3, fc3=0.2)
    best = causes(difference, BASE.K, BASE.names, motion)[0]
    assert (best.kind, best.number) == ("friction", 3)
    assert best.explained == pytest.approx(1.0, abs=1e-9)
    assert best.changes["fv3"] == pytest.approx(0.3)
    assert "lubrication" in meaning_of_cause(best, 4)


def test_a_tool_is_found_in_the_base_parameters_of_all_links() -> None:
    body = random_body(np.random.default_rng(6))
    names = ARM.layout.names[ARM.layout.inertial(3)]
    difference, motion = changed(**dict(zip(names, body.tolist(), strict=True)))
    moved = {name for name, value in zip(LEADING, difference, strict=True) if abs(value) > 1e-9}
    assert any(name.endswith(("1", "2")) for name in moved)
    best = causes(difference, BASE.K, BASE.names, motion)[0]
    assert (best.kind, best.number) == ("body", 4)
    assert best.explained == pytest.approx(1.0, abs=1e-9)
    assert best.changes["m4"] == pytest.approx(body[9])
    assert meaning_of_cause(best, 4) == "another tool or payload"
    assert "mounted" in meaning_of_cause(Cause("body", 2, 1.0, {}), 4)


def test_no_difference_has_no_cause() -> None:
    assert causes(np.zeros(BASE.size), BASE.K, BASE.names, motion_of(DELTA)) == []


@pytest.mark.parametrize(
    ("by_name", "word"), [({"fc1": 0.4}, "seals"), ({"fc1": -0.4}, "warmer"), ({"fo1": 0.4, "fc1": 0.01}, "zero of")]
)
def test_friction_up_down_and_offset_mean_different_things(by_name: dict[str, float], word: str) -> None:
    difference, motion = changed(**by_name)
    S = np.diag(np.full(BASE.size, 1e-8))
    first = ComparedEstimate(LEADING, BASE.K @ DELTA, S)
    second = ComparedEstimate(LEADING, BASE.K @ DELTA + difference, S, None, motion)
    found = detect_change(first, second)
    (effect,) = found.changes
    assert (effect.kind, effect.number) == ("friction", 1)
    assert word in meaning_of_effect(effect, found, LEADING, 4)
    ratio = friction_ratio(first, second, 1)
    assert ratio is not None
    values = dict(zip(ARM.layout.names, DELTA.tolist(), strict=True))
    before = values["fv1"] * ratio[1] + values["fc1"]
    assert ratio[0] == pytest.approx(1.0 + by_name["fc1"] / before if "fc1" in by_name else 1.0)
    assert ratio[1] == pytest.approx(2.0 / np.sqrt(3.0), rel=0.1)
