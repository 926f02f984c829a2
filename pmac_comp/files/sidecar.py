"""What a CSV capture cannot hold beside its columns: attributes in a JSON file next to it.

What lives here: that file, ``RUN.csv.attributes.json``, bound to the CSV by its digest. Programs
that read CSV want the header in the first line and nothing but numbers below, so that attributes
have no place in it. What may not: what they mean. Imports ``base`` only.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from pmac_comp.base.atomic import atomic_write_text
from pmac_comp.base.errors import CaptureError

Attribute = str | float | int
_SUFFIX: Final = ".attributes.json"
_KEYS: Final = {"about", "sha256", "attributes"}


def sidecar_of(path: Path) -> Path:
    """File that holds the attributes of a CSV capture."""
    return path.with_name(path.name + _SUFFIX)


def write_attributes(path: Path, content: str, attributes: Mapping[str, Attribute]) -> None:
    """Attributes of a CSV capture that is about to be written with ``content``.

    OSError leaves an earlier pair of files as it was, or its attributes without a file they are of.

    Raises
    ------
    CaptureError
        A file of that name is none of ours.
    """
    if sidecar_of(path).exists() and not is_sidecar(_read(sidecar_of(path))):
        raise CaptureError(
            f"There is a file {sidecar_of(path)} that holds no attributes of a capture; what is "
            "known of this one would be written over it.",
            code="PC-CAP-020",
            hint="Name another file for the result, or move that one. Nothing was written.",
        )
    kept = {
        "about": f"attributes of {path.name}, as long as its SHA-256 is this",
        "sha256": hashlib.sha256(content.encode("utf-8")).hexdigest(),
        "attributes": dict(attributes),
    }
    atomic_write_text(sidecar_of(path), json.dumps(kept, indent=1, ensure_ascii=False) + "\n")


def is_sidecar(data: Any) -> bool:
    """Whether what a JSON file holds are the attributes of a CSV capture."""
    return isinstance(data, dict) and data.keys() == _KEYS


def _read(path: Path) -> Any:
    """What a JSON file holds; None where it is none or cannot be read."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def read_attributes(path: Path) -> dict[str, Attribute]:
    """Attributes of a CSV capture; none where they are of another content, or cannot be read."""
    kept = _read(sidecar_of(path))
    if not is_sidecar(kept) or not isinstance(kept["attributes"], dict):
        return {}
    with path.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    found = kept["attributes"] if kept["sha256"] == digest else {}
    return {k: v for k, v in found.items() if isinstance(v, str | int | float)}
