# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Learning a noise pattern from labels
#
# A sensor errs, and a person has marked some frames in which the body was at rest. Which thresholds belong to this noise? The
# labels of the hard detector are steps and have no gradient; those of `kinjax.soft` have one, so thresholds can be learnt.
#
# Errors are independent from frame to frame, `nu_t` metres and `nu_r` radians a coordinate. From one frame to the next they move
# a body at rest by `eps` and turn it by `sigma`: each is `sqrt(2) nu` times the length of a vector of three standard normal
# numbers (Maxwell's law). **The true pattern** is meant to be the one that nine of ten displacements at rest keep to, each
# threshold on its own: `sigma_max = sqrt(2) nu_r m` and `eps_max = sqrt(2) nu_t m`, `m = 2.50` the 0.9 quantile of that law. We make
# the noise, so it is known. Nothing of it is told to the learner but the nine of ten.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import maxwell

from kinjax import make_poses, soft, synthetic

clean = synthetic.rolling_foot(rate=60.0, steps=12)
true = {"nu_r": 0.004, "nu_t": 0.0008}  # radians and metres, each coordinate
rng = np.random.default_rng(3)
turn = synthetic.spatial.quat_exp(rng.normal(size=(clean.frames, 1, 3)) * true["nu_r"])
rotation = synthetic.spatial.quat_mul(clean.poses.rotation, turn)
position = clean.poses.position + rng.normal(size=clean.poses.position.shape) * true["nu_t"]
poses = make_poses(clean.poses.names, rotation, position, clean.rate)
print(f"{poses.frames} frames, object {poses.names[0]}")

# %% [markdown]
# The labelled frames: the stances of the first half of the clip. An interval is at rest where both its frames are.

# %%
task = soft.prepare(poses, method="paper", thresholds=(1e-6, 1e-6))
at_rest = np.zeros(poses.frames, bool)
for c in clean.truth.of("foot", "space"):
    if c.end < poses.frames // 2:
        at_rest[c.begin : c.end + 1] = True
interval = jnp.asarray(at_rest[1:] & at_rest[:-1], float)[None]
print(f"{int(at_rest.sum())} labelled frames")

# %% [markdown]
# The loss: how far the share that passes is from nine in ten, for either threshold alone (the other one wide open).
# The unknowns are logarithms, so that both units have one scale.

# %%
WIDE = 10.0
share = 0.9


def loss(unknown, temperature):
    sigma_max, eps_max = jnp.exp(unknown)[:, None]
    open_ = jnp.full(1, WIDE)
    by_sigma = soft.detect(task, (sigma_max, open_), temperature=temperature)
    by_eps = soft.detect(task, (open_, eps_max), temperature=temperature)
    rates = jnp.stack([jnp.sum(interval * x.passed) / jnp.sum(interval) for x in (by_sigma, by_eps)])
    return jnp.sum((rates - share) ** 2), rates


slope = jax.jit(jax.value_and_grad(loss, has_aux=True))

# %% [markdown]
# Adam, from thresholds ten times too wide, with a temperature that falls.

# %%
unknown = jnp.log(jnp.array([0.1, 0.02]))
mean, square, path = jnp.zeros(2), jnp.zeros(2), []
for i in range(300):
    temperature = jnp.asarray(0.3 * 0.1 ** (i / 299))
    (value, rates), g = slope(unknown, temperature)
    mean, square = 0.8 * mean + 0.2 * g, 0.98 * square + 0.02 * g**2
    step = mean / (1 - 0.8 ** (i + 1)) / (jnp.sqrt(square / (1 - 0.98 ** (i + 1))) + 1e-6)
    unknown = unknown - 0.05 * 0.1 ** (i / 299) * step
    path.append((*np.exp(unknown), float(value)))
sigma_max, eps_max = np.exp(unknown)
print(f"learnt: sigma_max {sigma_max:.5f} rad, eps_max {eps_max * 1e3:.3f} mm; shares {rates}")

# %%
factor = np.sqrt(2) * maxwell.ppf(share)
learnt = {"nu_r": float(sigma_max) / factor, "nu_t": float(eps_max) / factor}
for name in true:
    print(f"{name}: {learnt[name]:.6f}, true {true[name]:.6f}: off by {learnt[name] / true[name] - 1:+.1%}")

# %% [markdown]
# On the whole clip, the unlabelled half included: labels of the soft detector with what was learnt, and the truth.

# %%
found = soft.detect(task, (np.array([sigma_max]), np.array([eps_max])), temperature=0.05)
truth = clean.truth.mask(poses.frames, "foot", "space")
wrong = float(np.abs(np.asarray(found.labels[0]) - truth).mean())
print(f"labels differ from the truth by {wrong:.1%} on average")

# %%
fig, (left, right) = plt.subplots(1, 2, figsize=(11, 3.6))
path = np.array(path)
left.semilogy(path[:, 0] / (factor * true["nu_r"]), label="sigma_max / true")
left.semilogy(path[:, 1] / (factor * true["nu_t"]), label="eps_max / true")
left.axhline(1, color="0.6")
left.set(xlabel="step", title="What is learnt")
left.legend()
seconds = np.arange(poses.frames) / poses.rate
right.fill_between(seconds, truth, step="mid", color="0.85", label="truth")
right.plot(seconds, found.labels[0], lw=0.8, label="soft label")
right.set(xlabel="s", title="At rest", xlim=(0, 6))
right.legend(loc="center right")
fig.tight_layout()

# %%
assert all(abs(learnt[name] / true[name] - 1) < 0.1 for name in true)
assert wrong < 0.05
