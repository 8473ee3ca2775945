"""Names, order and units of the link parameters, as the conventions have them."""

from __future__ import annotations

import numpy as np
import pytest

from ident_service.config.quantities import ParameterTable
from ident_service.errors import ParameterError
from ident_service.model.arm_model import ArmModel
from ident_service.model.parameter_layout import TERM_SYMBOLS, Layout

LINK = ["Lxx", "Lxy", "Lxz", "Lyy", "Lyz", "Lzz", "lx", "ly", "lz", "m"]
ALL = ("drive_inertia", "viscous", "coulomb", "offset")


def test_the_wam_has_98_parameters_in_the_papers_order(wam7: ArmModel) -> None:
    expected = [f"{symbol}{link}" for link in range(1, 8) for symbol in [*LINK, "Ia", "fv", "fc", "fo"]]
    assert list(wam7.layout.names) == expected
    assert wam7.layout.size == 98
    assert wam7.layout.per_link == 14


def test_terms_that_a_model_lacks_leave_their_columns_out() -> None:
    layout = Layout((True, True), ("coulomb",))
    assert list(layout.names) == [f"{symbol}{link}" for link in (1, 2) for symbol in [*LINK, "fc"]]
    assert layout.term_columns("coulomb").tolist() == [10, 21]
    assert layout.term_columns("viscous").tolist() == []
    assert layout.term_values("viscous", np.ones(22)).tolist() == [0.0, 0.0]


def test_the_order_of_terms_does_not_depend_on_who_asks() -> None:
    assert Layout((True,), ("offset", "drive_inertia", "coulomb", "viscous")).terms == ALL
    assert Layout((True,), ()).names == tuple(f"{symbol}1" for symbol in LINK)


def test_units_tell_turning_from_sliding_joints() -> None:
    units = Layout((True, False), ALL).units
    body = ["kg m^2"] * 6 + ["kg m"] * 3 + ["kg"]
    assert list(units[:14]) == [*body, "kg m^2", "N m s/rad", "N m", "N m"]
    assert list(units[14:]) == [*body, "kg", "N s/m", "N", "N"]


def test_every_term_has_a_unit() -> None:
    terms = tuple(TERM_SYMBOLS)
    units = Layout((True, False), terms, (0.1, 0.1)).units
    turning = ["kg m^2", "N m s/rad", "N m", "N m", "N m", "N m s^2/rad^2", "N m s/rad"]
    sliding = ["kg", "N s/m", "N", "N", "N", "N s^2/m^2", "N s/m"]
    assert list(units[10:17]) == turning
    assert list(units[27:]) == sliding


def test_every_parameter_has_one_place() -> None:
    layout = Layout((True, False, True), ALL)
    places = [column for link in range(3) for column in range(layout.size)[layout.inertial(link)]]
    places += [int(column) for term in ALL for column in layout.term_columns(term)]
    assert sorted(places) == list(range(layout.size))
    assert [layout.names[column] for column in layout.term_columns("viscous")] == ["fv1", "fv2", "fv3"]
    assert layout.names[layout.inertial(1)] == tuple(f"{symbol}2" for symbol in LINK)


def test_named_values_become_a_vector_and_the_rest_is_zero() -> None:
    layout = Layout((True, True), ALL)
    delta = layout.vector(ParameterTable(names=("fo2", "m1"), values=(0.5, 3.0)))
    assert delta[layout.names.index("fo2")] == 0.5
    assert delta[layout.names.index("m1")] == 3.0
    assert np.count_nonzero(delta) == 2


def test_names_that_the_arm_lacks_are_all_named() -> None:
    with pytest.raises(ParameterError, match="m3, Q1"):
        Layout((True, True), ALL).vector(ParameterTable(names=("m1", "m3", "Q1"), values=(1.0, 1.0, 1.0)))
