"""World poses of the objects of a motion, for what is differentiated.

In: local rotations, moving translations, offsets. Out: world poses of the objects, an array a component.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool

from ..components import Parts, rotate
from ..detect.interface import Joints
from ..forward import world_transforms
from .parts import normalize


def joint_poses(x: Joints) -> tuple[Parts, Parts, Bool[Array, "objects frames"]]:
    """World poses of the joints that are objects, origins at their segments' centres: `detect.engine.joint_poses`, with
    rotations normalised first, and frames that are not valid replaced by the identity."""
    # split, not indexed: the gradient is then one concatenation
    rows = (r[:, 0] for r in jnp.split(jnp.asarray(x.rotations), 4, axis=1))
    local = normalize(tuple(jnp.where(x.valid, r, 0 if k else 1) for k, r in enumerate(rows)))
    moving = jnp.where(x.valid, x.moving, 0)
    world = world_transforms(local, moving, x.offsets, x.parents, x.translated)
    q, t = x.objects(world[:4]), x.objects(world[4:])
    lever = rotate(q, tuple(x.centers[:, k, None] for k in range(3)))
    return q, tuple(a + b for a, b in zip(t, lever, strict=True)), x.valid & x.used[:, None]
