"""`python -m benchmarks.speed [--data DIR]`: every speed figure of detection, as ratios in one process on one core.

The process pins itself to one core before JAX starts, and keeps its memory (`kinjax.keep_memory`), as the command line and the
workers do: the baseline gives back 100 MB, and what comes after it would fetch its own anew. Each figure is the best of several
warm runs; both sides of a ratio run in turns, so that a machine whose speed drifts spoils neither alone.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

CORE = max(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 0


def one_core() -> None:
    """Pin this process to one core (the last: the first serves the machine), before anything starts threads."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {CORE})
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def best(run: Callable[[], object], repeats: int) -> float:
    """Seconds of the fastest of `repeats` runs, after one that does not count."""
    run()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        run()
        times.append(time.perf_counter() - begin)
    return min(times)


def in_turns(
    a: Callable[[], object], b: Callable[[], object], rounds: int = 5, repeats: int = 6
) -> tuple[float, float]:
    """Best times of two functions that are timed alternately."""
    pairs = [(best(a, repeats), best(b, 1)) for _ in range(rounds)]
    return min(p[0] for p in pairs), min(p[1] for p in pairs)


def row(name: str, figure: str, bar: str, ok: bool | None) -> None:
    """One line of the table."""
    verdict = "" if ok is None else "ok" if ok else "MISS"
    print(f"{name:<66} {figure:>34}  {bar:<16} {verdict}", flush=True)


def projection() -> None:
    """sigma-epsilon of displacements against batched `np.linalg.svd`, and against one pass over the same memory."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from kinjax.detect.displacements import Displacement
    from kinjax.detect.sigma_epsilon import sigma_epsilon

    n = 1 << 20
    rng = np.random.default_rng(0)
    v, d = (jnp.asarray(0.1 * rng.normal(size=(3, n)), jnp.float32) for _ in range(2))
    w = jnp.sqrt(1 - jnp.sum(v**2, 0))
    valid = jnp.ones(n, bool)
    project = jax.jit(lambda v, w, d: sigma_epsilon(Displacement(v, w, d, valid)))
    # the same arrays read once and as many written, with one addition each: what memory alone allows
    touch = jax.jit(lambda v, w, d: (v[0] + d[0], v[1] + d[1], v[2] + d[2], w + w))
    few = 20000
    a = rng.normal(size=(few, 3, 3)) * 0.1
    ours, svd = in_turns(lambda: jax.block_until_ready(project(v, w, d)), lambda: np.linalg.svd(a))
    memory = best(lambda: jax.block_until_ready(touch(v, w, d)), 10)
    ours = min(ours, best(lambda: jax.block_until_ready(project(v, w, d)), 10))
    ns, svd_ns, memory_ns = ours / n * 1e9, svd / few * 1e9, memory / n * 1e9
    row(
        "projection against np.linalg.svd, per displacement",
        f"{ns:.2f} ns, {svd_ns:.0f} ns: x{svd_ns / ns:.0f}",
        ">= 500",
        svd_ns / ns >= 500,
    )
    row(
        "projection against one pass over its memory",
        f"{ns:.2f} ns, {memory_ns:.2f} ns: x{ns / memory_ns:.2f}",
        "",
        None,
    )


def walking_crowd(frames: int = 4500, joints: int = 31):
    """A motion of 31 joints that rests and moves in turns, for timing (its content does not matter, its size does), in memory as
    a reader leaves it: each component's frames side by side."""
    import numpy as np
    from scipy.spatial.transform import Rotation

    from kinjax.motion import Motion
    from kinjax.skeleton import Skeleton, Topology

    rng = np.random.default_rng(0)
    moving = (np.sin(np.arange(frames) / 40) > 0)[:, None, None]
    angles = np.cumsum(moving * rng.normal(size=(frames, joints, 3)) * 0.004, axis=0)
    q = Rotation.from_rotvec(angles.reshape(-1, 3)).as_quat()[:, [3, 0, 1, 2]].reshape(frames, joints, 4)
    q = np.moveaxis(np.ascontiguousarray(np.moveaxis(q, 0, -1)), -1, 0)
    root = np.cumsum(moving * rng.normal(size=(frames, 1, 3)) * 0.002, axis=0)
    parents = (-1, *((i - 1) // 2 for i in range(1, joints)))
    offsets = rng.normal(size=(joints, 3)) * 0.1
    topology = Topology(tuple(f"j{i}" for i in range(joints)), parents)
    return Motion(root, q, Skeleton(offsets, np.zeros((0, 3)), topology), 120.0, "crowd")


def whole_detection() -> None:
    """Space detection of a whole clip, from joint rotations, against the baseline from world poses (its kinematics is free)."""
    import numpy as np

    from benchmarks import numpy_baseline as nb
    from kinjax.detect import detect
    from kinjax.kinematics import forward_kinematics, object_poses

    motion = walking_crowd()
    thresholds = (2e-3, 2e-3)
    rotation, position = (np.asarray(x, float) for x in forward_kinematics(motion))
    from scipy.spatial.transform import Rotation

    matrices = (
        Rotation.from_quat(rotation.reshape(-1, 4)[:, [1, 2, 3, 0]]).as_matrix().reshape(*rotation.shape[:2], 3, 3)
    )

    def baseline(vectorised: bool, objects: int) -> None:
        for o in range(objects):
            nb.detect(
                matrices[:, o],
                position[:, o],
                rate=120.0,
                types=("space",),
                thresholds={"space": thresholds},
                vectorised=vectorised,
            )

    def projected() -> None:
        for o in range(motion.joints):
            nb.project_vectorised(*nb.displacements_vectorised(matrices[:, o], position[:, o]))

    def ours() -> None:
        detect(motion, method="paper", thresholds=thresholds)

    mine, theirs = in_turns(ours, projected, 4)
    whole = best(lambda: baseline(True, motion.joints), 1)
    loops = best(lambda: baseline(False, 3), 1) * motion.joints / 3
    world = object_poses(motion)
    alike = best(lambda: detect(world, method="paper", thresholds=thresholds), 10)
    robust = best(lambda: detect(motion), 5)
    size = "4,500 frames x 31 joints"
    row(
        f"space detection, {size}, against the vectorised SVD part",
        f"{mine * 1e3:.1f} ms, {theirs * 1e3:.0f} ms: x{theirs / mine:.0f}",
        ">= 50",
        theirs / mine >= 50,
    )
    row("  against the whole vectorised baseline", f"{whole * 1e3:.0f} ms: x{whole / mine:.0f}", "", None)
    row(
        "  against its loops (3 of 31 objects timed)",
        f"{loops:.1f} s: x{loops / mine:.0f}",
        ">= 500",
        loops / mine >= 500,
    )
    row(
        "  from world poses, as the baseline, against SVD part, loops",
        f"{alike * 1e3:.1f} ms: x{theirs / alike:.0f}, x{loops / alike:.0f}",
        "",
        None,
    )
    row(
        "  the robust method on the same clip",
        f"{robust * 1e3:.1f} ms: x{theirs / robust:.0f} of the SVD part",
        "",
        None,
    )


def window_stage() -> None:
    """Rewards of all windows, and the dynamic programme over them, per window."""
    import jax
    import jax.numpy as jnp

    from kinjax.detect.interface import Clip
    from kinjax.detect.prepare import prepared
    from kinjax.detect.settings import Settings
    from kinjax.detect.windows import Reward, best_segmentation, window_rewards
    from kinjax.kinematics import object_poses

    poses = object_poses(walking_crowd(2048), ["j3", "j7", "j15", "j30"])
    clip = Clip(*map(jnp.asarray, prepared(poses, None, None, Settings()).arrays))
    shortest, longest = 7, 48
    count = clip.valid.size * (longest - shortest + 1)
    nu, near, turn = (jnp.full(4, x, jnp.float32) for x in (3e-3, 2e-3, 1e-2))
    reward = Reward(jnp.float32(4), nu, jnp.float32(28), jnp.float32(0.2), jnp.float32(1.8e-4), near, turn)
    score = jax.jit(lambda c: window_rewards(*c, ~c.valid, shortest, longest, reward, rest=False))
    both = jax.jit(
        lambda c: best_segmentation(window_rewards(*c, ~c.valid, shortest, longest, reward, rest=False), shortest)
    )
    a = best(lambda: jax.block_until_ready(score(clip)), 10) / count * 1e9
    b = best(lambda: jax.block_until_ready(both(clip)), 10) / count * 1e9
    row("window stage, per window (moments and closed-form 3 x 3)", f"{a:.1f} ns", "< 100 ns", a < 100)
    row("  with the dynamic programme", f"{b:.1f} ns", "< 100 ns", b < 100)


def reading(data: Path | None) -> None:
    """Reading a BVH file against upc-pymotion."""
    from kinjax.formats import read_bvh

    if data is None:
        row("reading a BVH against upc-pymotion", "no --data", ">= 10", None)
        return
    try:
        from pymotion.io.bvh import BVH
    except ImportError:
        row("reading a BVH against upc-pymotion", "not installed ([bench] extra)", ">= 10", None)
        return
    path = str(data / "bvh" / "cmu" / "01_03.bvh")

    def theirs() -> None:
        b = BVH()
        b.load(path)
        b.get_data()

    def only_load() -> None:
        BVH().load(path)

    ours, other = in_turns(lambda: read_bvh(path), theirs)
    load = best(only_load, 3)
    mb = Path(path).stat().st_size / 1e6
    row(
        "reading a BVH to rotations, against upc-pymotion",
        f"{ours * 1e3:.0f} ms ({mb / ours:.0f} MB/s): x{other / ours:.1f}",
        ">= 10",
        other / ours >= 10,
    )
    row("  against its parsing alone (to Euler angles)", f"{load * 1e3:.0f} ms: x{load / ours:.1f}", "", None)


def one_object() -> None:
    """One 400-frame clip and one object, one template, warm: the paper took 25 to 41 ms."""
    from kinjax.annotations import Template
    from kinjax.detect import detect
    from kinjax.kinematics import object_poses

    poses = object_poses(walking_crowd(400), ["j5"])
    template = [Template("j5", 130, 180)]
    for method in ("paper", "robust"):
        ms = best(lambda m=method: detect(poses, templates=template, method=m), 30) * 1e3
        row(
            f"400 frames, one object, one template, method={method}",
            f"{ms:.2f} ms: x{25 / ms:.1f} to x{41 / ms:.1f}",
            ">= 12 of 25 ms",
            25 / ms >= 12,
        )


def main() -> int:
    """Run all, or the named ones."""
    stages = {
        "projection": projection,
        "whole": whole_detection,
        "windows": window_stage,
        "reading": None,
        "one": one_object,
    }
    parser = argparse.ArgumentParser(prog="python -m benchmarks.speed", description=__doc__.split("\n\n")[0])
    parser.add_argument("stages", nargs="*", choices=[*stages, []], help="only these")
    parser.add_argument("--data", type=Path, help="folder of real motion data (for reading BVH)")
    args = parser.parse_args()
    one_core()
    from kinjax import keep_memory

    keep_memory()
    for name, stage in stages.items():
        if not args.stages or name in args.stages:
            reading(args.data) if stage is None else stage()
    return 0


if __name__ == "__main__":
    sys.exit(main())
