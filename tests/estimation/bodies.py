"""The paper's conditions on bodies written out a second time, for numbers and for cvxpy."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from ident_service.model.base_parameters import BaseParameters, base_from_expressions, parse_expression
from ident_service.model.parameter_layout import INERTIAL

if TYPE_CHECKING:
    import cvxpy as cp

Array = np.ndarray


def cloud(rng: np.random.Generator, points: int = 6) -> tuple[Array, Array]:
    """Mass points: where they are [m], shape (points, 3), and how heavy [kg]."""
    return rng.normal(scale=0.3, size=(points, 3)) + rng.normal(scale=0.3, size=3), rng.uniform(0.1, 1.0, size=points)


def skew(v: Array) -> Array:
    """S(v) of eq. 7: `S(v) w = v x w`."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def ten_of(points: Array, masses: Array) -> Array:
    """`Lxx ... m` of mass points, by the definition of inertia: the sum of m S(r)^T S(r)."""
    L = sum(m * skew(r).T @ skew(r) for m, r in zip(masses, points, strict=True))
    return np.array([L[0, 0], L[0, 1], L[0, 2], L[1, 1], L[1, 2], L[2, 2], *(masses @ points), masses.sum()])


def eq17(ten: Array) -> Array:
    """The 6x6 matrix of eq. 17 with the signs of its entries as printed."""
    xx, xy, xz, yy, yz, zz, lx, ly, lz, m = ten
    S = skew(np.array([lx, ly, lz]))
    return np.block([[np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), S], [S.T, m * np.eye(3)]])


def moments_of(points: Array, masses: Array) -> Array:
    """Sum of m [r; 1][r; 1]^T, which any mass distribution makes positive."""
    extended = np.column_stack([points, np.ones(len(points))])
    return np.asarray((extended.T * masses) @ extended)


def condition(kind: str, ten: Any) -> Any:
    """The matrix that must be positive, from a vector of ten cvxpy expressions."""
    import cvxpy as cp  # loads for a second, which every worker that collects this file would pay

    xx, xy, xz, yy, yz, zz, lx, ly, lz, m = (ten[k] for k in range(10))
    if kind == "inertia":
        return cp.bmat(
            [
                [xx, xy, xz, 0, -lz, ly],
                [xy, yy, yz, lz, 0, -lx],
                [xz, yz, zz, -ly, lx, 0],
                [0, lz, -ly, m, 0, 0],
                [-lz, 0, lx, 0, m, 0],
                [ly, -lx, 0, 0, 0, m],
            ]
        )
    return cp.bmat(
        [
            [(yy + zz - xx) / 2, -xy, -xz, lx],
            [-xy, (xx + zz - yy) / 2, -yz, ly],
            [-xz, -yz, (xx + yy - zz) / 2, lz],
            [lx, ly, lz, m],
        ]
    )


def conditions(kind: str, names: tuple[str, ...], delta: cp.Variable, margin: Any, total_mass: float) -> list[Any]:
    """Every link's matrix, every joint's Ia, fv and fc, and what is left of the total mass, are at least `margin`."""
    import cvxpy as cp

    index = {name: column for column, name in enumerate(names)}
    links = [int(name[1:]) for name in names if re.fullmatch(r"m\d+", name)]
    constraints = []
    for link in links:
        matrix = condition(kind, [delta[index[f"{symbol}{link}"]] for symbol in INERTIAL])
        slack = cp.Variable(matrix.shape, PSD=True)
        constraints.append(slack == matrix - margin * np.eye(matrix.shape[0]))
    constraints += [delta[index[name]] >= margin for name in names if name[:2] in ("Ia", "fv", "fc")]
    masses = sum(delta[index[f"m{link}"]] for link in links)
    return [*constraints, total_mass - masses >= margin]


def solved(problem: cp.Problem, variable: cp.Variable, solver: str) -> Array:
    """The variable at the optimum."""
    # Accelerated, SCS now and then wanders for as long as it is let, on one processor and not on another.
    options = {"eps": 1e-8, "max_iters": 100_000, "acceleration_lookback": 0} if solver == "SCS" else {}
    problem.solve(solver=solver, **options)
    assert problem.status == "optimal"
    return np.asarray(variable.value)


def table_names(rows: list[str]) -> list[str]:
    """`L_{1yy} + m_3` of table 1 as `Lyy1 + m3`."""

    def plain(text: str) -> str:
        text = re.sub(r"([Ll])_\{(\d)([xyz]+)\}", r"\1\3\2", text)
        return re.sub(r"m_(\d)", r"m\1", text)

    return [plain(row) for row in rows]


def table6_expression(combination: str) -> str:
    """`L_2xx -1 L_2zz +0.3 m_3` of table 6 as `Lxx2 - 1*Lzz2 + 0.3*m3`."""
    text = re.sub(r"([Ll])_(\d)([xyz]+)", r"\1\3\2", combination)
    text = re.sub(r"(m|Ia|fv|fc|fo)_(\d)", r"\1\2", text)
    return re.sub(r"([+-])([\d.e-]+) ", r"\1 \2*", text)


def grouping(expressions: list[str], names: tuple[str, ...] | None = None) -> BaseParameters:
    """The grouping of a table; without names, all ten of each link up to the highest that is mentioned."""
    if names is None:
        mentioned = {name for text in expressions for name in parse_expression(text)}
        links = max(int(re.sub(r"\D", "", name)) for name in mentioned)
        names = tuple(f"{symbol}{link}" for link in range(1, links + 1) for symbol in INERTIAL)
    return base_from_expressions(tuple(expressions), names)
