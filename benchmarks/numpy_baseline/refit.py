"""The last word on a merged constraint: its type, place, axis and residual from all its frames in one closed form.

W_i p = x is linear in the body point p and the world point x. With means over the valid frames the mean square distance
is p^T M p + 2 b^T p + c; eigenvectors of M with small eigenvalues are directions in which p may slide: the axis.
"""

import numpy as np

from .projection import FLOOR


def refit_space(t):
    """(position, residual): the mean origin and the root mean square distance to it."""
    centre = t.mean(axis=0)
    return centre, float(np.sqrt(np.mean(np.sum((t - centre) ** 2, axis=1))))


def refit_rotation(R, t, alpha_max):
    """(type, position, axis, residual) of a line or a point that holds in the frames `R`, `t`; a point has no axis."""
    Rbar, tbar = R.mean(axis=0), t.mean(axis=0)
    M = np.eye(3) - Rbar.T @ Rbar
    # b = mean(R^T t) - Rbar^T tbar and c = mean|t|^2 - |tbar|^2, without cancellation far from the origin:
    b = np.einsum("fji,fj->i", R - Rbar, t - tbar) / len(R)
    c = np.mean(np.sum((t - tbar) ** 2, axis=1))

    values, vectors = np.linalg.eigh(M)  # ascending
    is_line = values[0] <= np.sin(alpha_max) ** 2
    used = values > FLOOR
    used[0] &= not is_line  # a line's pivot is free to slide along its axis
    M_pinv_b = vectors[:, used] @ ((vectors[:, used].T @ b) / values[used])
    x = tbar - Rbar @ M_pinv_b
    residual = float(np.sqrt(max(0.0, c - b @ M_pinv_b)))
    if not is_line:
        return "point", x, None, residual
    axis = Rbar @ vectors[:, 0]
    axis /= np.linalg.norm(axis)
    return "line", x + axis * (axis @ (tbar - x)), axis, residual
