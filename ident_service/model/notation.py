"""Translate other notations of link parameters, Khalil's (SYMORO) and that of SymPyBotics, to ours.

    | ours          | Khalil, Dombre 2002        | SymPyBotics          |
    |---------------|----------------------------|----------------------|
    | Lxx1 ... Lzz1 | XX1 XY1 XZ1 YY1 YZ1 ZZ1    | L_1xx ... L_1zz      |
    | lx1 ly1 lz1   | MX1 MY1 MZ1                | l_1x l_1y l_1z       |
    | m1            | M1                         | m_1                  |
    | Ia1 fv1 fc1   | IA1 FV1 FS1                | Ia_1 fv_1 fc_1       |
    | fo1           | OFF1                       | fo_1                 |

Tables in Khalil's notation mark regrouped parameters with an R (`ZZR1` or `ZZ1R`) and print the regrouping elsewhere.
Such a name is read as the link parameter that it begins with; its regrouping must stand in the expression. Frames are
not converted: Khalil's are those of modified DH tables.
"""

from __future__ import annotations

import re
from typing import Literal

from ident_service.errors import ParameterError

Notation = Literal["khalil", "sympybotics"]
NOTATIONS: tuple[Notation, ...] = ("khalil", "sympybotics")

_KHALIL = {"XX": "Lxx", "XY": "Lxy", "XZ": "Lxz", "YY": "Lyy", "YZ": "Lyz", "ZZ": "Lzz"}
_KHALIL |= {"MX": "lx", "MY": "ly", "MZ": "lz", "M": "m", "IA": "Ia", "FV": "fv", "FS": "fc", "OFF": "fo"}
_KHALIL_NAME = re.compile(rf"({'|'.join(_KHALIL)})(R?)([1-9][0-9]*)(R?)")
_SYMPYBOTICS_NAME = re.compile(
    r"(?:(?P<tensor>L)_(?P<a>[1-9][0-9]*)(?P<axes>xx|xy|xz|yy|yz|zz)|(?P<moment>l)_(?P<b>[1-9][0-9]*)(?P<axis>[xyz])"
    r"|(?P<symbol>m|Ia|fv|fc|fo)_(?P<c>[1-9][0-9]*))"
)
# Not the e of an exponent.
_NAME = re.compile(r"(?<![\w.])[A-Za-z_]\w*")


def translate(text: str, notation: Notation) -> str:
    """Return an expression with all parameter names changed to ours; raises ParameterError for an unknown name.

    Raises:
        ParameterError: a name that the notation does not have.
    """
    return _NAME.sub(lambda match: _ours(match.group(), notation), text)


def regrouped(text: str, notation: Notation) -> tuple[str, ...]:
    """Return the names in an expression that Khalil's notation marks as regrouped; empty for other notations."""
    if notation != "khalil":
        return ()
    matches = (_KHALIL_NAME.fullmatch(name) for name in _NAME.findall(text))
    return tuple(match.group() for match in matches if match and (match[2] or match[4]))


def _ours(name: str, notation: Notation) -> str:
    if notation == "khalil":
        match = _KHALIL_NAME.fullmatch(name)
        if match and not (match[2] and match[4]):
            return f"{_KHALIL[match[1]]}{match[3]}"
        allowed = f"{' '.join(_KHALIL)}, each with a link number (XX1), regrouped ones with an R (XXR1 or XX1R)"
    else:
        match = _SYMPYBOTICS_NAME.fullmatch(name)
        if match and match["tensor"]:
            return f"L{match['axes']}{match['a']}"
        if match and match["moment"]:
            return f"l{match['axis']}{match['b']}"
        if match:
            return f"{match['symbol']}{match['c']}"
        allowed = "L_1xx ... L_1zz, l_1x l_1y l_1z, m_1, Ia_1 fv_1 fc_1 fo_1, 1 being the link number"
    raise ParameterError(f"{name!r} is no link parameter in the notation {notation}: allowed are {allowed}")
