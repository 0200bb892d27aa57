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
# # Bone lengths and a marker offset, from feet that must not slide
#
# A capture gives joint rotations and the path of a marker on the hips. The skeleton's leg bones are wrong by a few per cent, and
# the marker sits some centimetres off the hip joint. So feet that stood slide when the clip is played. Detection says when a foot
# stands; the lengths and the offset are those with which it stays where it is. We make the clip, so the true numbers are known.

# %%
from dataclasses import replace

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optimistix as optx
from scipy.spatial.transform import Rotation

from kinjax import forward_kinematics, synthetic
from kinjax.deform import Orientation, Position, Settings, deform
from kinjax.detect import detect

jax.config.update("jax_enable_x64", True)

# %% [markdown]
# The true motion: a walk whose hips also sway, roll and turn, while the deformation engine holds the feet where they were. A foot
# that stands says something about the offset only if the hips turn above it.

# %%
walk = synthetic.walking_biped(rate=60, steps=4).motion
names, time = walk.skeleton.names, np.arange(walk.frames) / walk.rate
sway = np.radians([5, 8, 6]) * np.sin(2 * np.pi * time[:, None] * np.array([0.7, 0.5, 0.9]) + np.array([0, 1, 2]))
turned = np.array(walk.rotations)
hips = Rotation.from_rotvec(sway) * Rotation.from_quat(turned[:, 0], scalar_first=True)
turned[:, 0] = hips.as_quat(scalar_first=True)
lowered = np.array(walk.translations) - [0, 0.03, 0]  # room for the legs
turns, places = (np.asarray(x) for x in forward_kinematics(walk))
feet = [names.index(n) for n in ("LeftFoot", "RightFoot")]
held = []
for side, foot in zip(("Left", "Right"), feet, strict=True):
    held.append(Position(f"{side}Foot", path=places[:, foot], recruit_to=f"{side}UpLeg", priority=2))
    held.append(Orientation(f"{side}Foot", path=turns[:, foot], recruits=(f"{side}Foot",), priority=1))
bent = deform(replace(walk, rotations=turned, translations=lowered), held, Settings(filter_root=None, iterations=30))
true = bent.motion
print(f"feet off their places by {1e3 * np.nanmax(bent.report.residual[:, [0, 2]]):.4f} mm at most")

# %% [markdown]
# What was captured: the same rotations on a skeleton with wrong thighs and shanks, and the path of the marker, with 0.2 mm of noise.

# %%
true_offset = np.array([0.025, -0.04, 0.06])  # metres, from the marker to the hip joint, in the axes of the hips
true_scale = np.array([1.05, 0.96])  # of the captured skeleton's thighs and shanks
legs = [
    [names.index(side + n) for side in ("Left", "Right")] for n in ("Leg", "Foot")
]  # a bone belongs to its lower joint
rng = np.random.default_rng(0)
wrong = np.array(true.skeleton.offsets)
for bones, scale in zip(legs, true_scale, strict=True):
    wrong[bones] /= scale
hip_turn = Rotation.from_quat(true.rotations[:, 0], scalar_first=True)
marker = true.translations[:, 0] - hip_turn.apply(true_offset) + rng.normal(size=(walk.frames, 3)) * 2e-4
captured = replace(true, skeleton=replace(true.skeleton, offsets=wrong), translations=marker[:, None])


# %% [markdown]
# Detection on what was captured finds the stances in spite of their slide, `still` a little wider than usual. What is to vanish: how far a
# foot is from its mean place in its stance.


# %%
def corrected(unknown):
    """The captured motion with an offset (3,) and scales (2,) of thighs and shanks."""
    offset, scale = unknown[:3], unknown[3:]
    q = jnp.asarray(captured.rotations[:, 0])
    w, v = q[:, :1], q[:, 1:]
    carried = offset + 2 * jnp.cross(v, jnp.cross(v, offset[None]) + w * offset[None])
    offsets = jnp.asarray(wrong)
    for k, bones in enumerate(legs):
        offsets = offsets.at[np.array(bones)].set(wrong[bones] * scale[k])
    translations = jnp.asarray(captured.translations) + carried[:, None]
    return replace(captured, skeleton=replace(captured.skeleton, offsets=offsets), translations=translations)


def stances(motion):
    """(frames, feet) the number of the stance of each foot that each frame belongs to, -1 for none."""
    out = np.full((walk.frames, 2), -1)
    for i, foot in enumerate(("LeftFoot", "RightFoot")):
        found = detect(motion, [foot], still=(0.2, 2.0)).constraints.of(foot, "space")
        for k, c in enumerate(found):
            out[c.begin : c.end + 1, i] = k
    return out


def slides(unknown, stance):
    """(frames, feet, 3) metres from the mean place of the stance; 0 where there is none."""
    place = forward_kinematics(corrected(unknown))[1][:, np.array(feet)]
    member = jnp.asarray(stance[None] == np.arange(stance.max() + 1)[:, None, None], float)  # (stances, frames, feet)
    mean = jnp.einsum("sfi,fix->six", member, place) / jnp.maximum(member.sum(1), 1)[..., None]
    return jnp.einsum("sfi,fix->fix", member, place) - jnp.einsum("sfi,six->fix", member, mean)


def worst(unknown, stance):
    """Root mean square slide, metres."""
    d = slides(unknown, stance)
    return float(jnp.sqrt(jnp.sum(d**2) / int((stance >= 0).sum())))


# %% [markdown]
# Levenberg-Marquardt over the five unknowns, with derivatives through the kinematics; twice, since stances are found
# better on the mended motion.

# %%
start = jnp.array([0.0, 0, 0, 1, 1])
unknown, rounds = start, []
for _ in range(2):
    mended = jax.tree.map(np.asarray, corrected(unknown))
    stance = stances(mended)
    solver = optx.LevenbergMarquardt(rtol=1e-10, atol=1e-10)
    residuals = lambda x, _, stance=stance: slides(x, stance).ravel()  # noqa: E731
    unknown = optx.least_squares(residuals, solver, unknown, max_steps=100).value
    rounds.append((stance, unknown))
offset, scale = np.asarray(unknown[:3]), np.asarray(unknown[3:])
before, after = worst(start, stance), worst(unknown, stance)
print(f"offset {1e3 * offset} mm, true {1e3 * true_offset}: off by {1e3 * np.linalg.norm(offset - true_offset):.2f} mm")
print(f"thighs and shanks times {scale}, true {true_scale}")
print(f"slide {1e3 * before:.2f} mm, now {1e3 * after:.3f} mm: {before / after:.0f} times less")

# %%
figure, axes = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
for motion, label, color in ((captured, "captured", "tab:red"), (corrected(unknown), "corrected", "tab:green")):
    place = np.asarray(forward_kinematics(motion)[1])[:, feet[0]]
    axes[0].plot(time, 1e3 * (place[:, 1] - place[:, 1].min()), color=color, label=label)
axes[0].set(xlabel="time [s]", ylabel="height of the left ankle [mm]")
axes[0].legend()
for x, label, color in ((start, "captured", "tab:red"), (unknown, "corrected", "tab:green")):
    d = np.linalg.norm(np.asarray(slides(x, stance)), axis=-1)
    axes[1].plot(time, np.where(stance[:, 0] >= 0, 1e3 * d[:, 0], np.nan), color=color, label=label)
axes[1].set(xlabel="time [s]", ylabel="left foot, from its stance's mean [mm]")
axes[1].legend()
figure.suptitle("Feet that stand stay where they are")

# %%
assert np.linalg.norm(offset - true_offset) < 1e-3
assert before > 10 * after
