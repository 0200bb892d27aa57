"""One prioritized linear solve in task space: an orthonormal basis of all rows in priority order, and a sweep over layers.

`J = L Q` with `Q Q^T = I` and `L` lower triangular: the paper's projected Jacobian of layer i is `L_ii Q_i`, so that every
pseudo-inverse is that of a small block, and what a layer leaves free is what is orthogonal to its rows of `Q`. No n x n
projector is formed. Adding layers below i changes the step by a multiple of later rows of `Q`, which `J_i` does not see.
"""

import numpy as np
from scipy.linalg.lapack import dgeqrf, dorgqr, dposv

TAU = 16 * np.finfo(float).eps


def row_basis(J):
    """(L, Q) with J = L Q: L (m, m) lower triangular, Q (m, n) with orthonormal rows, or zero rows where a row of J
    depends on those above it to rounding noise.

    Householder QR of J^T where the rows are clearly independent; where one is not, QR would spend a random direction on it.
    """
    m, n = J.shape
    if 0 < m <= n:
        packed, tau, _, _ = dgeqrf(J.T)
        diagonal = packed.diagonal()
        if (diagonal * diagonal > 1e-12 * np.vecdot(J, J)).all():
            return packed[:m].T * np.tri(m), dorgqr(packed[:, :m], tau)[0].T
    return gram_schmidt(J)


def gram_schmidt(J):
    """`row_basis` by classical Gram-Schmidt applied twice, row by row: safe at any rank, and each row is the same to the last
    bit whatever rows follow it, so that two stacks that begin alike can be compared.

    A row is kept if something above rounding noise is left of it after the first pass, and if that something is still
    there after the second.
    """
    m, n = J.shape
    L, Q = np.zeros((m, m)), np.zeros((m, n))
    for k, v in enumerate(J):
        c = Q[:k] @ v
        v1 = v - c @ Q[:k]
        n1 = np.linalg.norm(v1)
        if n1 <= TAU * np.linalg.norm(v):
            L[k, :k] = c
            continue
        u = v1 / n1
        c2 = Q[:k] @ u
        u2 = u - c2 @ Q[:k]
        n2 = np.linalg.norm(u2)
        L[k, :k] = c + n1 * c2
        if n2 > 0.5:
            Q[k] = u2 / n2
            L[k, k] = n1 * n2
    return L, Q


def gains(L, spans, damping):
    """For each layer the matrix `L_ii^T (L_ii L_ii^T + lambda_i^2)^-1`: the damped inverse of its own block."""
    found = []
    for (a, b), damp in zip(spans, damping, strict=True):
        block = L[a:b, a:b]
        if damp == 0:  # the normal matrix would square what is left of a nearly dependent row
            found.append(np.linalg.pinv(block, rcond=1e-13))
            continue
        normal = block @ block.T
        normal.ravel()[:: b - a + 1] += damp * damp
        found.append(dposv(normal, block)[1].T)
    return found


def sweep(L, spans, gain, errors, clamp=np.inf, budget=np.inf):
    """Task-space steps y (..., m) of errors (..., m), layer by layer: each takes what those above it left of its error.

    clamp: longest error that a layer acts on, one number or one per layer. budget: longest |y| altogether, given to the
    layers in order of priority: a clamp of the whole step would let a lower layer shorten the step of a higher one.
    """
    y = np.zeros_like(errors)
    left = budget * budget
    clamps = clamp if isinstance(clamp, list) else [clamp] * len(spans)
    for (a, b), G, reach in zip(spans, gain, clamps, strict=True):
        r = errors[..., a:b] - y[..., :a] @ L[a:b, :a].T if a else errors[..., a:b]
        step, squares = shortened(shortened(r, reach * reach)[0] @ G.T, left)
        y[..., a:b] = step
        left = np.maximum(left - squares, 0.0)
    return y


def shortened(v, longest):
    """v (..., k) and |v|^2 (...), scaled down to |v|^2 = `longest` (...) where it is more."""
    squares = np.vecdot(v, v)
    if (squares <= longest).all():
        return v, squares
    factor = np.sqrt(longest / np.maximum(squares, np.maximum(longest, 1e-300)))
    return v * factor[..., None], squares * factor**2


def posture_step(Q, y, z, budget=np.inf):
    """The part of z that no row sees (projected twice, against rounding), cut to the budget that y leaves."""
    free = z - (Q @ z) @ Q
    free = free - (Q @ free) @ Q
    return shortened(free, max(budget * budget - y @ y, 0.0))[0]


def linear_step(J, errors, spans, damping, posture=None, clamp=np.inf, budget=np.inf):
    """One solve from Jacobian to step: the tangent dm (n,), what the recursion computes."""
    L, Q = gram_schmidt(J)
    y = sweep(L, spans, gains(L, spans, damping), errors, clamp, budget)
    return y @ Q if posture is None else y @ Q + posture_step(Q, y, posture, budget)
