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

# %% [markdown]
# # A correction learnt through the solver
#
# A walk was retargeted with a stride that is too short for its legs: feet skate. A person has labelled when each foot stands. A small
# correction is trained, a smooth path added to what each foot is asked for, such that the feet **of the motion that comes out of the
# deformation engine** are planted where the labels say. The loss looks at that motion only; its gradient goes back through the solver.

# %%
from dataclasses import replace

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from kinjax import forward_kinematics, soft, synthetic
from kinjax.deform import Bend, Orientation, Position

jax.config.update("jax_enable_x64", True)
scene = synthetic.walking_biped(rate=60, steps=4)
walk, names = scene.motion, scene.motion.skeleton.names
skating = replace(walk, translations=walk.translations * [1.0, 1.0, 0.85])  # the body goes 15 % too short a way
feet = ("LeftFoot", "RightFoot")
at = np.array([names.index(f) for f in feet])
labels = np.zeros((2, walk.frames))
for i, foot in enumerate(feet):
    for c in scene.truth.of(foot, "space"):
        labels[i, c.begin : c.end + 1] = 1
time = np.arange(walk.frames) / walk.rate

# %% [markdown]
# The deformation: each ankle has a place and an orientation. Their targets are the variables; the correction is a curve with one knot every
# 0.15 s for each foot and coordinate.

# %%
goals = [Position(f, priority=2, recruit_to=f.replace("Foot", "UpLeg")) for f in feet]
goals += [Orientation(f, priority=1, recruits=(f,)) for f in feet]
bend = Bend(skating, goals, gradient="implicit_local")
knots = np.arange(time[0] - 0.3, time[-1] + 0.3, 0.15)
u = np.abs(time[:, None] - knots) / 0.15
basis = jnp.asarray(np.where(u < 1, 2 / 3 - u**2 + u**3 / 2, np.where(u < 2, (2 - u) ** 3 / 6, 0)))  # cubic B-splines
task = soft.prepare(skating, feet)


def bent(curve):
    """The motion that a curve (knots, feet, 3) leads to."""
    v = bend.variables
    return bend(replace(v, place=v.place.at[:, :2].add(jnp.einsum("fk,kix->fix", basis, curve))))


# %% [markdown]
# The loss: labelled frames in which the foot's place changes from frame to frame, and soft detection against the labels,
# and a little for the correction itself.

# %%
both = jnp.asarray(labels[:, 1:] * labels[:, :-1])


def loss(curve):
    out = bent(curve)
    place = forward_kinematics(out.motion)[1][:, at]
    speed2 = jnp.sum(((place[1:] - place[:-1]) * walk.rate) ** 2, axis=-1).T
    found = soft.detect(task.with_motion(out.motion.rotations, out.motion.translations), temperature=0.1).labels
    found = jnp.clip(found, 1e-6, 1 - 1e-6)
    planted = jnp.sum(both * speed2) / jnp.sum(both)
    agree = -jnp.mean(labels * jnp.log(found) + (1 - labels) * jnp.log(1 - found))
    return planted + 1e-3 * agree + 1e-6 * jnp.mean(curve**2), (planted, agree, out)


slope = jax.jit(jax.value_and_grad(loss, has_aux=True))

# %% [markdown]
# Adam with a rate that falls.

# %%
curve = jnp.zeros((len(knots), 2, 3))
mean, square, history = jnp.zeros_like(curve), jnp.zeros_like(curve), []
STEPS = 80
for i in range(1, STEPS + 1):
    (value, (planted, agree, out)), g = slope(curve)
    history.append((float(planted) ** 0.5, float(agree)))
    mean, square = 0.9 * mean + 0.1 * g, 0.99 * square + 0.01 * g**2
    rate = 0.01 * 0.5 * (1 + np.cos(np.pi * i / STEPS)) + 1e-5
    curve = curve - rate * (mean / (1 - 0.9**i)) / (jnp.sqrt(square / (1 - 0.99**i)) + 1e-12)
(_, (planted, agree, out)), _ = slope(curve)


def slide(motion):
    """Root mean square speed of the ankles in labelled frames, m/s."""
    place = np.asarray(forward_kinematics(motion)[1])[:, at]
    speed = np.linalg.norm(np.diff(place, axis=0), axis=-1).T * walk.rate
    return float(np.sqrt((both * speed**2).sum() / both.sum()))


before, after = slide(skating), slide(out.motion)
print(
    f"feet in labelled frames: {100 * before:.2f} cm/s before, {100 * after:.2f} cm/s after: {before / after:.1f} times less"
)
print(f"labels: cross-entropy {history[0][1]:.3f} before, {float(agree):.3f} after")
print(f"{int(out.converged.sum())} of {walk.frames} frames converged")

# %%
figure, axes = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
for motion, label, color in ((skating, "before", "tab:red"), (out.motion, "after", "tab:green")):
    place = np.asarray(forward_kinematics(motion)[1])[:, at[0]]
    speed = np.linalg.norm(np.diff(place, axis=0), axis=-1) * walk.rate
    axes[0].semilogy(time[1:], speed, color=color, label=label)
axes[0].fill_between(time, 1e-4, 3, where=labels[0] > 0, color="0.9", label="labelled: planted")
axes[0].set(xlabel="time [s]", ylabel="speed of the left ankle [m/s]", ylim=(1e-4, 3))
axes[0].legend()
axes[1].semilogy([h[0] for h in history], label="speed where labelled [m/s]")
axes[1].semilogy([h[1] for h in history], label="cross-entropy of soft labels")
axes[1].set(xlabel="step")
axes[1].legend()
figure.suptitle("A correction learnt through the solver")

# %%
assert before > 10 * after
assert float(agree) < history[0][1]
