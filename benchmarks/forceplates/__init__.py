"""Detection against force plates: the stances of walking trials, what is done to their markers, how labels are scored.

trials -> conditions -> methods -> scoring -> table, and comparison with the rules of thumb. `python -m benchmarks.forceplates
--data DIR` prints the table, with `--rules` the comparison; the tests use the same functions. A foot is the rigid cluster of
its heel, toe and ankle markers.
"""

from .comparison import compare, comparison, stance_labels
from .conditions import CONDITIONS, disturbed
from .methods import COMPARED, METHODS, PIVOTS, Label, labels_of, template_stance
from .scoring import Score, Total, flat_frames, score, total
from .table import evaluate, misses, report, totals
from .trials import FEET, MARKERS, Stance, Trial, load_trial, load_trials, poses_of, stances

__all__ = [
    "COMPARED",
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
    "compare",
    "comparison",
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
    "stance_labels",
    "stances",
    "template_stance",
    "total",
    "totals",
]
