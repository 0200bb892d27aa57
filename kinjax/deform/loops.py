"""How loops whose length is data are run: plainly, or such that reverse differentiation can go back through them.

In: a condition, a body, a state. Out: the last state. XLA's own loop keeps nothing of what it went through, so it has no reverse
derivative; Equinox's keeps a few states and computes the others again from these.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax

Loop = Callable[[Callable[[Any], Any], Callable[[Any], Any], Any], Any]

STATES = 16
"""States of a loop that are kept for going back through it."""


def plain(condition: Callable[[Any], Any], body: Callable[[Any], Any], state: Any) -> Any:
    """`jax.lax.while_loop`: forward derivatives only."""
    return jax.lax.while_loop(condition, body, state)


def stored(condition: Callable[[Any], Any], body: Callable[[Any], Any], state: Any) -> Any:
    """The same with a reverse derivative, at the cost of computing steps again."""
    import equinox.internal as eqxi

    return eqxi.while_loop(condition, body, state, kind="checkpointed", checkpoints=STATES)
