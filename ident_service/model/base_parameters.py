"""Find the base parameters beta = K delta (4.1) and write and read their expressions.

`beta = K delta` with `K = P_b^T + K_d P_d^T` (eqs. 38, 39), found numerically (Gautier 1991): the regressor at random
states has the structural rank of the mechanism; base columns are the first independent ones from the left (4.1), the
others' coefficients come from least squares and are rounded to decimals that the geometry explains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ident_service import certificate_verifier
from ident_service.errors import ParameterError
from ident_service.model.chain import Array, Chain
from ident_service.model.parameter_layout import NO_STRIBECK, Layout
from ident_service.model.regressor import joint_regressor


def format_number(value: float) -> str:
    """Return the shortest decimal that reads back as the same float, without a trailing `.0`."""
    text = repr(float(value))
    return text.removesuffix(".0")


def format_expression(terms: Sequence[tuple[float, str]]) -> str:
    """Return a sum as text, in the order given; names with the same coefficient share parentheses.

    Args:
        terms: coefficient and name; coefficients are not zero.
    """
    sharing: dict[float, list[str]] = {}
    for coefficient, name in terms:
        sharing.setdefault(coefficient, []).append(name)
    text = ""
    for coefficient, name in terms:
        names = sharing[coefficient]
        if abs(coefficient) == 1.0:
            body = name
        elif name == names[0]:
            body = f"{format_number(abs(coefficient))}*{name if len(names) == 1 else '(' + ' + '.join(names) + ')'}"
        else:
            continue
        sign = "-" if coefficient < 0 else "+"
        text += f" {sign} {body}" if text else body if sign == "+" else f"-{body}"
    return text


def parse_exactly(text: str) -> dict[str, Fraction]:
    """Parse an expression into exact coefficients by name; raises ParameterError where it is no sum.

    Raises:
        ParameterError: not a sum as in `certificate_verifier.parse_expression`; the message says where.
    """
    try:
        return certificate_verifier.parse_expression(text)
    except certificate_verifier.VerificationError as error:
        raise ParameterError(str(error)) from None


def parse_expression(text: str) -> dict[str, float]:
    """Parse an expression into coefficients by name, as floats; raises ParameterError where it is no sum.

    Raises:
        ParameterError: as `parse_exactly`, or a coefficient too large for a float.
    """
    try:
        return {name: float(coefficient) for name, coefficient in parse_exactly(text).items()}
    except OverflowError:
        raise ParameterError(f"a coefficient is too large for a float in {text!r}") from None


def parameter_matrix(expressions: Sequence[str], names: Sequence[str]) -> NDArray[np.float64]:
    """Return K of eq. 38: `K @ delta` gives the values of the expressions, shape (expressions, names).

    Raises:
        ParameterError: an expression does not parse or uses a name that is not among `names`.
    """
    index = {name: column for column, name in enumerate(names)}
    K = np.zeros((len(expressions), len(names)))
    for row, expression in enumerate(expressions):
        for name, coefficient in parse_expression(expression).items():
            if name not in index:
                raise ParameterError(f"expression {row + 1} ({expression!r}): no parameter is called {name!r}")
            K[row, index[name]] = coefficient
    return K


_ANY_STRIBECK = 0.1  # rad/s or m/s
_RANK_TOLERANCE = 1e-8
_DECIMALS = 11
_FAINT = 0.01  # of a column's length; of the shipped arms' none is below 0.4
_SEED = 20140301


@dataclass(frozen=True)
class BaseParameters:
    """Grouping of link parameters into base parameters.

    Attributes:
        names: link parameter names, the columns of K.
        K: eq. 38, shape (base, link parameters).
        base: columns that P_b selects, increasing, shape (base,); `K[:, base]` is invertible.
        units: the unit of each base parameter, empty strings where unknown.
        independence: for each base column, the share of its length that the base columns before it do not explain,
            shape (base,); None where it is not known.
    """

    names: tuple[str, ...]
    K: Array
    base: NDArray[np.intp]
    units: tuple[str, ...]
    independence: Array | None = None

    def __post_init__(self) -> None:
        self.K.setflags(write=False)
        self.base.setflags(write=False)

    @property
    def size(self) -> int:
        """Return the number of base parameters, n_b."""
        return int(self.K.shape[0])

    @cached_property
    def dependent(self) -> NDArray[np.intp]:
        """Return the indices of link parameters that are not base columns (those that P_d selects)."""
        return np.setdiff1d(np.arange(len(self.names)), self.base)

    @cached_property
    def expressions(self) -> tuple[str, ...]:
        """Return each base parameter as text, a sum of link parameters with coefficients (table 3)."""
        return tuple(
            format_expression([(float(row[column]), self.names[column]) for column in np.flatnonzero(row)])
            for row in self.K
        )


def base_parameters(chain: Chain, layout: Layout) -> BaseParameters:
    """Compute the base parameters of a mechanism from its regressor at seeded random states; always the same."""
    rng = np.random.default_rng(_SEED)
    samples = max(8, -(-4 * layout.size // chain.joints))
    states = rng.uniform(-np.pi, np.pi, size=(3, samples, chain.joints))
    if "stribeck" in layout.terms:
        # Also at the speeds where this term differs from Coulomb friction; one that is left out stays a parameter.
        velocities = np.array(layout.stribeck_velocity)
        velocities[velocities <= NO_STRIBECK] = _ANY_STRIBECK
        layout = replace(layout, stribeck_velocity=tuple(velocities.tolist()))
        states[1, ::2] *= velocities / np.pi
    H = joint_regressor(chain, layout, *states).transpose(0, 2, 1).reshape(-1, layout.size)
    return grouping(H, layout.names, layout.units)


def grouping(H: Array, names: tuple[str, ...], units: tuple[str, ...]) -> BaseParameters:
    """Group parameters into base parameters: the first independent columns of regressor H; others combine them.

    Args:
        H: a regressor at enough states, or K itself for some of its columns, shape (rows, names).
        names: of the parameters.
        units: of the parameters.
    """
    base, independence, K_d = _first_independent(H)
    K = np.zeros((len(base), len(names)))
    K[np.arange(len(base)), base] = 1.0
    dependent = np.setdiff1d(np.arange(len(names)), base)
    K[:, dependent] = K_d
    return BaseParameters(names, K, base, tuple(units[column] for column in base), independence)


def remarks_on_angles(base: BaseParameters) -> tuple[str, ...]:
    """Return a remark, in a tuple, if some base parameters can hardly be told apart, as with rounded angles; else ().

    Columns of real mechanisms are a third independent of the others, or not at all; 1.5708 for pi/2 leaves a millionth.
    """
    if base.independence is None:
        return ()
    faint = np.flatnonzero(base.independence < _FAINT)
    if not len(faint):
        return ()
    named = ", ".join(base.names[base.base[place]] for place in faint[:5])
    return (
        f"{len(faint)} of {base.size} base parameters ({named}{', ...' if len(faint) > 5 else ''}) can hardly be"
        f" separated from the others (by {base.independence[faint].max():.1g} of their effect): angles of the"
        " mechanism are probably rounded, as 1.5708 for pi/2; set kinematics.snap: true for a URDF, or"
        " write more digits",
    )


def static_base_parameters(chain: Chain, layout: Layout) -> BaseParameters:
    """Compute the base parameters that standing still and slow motion identify: gravity's and the friction terms."""
    rng = np.random.default_rng(_SEED)
    samples = max(8, -(-4 * layout.size // chain.joints))
    position, velocity = rng.uniform(-np.pi, np.pi, size=(2, samples, chain.joints))
    still = np.zeros_like(position)
    H = joint_regressor(chain, layout, position, still, still)
    terms = [int(column) for term in layout.terms if term != "drive_inertia" for column in layout.term_columns(term)]
    H[:, terms] = joint_regressor(chain, layout, position, velocity, still, terms)
    return grouping(H.transpose(0, 2, 1).reshape(-1, layout.size), layout.names, layout.units)


def _first_independent(H: Array) -> tuple[NDArray[np.intp], Array, Array]:
    """Return the first independent columns from the left, their independence, and K_d of the others (eq. 32)."""
    base, independence = _independent_columns(H)
    norms = np.linalg.norm(H, axis=0)
    dependent = np.setdiff1d(np.arange(H.shape[1]), base)
    H_b = H[:, base] / norms[base]
    q, r = np.linalg.qr(H_b)
    # r is triangular, but scipy's solver for that takes 0.2 s to load, and every look at a description needs this.
    K_d = np.linalg.solve(r, q.T @ H[:, dependent])
    K_d += np.linalg.solve(r, q.T @ (H[:, dependent] - H_b @ K_d))
    K_d /= norms[base][:, None]
    K_d[:, norms[dependent] <= _RANK_TOLERANCE * norms.max()] = 0.0
    # To decimals that people can read: rounding noise of the least squares becomes zero, geometry stays.
    return base, independence, np.asarray(np.round(K_d, _DECIMALS) + 0.0)


def base_from_expressions(expressions: tuple[str, ...], names: tuple[str, ...]) -> BaseParameters:
    """Build the base parameters that a table of expressions defines, without an arm model or units.

    Args:
        expressions: one per base parameter.
        names: link parameter names that delta consists of.

    Raises:
        ParameterError: no expressions, or ones that do not parse, use foreign names, or depend on each other.
    """
    from scipy.linalg.lapack import dgeqp3  # loads for 0.2 s, and few tables come without an arm

    if not expressions:
        raise ParameterError("no expressions: a table of base parameters has at least one")
    K = parameter_matrix(expressions, names)
    if empty := [row + 1 for row in range(len(K)) if not K[row].any()]:
        raise ParameterError(f"expression {empty[0]} ({expressions[empty[0] - 1]!r}) is zero whatever the parameters")
    R, order = dgeqp3(K.T)[:2]  # columns are counted from 1
    rank = int(np.sum(np.abs(np.diag(R)) > _RANK_TOLERANCE * max(1.0, abs(R[0, 0]))))
    if rank < len(expressions):
        raise ParameterError(
            f"expression {int(order[rank])} is a combination of the others: {expressions[order[rank] - 1]!r}"
        )
    base, _ = _independent_columns(K)
    return BaseParameters(names, K, base, ("",) * len(expressions))


def _independent_columns(matrix: Array) -> tuple[NDArray[np.intp], Array]:
    """Return the first independent columns from the left, and the share of each that those before it leave.

    Numerically null columns are none.
    """
    norms = np.linalg.norm(matrix, axis=0)
    basis = np.zeros((matrix.shape[0], min(matrix.shape)), order="F")
    chosen: list[int] = []
    lengths: list[float] = []
    # Columns that are only rounding noise must go before any scaling, or the noise looks like rank.
    for column in np.flatnonzero(norms > _RANK_TOLERANCE * norms.max()):
        residual, Q = matrix[:, column] / norms[column], basis[:, : len(chosen)]
        for _ in range(2):
            residual = residual - Q @ (Q.T @ residual)
        length = float(np.linalg.norm(residual))
        if length > _RANK_TOLERANCE:
            basis[:, len(chosen)] = residual / length
            chosen.append(int(column))
            lengths.append(length)
    return np.array(chosen, dtype=np.intp), np.array(lengths)
