"""What a file holds, told by its contents: only as much as says whether it may be replaced.

What lives here: the kinds of files that no command brings back as they are. What may not: reading
them (``capture``, ``model_file``, ``bench`` and those of the upper layers).
"""

import json
import re
from codecs import BOM_UTF8
from pathlib import Path
from typing import Any, Final

from pmac_comp.files.capture import holds_runs
from pmac_comp.files.sidecar import is_sidecar

COMPENSATION: Final = "compensation"
MODEL: Final = "model"
_BENCH: Final = re.compile(rb"^\s*config_version\s*=", re.M)


def kind_to_keep(path: Path) -> str:
    """Kind of a file that others build on, in words; empty for results that can be made again.

    Raises
    ------
    OSError
        The file cannot be read.
    """
    if not path.is_file():
        return ""
    if holds_runs(path):
        return "capture"
    content = path.read_bytes().removeprefix(BOM_UTF8).lstrip()
    if content.startswith(b"{"):
        return _kind_of_json(content)
    # The page of a report may quote a bench file.
    is_bench = not content.startswith(b"<") and _BENCH.search(content) is not None
    return "bench file" if is_bench else ""


def _kind_of_json(content: bytes) -> str:
    try:
        data: Any = json.loads(content)
    except ValueError:
        return ""
    if "compensation_version" in data:
        return COMPENSATION
    if "model_version" in data and "kind" not in data:  # a result of `identify` has one
        return MODEL
    if is_sidecar(data):
        return "file of attributes of a capture"
    return "backup" if data.keys() == {"sha256", "body"} else ""
