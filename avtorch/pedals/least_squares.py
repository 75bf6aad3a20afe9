"""Least squares with factors of which some have any sign and the others none below zero."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import nnls

from avtorch.arrays import FloatArray

_RIDGE = 1e-9  # of the mean diagonal: columns the drive never reaches must not make the matrix singular


def bounded_solution(normal: FloatArray, right: FloatArray, free: int) -> FloatArray:
    """The x (column,) that minimises x' `normal` x - 2 `right`' x with none but the first `free` below zero."""
    scale = 1 / np.sqrt(np.diag(normal) + _RIDGE * np.trace(normal) / len(normal))
    scaled = normal * scale[:, None] * scale + _RIDGE * np.eye(len(normal))
    root = np.linalg.cholesky(scaled).T  # upper
    target = solve_triangular(root, right * scale, trans=1)
    # the free ones fit whatever the others leave of their rows, so the others see only the rows below
    x = np.empty(len(normal))
    x[free:] = nnls(root[free:, free:], target[free:])[0] if free < len(normal) else 0.0
    x[:free] = solve_triangular(root[:free, :free], target[:free] - root[:free, free:] @ x[free:])
    return x * scale
