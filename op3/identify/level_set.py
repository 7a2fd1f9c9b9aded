"""Draws points from a level set of the loss, which fit a log about as well as the best point."""

import numpy as np

from op3.identify.sensitivity import Array

STEPS_PER_PARAMETER = 10
"""Steps of the random walk per parameter between two draws, which makes draws nearly independent."""


def draw_level_set(
    unit: Array, hessian: Array, gradient: Array, allowed: float, count: int, rng: np.random.Generator
) -> Array:
    """Draw points around an optimum at which the expected rise of a least-squares loss is limited.

    The loss is approximated by ``|r + J d|^2`` about the point, with the residual r and its Jacobian J. The set with at
    most the allowed rise is an ellipsoid, elongated where parameters compensate each other. Its overlap with the box is
    sampled uniformly by hit-and-run (Smith 1984): from a point inside, move along a random direction to a uniform
    position between the two ends of the set.

    Args:
        unit: the point in the unit box, ``[parameter]``.
        hessian: ``J^T J``, ``[parameter, parameter]``.
        gradient: ``J^T r``, ``[parameter]``.
        allowed: allowed rise of the loss; positive.

    Returns:
        Points in the unit box, ``[point, parameter]``.
    """
    # directions scaled to the set, otherwise the walk is slow along a long ellipsoid
    curvature, axes = np.linalg.eigh(hessian)
    lengths = np.minimum(1.0, np.sqrt(allowed / np.maximum(curvature, 1e-12)))
    step, points = np.zeros(len(unit)), []
    for _ in range(count):
        for _ in range(STEPS_PER_PARAMETER * len(unit)):
            direction = axes @ (lengths * rng.standard_normal(len(unit)))
            low, high = _chord(step, direction, hessian, gradient, allowed, unit)
            step = step + rng.uniform(low, high) * direction
        points.append(np.clip(unit + step, 0.0, 1.0))
    return np.array(points).reshape(count, len(unit))


def _chord(
    step: Array, direction: Array, hessian: Array, gradient: Array, allowed: float, unit: Array
) -> tuple[float, float]:
    """Largest backward and forward steps along a direction from a point inside the set."""
    # the loss along the line, a t^2 + 2 b t + c <= 0
    a = float(direction @ hessian @ direction)
    b = float(direction @ (hessian @ step + gradient))
    c = float(step @ hessian @ step + 2 * gradient @ step) - allowed
    low, high = -np.inf, np.inf
    if a > 0:
        root = np.sqrt(max(b * b - a * c, 0.0))
        low, high = (-b - root) / a, (-b + root) / a
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(0.0 - unit - step) / direction, (1.0 - unit - step) / direction])
    moves = np.abs(direction) > 1e-12
    low = max(low, float(ends.min(0)[moves].max(initial=-np.inf)))
    high = min(high, float(ends.max(0)[moves].min(initial=np.inf)))
    return (min(low, 0.0), max(high, 0.0))
