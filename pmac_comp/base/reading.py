"""Why a file could not be read or written, in words instead of the system's.

What lives here: one sentence part for each way in which a path can be wrong. What may not: what the
file was meant for and what to do; whoever asked for it knows.
"""

import errno
import json
from typing import Final

_WORDS: Final = {
    errno.ENOENT: "there is no such file or folder",
    errno.EISDIR: "it is a folder, not a file",
    errno.ENOTDIR: "a part of its path is a file, not a folder",
    errno.EACCES: "Permission denied for this user",
    errno.EPERM: "Permission denied for this user",
    errno.ENOSPC: "No space left on the disk",
    errno.EDQUOT: "this user's share of the disk is full",
    errno.EROFS: "it lies on a disk that can only be read",
    errno.ENAMETOOLONG: "its name is too long",
    errno.ELOOP: "its links lead in a circle",
    errno.EFBIG: "it is too large",
    errno.EIO: "the disk reports a fault",
    errno.EEXIST: "there is something of that name already",
    errno.EADDRINUSE: "another program listens there already",
}


def why(error: Exception) -> str:
    """What is wrong with a file, to be put behind a colon: ``there is no such file or folder``."""
    if isinstance(error, UnicodeDecodeError):
        return "it is not a text file in UTF-8"
    if isinstance(error, json.JSONDecodeError):
        if not error.doc.strip():
            return "it is empty"
        return f"it is no JSON (line {error.lineno}, column {error.colno})"
    if isinstance(error, OSError):
        if error.errno in _WORDS:
            return _WORDS[error.errno]
        return error.strerror or str(error)
    return str(error)
