"""Files that are either the old one or the new one, whatever happens in between."""

import os
import secrets
from pathlib import Path
from typing import Final

BINARY: Final[int] = getattr(os, "O_BINARY", 0)
"""Flag without which Windows ends lines its own way in what is written through a descriptor."""


def atomic_write_bytes(path: Path, data: bytes) -> None:
    """Write a file so that a crash leaves the old content or the new content whole.

    Parameters
    ----------
    path : Path
        Target; its folder must exist.
    data : bytes
        New content.

    Raises
    ------
    OSError
        From the file system; the old file is then untouched.
    """
    temporary = path.parent / f".{path.name}.{secrets.token_hex(4)}"
    # Never a file that is there already. Who may read it is for the user's umask to say: a model or
    # report on a bench's computer is for everybody who works there.
    handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | BINARY, 0o666)
    try:
        try:
            rest = memoryview(data)
            while rest:
                rest = rest[os.write(handle, rest) :]
            os.fsync(handle)
        finally:
            os.close(handle)
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def atomic_write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file as ``atomic_write_bytes`` does."""
    atomic_write_bytes(path, text.encode("utf-8"))


def sync_folder(folder: Path) -> None:
    """Make a rename durable; systems that cannot open a folder skip it."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
