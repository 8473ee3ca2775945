"""Compute with vectors and rotations of tape values, symbols and numbers alike, for Newton-Euler formulas."""

from __future__ import annotations

import numpy as np

from ident_service.model.chain import Array
from ident_service.model.tape import Symbol, Value

Vector = list[Value]
Rotation = list[list[Value]]
ZERO: Vector = [0.0, 0.0, 0.0]


def constant(values: Array) -> Vector:
    """Return numbers as a vector, shape (3,)."""
    return [float(value) for value in values]


def turned(placement: Array, axis: Array, c: Symbol, s: Symbol) -> Rotation:
    """Return the rows of the rotation from the parent's frame into the turned joint frame (Rodrigues, transposed)."""
    x, y, z = (float(component) for component in axis)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    still, sine, cosine = placement @ (np.eye(3) + K @ K), placement @ K, -(placement @ (K @ K))
    return [
        [float(still[j, i]) + (float(sine[j, i]) * s + float(cosine[j, i]) * c) for j in range(3)] for i in range(3)
    ]


def dot(a: Vector, b: Vector) -> Value:
    """Return the dot product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def rotate(rotation: Rotation, vector: Vector) -> Vector:
    """Return the product of a rotation, by rows, and a vector."""
    return [dot(row, vector) for row in rotation]


def scaled(vector: Vector, factor: Value) -> Vector:
    """Return the vector with every component multiplied by a factor."""
    return [component * factor for component in vector]


def cross(a: Vector, b: Vector) -> Vector:
    """Return the cross product, a x b."""
    return [a[i] * b[j] - a[j] * b[i] for i, j in ((1, 2), (2, 0), (0, 1))]


def add(a: Vector, b: Vector) -> Vector:
    """Return the sum of two vectors."""
    return [a[i] + b[i] for i in range(3)]
