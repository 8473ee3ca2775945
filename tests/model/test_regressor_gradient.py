"""The regressor run backwards: slopes over position, velocity, acceleration and direction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.random_arms import random_chain, random_states
from hypothesis import given, settings
from hypothesis import strategies as st

from ident_service.errors import ModelError
from ident_service.model.chain import Chain
from ident_service.model.parameter_layout import Layout
from ident_service.model.regressor import RegressorGradient, joint_regressor

Array = np.ndarray
TERMS = ("drive_inertia", "viscous", "coulomb", "offset", "stribeck", "quadratic", "viscous_asymmetry")
SAMPLES = 6


def coupled(rng: np.random.Generator, joints: int) -> tuple[Chain, Layout]:
    """A random mechanism whose drives move several joints each, with every friction term there is."""
    chain = replace(random_chain(rng, joints), coupling=np.eye(joints) + 0.3 * rng.normal(size=(joints, joints)))
    return chain, Layout(chain.revolute, TERMS, tuple(rng.uniform(0.5, 2.0, size=joints)))


@pytest.mark.slow
@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 4))
def test_the_pull_is_what_central_differences_say(seed: int, joints: int) -> None:
    rng = np.random.default_rng(seed)
    chain, layout = coupled(rng, joints)
    columns = np.sort(rng.choice(layout.size, size=rng.integers(1, layout.size + 1), replace=False))
    gradient = RegressorGradient(chain, layout, columns)
    states = [*random_states(rng, SAMPLES, joints), rng.uniform(-1.0, 1.0, size=(SAMPLES, joints))]
    # |rate| has no slope where a drive turns round.
    states[1][np.abs(states[1] @ chain.coupling.T).min(axis=1) < 1e-2] += 0.1
    seeds = rng.normal(size=(joints, len(columns), SAMPLES))

    def weighed(moved: list[Array]) -> Array:
        return np.asarray((seeds * joint_regressor(chain, layout, *moved[:3], columns, direction=moved[3])).sum((0, 1)))

    np.testing.assert_allclose(
        gradient.run(*states), joint_regressor(chain, layout, *states[:3], columns, direction=states[3]), atol=1e-12
    )
    for which, slopes in enumerate(gradient.pull(seeds)):
        for joint in range(joints):
            step = 1e-5 * np.eye(joints)[joint]
            above, below = ([*states[:which], states[which] + s, *states[which + 1 :]] for s in (step, -step))
            difference = (weighed(above) - weighed(below)) / 2e-5
            np.testing.assert_allclose(slopes[:, joint], difference, rtol=1e-5, atol=1e-5 * (1 + np.abs(slopes).max()))


def test_another_number_of_samples_is_another_run() -> None:
    rng = np.random.default_rng(1)
    chain, layout = coupled(rng, 3)
    gradient = RegressorGradient(chain, layout, range(layout.size))
    states = [*random_states(rng, 8, 3), rng.uniform(-1.0, 1.0, size=(8, 3))]
    seeds = rng.normal(size=(3, layout.size, 8))
    H = gradient.run(*states).copy()
    slopes = gradient.pull(seeds)
    np.testing.assert_array_equal(gradient.run(*(state[:3] for state in states)), H[:, :, :3])
    for part, whole in zip(gradient.pull(seeds[:, :, :3]), slopes, strict=True):
        np.testing.assert_array_equal(part, whole[:3])


def test_arrays_of_another_arm_are_refused() -> None:
    chain, layout = coupled(np.random.default_rng(2), 2)
    gradient = RegressorGradient(chain, layout, [0])
    with pytest.raises(ModelError, match=r"expected \(8, samples\)"):
        gradient.run(*np.zeros((4, 5, 3)))
