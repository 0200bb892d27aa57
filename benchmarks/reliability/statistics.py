"""Rows R: the least median of squares against what it promises, and against its definition.

In: `full` or fewer cases. Out: rows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from benchmarks.numpy_baseline import lmeds_vectorised
from kinjax.annotations import Template
from kinjax.detect import detect
from kinjax.detect.lmeds import AMBIGUOUS, EXACT, FEW, SHORT
from kinjax.errors import KinjaxError, TemplateTooShort

from .clips import foot
from .lmeds_sets import SIZE, contamination, kept, one_by_one, ragged, random_sets
from .table import Row

EPS64 = float(np.finfo(np.float64).eps)
BOTH = ("float64", "float32")


def r1(full: bool = True) -> Iterator[Row]:
    """Breakdown: exact up to (N-1)//2 outliers, far or in one cluster; broken with one more. R2: the bias of near ones."""
    curves = contamination(400 if full else 40)
    for kind in ("far", "clustered"):
        for n in (10, 20, 21, 41, 100):
            curve, limit = curves[kind, n], (n - 1) // 2
            worst = max(np.quantile(curve[bad], 0.95) for bad in range(limit + 1))
            yield Row("R1", f"N={n}, 0..{limit} {kind} outliers", "sigma_max / clean maximum, p95", worst, 1.0)
            broken = np.median(curve[limit + 1])
            yield Row("R1", f"N={n}, {limit + 1} {kind} outliers", "the same, median (it breaks here)", broken, 2.0, True)
    for share in (0.3, 0.4):
        bias = curves["near", 20][int(20 * share)].mean()
        yield Row("R2", f"N=20, {share:.0%} outliers at +6 sd", "sigma_max / clean maximum, mean", bias)


GAUSSIAN = {
    3: (2.350, 0.0426), 4: (2.948, 0.0074), 5: (1.587, 0.0362), 6: (1.921, 0.0108), 8: (1.559, 0.0134), 10: (1.385, 0.0156),
    15: (1.079, 0.0300), 20: (1.113, 0.0197), 30: (1.044, 0.0212), 50: (1.000, 0.0215), 100: (0.979, 0.0200), 200: (0.976, 0.0180),
}  # fmt: skip
"""N: mean scale and share rejected of clean N(0, 1), from the definition (every value tried as the centre; 60,000 sets, 4,000
from N = 100)."""


def r3(full: bool = True) -> Iterator[Row]:
    """Clean Gaussian values: the scale's bias and the share rejected, within the Monte Carlo error of the reference."""
    rng = np.random.default_rng(3)
    trials = 20000 if full else 1500
    for n, (scale, rejected) in GAUSSIAN.items():
        y = kept(rng.normal(100, 1, (trials, n)))
        mean, share = y.spread.mean(), 1 - y.kept.mean(1)
        fed = f"{trials} sets of N={n}, N(0,1)"
        off = abs(mean - scale) / np.hypot(y.spread.std() / trials**0.5, 2e-3 + 8e-3 * (n < 5))
        yield Row("R3", fed, f"mean scale {mean:.3f} for {scale:.3f}, in standard errors", off, 4)
        off = abs(share.mean() - rejected) / np.hypot(share.std() / trials**0.5, 4e-4)
        yield Row("R3", fed, f"rejected {share.mean():.2%} for {rejected:.2%}, in standard errors", off, 4)


def r5(full: bool = True) -> Iterator[Row]:
    """No, one and two values: a status, and a typed error where a person asked."""
    del full
    y = ragged([np.zeros(0), np.array([2.0]), np.array([2.0, 3.0]), np.array([2.0, 3.0, 4.0])])
    yield Row("R5", "N = 0, 1, 2", "NaN", np.isnan(y.largest).sum() + np.isnan(y.spread).sum(), 0)
    wrong = (y.status & SHORT > 0) != [True, True, True, False]
    yield Row("R5", "N = 0, 1, 2 (and 3)", "statuses that are wrong", wrong.sum(), 0)
    seen = np.ones((foot().frames, 1), bool)
    seen[10:20] = False
    typed = 0
    for span, clip in (((5, 6), foot()), ((5, 7), foot()), ((9, 20), replace(foot(), valid=seen))):
        try:
            detect(clip, templates=[Template("foot", *span)], method="paper")
        except TemplateTooShort:
            typed += 1
        except KinjaxError:
            pass
    yield Row("R5", "templates of 1 and 2 intervals, and of none that is seen", "TemplateTooShort raised", typed, 3, True)


def r6(full: bool = True) -> Iterator[Row]:
    """Ties: all identical, over half identical, all zero."""
    del full
    rest = np.random.default_rng(6).uniform(1, 5, 9)
    for name, v, largest, count in (
        ("21 identical", np.full(21, 0.25), 0.25, 21),
        ("3 identical", np.full(3, 1e-9), 1e-9, 3),
        ("21 zeros", np.zeros(21), 0.0, 21),
        ("12 identical, 9 spread", np.r_[np.full(12, 0.25), rest], 0.25, 12),
        ("12 zeros, 9 spread", np.r_[np.zeros(12), rest], 0.0, 12),
    ):
        for dtype in BOTH:
            y = kept(v[None], dtype=dtype)
            wrong = (y.kept.sum() != count) + (y.largest[0] != np.asarray(largest, dtype)) + (not y.status[0] & EXACT)
            yield Row("R6", f"{name}, {dtype}", "kept, sigma_max or status that is wrong", wrong, 0)


def r7(full: bool = True) -> Iterator[Row]:
    """Two equal clusters, and centres that tie: the smaller, whatever the order and the precision."""
    rng = np.random.default_rng(7)
    trials = 200 if full else 40
    v = np.concatenate([10 + np.arange(10) / 64, 20 + np.arange(10) / 64])  # exact in both precisions
    sets = np.stack([rng.permutation(v) for _ in range(trials)])
    answers = set()
    for y in (kept(sets, dtype=d) for d in BOTH):
        answers |= set(zip(y.largest.tolist(), y.status.tolist(), y.kept.sum(1).tolist(), strict=True))
    yield Row("R7", f"two clusters of 10, {trials} orders, both precisions", "different answers", len(answers), 1)
    yield Row("R7", "the same", "answers not called ambiguous", sum(not status & AMBIGUOUS for _, status, _ in answers), 0)
    # the centres 3 and 4 tie at M = 1: with 3, 12 is an outlier; with 4 it would not be
    sets = np.stack([rng.permutation([2.0, 3, 4, 5, 12]) for _ in range(trials)])
    wrong = sum(np.sum(kept(sets, dtype=d).largest != 5) for d in BOTH)
    yield Row("R7", f"two centres that tie, {trials} orders, both precisions", "answers that are not the smaller's", wrong, 0)


def r8(full: bool = True) -> Iterator[Row]:
    """NaN and inf among the values: the same as dropping them, to the bit."""
    rng = np.random.default_rng(8)
    sets = []
    for share in (0.01, 0.1, 0.25, 0.49):
        for _ in range(200 if full else 20):
            v = np.abs(rng.normal(1, 0.2, SIZE))
            lost = rng.permutation(SIZE)[: int(share * SIZE)]
            v[lost] = rng.choice([np.nan, np.inf, -np.inf], len(lost))
            sets.append(v)
    whole = np.stack(sets)
    for dtype in BOTH:
        a, b = kept(whole, dtype=dtype), ragged([v[np.isfinite(v)] for v in sets], dtype)
        differ = sum(np.sum(getattr(a, name) != getattr(b, name)) for name in ("largest", "spread", "size", "status"))
        for mine, theirs, finite in zip(a.kept, b.kept, np.isfinite(whole), strict=True):
            differ += mine[~finite].sum() + (not np.array_equal(mine[finite], theirs[: finite.sum()]))
        yield Row("R8", f"{len(sets)} sets, 1..49 % NaN or inf, {dtype}", "answers that differ from dropping them", differ, 0)


def r9(full: bool = True) -> Iterator[Row]:
    """Values whose squares overflow or underflow, and values on a grid."""
    base = np.abs(np.random.default_rng(9).normal(1, 0.3, (100 if full else 20, 41)))
    base[:, :5] *= 50
    for dtype, powers in (("float64", (996, -66, -1000)), ("float32", (110, -66, -110))):
        plain = kept(base, dtype=dtype)
        for power in powers:
            scale = np.asarray(2.0**power, dtype)
            y = kept(base.astype(dtype) * scale, dtype=dtype)
            wrong = np.sum(~np.isfinite(y.spread)) + np.sum(y.kept != plain.kept) + np.sum(y.largest != plain.largest * scale)
            yield Row("R9", f"values of about {scale:.0e}, {dtype}", "NaN, or answers not scaled with them", wrong, 0)
        y = kept(base * np.finfo(dtype).smallest_subnormal * 64, dtype=dtype)
        bad = np.isnan(y.spread).sum() + np.isnan(y.largest).sum() + np.sum(y.kept.sum(1) < 21)
        yield Row("R9", f"denormal values, {dtype}", "NaN, or under half kept", bad, 0)
    grid = np.round(base * 1e-3, 6)
    bad = sum(not np.array_equal(a.kept, lmeds_vectorised(v).kept) for v, a in zip(grid, one_by_one(kept(grid)), strict=True))
    yield Row("R9", "values on a grid of 1e-6", "kept sets that differ from the definition's", bad, 0)


def r10(full: bool = True) -> Iterator[Row]:
    """Against the definition, every value tried as the centre."""
    sets = random_sets(10000 if full else 1500)
    differ = np.zeros(3, int)
    for v, mine in zip(sets, one_by_one(ragged(sets)), strict=True):
        theirs = lmeds_vectorised(v)
        differ += (
            not np.array_equal(mine.kept[: len(v)], theirs.kept), mine.largest != theirs.largest,
            abs(mine.spread - theirs.scale) > 4 * EPS64 * theirs.scale,
        )  # fmt: skip
    figures = "kept sets that differ from the definition's", "sigma_max that differ", "scales off by over 4 ulp"
    for what, bad in zip(figures, differ, strict=True):
        yield Row("R10", f"{len(sets)} random sets, N=3..200, ties, duplicates", what, bad, 0)


def r11(full: bool = True) -> Iterator[Row]:
    """Order, shift and scale: T(aX + b) = a T(X) + b, on values for which that is exact."""
    rng = np.random.default_rng(11)
    sets = [np.round(64 * s) for s in random_sets(10000 if full else 1000, 11)]
    plain = ragged(sets)
    orders = [rng.permutation(len(s)) for s in sets]
    y = ragged([s[o] for s, o in zip(sets, orders, strict=True)])
    differ = y.largest != plain.largest
    differ |= [not np.array_equal(a[o], b[: len(o)]) for a, b, o in zip(plain.kept, y.kept, orders, strict=True)]
    yield Row("R11", f"{len(sets)} sets in another order", "counterexamples", differ.sum(), 0)
    a, b = 2.0 ** rng.integers(-20, 20, len(sets)), rng.integers(0, 1 << 20, len(sets)).astype(float)
    y = ragged([x * (s + z) for s, x, z in zip(sets, a, b, strict=True)])
    differ = (y.largest != a * (plain.largest + b)) | (y.kept != plain.kept).any(1)
    yield Row("R11", f"{len(sets)} sets a X + b", "counterexamples", differ.sum(), 0)
    few = np.array([len(s) < 10 for s in sets])
    wrong = (plain.status & FEW > 0) != few
    yield Row("R11", "those of fewer than ten values", "without the status that says so", wrong.sum(), 0)
