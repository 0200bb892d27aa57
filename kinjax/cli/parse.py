"""argv into a command; what the parser refuses becomes one line.

In: argv. Out: a command of `options`. As there, nothing heavy is imported.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tyro import cli
from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes

from .. import __version__
from ..errors import OptionError
from .options import NAMES, Command, Demo

DESCRIPTION = """Find the kinematic constraints in motion data (planted feet, gripping hands, hinges), and bend motion to constraints.

Without a command, `kinjax` runs the demo. `kinjax COMMAND --help` tells more."""


def parse(args: Sequence[str]) -> Any:
    """The command that argv asks for, the demo when it is empty; `OptionError` in one line where it makes no sense."""
    if not args:
        return Demo()
    if args[0] in ("--version", "-V"):
        print(f"kinjax {__version__}")
        raise SystemExit(0)
    if not args[0].startswith("-") and args[0] not in NAMES:
        hint = f"; to detect constraints: kinjax detect {args[0]}" if Path(args[0]).exists() else ""
        raise OptionError(f"no command {args[0]!r}: choose from {', '.join(NAMES)}{hint}")
    told = io.StringIO()
    try:
        with contextlib.redirect_stderr(told):
            return _tyro(args)
    except SystemExit as stop:
        if stop.code in (0, None):
            sys.stderr.write(told.getvalue())
            raise
    where = f"kinjax {args[0]}" if args[0] in NAMES else "kinjax"
    raise OptionError(f"{_complaint(args)} (see {where} --help)")


def _tyro(args: Sequence[str]) -> Any:
    return cli(
        Command,
        prog="kinjax",
        description=DESCRIPTION,
        args=list(args),
        default=Demo(),
        config=(FlagCreatePairsOff, OmitArgPrefixes),
    )


def _complaint(args: Sequence[str]) -> str:
    """The parser's message on arguments that it refuses, in one line: without its frame, title and advice.

    It is asked again with room for long lines. What it says is a title, the message, a rule, and perhaps suggestions, of
    which the first option is kept.
    """
    told, width = io.StringIO(), os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "2000"
    try:
        with contextlib.redirect_stderr(told), contextlib.suppress(SystemExit):
            _tyro(args)
    finally:
        os.environ.pop("COLUMNS")
        if width is not None:
            os.environ["COLUMNS"] = width
    lines = [line.strip(" │|") for line in told.getvalue().splitlines()]
    lines = [line for line in lines if line]
    lines = lines[1:] if lines[0][0] in "╭+" else lines[2:]  # the title is in the frame, or has a rule below
    said: list[str] = []
    near, body = "", True
    for line in lines:
        rule = not line.strip("─-╰╯+")
        body = body and not rule and not line.startswith("Got errors")
        if body:
            said.append(line)
        elif near == "?" and line.startswith("-") and not rule:
            near = line.split()[0].rstrip(",")
        elif line.startswith(("Perhaps you meant", "Arguments similar")):
            near = near or "?"
    text = " ".join(" ".join(said).split()).split(" Arguments are applied")[0].replace("{None}|", "")
    text = re.sub(r" \(applied to [^)]*\)", "", text).rstrip(".") or "bad arguments"
    return text[0].lower() + text[1:] + (f"; perhaps {near}" if near.startswith("-") else "")
