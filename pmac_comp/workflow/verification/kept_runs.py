"""Runs and result of a verification in a folder."""

import shlex
from pathlib import Path

from pmac_comp.base.atomic import atomic_write_text
from pmac_comp.base.documents import document
from pmac_comp.files.capture import Capture, write_capture
from pmac_comp.workflow.accuracy.ringing import is_ringing
from pmac_comp.workflow.accuracy.static_check import is_static
from pmac_comp.workflow.verification.result import Verification

RESULT = "verification.json"


class KeptRuns:
    """Runs of a verification in a folder, each written when it is gathered.

    Parameters
    ----------
    folder : Path or None
        Made if it is missing; None keeps nothing.
    """

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder
        self.names: dict[str, list[str]] = {"before": [], "after": []}
        self._counts: dict[str, int] = {}

    def keep(self, capture: Capture) -> None:
        """Write one run under its kind, side and number."""
        if self.folder is None:
            return
        side = "after" if capture.attributes.get("compensation") == "on" else "before"
        kind = "static_" if is_static(capture) else "ringing_" if is_ringing(capture) else ""
        number = self._counts.get(kind + side, 0) + 1
        self._counts[kind + side] = number
        self.folder.mkdir(parents=True, exist_ok=True)
        name = f"{kind}{side}_{number:02d}.h5"
        write_capture(self.folder / name, capture)
        self.names[side].append(name)

    def write_result(self, verification: Verification) -> None:
        """Write the result of the runs beside them; a later one takes its place."""
        if self.folder is not None:
            result = {**verification.as_result(), "files": self.names}
            atomic_write_text(self.folder / RESULT, document(result))

    def left(self, motor: int, compared: str) -> str:
        """What an interrupted verification leaves, for people; ``compared`` are more options."""
        stands = (
            f"Tables and law are as the last run had them: `pmac-comp status` shows whether they "
            f"act and whether motor #{motor} is enabled."
        )
        n = sum(len(names) for names in self.names.values())
        if self.folder is None or n == 0:
            return f"{stands} No run was kept (--out DIR keeps each one as it is made)."
        folder = shlex.quote(str(self.folder))
        return (
            f"{stands} {n} runs are kept: `pmac-comp verify --before {folder} --after {folder} "
            f"{compared}` compares the motions that were run on both sides."
        )


def earlier_runs(folder: Path) -> list[Path]:
    """What an earlier verification left in a folder: runs of two sessions are never mixed."""
    found = (folder.glob(pattern) for pattern in ("*before_*.h5", "*after_*.h5", RESULT))
    return sorted(path for paths in found for path in paths)
