"""Rotations on separate components: the formulas that `rotations` stacks, for code that never stacks.

In and out: tuples of arrays of any one shape, (w, x, y, z) or (x, y, z). A stack costs a hot kernel nothing, but the gradient of
taking one apart again is a padded copy for every component.
"""

from __future__ import annotations

from collections.abc import Sequence

from jaxtyping import Array, Float

Parts = tuple[Float[Array, "..."], ...]
Some = Sequence[Float[Array, "..."]] | Float[Array, "_ ..."]
"""Components, or a stack of them along the first axis."""


def multiply(a: Some, b: Some) -> Parts:
    """Hamilton product: first `b`, then `a`."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (aw * bw - ax * bx - ay * by - az * bz, *vector_of_product(a, b))


def vector_of_product(a: Some, b: Some) -> Parts:
    """The last three components of the Hamilton product."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def conjugate(q: Some) -> Parts:
    """Inverse of a unit quaternion."""
    w, x, y, z = q
    return w, -x, -y, -z


def cross(a: Some, b: Some) -> Parts:
    """Cross product."""
    ax, ay, az = a
    bx, by, bz = b
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


def rotate(q: Some, v: Some) -> Parts:
    """Vectors turned by unit quaternions."""
    w, *u = q
    t = [x + x for x in cross(u, v)]
    return tuple(x + w * y + z for x, y, z in zip(v, t, cross(u, t), strict=True))


def matrix(q: Some) -> Parts:
    """The nine elements of the rotation matrix of a unit quaternion, row by row."""
    w, x, y, z = q
    return (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
