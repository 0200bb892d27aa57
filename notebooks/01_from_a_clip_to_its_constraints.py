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
# # From a clip to its constraints
#
# Le Callennec and Boulic 2006, step by step, each with its picture. The clip is a synthetic walk whose constraints are known,
# with 1 mm of marker noise on it; put `kinjax.load("your.bvh")` and a foot of yours in its place.

# %%
import numpy as np

from kinjax import Template, plots, synthetic
from kinjax.detect import calibrate, detect
from kinjax.kinematics import forward_kinematics

scene = synthetic.with_noise(synthetic.walking_biped(), sigma=0.001, seed=1)
walk = scene.poses  # world poses of both feet; a Motion does as well
print(f"{walk.frames} frames at {walk.rate:g} fps, objects: {', '.join(walk.names)}")

# %% [markdown]
# The body, and what is known to hold it: green constraints are active in the frame that is drawn.

# %%
plots.skeleton_3d(scene.motion, scene.truth)

# %% [markdown]
# ## 1 and 2. Discretize, and express the motion as displacements
#
# `D_i = W_i^-1 W_{i+1}` takes an object from one frame to the next, seen from the object itself (eq. 13). Why not in the world's
# coordinates? Because then a displacement depends on how far from the origin it happens (appendix A). Here is the residual of the
# same walk at its place and 17 m further on, in both formulations.

# %%
further = synthetic.with_noise(synthetic.walking_biped(), sigma=0.001, seed=1).poses
offset = np.array([17.0, 0.0, 0.0])
moved = type(further)(
    further.rotation, further.position + offset, further.valid, further.rate, further.names, further.clip, further.up
)
loose = {"method": "paper", "thresholds": (1.0, 1.0)}
eps = {
    (where, form): detect(poses, ["LeftFoot"], formulation=form, **loose).eps_3[:, 0]
    for where, poses in (("here", walk), ("there", moved))
    for form in ("local", "global")
}
times = np.arange(len(eps["here", "local"])) / walk.rate
plots.local_against_global(
    times, eps["here", "local"], eps["there", "local"], eps["here", "global"], eps["there", "global"], offset
)

# %% [markdown]
# ## 3. The sigma-epsilon space
#
# Each displacement becomes a point: `sigma_3`, how much it turns, and `eps_3`, how far the object's origin moves, if it is asked to
# be at rest; `sigma_1` and `eps_1` if it is asked to turn about an axis.
#
# ## 4. The noise pattern
#
# A person gives one example: this foot is planted here. The least median of squares finds the thresholds in it, and tells its
# outliers.

# %%
stance = max(scene.truth.of("LeftFoot", "space"), key=lambda c: c.frames)
template = Template("LeftFoot", stance.begin, stance.end)
patterns = calibrate(walk, [template], method="paper")
for p in patterns:
    print(f"sigma_max {p.sigma_max[0]:.2e}, eps_max {p.eps_max[0] * 1e3:.2f} mm from {p.kept} of {p.intervals} intervals: {p.status}")

# %% [markdown]
# ## 5 and 6. Instantaneous constraints, merged

# %%
paper = detect(walk, ["LeftFoot"], templates=[template], method="paper")
print(paper)

# %%
plots.sigma_epsilon(paper, "LeftFoot")

# %%
plots.noise_pattern(paper, "LeftFoot")

# %% [markdown]
# A second example refines the pattern: it then changes over time (section 6.2).

# %%
others = [c for c in scene.truth.of("LeftFoot", "space") if c.begin > stance.end or c.end < stance.begin]
refined = detect(
    walk, ["LeftFoot"], method="paper", templates=[template, Template("LeftFoot", others[0].begin, others[0].end)]
)
plots.noise_pattern(refined, "LeftFoot")

# %% [markdown]
# ## Without any example
#
# The robust method looks at 40 ms of motion at a time and needs no template. Asked for lines, it also finds the heel that the foot
# rolls over when it lands, and the toes over which it leaves.

# %%
robust = detect(walk, types=("space", "line", "point"))
print(robust)

# %%
plots.timeline(robust, truth=scene.truth)

# %%
plots.skeleton_3d(scene.motion, robust.constraints)

# %% [markdown]
# How well does it agree with the truth, frame by frame?

# %%
for name in walk.names:
    found, true = (c.mask(walk.frames, name, "space") for c in (robust.constraints, scene.truth))
    print(f"{name}: {np.mean(found == true):.1%} of the frames agree on rest")

# %% [markdown]
# ## Keep it
#
# `robust.save("walk.json")` writes the annotations; `.csv`, `.parquet` and `.npz` (a label for every frame) as well.

# %%
rotation, position = forward_kinematics(scene.motion)
assert rotation.shape[:2] == position.shape[:2] == (walk.frames, scene.motion.joints)
assert len(robust.constraints.of("LeftFoot", "space")) == len(scene.truth.of("LeftFoot", "space"))
