"""Packed flags against plain Boolean arrays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinjax.bits import (
    bits_after,
    bits_before,
    counted,
    counts_at,
    packed_bits,
    true_positions,
)


@pytest.mark.parametrize("n", [1, 31, 64, 300])
def test_true_positions(n):
    flags = np.random.default_rng(n).random((6, n)) < np.array([0, 0.02, 0.2, 0.5, 0.9, 1])[:, None]
    find = jax.jit(lambda f: true_positions(counted(packed_bits(f)), 40))
    found, total = find(jnp.asarray(flags))
    np.testing.assert_array_equal(total, flags.sum(1))
    for row, f in zip(np.asarray(found), flags, strict=True):
        at = np.flatnonzero(f)[:40]
        np.testing.assert_array_equal(row[: len(at)], at)
        assert (row[len(at) :] >= n).all()


def test_flags_are_counted_exactly_in_long_clips():
    n = 2**22
    flags = counted(packed_bits(jnp.ones((1, n), bool)))
    np.testing.assert_array_equal(flags.until[0], np.arange(32, n + 1, 32))


@pytest.mark.parametrize("n", [32, 64, 77, 320])
def test_packed_bits_find_and_count_flags(n):
    rng = np.random.default_rng(n)
    flags = rng.random((4, n)) < np.array([[0.0], [0.1], [0.6], [1.0]])
    words = packed_bits(jnp.asarray(flags))
    found, total = true_positions(counted(words), n)
    for lane in range(4):
        at = np.flatnonzero(flags[lane])
        assert total[lane] == len(at)
        np.testing.assert_array_equal(found[lane][: len(at)], at)
        assert (np.asarray(found[lane][len(at) :]) >= n).all()
    index = rng.integers(0, n, (4, 50))
    expected = np.take_along_axis(np.cumsum(flags, axis=1), index, axis=1)
    np.testing.assert_array_equal(counts_at(counted(words), jnp.asarray(index, jnp.int32)), expected)
    earlier, later = np.zeros_like(flags), np.zeros_like(flags)
    earlier[:, 1:], later[:, :-1] = flags[:, :-1], flags[:, 1:]
    whole = n // 32  # the last word may hold one shifted flag more
    for shifted, expected in ((bits_before(words), earlier), (bits_after(words), later)):
        np.testing.assert_array_equal(shifted[:, :whole], packed_bits(jnp.asarray(expected))[:, :whole])
