"""The command line, `kinjax`: `main` parses, runs one command, and turns every error of input into one line.

In: argv. Out: an exit code; 0 done, 1 some of several clips failed (the others are done), 2 bad input. Importing this
loads nothing but the standard library, and `kinjax --help` loads neither JAX nor NumPy nor a library of pictures or
tables: the commands import what they need when they run.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Sequence

from ..errors import KinjaxError

__all__ = ["main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run `kinjax ARGV...` and give the exit code."""
    args = list(sys.argv[1:] if argv is None else argv)
    _tolerate_any_encoding()
    try:
        from .parse import parse

        return parse(args).run()
    except KinjaxError as error:
        return fail(error)
    except BrokenPipeError:
        _drop_stdout()
        return 0
    except OSError as error:
        return fail(f"{error.filename}: {error.strerror}" if error.filename is not None and error.strerror else error)
    except KeyboardInterrupt:
        fail("interrupted")
        return 130
    finally:
        _flush()


def fail(error: object) -> int:
    """One line on stderr; gives exit code 2."""
    print("kinjax: error:", " ".join(str(error).split()), file=sys.stderr)
    return 2


def _tolerate_any_encoding() -> None:
    """Joint names may hold any character; a terminal that cannot show one shows an escape instead of failing."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def _flush() -> None:
    """Flush stdout while a closed pipe can still be dealt with."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        _drop_stdout()


def _drop_stdout() -> None:
    """The reader of a pipe has gone: what is still printed goes nowhere, quietly."""
    with contextlib.suppress(OSError, ValueError):  # a stdout without a descriptor, as under a test
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
