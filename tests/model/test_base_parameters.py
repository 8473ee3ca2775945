"""Base parameters: the WAM's against the published table, random mechanisms against the algebra they promise."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from helpers.random_arms import random_chain, random_delta, random_states
from hypothesis import given, settings
from hypothesis import strategies as st

from ident_service.config.load import load_arm
from ident_service.errors import ParameterError
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.base_parameters import BaseParameters, base_from_expressions, base_parameters
from ident_service.model.parameter_layout import INERTIAL, Layout
from ident_service.model.regressor import joint_regressor

Array = np.ndarray
ALL = ("drive_inertia", "viscous", "coulomb", "offset")


@pytest.fixture(scope="module")
def wam7_base(wam7: ArmModel) -> BaseParameters:
    return base_parameters(wam7.chain, wam7.layout)


@pytest.fixture(scope="module")
def table6(wam7_data: Path) -> list[dict[str, object]]:
    """Rows of table 6, with the combinations of table 3."""
    rows: list[dict[str, object]] = json.loads((wam7_data / "table6.json").read_text())["rows"]
    return rows


def our_name(symbol: str) -> str:
    """`L_2xx` is Lxx2, `l_3y` is ly3, `Ia_1` is Ia1."""
    found = re.fullmatch(r"([A-Za-z]+)_(\d)([xyz]*)", symbol)
    assert found is not None, symbol
    return found[1] + found[3] + found[2]


def published_terms(combination: str) -> dict[str, float]:
    """`L_1yy +1 Ia_1 +1 L_2zz` and the like, coefficient before name."""
    first, *rest = combination.split()
    terms = {our_name(first): 1.0}
    for coefficient, symbol in zip(rest[::2], rest[1::2], strict=True):
        terms[our_name(symbol)] = float(coefficient)
    return terms


def published_cad(value: object) -> float | None:
    """The number in a cell of the CAD column, without the unknown drive inertia that some carry."""
    return None if value is None else float(str(value).rsplit("+", 1)[-1].replace("−", "-"))


def cad_column(rows: list[dict[str, object]]) -> list[tuple[int, float, float]]:
    """Row, value and half a unit of its last printed digit (four significant ones)."""
    cells = []
    for index, row in enumerate(rows):
        value = published_cad(row["resolved"]["beta_cad"])  # type: ignore[index]
        if value is not None:
            cells.append((index, value, 0.5000001 * 10.0 ** (np.floor(np.log10(abs(value))) - 3)))
    return cells


def test_the_wam_has_69_base_parameters_of_98(wam7_base: BaseParameters) -> None:
    assert wam7_base.size == 69
    assert wam7_base.K.shape == (69, 98)


def test_the_wams_base_parameters_are_table_3_entry_for_entry(
    wam7: ArmModel, wam7_base: BaseParameters, table6: list[dict[str, object]]
) -> None:
    expected = np.zeros((69, 98))
    for index, row in enumerate(table6):
        for name, coefficient in published_terms(str(row["combination"])).items():
            expected[index, wam7.layout.names.index(name)] = coefficient
    np.testing.assert_allclose(wam7_base.K, expected, rtol=0, atol=1e-12)
    assert [wam7_base.names[column] for column in wam7_base.base] == [our_name(str(r["base_column"])) for r in table6]


def test_the_wams_expressions_read_as_in_the_paper(wam7_base: BaseParameters) -> None:
    assert "Lxx2 - Lzz2 + Lzz3 - 1.1*ly3 + 0.300475*(m3 + m4 + m5 + m6 + m7)" in wam7_base.expressions
    assert "Lxx7 - Lyy7" in wam7_base.expressions


def test_the_cad_model_gives_the_cad_column_of_table_6(
    wam7: ArmModel, wam7_base: BaseParameters, wam7_data: Path, table6: list[dict[str, object]]
) -> None:
    cad = json.loads((wam7_data / "wam7_cad.json").read_text())
    delta = np.zeros(wam7.layout.size)
    for link, body in enumerate(cad["links"]):
        L = body["L_frame_origin"]
        inertia = [L[name] for name in ("xx", "xy", "xz", "yy", "yz", "zz")]
        delta[wam7.layout.inertial(link)] = [*inertia, *body["first_moment_l"], body["mass"]]
    beta = wam7_base.K @ delta
    cells = cad_column(table6)
    assert len(cells) == 43
    for index, value, rounding in cells:
        assert abs(beta[index] - value) <= rounding, (wam7_base.expressions[index], beta[index], value)


def test_the_shipped_prior_gives_the_cad_column_of_table_6(
    wam7: ArmModel, wam7_base: BaseParameters, table6: list[dict[str, object]]
) -> None:
    assert wam7.prior is not None
    beta = wam7_base.K @ wam7.prior
    rows, values, _ = zip(*cad_column(table6), strict=True)
    # Off the table by at most what keeps the prior strictly inside the feasible set.
    np.testing.assert_allclose(beta[list(rows)], values, rtol=1e-4, atol=2e-8)


def test_the_shipped_prior_and_truth_are_the_published_ones(wam7: ArmModel, wam7_data: Path) -> None:
    for published, vector in (
        ("nominal_parameters.json", wam7.prior),
        ("simulated_truth.json", wam7.layout.vector(load_arm("wam7_sim").driver.truth)),  # type: ignore[union-attr, arg-type]
    ):
        content = json.loads((wam7_data / published).read_text())
        np.testing.assert_array_equal(vector, content["values"])
        assert tuple(content["names"]) == wam7.layout.names


def test_the_same_mechanism_has_the_same_base_parameters_every_time(wam7: ArmModel, wam7_base: BaseParameters) -> None:
    again = base_parameters(wam7.chain, wam7.layout)
    np.testing.assert_array_equal(again.K, wam7_base.K)
    np.testing.assert_array_equal(again.base, wam7_base.base)


@pytest.mark.parametrize(("arm", "expected"), [("planar2", 13), ("threelink", 22)])
def test_the_small_arms_have_what_theory_says(arm: str, expected: int) -> None:
    model = arm_model(load_arm(arm))
    assert base_parameters(model.chain, model.layout).size == expected


def test_a_planar_two_link_arm_has_the_textbooks_base_parameters() -> None:
    model = arm_model(load_arm("planar2"))
    base = base_parameters(model.chain, model.layout)
    assert [text for text in base.expressions if text[0] not in "fI"] == [
        "Lzz1 - 0.25*(m1 + m2) + Ia1",
        "lx1 + 0.5*(m1 + m2)",
        "ly1",
        "Lzz2 - 0.25*m2",
        "lx2 + 0.5*m2",
        "ly2",
    ]
    unit = dict(zip(base.expressions, base.units, strict=True))
    assert (unit["lx2 + 0.5*m2"], unit["fv1"]) == ("kg m", "N m s/rad")


@pytest.mark.slow
@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 6), square=st.booleans(), terms=st.sampled_from([ALL, ()]))
def test_base_parameters_predict_every_torque_that_link_parameters_do(
    seed: int, joints: int, square: bool, terms: tuple[str, ...]
) -> None:
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, joints, square=square)
    layout = Layout(chain.revolute, terms)  # type: ignore[arg-type]
    base = base_parameters(chain, layout)
    fresh = random_states(rng, 40, joints)
    H = joint_regressor(chain, layout, *fresh).transpose(0, 2, 1).reshape(-1, layout.size)
    delta = random_delta(rng, layout)
    torque = H @ delta
    np.testing.assert_allclose(H[:, base.base] @ base.K @ delta, torque, rtol=0, atol=1e-8 * np.abs(torque).max())
    assert base.size == np.linalg.matrix_rank(H / np.maximum(np.linalg.norm(H, axis=0), 1e-6), tol=1e-6)
    np.testing.assert_array_equal(base.K[:, base.base], np.eye(base.size))
    assert (np.diff(base.base) > 0).all()
    assert sorted([*base.base, *base.dependent]) == list(range(layout.size))
    first_column = np.argmax(np.abs(base.K) > 0, axis=1)
    np.testing.assert_array_equal(first_column, base.base)


@pytest.mark.slow
@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 5))
def test_moving_along_what_cannot_be_seen_changes_no_torque(seed: int, joints: int) -> None:
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, joints, square=True)
    layout = Layout(chain.revolute, ALL)
    base = base_parameters(chain, layout)
    H = joint_regressor(chain, layout, *random_states(rng, 20, joints)).transpose(0, 2, 1).reshape(-1, layout.size)
    null = np.linalg.svd(base.K)[2][base.size :]
    unseen = null.T @ rng.normal(size=len(null))
    assert np.linalg.norm(unseen) > 0.1
    assert np.abs(H @ unseen).max() < 1e-9 * np.linalg.norm(H)


def test_links_nearer_the_base_have_fewer_base_parameters(wam7_base: BaseParameters) -> None:
    # A first link on an upright axis shows its inertia about that axis and nothing else.
    first = [wam7_base.names[column] for column in wam7_base.base if wam7_base.names[column].endswith("1")]
    assert first == ["Lyy1", "fv1", "fc1", "fo1"]


@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 5))
def test_a_table_of_expressions_is_the_grouping_it_came_from(seed: int, joints: int) -> None:
    chain = random_chain(np.random.default_rng(seed), joints)
    layout = Layout(chain.revolute, ALL)
    base = base_parameters(chain, layout)
    again = base_from_expressions(base.expressions, layout.names)
    np.testing.assert_allclose(again.K, base.K, rtol=1e-15, atol=0)
    np.testing.assert_array_equal(again.base, base.base)
    assert again.expressions == base.expressions


def test_the_wams_table_of_expressions_is_its_grouping(wam7: ArmModel, wam7_base: BaseParameters) -> None:
    again = base_from_expressions(wam7_base.expressions, wam7.layout.names)
    np.testing.assert_array_equal(again.K, wam7_base.K)
    assert np.linalg.cond(again.K[:, again.base]) < 1e6


@pytest.mark.parametrize(
    ("expressions", "message"),
    [
        (("a", "b", "a"), "is a combination of the others"),
        (("a + b", "b + c", "a - c"), "is a combination of the others"),
        (("a", "b - b"), r"expression 2 ('b - b') is zero"),
        (("0*a",), "expression 1"),
        (("a", "2*d"), "no parameter is called 'd'"),
        (("a", "2*"), "expected a name"),
        ((), "no expressions"),
    ],
)
def test_expressions_that_are_no_base_are_refused(expressions: tuple[str, ...], message: str) -> None:
    with pytest.raises(ParameterError, match=re.escape(message)):
        base_from_expressions(expressions, ("a", "b", "c"))


def test_foreign_tables_need_not_lead_with_a_unit_coefficient() -> None:
    base = base_from_expressions(("2*a + b", "b - 3*c"), ("a", "b", "c"))
    assert base.base.tolist() == [0, 1]
    assert abs(np.linalg.det(base.K[:, base.base])) == pytest.approx(2.0)


def test_the_matrix_cannot_be_changed(wam7_base: BaseParameters) -> None:
    with pytest.raises(ValueError, match="read-only"):
        wam7_base.K[0, 0] = 2.0


def test_inertial_names_have_one_order_everywhere(wam7: ArmModel) -> None:
    assert wam7.layout.names[:10] == tuple(f"{symbol}1" for symbol in INERTIAL)
