"""The recursion of section 3.2 as it is printed: damped pseudo-inverses and explicit null-space projectors.

The oracle of the tests. Two readings are fixed, both from Baerlocher and Boulic 2004, to whom the paper refers: damping is
in the step only, never in the projector; a direction counts as used if its singular value is above the rounding noise of
the layer's *own* Jacobian, not of the projected one, which may be nothing but noise.
"""

import numpy as np


def recursion(jacobians, errors, damping=None, posture=None):
    """The steps after each layer, [dm_1, ..., dm_k], most important layer first; with `posture`, P z is added to the last.

    jacobians: J_i (m_i, n). errors: dx_i (m_i,). damping: lambda_i, default 0.
    """
    n = jacobians[0].shape[1]
    damping = [0.0] * len(jacobians) if damping is None else damping
    dm, P, steps = np.zeros(n), np.eye(n), []
    for J, dx, damp in zip(jacobians, errors, damping, strict=True):
        J_free = J @ P
        U, s, Vt = np.linalg.svd(J_free, full_matrices=False)
        used = s > 16 * max(J.shape) * np.finfo(float).eps * np.linalg.norm(J)
        U, s, Vt = U[:, used], s[used], Vt[used]
        damped_inverse = Vt.T @ np.diag(s / (s**2 + damp**2)) @ U.T
        dm = dm + damped_inverse @ (dx - J @ dm)
        P = P - Vt.T @ Vt  # = P - pinv(J_free) J_free
        steps.append(dm)
    if posture is not None:
        steps[-1] = steps[-1] + P @ posture
    return steps
