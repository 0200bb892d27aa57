"""What an annotation job is asked for, in Python or as a TOML file, and the hash that names it.

In: keyword arguments or a file. Out: a `Configuration`, immutable and small enough to travel with every task. Whatever
changes an annotation is in here; how many processes work on it, and for how long, is not.
"""

from __future__ import annotations

import hashlib
import re
import tomllib
from dataclasses import dataclass, field, fields
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, get_type_hints

import msgspec

from ..annotations import ConstraintType
from ..detect.settings import Settings
from ..errors import FileFormatError, OptionError
from ..formats.files import read_bytes

Scope = Literal["skeleton", "subject", "all"]
SUBJECT = r"^([^_]+)_\d+"
"""The subject of a clip by default: what stands before the number of the take, as in 02_01.bvh."""


@dataclass(frozen=True)
class TemplateRule:
    """An example constraint in one clip, for all clips of the same `skeleton`, of the same `subject`, or for `all`.

    clip: path of its file as a person gives it, absolute or from where the job runs, or the clip's name in the store.
    object: a joint's name, or a role such as left_foot: it holds for that role in clips with other names.
    begin, end: frames, 0-based, both included.
    """

    clip: str
    object: str
    begin: int
    end: int
    type: ConstraintType = "space"
    scope: Scope = "skeleton"


@dataclass(frozen=True)
class Configuration:
    """What to look for in a database, and how its files are read.

    objects: names, roles (`joint_names.roles`), groups (feet, hands, ...), patterns with *, or all. settings: of detection.
    templates: examples that are carried over; without one, thresholds follow from each clip's own noise. unit, up: as for
    `read_bvh`, for files that do not say. subject: a regular expression on the file's name whose first group is the subject;
    where it does not match, the folder's name is. clusters: marker clusters of C3D files, object to labels, instead of those
    that are known. include, exclude: patterns on paths below a folder.
    """

    objects: tuple[str, ...] = ("feet", "hands")
    settings: Settings = field(default_factory=Settings)
    templates: tuple[TemplateRule, ...] = ()
    unit: str | float = "auto"
    up: Literal["x", "y", "z"] | None = None
    subject: str = SUBJECT
    clusters: tuple[tuple[str, tuple[str, ...]], ...] = ()
    include: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if isinstance(self.objects, str) or not self.objects or not all(isinstance(o, str) and o for o in self.objects):
            raise OptionError(f"objects={self.objects!r}: give a tuple of names, roles or patterns")
        try:
            groups = re.compile(self.subject).groups
        except re.error as error:
            raise OptionError(f"subject={self.subject!r} is no regular expression: {error}") from None
        if not groups:
            raise OptionError(f"subject={self.subject!r} needs a group in parentheses: what it matches is the subject")

    def document(self) -> dict[str, Any]:
        """All of it as plain values, for the manifest."""
        return msgspec.to_builtins(self)

    def key(self) -> str:
        """A hash of what is asked for and of the code that answers."""
        text = msgspec.json.encode([self.document(), code_version()])
        return hashlib.sha256(text).hexdigest()[:20]

    def subject_of(self, name: str, folder: str) -> str:
        """The subject of a clip, by its file's name, or by its folder's."""
        match = re.search(self.subject, name)
        return (match.group(1) or "") if match else folder


@lru_cache(maxsize=1)
def code_version() -> str:
    """The version, and a hash of the sources that an annotation depends on."""
    from .. import __version__

    package = Path(__file__).resolve().parent.parent
    digest = hashlib.sha256()
    for folder in (".", "detect", "formats", "database"):
        for path in sorted((package / folder).glob("*.py")):
            digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return f"{__version__}+{digest.hexdigest()[:12]}"


def read_configuration(path: str | Path) -> Configuration:
    """A configuration from a TOML file (docs/annotation.md); unknown keys and wrong values are refused with their place."""
    try:
        text = read_bytes(path, limit=1 << 20).decode("utf-8")
        data = tomllib.loads(text)
    except UnicodeDecodeError as error:
        raise FileFormatError("the file is not UTF-8 text", path=path, remedy="save it as UTF-8") from error
    except tomllib.TOMLDecodeError as error:
        found = re.search(r"\(at line (\d+), column (\d+)\)", str(error))
        line, column = (int(found[1]), int(found[2])) if found else (None, None)
        plain = re.sub(r" \(at .*\)$", "", str(error))
        raise FileFormatError(plain, path=path, line=line, column=column, remedy="write it as TOML") from error
    values: dict[str, Any] = dict(data)
    names = {"template": "templates", **{f.name: f.name for f in fields(Configuration) if f.name != "templates"}}
    for key in values:
        if key not in names:
            raise FileFormatError(
                f"there is no key {key!r}",
                path=path,
                line=_line(text, key),
                remedy=f"known: {', '.join(sorted(names))}",
            )
    made: dict[str, Any] = {}
    hints = get_type_hints(Configuration)
    for key, value in values.items():
        try:
            if key == "settings":
                made[key] = _settings(value)
            elif key == "template":
                made["templates"] = tuple(_template(v) for v in msgspec.convert(value, list[dict[str, Any]]))
            elif key == "clusters":
                pairs = msgspec.convert(value, dict[str, tuple[str, ...]])
                made[key] = tuple(pairs.items())
            else:
                made[key] = msgspec.convert(value, hints[key])
        except (msgspec.ValidationError, OptionError) as error:
            raise FileFormatError(
                f"{key}: {error}", path=path, line=_line(text, key), remedy="see docs/annotation.md"
            ) from error
    try:
        return Configuration(**made)
    except OptionError as error:
        raise FileFormatError(str(error), path=path, remedy="see docs/annotation.md") from error


def _settings(value: Any) -> Settings:
    hints = get_type_hints(Settings)
    given = msgspec.convert(value, dict[str, Any])
    for name in given:
        if name not in hints:
            Settings().but(**{name: None})  # says which names are near
    return Settings().but(**{k: msgspec.convert(v, hints[k]) for k, v in given.items()})


def _template(value: dict[str, Any]) -> TemplateRule:
    renamed = {("scope" if k == "for" else k): v for k, v in value.items()}
    hints = get_type_hints(TemplateRule)
    unknown = [k for k in renamed if k not in hints]
    if unknown:
        raise OptionError(f"there is no key {unknown[0]!r}: known are clip, object, begin, end, type, for")
    missing = [k for k in ("clip", "object", "begin", "end") if k not in renamed]
    if missing:
        raise OptionError(f"a template needs {', '.join(missing)}")
    return TemplateRule(**{k: msgspec.convert(v, hints[k]) for k, v in renamed.items()})


def _line(text: str, key: str) -> int | None:
    """The line on which a key stands first."""
    pattern = re.compile(rf"\s*(?:\[+\s*)?[\"']?{re.escape(key)}[\"']?\s*(?:[=.\]])")
    return next((i for i, line in enumerate(text.splitlines(), 1) if pattern.match(line)), None)
