"""Sets of values for the least median of squares, and its answers to many of them at one compiled shape."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from kinjax.detect.lmeds import Kept, lmeds

SIZE = 200
"""Values a set holds at most: every set is padded to it, so one compilation serves all."""

_lmeds = jax.jit(jax.vmap(lmeds))


def kept(values: np.ndarray, mask: np.ndarray | None = None, dtype: str = "float64", batch: int = 500, width: int = SIZE) -> Kept:
    """The least median of squares of sets (n, m), m <= width; every call runs at one shape (batches of `batch`, padded)."""
    n, m = values.shape
    mask = np.ones((n, m), bool) if mask is None else mask
    rows = -(-n // batch) * batch
    v, k = np.zeros((rows, width), dtype), np.zeros((rows, width), bool)
    with np.errstate(over="ignore"):
        v[:n, :m] = values
    k[:n, :m] = mask
    with jax.enable_x64(dtype == "float64"):
        cuts = [slice(i, i + batch) for i in range(0, rows, batch)]
        parts = [jax.device_get(_lmeds(jnp.asarray(v[c]), jnp.asarray(k[c]))) for c in cuts]
    y = Kept(*(np.concatenate(x)[:n] for x in zip(*parts, strict=True)))
    return y._replace(kept=y.kept[:, :m])


def ragged(sets: Sequence[np.ndarray], dtype: str = "float64") -> Kept:
    """The same for sets of different sizes."""
    size = max(map(len, sets))
    mask = np.arange(size) < np.array([len(s) for s in sets])[:, None]
    return kept(np.stack([np.pad(s, (0, size - len(s))) for s in sets]), mask, dtype)


KINDS = ("far", "clustered", "near")


def contaminated(kind: str, n: int, bad: int, trials: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Sets of `n` values N(10, 1), `bad` of them (the first) replaced; and the largest clean value of each set."""
    v = np.abs(rng.normal(10, 1, (trials, n)))
    clean = v[:, bad:].max(1)
    size = trials, bad
    v[:, :bad] = {
        "far": lambda: rng.uniform(100, 1e4, size),
        "clustered": lambda: rng.normal(1000, 0.01, size),
        "near": lambda: rng.normal(16, 1, size),
    }[kind]()
    return v, clean


def contamination(
    trials: int, sizes: Sequence[int] = (10, 20, 21, 41, 100), seed: int = 0
) -> dict[tuple[str, int], dict[int, np.ndarray]]:
    """`sigma_max / clean maximum` (trials) by kind and N, by number of outliers from 0 to 60 %."""
    rng = np.random.default_rng(seed)
    keys = [(kind, n, bad) for kind in KINDS for n in sizes for bad in range(int(0.6 * n) + 1)]
    sets = [contaminated(*key, trials, rng) for key in keys]
    values = np.concatenate([np.pad(v, ((0, 0), (0, SIZE - v.shape[1]))) for v, _ in sets])
    mask = np.concatenate([np.broadcast_to(np.arange(SIZE) < n, (trials, SIZE)) for _, n, _ in keys])
    ratio = kept(values, mask).largest.reshape(len(keys), trials) / np.stack([c for _, c in sets])
    out: dict[tuple[str, int], dict[int, np.ndarray]] = {}
    for (kind, n, bad), r in zip(keys, ratio, strict=True):
        out.setdefault((kind, n), {})[bad] = r
    return out


def one_by_one(y: Kept) -> Iterator[Kept]:
    """Set by set."""
    return (Kept(*x) for x in zip(*y, strict=True))


def random_sets(count: int, seed: int = 10) -> list[np.ndarray]:
    """Sets of 3 to 200 values: continuous, on coarse grids (ties), with duplicates, outliers and several clusters."""
    rng = np.random.default_rng(seed)
    sets = []
    for i in range(count):
        n = int(rng.integers(3, 13) if i % 3 else rng.integers(3, SIZE + 1))
        grid, clusters = rng.integers(0, 8, n).astype(float), rng.normal(rng.integers(1, 4, n) * 5, 0.2)
        v = np.abs((rng.normal(3, 1, n), rng.exponential(1, n), grid, clusters)[i % 4])
        if i % 5 == 0:
            v = rng.choice(v, n)
        if i % 7 == 0:
            v[: n // 3] *= 100
        sets.append(v)
    return sets
