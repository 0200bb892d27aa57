"""Linear systems that couple each frame with the next two: Cholesky factors of a block-pentadiagonal matrix.

In: the blocks of a symmetric positive definite matrix, frames along the first axis, and a right-hand side. Out: its factors,
and the solution. The matrix of F frames of n numbers is never there: memory and time grow as `F n^2` and `F n^3`. One
system a call; several are `vmap`ped. Frames that only fill an array up are blocks of the identity with nothing beside them.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

Three = tuple[Array, Array, Array]


class Bands(NamedTuple):
    """A symmetric matrix of F x F blocks: on the diagonal, and one and two below it.

    first[t] is the block in row t + 1 and column t, second[t] that in row t + 2; the last one (two) of them lie outside of
    the matrix and are not read.
    """

    diagonal: Float[Array, "f n n"]
    first: Float[Array, "f n n"]
    second: Float[Array, "f n n"]


class Factors(NamedTuple):
    """`L` of `A = L L'`, with blocks placed as in `Bands`, those on the diagonal lower triangular.

    sound: whether the matrix was positive definite to working precision. Where it was not, the factors are finite all the
    same, and are those of another matrix.
    """

    diagonal: Float[Array, "f n n"]
    first: Float[Array, "f n n"]
    second: Float[Array, "f n n"]
    sound: Bool[Array, ""]


def times(bands: Bands, x: Float[Array, "f n"]) -> Float[Array, "f n"]:
    """The matrix times a vector."""
    bands = _inside(bands)
    out = _act(bands.diagonal, x)
    for k, block in ((1, bands.first), (2, bands.second)):
        down, up = _act(block, x), _act(jnp.swapaxes(block, 1, 2), _later(x, k))
        out = out + _later(down, -k) + up
    return out


def factorize(bands: Bands) -> Factors:
    """Cholesky factors of a positive definite matrix, one frame after the other."""
    n = bands.diagonal.shape[1]
    same = jnp.eye(n, dtype=bands.diagonal.dtype)

    def step(carried: Three, x: Bands) -> tuple[Three, tuple[Array, ...]]:
        # below the diagonal, in the columns before this one: (t, t-1), (t+1, t-1), (t, t-2)
        left, under, far = carried
        pivot = x.diagonal - _dot(left, left.T) - _dot(far, far.T)
        found = jax.lax.linalg.cholesky(pivot, symmetrize_input=False)
        sound = jnp.isfinite(found).all()
        lower = jnp.where(sound, found, same)
        below = jnp.concatenate([x.first - _dot(under, left.T), x.second])
        below = jax.lax.linalg.triangular_solve(lower, below, left_side=False, lower=True, transpose_a=True)
        first, second = below[:n], below[n:]
        return (first, second, under), (lower, first, second, sound)

    none = jnp.zeros_like(same)
    diagonal, first, second, sound = jax.lax.scan(step, (none, none, none), _inside(bands))[1]
    return Factors(diagonal, first, second, sound.all())


def solve(factors: Factors, b: Float[Array, "f n"]) -> Float[Array, "f n"]:
    """`x` of `L L' x = b`."""
    none = jnp.zeros_like(b[0])

    def forward(carried: tuple[Array, Array], x: tuple[Array, ...]) -> tuple[tuple[Array, Array], Array]:
        # what the two frames before have left for this one, and the one before for the next
        here, after = carried
        lower, first, second, right = x
        y = _triangle(lower, right - here, False)
        return (after + _dot(first, y), _dot(second, y)), y

    def backward(carried: tuple[Array, Array], x: tuple[Array, ...]) -> tuple[tuple[Array, Array], Array]:
        one, two = carried
        lower, first, second, right = x
        z = _triangle(lower, right - _dot(first.T, one) - _dot(second.T, two), True)
        return (z, one), z

    blocks = factors[:3]
    y = jax.lax.scan(forward, (none, none), (*blocks, b))[1]
    return jax.lax.scan(backward, (none, none), (*blocks, y), reverse=True)[1]


def _inside(bands: Bands) -> Bands:
    """The same, with zeros for the blocks that lie outside of the matrix."""
    frame = jnp.arange(bands.diagonal.shape[0], dtype=jnp.int32)[:, None, None]
    first, second = (jnp.where(frame < len(frame) - k, x, 0) for k, x in ((1, bands.first), (2, bands.second)))
    return Bands(bands.diagonal, first, second)


def _later(x: Float[Array, "f n"], k: int) -> Float[Array, "f n"]:
    """Row t is row t + k, or 0 where there is none."""
    frames = x.shape[0]
    k = max(-frames, min(k, frames))
    empty = jnp.zeros_like(x[: abs(k)])
    return jnp.concatenate([x[k:], empty]) if k > 0 else jnp.concatenate([empty, x[: frames + k]])


def _act(blocks: Float[Array, "f n n"], x: Float[Array, "f n"]) -> Float[Array, "f n"]:
    return jnp.einsum("fij,fj->fi", blocks, x, precision="highest")


def _dot(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision="highest")


def _triangle(lower: Float[Array, "n n"], b: Float[Array, " n"], transposed: bool) -> Float[Array, " n"]:
    return jax.lax.linalg.triangular_solve(lower, b[:, None], left_side=True, lower=True, transpose_a=transposed)[:, 0]
