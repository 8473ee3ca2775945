"""The stick-slip problem's solution obeys its complementarity conditions, whatever the matrix."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_backend import plant as friction
from sim_backend.plant import stick_slip_velocity


def assert_solves(A, b, bound, v, tolerance=1e-11):
    holding = b - A @ v
    scale = np.abs(b).max() + np.abs(A).max() * np.abs(v).max() + bound.max() + 1e-300
    moving = v != 0.0
    np.testing.assert_allclose(holding[moving], (bound * np.sign(v))[moving], rtol=0, atol=tolerance * scale)
    assert (np.abs(holding[~moving]) <= bound[~moving] + tolerance * scale).all()


@st.composite
def problems(draw):
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n = draw(st.integers(1, 8))
    spread = draw(st.sampled_from([0.0, 1.0, 3.0]))
    G = rng.normal(size=(n, n)) * 10.0 ** rng.uniform(-spread, 0.0, size=(n, 1))
    A = G @ G.T + 10.0 ** -draw(st.integers(0, 6)) * np.diag(np.diag(G @ G.T))
    b = rng.normal(size=n) * np.sqrt(np.diag(A))
    bound = np.abs(rng.normal(size=n)) * np.sqrt(np.diag(A)) * rng.choice([0.0, 0.1, 1.0, 10.0], size=n)
    return A, b, bound, rng.choice([-1.0, 0.0, 1.0], size=n)


@given(problems())
@settings(max_examples=400, deadline=None, derandomize=True)
def test_complementarity(problem):
    A, b, bound, guess = problem
    assert_solves(A, b, bound, stick_slip_velocity(A, b, bound, guess))


@given(problems())
@settings(max_examples=100, deadline=None, derandomize=True)
def test_any_guess_leads_to_the_same_solution(problem):
    A, b, bound, guess = problem
    first = stick_slip_velocity(A, b, bound, guess)
    second = stick_slip_velocity(A, b, bound, -guess)
    np.testing.assert_array_equal(first == 0.0, second == 0.0)
    np.testing.assert_allclose(first, second, rtol=0, atol=1e-8 * (np.abs(first).max() + 1e-300))


@given(problems())
@settings(max_examples=100, deadline=None, derandomize=True)
def test_sweeps_alone_get_there(problem):
    A, b, bound, guess = problem
    pivots, friction._PIVOTS = friction._PIVOTS, 0
    try:
        v = stick_slip_velocity(A, b, bound, guess)
    finally:
        friction._PIVOTS = pivots
    assert_solves(A, b, bound, v)


def test_frictionless_is_a_linear_system():
    A, b = np.array([[2.0, 0.5], [0.5, 1.0]]), np.array([1.0, -3.0])
    np.testing.assert_allclose(stick_slip_velocity(A, b, np.zeros(2), np.zeros(2)), np.linalg.solve(A, b), rtol=1e-15)


def test_edge_of_the_cone_sticks_exactly():
    A = np.array([[2.0, 0.3], [0.3, 1.0]])
    v = stick_slip_velocity(A, np.array([0.7, -0.2]), np.array([0.7, 0.2]), np.zeros(2))
    np.testing.assert_array_equal(v, 0.0)


def test_nothing_pushes_nothing_moves():
    np.testing.assert_array_equal(stick_slip_velocity(np.eye(3), np.zeros(3), np.zeros(3), np.ones(3)), 0.0)
