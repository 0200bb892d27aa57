"""Step 3 of the overview: every displacement becomes a point (sigma_3, eps_3, sigma_1, eps_1) (section 5, eq. 5 to 8).

The singular values of A = R_D - I are numbered as in the paper, sigma_3 >= sigma_2 >= sigma_1; NumPy returns them in
that order. `eps_k` is the residual after zeroing every singular value equal to or below sigma_k. Singular values at or
below FLOOR are rounding noise: they become exactly zero, which makes them equal to one another.
"""

from typing import NamedTuple

import numpy as np

FLOOR = float(32.0 * np.finfo(np.float64).eps)


class Projection(NamedTuple):
    """One row per interval, NaN where the interval is not valid.

    `p` is the particular solution with sigma_1 zeroed: for a rotation the point of the screw axis nearest the origin.
    `axis` is the null vector of A; its sign is arbitrary, and it means nothing where sigma_3 is zero.
    """

    sigma3: np.ndarray
    eps3: np.ndarray
    sigma1: np.ndarray
    eps1: np.ndarray
    p: np.ndarray
    axis: np.ndarray


def project_one(R_D, t_D):
    """(sigma_3, eps_3, sigma_1, eps_1, p, axis) of one displacement."""
    A = R_D - np.eye(3)  # eq. 6
    U, s, Vt = np.linalg.svd(A)  # eq. 7
    s = np.where(s <= FLOOR, 0.0, s)
    sigma3, sigma1 = s[0], s[2]

    eps3 = np.linalg.norm(t_D)  # eq. 8 with all three values zeroed: p = 0

    inverse = np.zeros(3)
    for k in range(3):
        if s[k] > sigma1:
            inverse[k] = 1.0 / s[k]
    p = -Vt.T @ (inverse * (U.T @ t_D))
    eps1 = np.linalg.norm(A @ p + t_D)  # eq. 8
    return sigma3, eps3, sigma1, eps1, p, Vt[2]


def project_loop(R_D, t_D, valid):
    """One singular value decomposition per displacement."""
    n = len(R_D)
    out = Projection(*(np.full(n, np.nan) for _ in range(4)), np.full((n, 3), np.nan), np.full((n, 3), np.nan))
    for i in range(n):
        if valid[i]:
            for column, value in zip(out, project_one(R_D[i], t_D[i]), strict=True):
                column[i] = value
    return out


def project_vectorised(R_D, t_D, valid):
    """One batched singular value decomposition."""
    ok = np.asarray(valid, dtype=bool)
    t = np.where(ok[:, None], t_D, 0.0)
    A = np.where(ok[:, None, None], R_D, np.eye(3)) - np.eye(3)  # eq. 6
    U, s, Vt = np.linalg.svd(A)  # eq. 7
    s = np.where(s <= FLOOR, 0.0, s)
    used = s > s[:, 2:]
    inverse = np.where(used, 1.0 / np.where(used, s, 1.0), 0.0)
    p = -np.einsum("nkj,nk->nj", Vt, inverse * np.einsum("njk,nj->nk", U, t))
    eps1 = np.linalg.norm(np.einsum("njk,nk->nj", A, p) + t, axis=1)  # eq. 8
    rows = Projection(s[:, 0], np.linalg.norm(t, axis=1), s[:, 2], eps1, p, Vt[:, 2])
    return Projection(*(np.where(ok if x.ndim == 1 else ok[:, None], x, np.nan) for x in rows))
