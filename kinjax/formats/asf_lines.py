"""The frames of an AMC file, one line after the other: slow, and exact about what is wrong.

In: the text of the file from the first frame on. Out: the numbers of every frame, in the order of the nodes, whatever the
order of the bones in each frame; or a `FileFormatError` with line, column, what was found and the remedy.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from typing import NoReturn

import numpy as np

from .asf import Node
from .asf_text import MOST_WORDS, Word, is_number, lines_of, number
from .bvh_header import fail, shown


def read_lines(
    text: bytes, begin: int, nodes: Sequence[Node], path: object, skeleton: str
) -> tuple[np.ndarray, list[int], int]:
    """Values (frames, numbers), the column of each node's first number, and the first frame's number.

    Refused: a frame that does not follow the one before, a bone that is unknown, twice or missing in a frame, or has another
    number of values than its degrees of freedom.
    """
    return _Lines(text, nodes, path, skeleton).read(begin)


class _Lines:
    def __init__(self, text: bytes, nodes: Sequence[Node], path: object, skeleton: str):
        self.text, self.nodes, self.path, self.skeleton = text, nodes, path, skeleton
        self.index = {node.key: j for j, node in enumerate(nodes)}
        self.columns = np.cumsum([0, *(len(node.dof) for node in nodes)]).tolist()
        self.needed = {j for j, node in enumerate(nodes) if node.dof}

    def fail(self, at: int, found: str, remedy: str) -> NoReturn:
        fail(self.text, at, self.path, found, remedy)

    def read(self, begin: int) -> tuple[np.ndarray, list[int], int]:
        rows: list[np.ndarray] = []
        first = frame = -1
        seen: set[int] = set()
        row = np.zeros(0)
        for words in lines_of(self.text, begin, MOST_WORDS):
            head = words[0].group()
            if head.isdigit() and len(words) == 1:
                if frame >= 0:
                    self.complete(seen, frame, words[0].start(), end=False)
                frame = self.frame(words[0], frame)
                first = frame if first < 0 else first
                seen, row = set(), np.empty(self.columns[-1])
                rows.append(row)
                continue
            j = self.node(words)
            if j in seen:
                remedy = "keep one of the lines; or a frame's number is missing before this one"
                self.fail(words[0].start(), f"{shown(head)} stands twice in frame {frame}", remedy)
            seen.add(j)
            column = self.columns[j]
            row[column : column + len(words) - 1] = [number(self.text, w, "a number", self.path) for w in words[1:]]
        self.complete(seen, frame, len(self.text), end=True)
        return np.array(rows), self.columns[:-1], first

    def frame(self, word: Word, before: int) -> int:
        digits = word.group()
        if len(digits) > 15:
            self.fail(word.start(), f"found {shown(digits)} as a frame's number", "number the frames from 1")
        if before >= 0 and int(digits) != before + 1:
            found = f"frame {int(digits)} comes after frame {before}"
            self.fail(
                word.start(),
                found,
                "frames are missing or were moved: get a complete copy, or number them one after the other",
            )
        return int(digits)

    def node(self, words: list[Word]) -> int:
        """The node of a line with as many values as it should have."""
        head = words[0].group()
        j = self.index.get(head, -1)
        if j < 0:
            if is_number(head):
                remedy = "a bone's name and its numbers stand on one line, a frame's number alone on one"
                self.fail(words[0].start(), f"found the number {shown(head)} where a bone's name should stand", remedy)
            near = difflib.get_close_matches(shown(head)[1:-1], [n.key.decode("latin-1") for n in self.nodes], n=3)
            remedy = "check that the skeleton belongs to this motion"
            remedy = f"nearest: {', '.join(near)}; {remedy}" if near else remedy
            self.fail(words[0].start(), f"{self.skeleton} has no bone {shown(head)}", remedy)
        dof = self.nodes[j].dof
        if len(words) != len(dof) + 1:
            for word in words[1:]:  # a missing space, for one, is a wrong number first
                number(self.text, word, "a number", self.path)
            at = words[len(dof) + 1].start() if len(words) > len(dof) + 1 else words[-1].end()
            has = f"{len(dof)}: {' '.join(dof)}" if dof else "none"
            count = f"{len(words) - 1}{' or more' if len(words) == MOST_WORDS else ''}"
            found = f"{shown(head)} has {count} numbers here; its degrees of freedom in {self.skeleton} are {has}"
            self.fail(at, found, "correct the line; or the file is cut short, or the skeleton is another one's")
        return j

    def complete(self, seen: set[int], frame: int, at: int, end: bool) -> None:
        missing = [self.nodes[j].key for j in sorted(self.needed - seen)]
        if not missing:
            return
        names = ", ".join(map(shown, missing[:4])) + (f" and {len(missing) - 4} more" if len(missing) > 4 else "")
        remedy = (
            "the file is cut short: get a complete copy, or delete its last frame"
            if end
            else "each frame gives every bone"
        )
        self.fail(at, f"{'the file ends inside' if end else 'here ends'} frame {frame} without {names}", remedy)
