"""Random motions for tests."""

from __future__ import annotations

import numpy as np

from ident_service.excitation.trajectory import FourierPath, FourierSeries, PosturePath

Array = np.ndarray


def random_series(rng: np.random.Generator, joints: int, harmonics: int, frequency: float) -> FourierSeries:
    """About one radian of swing in all."""
    a, b = rng.normal(size=(2, joints, harmonics)) * 2.0 * np.pi * frequency
    return FourierSeries(frequency, a, b, rng.normal(size=joints))


def random_fourier_path(seed: int, joints: int = 2, harmonics: int = 3, *, ramps: bool = True) -> FourierPath:
    """A motion of one to three periods between ramps, or without."""
    rng = np.random.default_rng(seed)
    frequency = float(rng.uniform(0.05, 1.0))
    ramp = float(rng.uniform(0.1, 1.0) / frequency) if ramps else 0.0
    return FourierPath(random_series(rng, joints, harmonics, frequency), int(rng.integers(1, 4)), ramp)


def random_posture_path(seed: int, joints: int = 2, postures: int = 4) -> PosturePath:
    """Ways of half a second to two seconds, with or without a rest at each posture."""
    rng = np.random.default_rng(seed)
    points, times = rng.normal(size=(postures, joints)), rng.uniform(0.5, 2.0, size=postures - 1)
    return PosturePath(points, times, float(rng.choice([0.0, rng.uniform(0.1, 1.0)])))


def random_path(seed: int, joints: int = 2) -> FourierPath | PosturePath:
    """Any of them."""
    kind = seed % 3
    return random_posture_path(seed, joints) if kind == 2 else random_fourier_path(seed, joints, ramps=kind == 1)
