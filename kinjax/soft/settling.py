"""Where a rest begins and ends, softly: the counterpart of `detect.settling` (robust method).

In: how much each displacement is the first and the last of a constraint, raw and averaged poses of one object. Out: how
much each frame outside belongs to it all the same, because the object has not left its place yet.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..components import Parts, conjugate, vector_of_product
from ..detect.settling import PLACE
from ..numerics import shifted
from ..rotations import dot
from .steps import within


def soft_settle(
    begins: Float[Array, " n"],
    ends: Float[Array, " n"],
    raw: tuple[Parts, Parts, Bool[Array, " frames"]],
    mean: tuple[Parts, Parts],
    noise: tuple[Float[Array, ""], Float[Array, ""]],
    span: int,
    most: int,
    temperature: Float[Array, ""],
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """How much each frame `0..n-1` stays *unreached* by constraints that end before it, and by those that begin after it.

    A constraint whose last displacement is `j` reaches the `m`-th frame after it as far as all frames up to there are seen and in
    the place of the mean pose at `j`; `m` goes up to `most`. Contributions of several constraints are combined as if they were
    independent.
    """
    n = begins.shape[0]
    low, high = span // 2, (span + 1) // 2
    pad = most + high
    wide = lambda x: jnp.pad(x, (pad, pad))  # noqa: E731
    q, t, seen = tuple(map(wide, raw[0])), tuple(map(wide, raw[1])), wide(raw[2].astype(begins.dtype))
    reach = [jnp.asarray(allowed, n_.dtype) + 2.5 * n_ for allowed, n_ in zip((PLACE, PLACE / 0.1), noise, strict=True)]

    def unreached(edge: Array, at: int, way: int, offset: int) -> Array:
        home_q, home_t = (tuple(x[at : at + n] for x in y) for y in mean)

        @jax.checkpoint
        def step(grown: Array, m: Array) -> tuple[Array, Array]:
            take = lambda x: jax.lax.dynamic_slice(x, (pad + offset + way * m,), (n,))  # noqa: E731
            apart = [take(a) - b for a, b in zip(t, home_t, strict=True)]
            turn = vector_of_product(tuple(take(a) for a in q), conjugate(home_q))
            turned = 4 * dot(turn, turn)
            same = within(dot(apart, apart), reach[0], temperature) * within(turned, reach[1], temperature)
            grown = grown * same * take(seen)
            return grown, 1 - grown

        steps = jnp.arange(1, most + 1, dtype=jnp.int32)
        _, free = jax.lax.scan(step, edge, steps)

        # the m-th frame from edge j is one further than the (m-1)-th: the furthest is moved one place a step
        def gather(state: Array, one: Array) -> tuple[Any, None]:
            return one * shifted(state, -way, 1.0), None

        # counted from the displacement's own frame: a place before the clip's begin would be lost
        free = shifted(free, -offset, 1.0)
        out, _ = jax.lax.scan(gather, jnp.ones_like(edge), free, reverse=True)
        return shifted(out, -way, 1.0)

    return unreached(ends, 0, 1, high), unreached(begins, span, -1, low)
