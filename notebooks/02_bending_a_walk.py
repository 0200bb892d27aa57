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
# # Bending a walk
#
# Le Callennec and Boulic 2004, figure 3, step by step: somebody walks by and takes something beside the path. The walk is
# synthetic; put `kinjax.load("your.bvh")` and the names of your joints in its place.

# %%
import numpy as np

from kinjax import plots, synthetic
from kinjax.deform import CenterOfMass, Position, deform, redeform
from kinjax.kinematics import forward_kinematics
from kinjax.motion import resample

walk = resample(synthetic.walking_biped(steps=4).motion, 24.0)  # the paper's motions have 24 frames a second
names = walk.skeleton.names
print(f"{walk.frames} frames at {walk.rate:g} fps; joints: {', '.join(names)}")

# %% [markdown]
# Where is the left hand when the walk is half over, and where shall it go? Half a metre to the left and a little up, which is
# further than the arm reaches.

# %%
middle = walk.frames // 2
hand = np.asarray(forward_kinematics(walk)[1])[middle, names.index("LeftHand")]
goal = hand + np.array([0.42, 0.12, 0.1])
print("from", hand.round(2), "to", goal.round(2))

# %% [markdown]
# ## 1. Only the hand
#
# A constraint is a wish with a time: hold the hand there for 6 frames, half a second to get there and half a second back. It
# recruits every joint from the forearm up to the root, so the whole body goes along, and takes its feet with it.

# %%
span = {"begin": middle - 3, "end": middle + 2, "ease_in": 0.5, "ease_out": 0.5}
reach = Position("LeftHand", at=goal, priority=2, name="hand to its goal", **span)
alone = deform(walk, [reach])
print(alone.report)

# %%
feet = ["LeftFoot", "LeftToeBase", "RightFoot", "RightToeBase"]
before, after = (np.asarray(forward_kinematics(m)[1])[:, [names.index(f) for f in feet]] for m in (walk, alone.motion))
print(f"the feet slide by up to {100 * np.linalg.norm(after - before, axis=-1).max():.0f} cm")

# %% [markdown]
# ## 2. Feet first
#
# Ankles and toes keep their trajectories. They come first: a higher priority is not a bigger weight, the hand gets what the feet
# leave to it.

# %%
planted = [Position(f, priority=3, name=f"{f} as it was") for f in feet]
stepping = deform(walk, [*planted, reach])
print(stepping.report)

# %% [markdown]
# ## 3. In balance
#
# The hips follow the hand as far as the legs let them: nobody stands like that. The centre of mass keeps its trajectory, as far as
# feet and hand leave it free to do so.

# %%
balance = CenterOfMass(priority=1, name="centre of mass as it was")
balanced = deform(walk, [*planted, reach, balance])
print(balanced.report)

# %%
plots.residuals_over_time(balanced)

# %% [markdown]
# ## 4. Another goal
#
# An edit of one constraint solves only the frames that it can reach again.

# %%
higher = Position("LeftHand", at=goal + np.array([0, 0.1, 0]), priority=2, name="hand to its goal", **span)
edited = redeform(balanced, walk, [*planted, higher, balance])

# %% [markdown]
# ## What came out
#
# In the middle of the reach, from left to right: in balance, then with the feet alone, then nothing but the hand, then the walk.

# %%
plots.side_by_side(
    {"balanced": balanced.motion, "feet and hand": stepping.motion, "hand alone": alone.motion, "walk": walk},
    middle,
    goals=[goal],
    trail=["LeftHand"],
    reference="walk",
)

# %% [markdown]
# Does it hold? The report's residuals are measured on the motion that came out.

# %%
held = slice(span["begin"], span["end"] + 1)
for result in (balanced, edited):
    titles = result.report.titles
    assert np.nanmax(result.report.residual[:, :4]) < 1e-3  # the feet, metres
    assert result.report.residual[held, titles.index("hand to its goal")].max() < 1e-3
