"""Other notations are renamed to ours, name by name, and nothing else of an expression changes."""

from __future__ import annotations

from fractions import Fraction

import pytest

from ident_service.certificate_verifier import INERTIAL, JOINT_TERMS, split_name
from ident_service.errors import ParameterError
from ident_service.model.base_parameters import parse_exactly
from ident_service.model.notation import Notation, regrouped, translate

KHALIL = ["XX", "XY", "XZ", "YY", "YZ", "ZZ", "MX", "MY", "MZ", "M", "IA", "FV", "FS", "OFF"]
SYMPYBOTICS = [f"L_{{}}{axes}" for axes in ("xx", "xy", "xz", "yy", "yz", "zz")]
SYMPYBOTICS += ["l_{}x", "l_{}y", "l_{}z", "m_{}", "Ia_{}", "fv_{}", "fc_{}", "fo_{}"]
OURS = [*INERTIAL, *JOINT_TERMS[:4]]


@pytest.mark.parametrize("link", [1, 7, 12])
def test_every_name_has_its_own(link: int) -> None:
    ours = [f"{symbol}{link}" for symbol in OURS]
    assert [translate(f"{name}{link}", "khalil") for name in KHALIL] == ours
    assert [translate(f"{name}R{link}", "khalil") for name in KHALIL] == ours
    assert [translate(f"{name}{link}R", "khalil") for name in KHALIL] == ours
    assert [translate(name.format(link), "sympybotics") for name in SYMPYBOTICS] == ours
    assert [split_name(name) for name in ours] == [(symbol, link) for symbol in OURS]


@pytest.mark.parametrize(
    ("notation", "text", "ours"),
    [
        ("khalil", "ZZR1 + 0.25*M2", "Lzz1 + 0.25*m2"),
        ("khalil", "-(MX2 - 1.5e-3*(FS1 + 2E2*M3))", "-(lx2 - 1.5e-3*(fc1 + 2E2*m3))"),
        ("sympybotics", "L_1zz + 2.e1*l_2x - m_10", "Lzz1 + 2.e1*lx2 - m10"),
    ],
)
def test_expressions_keep_their_numbers(notation: Notation, text: str, ours: str) -> None:
    assert translate(text, notation) == ours
    assert all(isinstance(number, Fraction) for number in parse_exactly(ours).values())


@pytest.mark.parametrize(
    ("notation", "name"),
    [
        ("khalil", "Lzz1"),
        ("khalil", "ZZ01"),
        ("khalil", "ZZR1R"),
        ("khalil", "ZZ"),
        ("khalil", "FC1"),
        ("sympybotics", "L_1yx"),
        ("sympybotics", "L_zz1"),
        ("sympybotics", "m_0"),
        ("sympybotics", "m1"),
    ],
)
def test_other_names_are_refused_with_those_that_are_allowed(notation: Notation, name: str) -> None:
    with pytest.raises(
        ParameterError, match=f"^'{name}' is no link parameter in the notation {notation}: allowed are "
    ):
        translate(f"2*{name}", notation)


def test_regrouped_names_are_found() -> None:
    assert regrouped("ZZR1 + 0.25*M2 - MX2R", "khalil") == ("ZZR1", "MX2R")
    assert regrouped("L_1zz", "sympybotics") == ()
