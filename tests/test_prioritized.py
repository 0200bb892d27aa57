"""The linear solve: strict priority at every configuration, and the paper's own recursion where that is well defined."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.numpy_baseline.deform import recursion
from kinjax.deform.prioritized import factorize, inverse, layered_step, outside, product, row_basis, solve

LAYERS, ROWS, N = 5, 3, 30


def stacks(kind: str, count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 15, 30) Jacobians of five layers of three rows, hard in the way that `kind` says."""
    j = rng.normal(size=(count, LAYERS * ROWS, N))
    pick = lambda: rng.integers(0, LAYERS * ROWS, count)  # noqa: E731
    i = np.arange(count)
    if kind == "duplicated":
        j[i, pick()] = j[i, pick()]
    elif kind == "layer repeats":
        j[:, 3:6] = j[:, :3]
    elif kind == "near parallel":
        size = 10.0 ** -rng.uniform(1, 12, (count, 1, 1))
        j[:, 3:6] = j[:, :3] + size * rng.normal(size=(count, 3, N))
    elif kind == "in span":
        j[:, 6:9] = np.einsum("cij,cjn->cin", rng.normal(size=(count, 3, 6)), j[:, :6])
    elif kind == "zero rows":
        j[rng.random((count, LAYERS * ROWS)) < 0.4] = 0
    elif kind == "rank zero":
        j[:, :3] = 0
    elif kind == "singular layer":
        j[:, :3] = np.einsum("ci,cn->cin", rng.normal(size=(count, 3)), rng.normal(size=(count, N)))
    elif kind == "scaled":
        j *= 10.0 ** rng.uniform(-3, 3, (count, LAYERS * ROWS, 1))
    elif kind == "one column":
        j[:, :, 1:] = 0
    elif kind == "few columns":
        j[:, :, 7:] = 0
    elif kind == "nearly singular":
        u, s, v = np.linalg.svd(j[:, :6], full_matrices=False)
        s[:, -2:] *= 10.0 ** -rng.uniform(2, 16, (count, 1))
        j[:, :6] = np.einsum("cij,cj,cjn->cin", u, s, v)
    return j


KINDS = (
    "plain", "duplicated", "layer repeats", "near parallel", "in span", "zero rows", "rank zero", "singular layer", "scaled",
    "one column", "few columns", "nearly singular",
)  # fmt: skip
LAYER = np.repeat(np.arange(LAYERS), ROWS).astype(np.int32)


@jax.jit
@jax.vmap
def prefixes(j, dx, damping, z):
    """The whole step, and those of the first 1, 2, ... layers alone: (6, n), the whole one last."""

    def one(depth):
        on = (jnp.asarray(LAYER) < depth).astype(j.dtype)
        return solve(j * on[:, None], dx * on, jnp.asarray(LAYER), LAYERS, damping)

    alone = jnp.stack([one(d) for d in range(1, LAYERS + 1)])
    return jnp.concatenate([alone, solve(j, dx, jnp.asarray(LAYER), LAYERS, damping, z)[None]])


def test_adding_lower_layers_moves_no_higher_one(precision):
    """`|J_i (dm_all - dm_i)| <= 20 eps |J_i| (|dm_all| + |dm_i|)` on 10,080 stacks of twelve kinds."""
    dtype = np.dtype(precision)
    rng = np.random.default_rng(7)
    eps = np.finfo(dtype).eps
    worst = {}
    for kind in KINDS:
        count = 840
        j = stacks(kind, count, rng).astype(dtype)
        dx = (rng.normal(size=j.shape[:2]) * 10.0 ** rng.uniform(-3, 1, (count, 1))).astype(dtype)
        damping = np.repeat(rng.choice([0, 1e-4, 1e-2, 0.3], (count, LAYERS)), ROWS, axis=1).astype(dtype)
        z = rng.normal(size=(count, N)).astype(dtype)
        step = np.asarray(prefixes(j, dx, damping, z), np.float64)
        assert np.isfinite(step).all(), kind
        for i in range(LAYERS):
            rows = j[:, 3 * i : 3 * i + 3].astype(np.float64)
            leak = np.linalg.norm(np.einsum("cij,cj->ci", rows, step[:, -1] - step[:, i]), axis=1)
            size = np.linalg.norm(rows, axis=(1, 2)) * (
                np.linalg.norm(step[:, -1], axis=1) + np.linalg.norm(step[:, i], axis=1)
            )
            worst[kind] = max(worst.get(kind, 0), float((leak / np.maximum(eps * size, 1e-300)).max()))
    assert max(worst.values()) <= 20, worst


def test_agrees_with_the_papers_recursion(x64):
    """Undamped (as little as it can be), on stacks where every layer has room: the recursion with explicit projectors."""
    rng = np.random.default_rng(3)
    ours_of = jax.jit(lambda j, dx, z: solve(j, dx, jnp.asarray(LAYER[:9]), 3, jnp.zeros(9), z))
    for _ in range(50):
        j, dx, z = rng.normal(size=(9, N)), rng.normal(size=9), rng.normal(size=N)
        ours = ours_of(j, dx, z)
        theirs = recursion([j[:3], j[3:6], j[6:]], [dx[:3], dx[3:6], dx[6:]], [0.0] * 3, z)[-1]
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9)


def test_basis_is_orthonormal_and_spans_the_rows(precision):
    eps = np.finfo(precision).eps
    j = jnp.asarray(np.random.default_rng(1).normal(size=(12, N)), precision)
    q, r = row_basis(j)
    assert np.abs(q @ q.T - np.eye(12)).max() < 20 * eps
    assert np.abs(r @ q - j).max() < 50 * eps * np.abs(j).max()
    assert np.array_equal(np.triu(r, 1), np.zeros_like(r))


def test_a_row_is_not_bothered_by_those_after_it(precision):
    """Bit for bit: what a layer does cannot depend on the layers below it."""
    j = jnp.asarray(np.random.default_rng(2).normal(size=(9, N)), precision)
    whole, part = row_basis(j), row_basis(j.at[6:].set(0))
    assert np.array_equal(whole.rows[:6], part.rows[:6]) and np.array_equal(whole.factors[:6, :6], part.factors[:6, :6])


def test_inverse_of_a_symmetric_matrix(precision):
    a = np.random.default_rng(4).normal(size=(9, 9))
    a = a @ a.T + 0.1 * np.eye(9)
    got = inverse(jnp.asarray(a, precision))
    np.testing.assert_allclose(got @ a, np.eye(9), atol=3000 * np.finfo(precision).eps)


def test_budget_is_spent_in_order_and_clamps_hold():
    rng = np.random.default_rng(5)
    j = jnp.asarray(rng.normal(size=(9, N)), jnp.float32)
    layer = jnp.asarray(LAYER[:9])
    f = factorize(j, layer, jnp.zeros(9))
    dx = jnp.asarray(rng.normal(size=9), jnp.float32)
    free = layered_step(f, dx, layer, 3, 3, jnp.inf, jnp.inf)
    first = float(jnp.linalg.norm(free[:3]))
    tight = layered_step(f, dx, layer, 3, 3, jnp.inf, 1.1 * first)
    np.testing.assert_array_equal(tight[:3], free[:3])  # the first layer has its step
    assert np.isclose(float(jnp.linalg.norm(tight)), 1.1 * first, rtol=1e-5)
    short = layered_step(f, dx, layer, 3, 3, 1e-3, jnp.inf)
    moved = f.basis.factors @ short
    for k in range(3):
        asked = moved[3 * k : 3 * k + 3]
        assert float(jnp.linalg.norm(asked)) <= 1.01e-3 * (1 if k == 0 else 1.2)


def test_posture_is_invisible_to_every_row(precision):
    rng = np.random.default_rng(6)
    j = jnp.asarray(rng.normal(size=(12, N)), precision)
    z = outside(row_basis(j), jnp.asarray(rng.normal(size=N), precision))
    assert np.abs(j @ z).max() < 100 * np.finfo(precision).eps


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_drag_spares_what_is_not_singular(scale, x64):
    """A direction with a singular value well above the threshold is not held back; one far below it hardly moves."""
    j = jnp.asarray(np.diag([1.0, 1.0, 1e-3])[:, :3])
    travel = jnp.asarray([0.0, 0, 0])
    strong = jnp.full(3, 0.3)
    held = factorize(j, jnp.zeros(3, jnp.int32), jnp.zeros(3), (strong, 0.1), travel)
    free = factorize(j, jnp.zeros(3, jnp.int32), jnp.zeros(3))
    dx = scale * jnp.asarray([1.0, 1.0, 1e-3])
    y = layered_step(held, dx, jnp.zeros(3, jnp.int32), 1, 3, jnp.inf, jnp.inf, drag=True)
    f = layered_step(free, dx, jnp.zeros(3, jnp.int32), 1, 3, jnp.inf, jnp.inf)
    np.testing.assert_allclose(y[:2], f[:2], rtol=1e-6)
    assert abs(float(y[2])) < 1e-4 * abs(float(f[2]))


@pytest.mark.parametrize("rows", [1, 15, 16, 45])
def test_products_of_any_size(rows, precision):
    """Few rows are written out, many are multiplied one by one."""
    rng = np.random.default_rng(rows)
    a, b = rng.normal(size=(rows, 7)), rng.normal(size=(7, N))
    got = product(jnp.asarray(a, precision), jnp.asarray(b, precision))
    assert got.dtype == precision
    np.testing.assert_allclose(got, a @ b, atol=100 * np.finfo(precision).eps)
