"""Where files lie: bundled bench and firmware files, in a checkout or a wheel, and the journal."""

import os
import sys
import tempfile
from pathlib import Path
from typing import Final

from pmac_comp.base.errors import ConfigError

DEFAULT_JOURNAL: Final = Path("pmac-comp-journal")  # of uploads, below the present folder
_LOCKS: Final = "locks"
_PACKAGE = Path(__file__).resolve().parent.parent


def data_folder(name: str) -> Path:
    """Folder ``configs`` or ``firmware_plc``.

    Raises
    ------
    ConfigError
        The installation lacks the folder.
    """
    for folder in (_PACKAGE / "_data" / name, _PACKAGE.parent / name):
        if folder.is_dir():
            return folder
    raise ConfigError(
        f"The folder {name} is missing from this installation.",
        code="PC-CFG-001",
        hint="Install pmac-comp again from a wheel or a full checkout.",
    )


def locks_folder() -> Path:
    """Folder of this user, whatever the present one, for locks that all commands of a host share.

    ``$XDG_STATE_HOME/pmac-comp/locks``, below ``~/.local/state`` where that is not set; on Windows
    below ``%LOCALAPPDATA%``. An account without a home that it may write to has it below the folder
    for temporary files.
    """
    if sys.platform == "win32":
        root = os.environ.get("LOCALAPPDATA") or str(Path.home() / "AppData" / "Local")
        return Path(root) / "pmac-comp" / _LOCKS
    if root := os.environ.get("XDG_STATE_HOME"):
        return Path(root) / "pmac-comp" / _LOCKS
    folder = Path(os.environ.get("HOME", "")) / ".local" / "state" / "pmac-comp" / _LOCKS
    there = next((p for p in folder.parents if p.exists()), None)
    if folder.is_absolute() and there is not None and os.access(there, os.W_OK):
        return folder
    return Path(tempfile.gettempdir()) / f"pmac-comp-{os.getuid()}" / _LOCKS


def firmware_path(name: str) -> Path:
    """Path of a bundled firmware file such as ``comp_guard.plc``."""
    return data_folder("firmware_plc") / name
