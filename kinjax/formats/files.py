"""Bytes in and out of disk: regular files only, read without blocking and written atomically.

In: a path. Out: its bytes, or a `FileFormatError` that says what the path is instead of a file; writers hand over the
bytes of the whole file. Errors of the machine (disk full, I/O error) stay `OSError`: no input caused them.
"""

from __future__ import annotations

import errno
import os
import secrets
import stat
from pathlib import Path

from ..errors import FileFormatError, OptionError

LIMIT = 4 << 30  # bytes; no motion or annotation file comes near it, a wrong path (a disk image) does

TEMPORARY = ".kinjax-*.tmp"
"""What a file is called until it is whole; one that is left over is of a process that was killed."""

_CANNOT_OPEN = {
    errno.ENOENT: ("there is no such file", "check the path"),
    errno.ENOTDIR: ("a part of the path is a file, not a folder", "check the path"),
    errno.ELOOP: ("the path is a loop of symbolic links", "give the file itself"),
    errno.EACCES: ("no permission to read the file", "change its permissions"),
    errno.EPERM: ("no permission to read the file", "change its permissions"),
    errno.ENAMETOOLONG: ("the file name is too long", "check the path"),
    errno.EINVAL: ("this is no possible file name", "check the path"),
    errno.ENXIO: ("this is no regular file", "give the path of a file"),
}
_KINDS = (
    (stat.S_ISDIR, "a folder", "give a file inside it"),
    (stat.S_ISFIFO, "a pipe", "save its content to a file first"),
    (stat.S_ISSOCK, "a socket", "give the path of a file"),
    (stat.S_ISCHR, "a device", "give the path of a file"),
    (stat.S_ISBLK, "a device", "give the path of a file"),
)


def _refuse_kind(path: object, mode: int) -> None:
    if stat.S_ISREG(mode):
        return
    for is_kind, name, remedy in _KINDS:
        if is_kind(mode):
            raise FileFormatError(f"this is {name}, not a file", path=path, remedy=remedy)
    raise FileFormatError("this is no regular file", path=path, remedy="give the path of a file")


def read_bytes(path: str | Path, limit: int = LIMIT) -> bytes:
    """All bytes of a regular file. `FileFormatError` if it is missing, no regular file (a pipe is not waited for), or too big."""
    try:
        _refuse_kind(path, os.stat(path).st_mode)
        # The path may have become a pipe since: opened without blocking, and looked at again through the descriptor.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except FileFormatError:
        raise
    except (ValueError, TypeError) as e:  # a NUL or a lone surrogate in the name; not a path at all
        raise FileFormatError("this is no possible file name", path=repr(path), remedy="check the path") from e
    except OSError as e:
        if e.errno not in _CANNOT_OPEN:
            raise
        found, remedy = _CANNOT_OPEN[e.errno]
        raise FileFormatError(found, path=path, remedy=remedy) from e
    with open(handle, "rb") as f:
        status = os.fstat(f.fileno())
        _refuse_kind(path, status.st_mode)
        if status.st_size > limit:
            remedy = "check that it is the file that you mean"
            raise FileFormatError(f"the file has more than {limit >> 20} MiB", path=path, remedy=remedy)
        return f.read()


def write_atomically(path: str | Path, data: bytes) -> Path:
    """Write a whole file, or nothing: a temporary file in the same folder, synced, then moved over `path`. Returns the path.

    Raises `OptionError` when the folder is missing or `path` is something other than a regular file.
    """
    target = Path(path)
    try:
        if not target.parent.is_dir():
            raise OptionError(f"{target}: there is no folder {str(target.parent)!r}; create it first")
        if target.exists() and not target.is_file():
            raise OptionError(f"{target}: this exists and is no regular file; choose another name")
    except ValueError as e:
        if isinstance(e, OptionError):
            raise
        raise OptionError(f"{str(path)!r} is no possible file name") from e
    temporary = target.parent / TEMPORARY.replace("*", secrets.token_hex(8))
    handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)
    try:
        with open(handle, "wb") as f:
            f.write(data)
            f.flush()
            os.fsync(f.fileno())
        os.replace(temporary, target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    return target


def clean_text(text: str) -> str:
    """`text` as it can be encoded in UTF-8: a lone surrogate (a file name in another encoding) becomes its escape."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")
