"""Files with their own SHA-256: a backup that was touched is refused."""

import json
from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path

from pmac_comp.base.atomic import atomic_write_bytes
from pmac_comp.base.errors import ConfigError, ControllerState, StorageFull, TableStateError
from pmac_comp.base.reading import why


def write_sealed_json(path: Path, data: Mapping[str, object]) -> None:
    """Write JSON with its SHA-256, read it again and compare.

    Raises
    ------
    StorageFull
        The file could not be stored; nothing was changed on the controller.
    TableStateError
        What was read is not what was written; nothing was changed on the controller.
    """
    body = json.dumps(dict(data), sort_keys=True)
    digest = sha256(body.encode()).hexdigest()
    content = json.dumps({"sha256": digest, "body": body}).encode("utf-8")
    try:
        atomic_write_bytes(path, content)
        stored = path.read_bytes()
    except OSError as error:
        raise StorageFull(
            f"The backup {path} cannot be written: {why(error)}.",
            code="PC-TXN-008",
            hint="Nothing is changed without a backup; free the disk or choose a folder.",
        ) from error
    if stored != content:
        raise TableStateError(
            f"The file {path} does not read back as written.",
            code="PC-TXN-004",
            hint="Nothing was sent. Check the disk, or name another folder with --journal.",
            left=ControllerState.OLD,
        )


def read_sealed_json(path: Path) -> dict[str, object]:
    """Content of a sealed file.

    Raises
    ------
    ConfigError
        Missing, unreadable or changed since it was written.
    """
    if not path.exists():
        raise ConfigError(
            f"There is no file {path}.",
            code="PC-TXN-017",
            hint="Give a file that `pmac-comp backup --out` wrote, or one of a journal folder.",
        )
    try:
        outer = json.loads(path.read_text(encoding="utf-8"))
        body = str(outer["body"])
        fits = sha256(body.encode()).hexdigest() == outer["sha256"]
        data = json.loads(body)
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise ConfigError(
            f"{path} is no readable backup.",
            code="PC-TXN-005",
            hint="Give a file that `pmac-comp backup --out` wrote, or one of a journal folder.",
        ) from error
    if not fits or not isinstance(data, dict):
        raise ConfigError(
            f"{path} was changed after it was written (digest mismatch).",
            code="PC-TXN-006",
            hint="Use another backup.",
        )
    return data
