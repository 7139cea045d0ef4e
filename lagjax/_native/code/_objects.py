"""Compiled objects kept on disk, so that a second process need not compile them again.

The name of an object file is a digest of all it was made from: the text of its module, the processor, the passes and
the version of LLVM. It has no addresses of a process: functions of the C library are called by name. A file is written
under a temporary name and then renamed, so that any number of processes may read and write at once; a truncated or
damaged file does not match the digest in its first bytes, and is made anew. Where files cannot be read or written,
objects are not kept, and nothing fails.

They lie in the user's cache folder. The environment variable `LAGJAX_CACHE` names another folder; `off` keeps none. The
objects are executed, so a folder is used only if it belongs to the user and no other user may write to it; in any other
one, such as /tmp, a private subfolder is made, and if that fails nothing is kept and one warning is given. A file is
read only if it is a regular file of the user, and no link is followed.
"""

import contextlib
import functools
import hashlib
import os
import stat
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

# Bytes of all files, beyond which the ones that were not used for longest go until a quarter is free. A double pendulum
# takes 60 kB, a chain of 16 half a megabyte.
LARGEST_CACHE = 2**28
# Bytes that this process may write into a folder until it looks at all files there again: a sixteenth of the largest
# sum, since a look at 6400 files takes 25 ms, which each of them took when every new object looked. So the folder may
# exceed that sum by a sixteenth for every process that writes. A process looks at its first object.
_LEFT: dict[Path, int] = {}
_MAGIC = b"lagjax object 1\n"
_DIGEST = hashlib.sha256
# A link may lead to another file than the one that is looked at, and a named pipe waits for a writer for ever.
_NO_LINK = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)


def object_folder() -> Path | None:
    """The folder of kept objects; None if `LAGJAX_CACHE` turns that off."""
    chosen = os.environ.get("LAGJAX_CACHE", "")
    if chosen:
        return None if chosen.lower() in ("off", "0", "no", "false") else Path(chosen).expanduser()
    try:
        if sys.platform == "win32":
            base = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
        elif sys.platform == "darwin":
            base = Path.home() / "Library" / "Caches"
        else:
            base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:  # there is no home
        return None
    return base / "lagjax" / "objects"


def private_folder(place: Path) -> Path | None:
    """This folder (created if missing) if only the user may write to it, else a private subfolder, else None."""
    inside = place / f"lagjax-{os.geteuid() if hasattr(os, 'geteuid') else 'user'}"
    for candidate in (place, inside):
        with contextlib.suppress(OSError):
            candidate.mkdir(mode=0o700, parents=True, exist_ok=True)
            status = os.lstat(candidate)
            if stat.S_ISDIR(status.st_mode) and _is_private(status):
                return candidate
    _warn_once(place)
    return None


def _is_private(status: os.stat_result) -> bool:
    """True if a file or folder belongs to the user and no other user may write to it."""
    if not hasattr(os, "geteuid"):  # Windows, where the folder for caches is the user's
        return True
    return status.st_uid == os.geteuid() and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


@functools.cache
def _warn_once(place: Path) -> None:
    warnings.warn(
        f"Machine code is not kept: {place} is no folder that only you can write to. Set LAGJAX_CACHE to one of your "
        "own, or to 'off'.",
        stacklevel=2,
    )


def load_or_make(make: Callable[[], bytes], *made_from: str) -> bytes:
    """The object kept for the texts `made_from`, or, if there is none, `make()`, which is then kept."""
    chosen = object_folder()
    place = None if chosen is None else private_folder(chosen)
    if place is None:
        return make()
    digest = _DIGEST()
    for text in made_from:
        digest.update(len(text).to_bytes(8, "little") + text.encode())
    file = place / f"{digest.hexdigest()}.o"
    found = _read_object(file)
    if found is not None:
        return found
    made = make()
    with contextlib.suppress(OSError):
        _write_object(file, made)
        _LEFT[place] = _LEFT.get(place, 0) - len(made)
        if _LEFT[place] <= 0:
            _remove_oldest(place)
            _LEFT[place] = LARGEST_CACHE // 16
    return made


def _read_object(file: Path) -> bytes | None:
    """The bytes of an object file; None if it is missing, damaged, or not private to the user."""
    try:
        number = os.open(file, os.O_RDONLY | _NO_LINK)
        with os.fdopen(number, "rb") as opened:
            status = os.fstat(number)
            if not (stat.S_ISREG(status.st_mode) and _is_private(status)):
                return None
            content = opened.read()
    except OSError:
        return None
    begin = len(_MAGIC) + _DIGEST().digest_size
    body = content[begin:]
    if content[:begin] != _MAGIC + _DIGEST(body).digest():
        return None
    with contextlib.suppress(OSError):
        os.utime(file)  # it was used now
    return body


def _write_object(file: Path, body: bytes) -> None:
    number, name = tempfile.mkstemp(dir=file.parent, suffix=".part")
    try:
        with os.fdopen(number, "wb") as part:
            part.write(_MAGIC + _DIGEST(body).digest() + body)
        os.replace(name, file)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(name)
        raise


def _remove_oldest(place: Path) -> None:
    """Remove the least recently used files if the total size exceeds its limit."""
    files = []
    with os.scandir(place) as entries:
        for entry in entries:
            with contextlib.suppress(OSError):  # another process removed it
                status = entry.stat()
                files.append((status.st_mtime, status.st_size, entry.path))
    total = sum(size for _, size, _ in files)
    if total <= LARGEST_CACHE:
        return
    for _, size, file in sorted(files):
        if total <= 0.75 * LARGEST_CACHE:
            break
        with contextlib.suppress(OSError):
            os.unlink(file)
        total -= size
