"""What is done to the markers before the cluster fit: noise, spikes, lost frames. Seeded, so every run is the same.

In: markers by foot (frames, markers, 3), metres. Out: the same, disturbed. White and coloured noise and spikes come to
each marker on its own, as a camera system errs; a lost frame is lost for the whole foot.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping

import numpy as np

Disturbance = Callable[[np.ndarray, float, np.random.Generator], np.ndarray]
"""Markers of a foot, rate, random numbers -> markers."""

COLOUR = 0.05
"""Seconds in which coloured noise forgets (1/e)."""


def clean(x: np.ndarray, rate: float, rng: np.random.Generator) -> np.ndarray:
    """As recorded."""
    return x


def white(sigma: float) -> Disturbance:
    """White Gaussian noise with a standard deviation of `sigma` metres on every marker coordinate."""
    return lambda x, rate, rng: x + sigma * rng.normal(size=x.shape)


def coloured(sigma: float) -> Disturbance:
    """First-order autoregressive Gaussian noise, `sigma` metres on every coordinate, correlated over `COLOUR`."""

    def add(x: np.ndarray, rate: float, rng: np.random.Generator) -> np.ndarray:
        keep = np.exp(-1 / (COLOUR * rate))
        noise = rng.normal(size=x.shape)
        noise[1:] *= np.sqrt(1 - keep**2)
        for i in range(1, len(noise)):
            noise[i] += keep * noise[i - 1]
        return x + sigma * noise

    return add


def spikes(fraction: float, size: float) -> Disturbance:
    """A `fraction` of the frames of each marker moved by `size` metres in a random direction."""

    def add(x: np.ndarray, rate: float, rng: np.random.Generator) -> np.ndarray:
        way = rng.normal(size=x.shape)
        way *= size / np.linalg.norm(way, axis=-1, keepdims=True)
        return x + np.where(rng.random(x.shape[:2])[..., None] < fraction, way, 0.0)

    return add


def lost(fraction: float) -> Disturbance:
    """A `fraction` of the frames lost, each for all markers of the foot."""
    return lambda x, rate, rng: np.where(rng.random(len(x))[:, None, None] < fraction, np.nan, x)


CONDITIONS: dict[str, Disturbance] = {
    "clean": clean,
    "1 mm white": white(0.001),
    "3 mm white": white(0.003),
    "1 mm coloured": coloured(0.001),
    "2 % spikes": spikes(0.02, 0.03),
    "10 % lost": lost(0.1),
}
"""The six conditions by name."""


def disturbed(
    markers: Mapping[str, np.ndarray], rate: float, condition: str, clip: str = "", seed: int = 0
) -> dict[str, np.ndarray]:
    """The markers under one of `CONDITIONS`; clip, foot, condition and seed decide the random numbers."""
    out = {}
    for foot, x in markers.items():
        rng = np.random.default_rng([seed, zlib.crc32(f"{clip}/{foot}/{condition}".encode())])
        out[foot] = CONDITIONS[condition](x, rate, rng)
    return out
