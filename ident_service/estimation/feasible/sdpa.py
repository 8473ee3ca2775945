"""Write the feasibility problems in SDPA sparse format (.dat-s), as used by the paper's authors (section 5).

`minimise c^T x  subject to  sum_i x_i F_i - F_0 >= 0`, block-diagonal, with norms as Schur complements (eqs. 54, 73).
Conditions that are numbers, and each equality as two of them, stand in diagonal blocks. Writer only, pure computation,
no I/O.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ident_service.errors import ParameterError
from ident_service.estimation.feasible.conic import triangle_entries
from ident_service.estimation.feasible.feasible_set import FeasibleSet
from ident_service.estimation.feasible.formulation import EPSILON, LinkParameterMap, require_consistent
from ident_service.estimation.least_squares import LeastSquares
from ident_service.model.base_parameters import BaseParameters
from ident_service.model.chain import Array

_LARGEST_MARGIN = 1e3  # as in the feasibility test: nothing may bound the margin, and a larger one says no more


def bpft_sdpa(beta: Array, base: BaseParameters, conditions: FeasibleSet) -> str:
    """Return BPFT as SDPA text (eq. 51): minimise -t over (t, delta_d) with D(beta, delta_d) - t 1 >= 0.

    Args:
        beta: base parameters in SI units, shape (base,).
        base: grouping of the link parameters.
        conditions: the feasible set over the same link parameters.

    Returns:
        The text of the file; the margin is minus the optimum.

    Raises:
        ParameterError: shapes or names do not fit.
    """
    require_consistent(beta, base, conditions)
    lift = LinkParameterMap(base)
    names = ["t", *(base.names[column] for column in lift.dependent)]
    file = _File("BPFT, eq. 51, as a largest margin t", names, np.append(-1.0, np.zeros(len(lift.dependent))))
    _conditions(file, conditions, lift.of_beta @ beta, lift.of_dependent, 0.0, margin=True)
    file.numbers("t is bounded", np.append(-1.0, np.zeros(len(lift.dependent)))[None], np.array([_LARGEST_MARGIN]))
    return file.text()


def bpfc_sdpa(beta: Array, base: BaseParameters, conditions: FeasibleSet) -> str:
    """Return BPFC (eq. 55) as SDPA text: minimise u over (u, beta, delta_d), [[u, (b - beta)^T], [b - beta, 1]] >= 0.

    Args:
        beta: base parameters b in SI units, shape (base,).
        base: grouping of the link parameters.
        conditions: the feasible set over the same link parameters.

    Returns:
        The text of the file; the distance is the root of the optimum.

    Raises:
        ParameterError: shapes or names do not fit.
    """
    require_consistent(beta, base, conditions)
    return _nearest("BPFC, eq. 55", np.eye(base.size), beta, 0.0, base, conditions)


def fbpe_sdpa(fit: LeastSquares, base: BaseParameters, conditions: FeasibleSet) -> str:
    """Return FBPE-OLS as SDPA text (eq. 74): minimise u over (u, beta, delta_d) with U_rho(u, beta) >= 0 (eq. 73).

    Args:
        fit: unconstrained estimate, for R_1, rho_1 and |rho_2|.
        base: the grouping of its parameters.
        conditions: the feasible set over the same link parameters.

    Returns:
        The text of the file; the optimum is the sum of squared residuals.

    Raises:
        ParameterError: shapes or names do not fit.
    """
    require_consistent(fit.beta, base, conditions)
    return _nearest("FBPE-OLS, eq. 74", fit.R1, fit.rho1, fit.rho2**2, base, conditions)


@dataclass
class _File:
    """SDPA file: blocks are added one by one, then it is written.

    Attributes:
        title: title of the problem.
        names: names of the variables, in order.
        objective: c, shape (variables,).
    """

    title: str
    names: Sequence[str]
    objective: Array
    _blocks: list[str] = field(default_factory=list)
    _sizes: list[int] = field(default_factory=list)
    _entries: list[tuple[int, int, int, int, float]] = field(default_factory=list)

    def matrix(self, name: str, size: int, F: Array, f: Array) -> None:
        """Add a symmetric matrix `F x + f`, upper triangle column by column, that must be positive semidefinite."""
        self._add(name, size, triangle_entries(size), F, f)

    def numbers(self, name: str, F: Array, f: Array) -> None:
        """Add numbers `F x + f` that must not be negative."""
        self._add(name, -len(f), [(i, i) for i in range(len(f))], F, f)

    def _add(self, name: str, size: int, places: Sequence[tuple[int, int]], F: Array, f: Array) -> None:
        self._blocks.append(name)
        self._sizes.append(size)
        block = len(self._sizes)
        for (i, j), row, constant in zip(places, F, f, strict=True):
            if constant != 0.0:
                self._entries.append((0, block, i + 1, j + 1, -float(constant)))
            self._entries += [
                (int(variable) + 1, block, i + 1, j + 1, float(row[variable])) for variable in np.flatnonzero(row)
            ]

    def text(self) -> str:
        """Return the text of the file."""
        values = [*self.objective, *(entry[-1] for entry in self._entries)]
        if not np.all(np.isfinite(values)):
            raise ParameterError(f"{self.title}: a coefficient is not finite")
        lines = [f'"{self.title}: minimise c^T x, sum_i x_i F_i - F_0 >= 0; SI units']
        lines += [f'"x{number} = {name}' for number, name in enumerate(self.names, 1)]
        lines += [f'"block {number}: {name}' for number, name in enumerate(self._blocks, 1)]
        lines += [str(len(self.names)), str(len(self._sizes)), " ".join(map(str, self._sizes))]
        lines.append(" ".join(repr(float(value)) for value in self.objective))
        lines += [f"{m} {block} {i} {j} {value!r}" for m, block, i, j, value in sorted(self._entries)]
        return "\n".join(lines) + "\n"


def _nearest(
    title: str, metric: Array, target: Array, offset: float, base: BaseParameters, conditions: FeasibleSet
) -> str:
    """Return the text of the problem: minimise u with `u - offset >= |target - metric beta|^2`."""
    lift = LinkParameterMap(base)
    n, dependents = base.size, len(lift.dependent)
    names = ["u", *(f"beta_{i} = {text}" for i, text in enumerate(base.expressions, 1))]
    names += [base.names[column] for column in lift.dependent]
    file = _File(title, names, np.append(1.0, np.zeros(n + dependents)))
    places = triangle_entries(n + 1)
    F, f = np.zeros((len(places), 1 + n + dependents)), np.zeros(len(places))
    for entry, (i, j) in enumerate(places):
        if i == j == 0:
            F[entry, 0], f[entry] = 1.0, -offset
        elif i == 0:
            F[entry, 1 : 1 + n], f[entry] = -metric[j - 1], target[j - 1]
        elif i == j:
            f[entry] = 1.0
    file.matrix("Schur complement of the norm", n + 1, F, f)
    to_delta = np.column_stack([np.zeros(len(base.names)), lift.of_beta, lift.of_dependent])
    _conditions(file, conditions, np.zeros(len(base.names)), to_delta, EPSILON, margin=False)
    return file.text()


def _conditions(
    file: _File, conditions: FeasibleSet, fixed: Array, to_delta: Array, inset: float, *, margin: bool
) -> None:
    """Add every block of D at `delta = to_delta x + fixed`, less the inset, or less t, the first variable then."""
    for block in conditions.blocks:
        F, f = block.F @ to_delta, block.f + block.F @ fixed - inset * block.identity()
        if margin:
            F = np.column_stack([-block.identity(), F])
        if block.size == 0:
            file.numbers(block.name, F, f)
        else:
            file.matrix(block.name, block.size, F, f)
    for block in conditions.equalities:
        F, f = block.F @ to_delta, block.f + block.F @ fixed
        if margin:
            F = np.column_stack([np.zeros(len(f)), F])
        file.numbers(f"{block.name}, both signs", np.vstack([F, -F]), np.concatenate([f, -f]))
