"""Random arms: real bodies are proven feasible, broken triangle inequalities infeasible, equalities count."""

from __future__ import annotations

import numpy as np
import pytest
from certificate_samples import parameter_file, random_bodies, random_config, text
from helpers.examples import some
from hypothesis import given
from hypothesis import strategies as st

from ident_service.certificate_verifier import verify
from ident_service.estimation.certificate import certify
from ident_service.estimation.feasible.feasible_set import FeasibleSet, feasible_set
from ident_service.model.arm_model import arm_model
from ident_service.model.base_parameters import base_from_expressions, base_parameters
from ident_service.model.parameter_layout import INERTIAL


@pytest.mark.slow
@some(6)
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 5), square=st.booleans())
def test_real_bodies_are_proven_feasible(seed: int, joints: int, square: bool) -> None:
    rng = np.random.default_rng(seed)
    model = arm_model(random_config(rng, joints, square=square))
    base = base_parameters(model.chain, model.layout)
    delta = random_bodies(rng, base.names)
    beta = base.K @ delta
    for kind in ("inertia", "pseudo_inertia"):
        conditions = feasible_set(kind, base.names, model.config)
        for tried in (delta, None):
            certificate = certify(beta, base, conditions, tried)
            assert certificate.verdict == "feasible"
            verification = verify(text(parameter_file(beta, base, certificate, tried)))
            assert verification.verdict == "feasible", verification.message


@pytest.mark.slow
@some(4)
@given(seed=st.integers(0, 2**32 - 1), square=st.booleans())
def test_impossible_bodies_are_proven_infeasible(seed: int, square: bool) -> None:
    rng = np.random.default_rng(seed)
    model = arm_model(random_config(rng, 4, square=square))
    base = base_parameters(model.chain, model.layout)
    delta = random_bodies(rng, base.names)
    # Of the last link all moments can be told but one sum: its centre may not lie farther out than its inertia allows.
    for name in ("lx4", "ly4"):
        delta[base.names.index(name)] += 8.0
    beta = base.K @ delta
    for kind in ("inertia", "pseudo_inertia"):
        # The mass of link 4 hides behind those before it, so the whole arm is bounded.
        conditions = feasible_set(kind, base.names, _bounded(model.config))
        certificate = certify(beta, base, conditions)
        assert certificate.verdict == "infeasible"
        verification = verify(text(parameter_file(beta, base, certificate)))
        assert verification.verdict == "infeasible", verification.message


def _bounded(config):  # type: ignore[no-untyped-def]
    mass = type(config.constraints.total_mass)(upper=25.0)
    return config.model_copy(update={"constraints": config.constraints.model_copy(update={"total_mass": mass})})


def test_a_broken_triangle_inequality_shows_under_the_4x4_condition_alone() -> None:
    names = tuple(f"{symbol}1" for symbol in INERTIAL)
    base = base_from_expressions(("Lxx1 - Lyy1", "Lzz1", "Lxy1", "Lxz1", "Lyz1", "lx1", "ly1", "lz1", "m1"), names)
    # Lxx - Lyy > Lzz cannot be: a body wider than it is long in every direction.
    beta = np.array([2.0, 0.5, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 1.0])
    for kind, verdict in (("inertia", "feasible"), ("pseudo_inertia", "infeasible")):
        certificate = certify(beta, base, feasible_set(kind, names))
        assert certificate.verdict == verdict
        verification = verify(text(parameter_file(beta, base, certificate)))
        assert verification.verdict == verdict, verification.message
    assert certificate.shares == (("link 1: a mass distribution exists", 1.0),)


def test_on_the_boundary_itself_no_body_lies_inside() -> None:
    names = tuple(f"{symbol}1" for symbol in INERTIAL)
    base = base_from_expressions(("m1", "Lzz1"), names)
    for value in (0.0, -1.0):
        beta = np.array([1.0, value])
        certificate = certify(beta, base, feasible_set("inertia", names))
        verification = verify(text(parameter_file(beta, base, certificate)))
        assert verification.verdict == certificate.verdict
        assert certificate.verdict in (("infeasible", "undecided") if value == 0.0 else ("infeasible",))


def test_expressions_in_another_basis_are_solved_exactly() -> None:
    names = tuple(f"{symbol}{link}" for link in (1, 2) for symbol in INERTIAL)
    expressions = ("0.3*Lzz1 + 0.7*(Lzz2 + m2)", "0.1*Lzz1 - 3*m2", "lx2 + 0.37*m2", "ly2", "Lzz2 + lx2")
    base = base_from_expressions(expressions, names)
    delta = random_bodies(np.random.default_rng(5), names)
    beta = base.K @ delta
    certificate = certify(beta, base, feasible_set("pseudo_inertia", names), delta, expressions=expressions)
    document = parameter_file(beta, base, certificate)
    document["base_parameters"]["expressions"] = list(expressions)
    assert verify(text(document)).verdict == certificate.verdict == "feasible"


@pytest.mark.parametrize(("moment", "verdict"), [(0.0, "feasible"), (0.1, "infeasible")])
def test_equalities_are_part_of_the_proof(moment: float, verdict: str) -> None:
    names = tuple(f"{symbol}1" for symbol in INERTIAL)
    base = base_from_expressions(("m1", "lz1", "Lzz1"), names)
    plain = feasible_set("pseudo_inertia", names)
    F = np.zeros((3, len(names)))
    F[0, names.index("lz1")] = F[1, names.index("Lxz1")] = F[2, names.index("Lyz1")] = 1.0
    plane = type(plain.blocks[0])("link 1: symmetric about its xy plane", 0, F, np.zeros(3))
    conditions = FeasibleSet(plain.kind, plain.names, plain.blocks, (plane,))
    beta = np.array([1.0, moment, 0.5])
    certificate = certify(beta, base, conditions)
    assert certificate.verdict == verdict
    verification = verify(text(parameter_file(beta, base, certificate)))
    assert verification.verdict == verdict, verification.message
    assert any("symmetric about its xy plane" in line and "lz1 = 0" in line for line in verification.checked)
