"""Compute the smallest distance of line segments to each other, to half spaces and to boxes, for many at once.

Arrays have their three components first and the samples last: points are of shape (3, pairs, samples). Where along the
lines the distance is smallest comes back too, because the gradient of a smallest distance is that of the distance
between those points held fast (envelope theorem).

`capsules.py` supplies the end points.
"""

from __future__ import annotations

import numpy as np

from ident_service.model.chain import Array

_BISECTIONS = 36
_TOUCH = 1e-9  # m; what comes nearer to a box may as well be inside it


def dot(a: Array, b: Array) -> Array:
    """Return inner products along the first axis."""
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def unit(vectors: Array) -> tuple[Array, Array]:
    """Return lengths and directions; a vector of length zero has direction zero."""
    length = np.sqrt(dot(vectors, vectors))
    # Squares of anything shorter underflow.
    return length, vectors * (1.0 / np.maximum(length, 1e-150))


def between_segments(
    start: Array, along: Array, other_start: Array, other_along: Array, squares: Array, other_squares: Array
) -> tuple[Array, Array, Array, Array]:
    """Return distances between segments (Ericson, Real-Time Collision Detection, 5.1.9), also parallel and degenerate.

    Args:
        start: of the first segments [m], shape (3, pairs, samples).
        along: from their start to their end.
        other_start: of the second ones.
        other_along: likewise.
        squares: squared lengths of the first ones [m^2], shape (pairs, 1).
        other_squares: of the second ones.

    Returns:
        Distances, directions from the second to the first, and the shares along the first and the second segment.
    """
    apart = start - other_start
    b, c, f = dot(along, other_along), dot(along, apart), dot(other_along, apart)
    a, e = squares, other_squares
    determinant = a * e - b * b
    # Of parallel lines any point of the first will do.
    skew = determinant > 1e-14 * a * e
    s = np.where(skew, (b * f - c * e) / np.where(skew, determinant, 1.0), 0.0)
    np.clip(s, 0.0, 1.0, out=s)
    t = np.clip((b * s + f) * _inverse(e), 0.0, 1.0)
    s = np.clip((b * t - c) * _inverse(a), 0.0, 1.0)
    distance, direction = unit(apart + along * s - other_along * t)
    return distance, direction, s, t


def _inverse(squares: Array) -> Array:
    return np.where(squares > 0.0, 1.0 / np.where(squares > 0.0, squares, 1.0), 0.0)


def to_half_spaces(start: Array, along: Array, normal: Array, offset: Array) -> tuple[Array, Array]:
    """Return distances of segments to half spaces, `normal . x - offset` at the lower end.

    Args:
        start: [m], shape (3, pairs, samples).
        along: from start to end.
        normal: unit vectors, shape (3, pairs, 1).
        offset: [m], shape (pairs, 1).

    Returns:
        Signed distances and the share along the segment, 0 or 1.
    """
    slope = dot(normal, along)
    share = np.where(slope < 0.0, 1.0, 0.0)
    return np.asarray(dot(normal, start) - offset + share * slope), share


def to_boxes(start: Array, along: Array, half: Array) -> tuple[Array, Array, Array]:
    """Return signed distances of segments to boxes about the origin, along the axes.

    Outside, half the slope of the squared distance is linear between the places where the line crosses a face's plane.
    Of a line that enters the box the deepest point counts, whose negative distance to the nearest face is convex too.

    Args:
        start: in the box's frame [m], shape (3, pairs, samples).
        along: from start to end.
        half: half edges [m], shape (3, pairs, 1).

    Returns:
        Signed distances of the nearest points, their gradients with respect to the point, and their shares.
    """
    share = _nearest(start, along, half)
    distance, gradient = _box_gradient(start + along * share, half)
    enters = distance < _TOUCH
    if enters.any():
        inner, way = start[:, enters], along[:, enters]
        edges = np.broadcast_to(half, start.shape)[:, enters]
        distance[enters], gradient[:, enters], share[enters] = _deepest(inner, way, edges)
    return distance, gradient, share


def _nearest(start: Array, along: Array, half: Array) -> Array:
    """Return the share along a segment at which it is nearest to a box that it does not enter."""
    moves = np.abs(along) > 1e-12
    inverse = np.where(moves, 1.0, 0.0) / np.where(moves, along, 1.0)
    crossings = np.concatenate([(half - start) * inverse, (-half - start) * inverse])
    low, high = np.zeros(start.shape[1:]), np.ones(start.shape[1:])
    slope_low, slope_high = _slope(start, along, half, low), _slope(start, along, half, high)
    at_end = np.where(slope_low >= 0.0, 0.0, np.where(slope_high <= 0.0, 1.0, np.nan))
    for crossing in crossings:
        inside = (crossing > low) & (crossing < high)
        slope = _slope(start, along, half, crossing)
        falls, rises = inside & (slope < 0.0), inside & (slope >= 0.0)
        low, slope_low = np.where(falls, crossing, low), np.where(falls, slope, slope_low)
        high, slope_high = np.where(rises, crossing, high), np.where(rises, slope, slope_high)
    # Between the two nearest crossings the slope is linear.
    change = np.maximum(slope_high - slope_low, 1e-300)
    between = low + (high - low) * np.clip(-slope_low / change, 0.0, 1.0)
    return np.where(np.isnan(at_end), between, at_end)


def _slope(start: Array, along: Array, half: Array, share: Array) -> Array:
    """Return half the derivative of the squared distance to the box along the line."""
    points = start + along * share
    return dot(points - np.clip(points, -half, half), along)


def _deepest(start: Array, along: Array, half: Array) -> tuple[Array, Array, Array]:
    """Return distance, gradient and share, as `to_boxes`, of segments that enter their box, shape (3, segments)."""
    low, high = np.zeros(start.shape[1:]), np.ones(start.shape[1:])
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        falls = dot(_box_gradient(start + along * middle, half)[1], along) < 0.0
        low, high = np.where(falls, middle, low), np.where(falls, high, middle)
    before, after = (_box_gradient(start + along * share, half)[1] for share in (low, high))
    falling, rising = np.maximum(-dot(before, along), 0.0), np.maximum(dot(after, along), 0.0)
    # A deepest point equally far from two faces: they share the gradient so that it has no part along the line.
    share_before = np.where(falling > 0.0, rising / np.maximum(falling + rising, 1e-300), 0.0)
    share = 0.5 * (low + high)
    distance, _ = _box_gradient(start + along * share, half)
    return distance, before * share_before + after * (1.0 - share_before), share


def _box_gradient(points: Array, half: Array) -> tuple[Array, Array]:
    """Return the signed distance of points to boxes, and its gradient."""
    beyond = np.abs(points) - half
    outside = np.maximum(beyond, 0.0)
    length, direction = unit(outside)
    deepest = np.maximum(np.maximum(beyond[0], beyond[1]), beyond[2])
    within = length == 0.0
    faces = beyond == deepest
    direction = np.where(within, faces / faces.sum(axis=0), direction)
    return np.where(within, deepest, length), direction * np.sign(points)
