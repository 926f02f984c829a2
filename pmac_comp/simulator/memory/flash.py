"""Flash image of the card: what SAVE keeps and power-up brings back.

The image is a NumPy archive behind a header with its SHA-256; an image that does not match its sum
reverts the card to factory values with the status bits of a flash error.
Source: Turbo PMAC Software Reference Manual p. 273, 394.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pmac_comp.base.atomic import atomic_write_bytes
from pmac_comp.base.errors import ConfigError
from pmac_comp.base.reading import why

_MAGIC = b"TURBO PMAC FLASH 1\n"
_SUM_BYTES = 64


class FlashDamaged(Exception):
    """The image does not match its checksum or cannot be read."""


@dataclass
class Image:
    """Saved state.

    Parameters
    ----------
    variables : dict of int to float
        I-variables.
    cells : dict of int to ndarray of int32, shape (2, n)
        X and Y words of saved address ranges by first address.
    programs, plcs : dict of int to str
        Program text, one statement group per line.
    axes : list of (int, int, str)
        Coordinate system, motor, definition.
    password : str
        Password of protected programs.
    """

    variables: dict[int, float]
    cells: dict[int, NDArray[np.int32]]
    programs: dict[int, str] = field(default_factory=dict)
    plcs: dict[int, str] = field(default_factory=dict)
    axes: list[tuple[int, int, str]] = field(default_factory=list)
    password: str = ""

    def encode(self) -> bytes:
        """Bytes of the image with its checksum."""
        text = json.dumps(
            {
                "variables": {str(k): v for k, v in self.variables.items()},
                "programs": {str(k): v for k, v in self.programs.items()},
                "plcs": {str(k): v for k, v in self.plcs.items()},
                "axes": self.axes,
                "password": self.password,
            }
        )
        arrays = {f"cells_{start}": words for start, words in self.cells.items()}
        stream = io.BytesIO()
        np.savez_compressed(
            stream,
            text=np.frombuffer(text.encode(), dtype=np.uint8),
            **arrays,  # type: ignore[arg-type]
        )
        body = stream.getvalue()
        return _MAGIC + hashlib.sha256(body).hexdigest().encode() + body

    @classmethod
    def decode(cls, data: bytes) -> Image:
        """Image of bytes; FlashDamaged if they are not one."""
        head = len(_MAGIC) + _SUM_BYTES
        body = data[head:]
        if data[: len(_MAGIC)] != _MAGIC:
            raise FlashDamaged("not a flash image")
        if hashlib.sha256(body).hexdigest().encode() != data[len(_MAGIC) : head]:
            raise FlashDamaged("checksum does not match")
        try:
            with np.load(io.BytesIO(body), allow_pickle=False) as archive:
                stored = json.loads(archive["text"].tobytes())
                cells = {
                    int(name.split("_")[1]): archive[name]
                    for name in archive.files
                    if name.startswith("cells_")
                }
        except (ValueError, KeyError, zipfile.BadZipFile) as error:
            raise FlashDamaged(str(error)) from error
        return cls(
            {int(k): float(v) for k, v in stored["variables"].items()},
            cells,
            {int(k): v for k, v in stored["programs"].items()},
            {int(k): v for k, v in stored["plcs"].items()},
            [(int(cs), int(motor), str(text)) for cs, motor, text in stored["axes"]],
            str(stored["password"]),
        )


def check_image(path: Path) -> None:
    """Refuse a path that SAVE must not write over or cannot write to; a damaged image is none.

    Raises
    ------
    ConfigError
        A folder, a file of another kind, or no folder that SAVE could write it into.
    """
    try:
        with path.open("rb") as stream:
            wrong = "" if stream.read(len(_MAGIC)) in {_MAGIC, b""} else "it holds something else"
    except FileNotFoundError:
        wrong = "" if path.parent.is_dir() else f"there is no folder {path.parent}"
    except OSError as error:
        wrong = why(error)
    # SAVE puts a new file in the place of the old one: that takes the right to write the folder.
    if not wrong and not os.access(path.parent, os.W_OK | os.X_OK):
        wrong = f"this user may not write into the folder {path.parent}"
    if wrong:
        raise ConfigError(
            f"{path} cannot be the flash image: {wrong}.",
            code="PC-SIM-006",
            hint="Name with --flash a new file in a folder that you may write to, or one that a "
            "simulated card has saved; SAVE writes it.",
        )


class Flash:
    """Where the image is kept: a file, or this process.

    Parameters
    ----------
    path : Path or None
        File of the image; None keeps it in memory.
    """

    def __init__(self, path: Path | None = None) -> None:
        self.path = path
        self._data: bytes | None = None
        if path is not None and path.exists():
            self._data = path.read_bytes()

    @property
    def written(self) -> bool:
        """Whether something was ever saved."""
        return self._data is not None

    def load(self) -> Image | None:
        """Saved image, None if nothing was saved; FlashDamaged if it is spoiled."""
        # A reset reads what is on the disk now, not what this process once wrote there.
        if self.path is not None and self.path.exists():
            self._data = self.path.read_bytes()
        return None if self._data is None else Image.decode(self._data)

    def store(self, image: Image) -> None:
        """Keep an image; on disk it replaces the old one in one step."""
        self._data = image.encode()
        if self.path is not None:
            atomic_write_bytes(self.path, self._data)

    def spoil(self) -> None:
        """Turn one bit of the image over (commanded fault)."""
        if self._data is None:
            return
        data = bytearray(self._data)
        data[-1] ^= 1
        self._data = bytes(data)
        if self.path is not None:
            atomic_write_bytes(self.path, self._data)
