"""`python -m benchmarks.soft`: soft detection with its gradient against hard detection, as ratios in one process on one core.

`--distance` prints how far soft labels are from hard ones as the temperature falls. The clip and the way of timing are those of
`benchmarks.speed`, with `kinjax.keep_memory()`; the gradient is that of a label loss with respect to all joint rotations and the
thresholds of all objects.
"""

from __future__ import annotations

import argparse

from benchmarks.speed import best, in_turns, one_core, row, walking_crowd

TEMPERATURES = (0.3, 0.1, 0.03, 0.01, 0.001)


def speed() -> None:
    """value_and_grad of a label loss, both methods, against `kinjax.detect.detect` of the same clip and method."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from kinjax import keep_memory, soft
    from kinjax.detect import detect

    keep_memory()
    motion = walking_crowd()
    rotations = jnp.asarray(motion.rotations, jnp.float32)
    for method, options, width in (
        ("paper", {"thresholds": (2e-3, 2e-3)}, (2.5e-3, 2.5e-3)),
        ("robust", {}, (2.0, 0.2)),
    ):
        hard = detect(motion, method=method, **options)
        target = jnp.asarray(np.stack([hard.constraints.mask(motion.frames, o) for o in hard.objects]), jnp.float32)
        limits = tuple(jnp.full(motion.joints, w, jnp.float32) for w in width)
        task = soft.prepare(motion, method=method, **options)

        def labels(task, rotations, limits):
            return soft.detect(task.with_motion(rotations), limits, temperature=jnp.asarray(0.1, jnp.float32)).labels

        def loss(rotations, limits, task, target):
            return jnp.mean((labels(task, rotations, limits) - target) ** 2)

        value, slope = jax.jit(labels), jax.jit(jax.value_and_grad(loss, argnums=(0, 1)))
        (mine, theirs) = in_turns(
            lambda: jax.block_until_ready(slope(rotations, limits, task, target)),  # noqa: B023
            lambda: detect(motion, method=method, **options),  # noqa: B023
            6,
        )
        alone = best(lambda: jax.block_until_ready(value(task, rotations, limits)), 5)  # noqa: B023
        size = "4,500 frames x 31 joints"
        row(
            f"soft {method} detection and gradient, {size}, against hard {method}",
            f"{mine * 1e3:.0f} ms, {theirs * 1e3:.0f} ms: x{mine / theirs:.1f}",
            "<= 6",
            mine / theirs <= 6,
        )
        row("  labels alone", f"{alone * 1e3:.0f} ms: x{alone / theirs:.1f}", "", None)


def distance() -> None:
    """Mean distance between soft and hard labels over all frames and objects, by temperature."""
    import numpy as np

    from kinjax import soft, synthetic
    from kinjax.detect import detect

    paper = {"method": "paper", "thresholds": (2e-3, 2e-3)}
    clips = (
        ("walk, 1 mm of noise", synthetic.with_noise(synthetic.walking_biped(), 0.001, seed=1).poses, {}),
        ("walk, a tenth lost", synthetic.with_gaps(synthetic.walking_biped(), 0.1, seed=1).poses, {}),
        ("heel, stand, toe", synthetic.rolling_foot().poses, {}),
        ("dice (paper)", synthetic.rolling_dice().poses, paper),
    )
    print(f"{'clip':<24}" + "".join(f"{t:>10}" for t in TEMPERATURES))
    for name, poses, options in clips:
        found, task = detect(poses, **options), soft.prepare(poses, **options)
        hard = np.stack([found.constraints.mask(found.frames, o, "space") for o in found.objects])
        off = (np.abs(np.asarray(soft.detect(task, temperature=t).labels) - hard).mean() for t in TEMPERATURES)
        print(f"{name:<24}" + "".join(f"{x:>10.4f}" for x in off), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--distance", action="store_true", help="print distances to hard labels, not times")
    asked = parser.parse_args()
    one_core()
    if asked.distance:
        distance()
    else:
        speed()


if __name__ == "__main__":
    main()
