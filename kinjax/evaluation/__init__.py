"""How well constraints that were found agree with labels: precision, recall, errors of begins and ends, by object and type.

In: tables of found constraints and of clips, labels, all in frames or seconds. Out: `Evaluation`. The door is `evaluate`; `rules` has
the usual rules of thumb to compare with. Files stop outside (`kinjax.formats.labels`); NumPy only, nothing is detected here.
"""

from .counting import Counts, against_bounds, against_frames
from .judging import evaluate
from .labels import Label, labels_of
from .results import Counting, Evaluation, LabelScore, Left
from .scores import Score, Spread
from .tables import from_annotations

__all__ = [
    "Counting",
    "Counts",
    "Evaluation",
    "Label",
    "LabelScore",
    "Left",
    "Score",
    "Spread",
    "against_bounds",
    "against_frames",
    "evaluate",
    "from_annotations",
    "labels_of",
]
