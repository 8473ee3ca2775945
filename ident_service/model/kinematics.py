"""Where the links are: origins of all joint and link frames in the base frame, for many postures at once."""

from __future__ import annotations

import numpy as np

from ident_service.model.chain import WORLD, Array, Chain


def frame_origins(chain: Chain, position: Array) -> Array:
    """Origins along the arm.

    Args:
        chain: the mechanism.
        position: [rad or m], shape (postures, joints).

    Returns:
        [m], shape (postures, 1 + 2 joints, 3): the base, then of every joint its own frame's and its link frame's.
    """
    postures = len(position)
    origins = np.zeros((postures, 1 + 2 * chain.joints, 3))
    turns: list[Array] = []
    places: list[Array] = []
    for k in range(chain.joints):
        parent = chain.parents[k]
        R = np.broadcast_to(np.eye(3), (postures, 3, 3)) if parent == WORLD else turns[parent]
        p = np.zeros((postures, 3)) if parent == WORLD else places[parent]
        p = p + R @ chain.translation[k]
        R = R @ chain.rotation[k]
        axis = chain.axes[k]
        if chain.revolute[k]:
            K = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
            sine, cosine = np.sin(position[:, k])[:, None, None], np.cos(position[:, k])[:, None, None]
            R = R @ (np.eye(3) + sine * K + (1.0 - cosine) * (K @ K))
        else:
            p = p + position[:, k, None] * (R @ axis)
        turns.append(np.asarray(R))
        places.append(p)
        origins[:, 1 + 2 * k] = p
        origins[:, 2 + 2 * k] = p + R @ chain.link_translation[k]
    return origins


def branches(chain: Chain) -> tuple[tuple[int, ...], ...]:
    """Per branch of the arm, the points of `frame_origins` from the base to its end."""
    ends = set(range(chain.joints)) - set(chain.parents)
    return tuple(
        (0, *(point for k in chain.ancestors(end) for point in (1 + 2 * k, 2 + 2 * k))) for end in sorted(ends)
    )
