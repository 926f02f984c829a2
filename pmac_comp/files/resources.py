"""Where files lie: bundled bench and firmware files, in a checkout or a wheel, and the journal."""

import os
import sys
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
    below ``%LOCALAPPDATA%``.
    """
    if sys.platform == "win32":
        root = os.environ.get("LOCALAPPDATA") or str(Path.home() / "AppData" / "Local")
    else:
        root = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    return Path(root) / "pmac-comp" / _LOCKS


def firmware_path(name: str) -> Path:
    """Path of a bundled firmware file such as ``comp_guard.plc``."""
    return data_folder("firmware_plc") / name
