"""What a deformation gives back: the motion, and a report that says of every constraint and frame how well it holds.

In: arrays from the pipeline. Out: `Deformation`, `Report`. Residuals are those of the final motion, after filtering.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from ..motion import Motion

STATUSES = ("free", "converged", "stalled", "unreachable", "conflict", "max_iter", "nonfinite")
"""What became of a frame or a constraint; the numbers in reports are indices into this."""
FREE, CONVERGED, STALLED, UNREACHABLE, CONFLICT, MAX_ITER, NONFINITE = range(len(STATUSES))


@dataclass(frozen=True, eq=False)
class Report:
    """How well each of B constraints holds in each of F frames.

    titles: of the constraints; unit: "m" or "rad" of each one's residual. layer: (B,) 0 the most important, -1 unused
    (weight 0). residual: (F, B) distance or angle left, NaN where not active. status: (F, B) indices into `STATUSES`:
    "free" where not active. rank: (F, layers) freedoms that each layer took. iterations: (F,). joints: names, change: (F, J)
    radians by which each joint's rotation differs from the input; root_change: (F,) metres. passes: how often the clip was
    solved. notes: what is worth knowing, in words.
    """

    titles: tuple[str, ...]
    unit: tuple[str, ...]
    layer: tuple[int, ...]
    residual: Float[np.ndarray, "f b"]
    status: Int[np.ndarray, "f b"]
    rank: Int[np.ndarray, "f layers"]
    iterations: Int[np.ndarray, " f"]
    joints: tuple[str, ...]
    change: Float[np.ndarray, "f j"]
    root_change: Float[np.ndarray, " f"]
    passes: int = 1
    notes: tuple[str, ...] = ()

    @property
    def active(self) -> Bool[np.ndarray, "f b"]:
        """Where each constraint is active."""
        return self.status != FREE

    def frame_status(self) -> Int[np.ndarray, " f"]:
        """The worst status of each frame's constraints."""
        order = np.array(
            [0, 1, 4, 2, 3, 5, 6]
        )  # how bad: free, converged, max_iter, unreachable, conflict, stalled, nonfinite
        badness = np.array([0, 1, 5, 3, 4, 2, 6])
        if not self.status.shape[1]:
            return np.zeros(len(self.status), int)
        worst = badness[self.status].max(1)
        return np.array([int(np.flatnonzero(badness == b)[0]) for b in range(len(order))])[worst]

    def rows(self) -> list[dict[str, Any]]:
        """One row a constraint: name, layer, frames, largest and mean residual, the frame of the largest, worst status."""
        out = []
        for i, title in enumerate(self.titles):
            on = self.active[:, i]
            r = self.residual[:, i]
            seen = on & np.isfinite(r)
            at = int(np.nanargmax(np.where(seen, r, -1))) if seen.any() else None
            words = [STATUSES[s] for s in sorted(set(self.status[on, i].tolist()))]
            out.append(
                {
                    "constraint": title,
                    "layer": self.layer[i] + 1 if self.layer[i] >= 0 else None,
                    "frames": int(on.sum()),
                    "unit": self.unit[i],
                    "largest": float(r[at]) if at is not None else float("nan"),
                    "mean": float(r[seen].mean()) if seen.any() else float("nan"),
                    "frame": at,
                    "status": {w: int((self.status[on, i] == STATUSES.index(w)).sum()) for w in words},
                }
            )
        return out

    def largest_change(self) -> tuple[str, float, int]:
        """The joint that turned most, by how many radians, and in which frame."""
        if not self.change.size or not np.isfinite(self.change).any():
            return "", 0.0, 0
        frame, joint = np.unravel_index(np.nanargmax(self.change), self.change.shape)
        return self.joints[joint], float(self.change[frame, joint]), int(frame)

    def rms_change(self) -> float:
        """Root mean square change of all joints over all frames, radians."""
        return float(np.sqrt(np.nanmean(self.change**2))) if np.isfinite(self.change).any() else 0.0

    def __str__(self) -> str:
        head = f"{'constraint':<28} {'layer':>5} {'frames':>6} {'largest':>12} {'at frame':>8} {'mean':>12}  status"
        lines = [head]
        for row in self.rows():
            layer = "-" if row["layer"] is None else str(row["layer"])
            at = "-" if row["frame"] is None else str(row["frame"])
            status = ", ".join(f"{k} {v}" for k, v in row["status"].items()) or "not active"
            lines.append(
                f"{row['constraint']:<28} {layer:>5} {row['frames']:>6} {_amount(row['largest'], row['unit']):>12} {at:>8} "
                f"{_amount(row['mean'], row['unit']):>12}  {status}"
            )
        joint, angle, frame = self.largest_change()
        if joint:
            root = float(np.max(self.root_change, initial=0.0, where=np.isfinite(self.root_change)))
            lines.append(
                f"largest change: {joint} {np.degrees(angle):.1f} deg in frame {frame}; root {1e3 * root:.1f} mm; "
                f"all joints {np.degrees(self.rms_change()):.2f} deg RMS"
            )
        return "\n".join([*lines, *self.notes])


def _amount(value: float, unit: str) -> str:
    if not np.isfinite(value):
        return "-"
    return f"{1e3 * value:.4f} mm" if unit == "m" else f"{np.degrees(value):.4f} deg"


@dataclass(frozen=True, eq=False)
class Deformation:
    """The deformed `motion` and its `report`; `again` is what `redeform` starts from."""

    motion: Motion
    report: Report
    again: Any = field(default=None, repr=False)
