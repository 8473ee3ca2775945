"""Compute poses and origins of joint and link frames in the base frame, for many postures at once."""

from __future__ import annotations

import numpy as np

from ident_service.model.chain import WORLD, Array, Chain


def frame_origins(chain: Chain, position: Array) -> Array:
    """Return origins in the base frame [m], (postures, 1 + 2 joints, 3): base, then each joint's and its link's frame.

    Args:
        chain: the mechanism.
        position: [rad or m], shape (postures, joints).

    Returns:
        [m], shape (postures, 1 + 2 joints, 3): the base, then of every joint its own frame's and its link frame's.
    """
    origins = np.zeros((len(position), 1 + 2 * chain.joints, 3))
    for k, (R, p) in enumerate(joint_poses(chain, position)):
        origins[:, 1 + 2 * k] = p
        origins[:, 2 + 2 * k] = p + R @ chain.link_translation[k]
    return origins


def joint_frames(chain: Chain, position: Array) -> tuple[Array, Array]:
    """Return rotation and origin [m] in the base frame of every joint frame, as its joint moves it, at each posture.

    Args:
        chain: the mechanism.
        position: [rad or m], shape (postures, joints).

    Returns:
        Joint frame to base frame, shape (postures, joints, 3, 3), and its origin in the base frame [m], shape
        (postures, joints, 3).
    """
    poses = joint_poses(chain, position)
    return np.stack([R for R, _ in poses], axis=1), np.stack([p for _, p in poses], axis=1)


def link_poses(chain: Chain, position: Array) -> tuple[Array, Array]:
    """Return rotation and origin [m] of every link frame in the base frame, at each posture.

    Args:
        chain: the mechanism.
        position: [rad or m], shape (postures, joints).

    Returns:
        Link frame to base frame, shape (postures, joints, 3, 3), and its origin in the base frame [m], shape
        (postures, joints, 3).
    """
    poses = joint_poses(chain, position)
    turns = [R @ chain.link_rotation[k] for k, (R, _) in enumerate(poses)]
    places = [p + R @ chain.link_translation[k] for k, (R, p) in enumerate(poses)]
    return np.stack(turns, axis=1), np.stack(places, axis=1)


def joint_poses(chain: Chain, position: Array) -> list[tuple[Array, Array]]:
    """Return per joint its rotation to the base frame, shape (postures, 3, 3), and origin [m], (postures, 3)."""
    postures = len(position)
    poses: list[tuple[Array, Array]] = []
    for k in range(chain.joints):
        parent = chain.parents[k]
        still = (np.broadcast_to(np.eye(3), (postures, 3, 3)), np.zeros((postures, 3)))
        R, p = still if parent == WORLD else poses[parent]
        p = p + R @ chain.translation[k]
        R = R @ chain.rotation[k]
        axis = chain.axes[k]
        if chain.revolute[k]:
            K = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
            sine, cosine = np.sin(position[:, k])[:, None, None], np.cos(position[:, k])[:, None, None]
            R = R @ (np.eye(3) + sine * K + (1.0 - cosine) * (K @ K))
        else:
            p = p + position[:, k, None] * (R @ axis)
        poses.append((np.asarray(R), p))
    return poses


def branches(chain: Chain) -> tuple[tuple[int, ...], ...]:
    """Return per branch of the arm the indices into `frame_origins`' points, from the base to the branch's end."""
    ends = set(range(chain.joints)) - set(chain.parents)
    return tuple(
        (0, *(point for k in chain.ancestors(end) for point in (1 + 2 * k, 2 + 2 * k))) for end in sorted(ends)
    )
