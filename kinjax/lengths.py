"""Lengths that arrays are padded to, so that few programs serve clips of every length.

In: a number of frames. Out: a length. Nothing is imported here: what only sorts clips by length needs no engine.
"""

BLOCK = 32
"""Running sums work in blocks of so many; padded lengths are multiples of it (XLA pads slowly)."""


def bucket(n: int, smallest: int = 64) -> int:
    """The next array length from 64, 96, 128, 160, 192, 224, 256, 320, ...: from 128 on four sizes an octave, so at most a
    fifth of a long clip is padding. All are multiples of `BLOCK`."""
    size = smallest
    while size * 2 <= n:
        size *= 2
    step = max(BLOCK, size // 4)
    return size + step * max(0, -(-(n - size) // step))


def octave(n: int, smallest: int = 128) -> int:
    """The next array length from 128, 256, 512, ...: a third of the compilations that `bucket` asks for, and more padding. For
    databases, where a program has to be compiled for every length that occurs, in every process."""
    return max(smallest, 1 << (n - 1).bit_length())
