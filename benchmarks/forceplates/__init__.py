"""Detection against force plates: the stances of walking trials, what is done to their markers, how labels are scored.

trials -> conditions -> methods -> scoring -> table. `python -m benchmarks.forceplates --data DIR` prints the table; the
tests use the same functions. A foot is the rigid cluster of its heel, toe and ankle markers.
"""

from .conditions import CONDITIONS, disturbed
from .methods import METHODS, PIVOTS, Label, labels_of, template_stance
from .scoring import Score, Total, flat_frames, score, total
from .table import evaluate, misses, report, totals
from .trials import FEET, MARKERS, Stance, Trial, load_trial, load_trials, poses_of, stances

__all__ = [
    "CONDITIONS",
    "FEET",
    "MARKERS",
    "METHODS",
    "PIVOTS",
    "Label",
    "Score",
    "Stance",
    "Total",
    "Trial",
    "disturbed",
    "evaluate",
    "flat_frames",
    "labels_of",
    "load_trial",
    "load_trials",
    "misses",
    "poses_of",
    "report",
    "score",
    "stances",
    "template_stance",
    "total",
    "totals",
]
