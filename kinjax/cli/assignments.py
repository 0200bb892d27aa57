"""Options of the form NAME=VALUE, as --set and --solver take them.

In: texts. Out: values of the types that the settings have. Everything wrong here is one `OptionError` line.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Sequence
from typing import Any, get_type_hints

import msgspec

from ..detect.settings import Settings
from ..errors import OptionError


def changed_settings(given: Sequence[str]) -> dict[str, Any]:
    """The settings that `--set NAME=VALUE` changes."""

    def unknown(name: str) -> None:
        Settings().but(**{name: None})  # says which names are near

    return assignments("--set", given, Settings, _literal, unknown)


def assignments(
    option: str,
    given: Sequence[str],
    settings: type,
    meant: Callable[[str, str], Any],
    unknown: Callable[[str], object],
) -> dict[str, Any]:
    """What the texts NAME=VALUE of an option assign, checked against the types of the fields of `settings`.

    meant: the value of a name and its text, before it is converted to the field's type. unknown: raises for a name that is none.
    """
    kinds = get_type_hints(settings)
    changes: dict[str, Any] = {}
    for text in given:
        name, equals, value = text.partition("=")
        name = name.strip().replace("-", "_")
        if not equals:
            raise OptionError(f"{option} {text!r}: write NAME=VALUE")
        if name not in kinds:
            unknown(name)
        try:
            changes[name] = msgspec.convert(meant(name, value), kinds[name], strict=False)
        except msgspec.ValidationError as error:
            raise OptionError(f"{option} {text}: {str(error)[:1].lower()}{str(error)[1:]}") from None
    return changes


def _literal(name: str, text: str) -> Any:
    """The value of a setting of detection: a Python literal, words with commas between them, or one word."""
    try:
        value = ast.literal_eval(text.strip())
    except (ValueError, SyntaxError):
        value = tuple(part.strip() for part in text.split(",")) if "," in text or name == "types" else text.strip()
    return (value,) if name == "types" and isinstance(value, str) else value
