"""What a run has gathered is on the disk while it lasts: logs, and captures made from them.

What lives here: where the log of one run lies, what is said of it after an error, and a capture
from what it holds. The log itself is ``machine.controller.gather.capture_log``.
"""

import shlex
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pmac_comp.base.arrays import FloatArray, IntArray
from pmac_comp.base.clock import Clock
from pmac_comp.base.errors import CaptureError
from pmac_comp.files.bench import Bench, parse_bench
from pmac_comp.files.capture import Capture
from pmac_comp.files.sidecar import Attribute
from pmac_comp.machine.controller.gather.capture_log import CaptureLog, RecoveredLog, recover
from pmac_comp.machine.controller.gather.gather_plan import COUNTER_NAME
from pmac_comp.workflow.bench.scales import Scales
from pmac_comp.workflow.capture.samples import capture_in_SI

SUFFIX = ".log"


@dataclass
class RunLog:
    """The log of one run; without a path none is kept."""

    path: Path | None = None
    n_samples: int = 0

    @contextmanager
    def of(self, attributes: Mapping[str, Attribute], clock: Clock) -> Iterator[CaptureLog | None]:
        """An open log for one attempt at the run, closed however it ends."""
        if self.path is None:
            yield None
            return
        self.drop()  # of an attempt that lost samples
        log = CaptureLog.create(self.path, attributes, clock=clock)
        reason = "interrupted"
        try:
            yield log
            reason = "complete"
        finally:
            self.n_samples = log.n_rows
            try:
                log.close(reason)
            except CaptureError:  # a full disk: what was synced before is intact without an end
                log.abandon()

    def drop(self) -> None:
        """Remove the log: its samples are stored elsewhere, or there are none."""
        if self.path is not None:
            with suppress(OSError):
                self.path.unlink(missing_ok=True)

    def kept(self) -> str:
        """Words for after an error: how much was kept and how to get at it; empty for nothing."""
        if self.path is None or not self.path.exists():
            return ""
        if self.n_samples == 0:
            self.drop()
            return ""
        again = f"--recover {shlex.quote(str(self.path))} --out FOLDER"
        return (
            f"{self.n_samples} samples of this run are kept in {self.path}; `pmac-comp capture URL "
            f"--bench FILE {again}` makes a capture of them"
        )


def new_log(folder: Path, stem: str) -> RunLog:
    """Log in a folder under a name that nobody has; one that an earlier run left stays."""
    names = (stem, *(f"{stem}_{i}" for i in range(2, 1000)))
    return RunLog(next(p for name in names if not (p := folder / f"{name}{SUFFIX}").exists()))


def capture_of_log(path: Path, bench: Bench) -> tuple[Capture, RecoveredLog]:
    """Capture of everything intact in a log, lost samples marked not valid.

    Parameters
    ----------
    path : Path
        The log.
    bench : Bench
        Used where the log does not hold the text of its own bench file.

    Raises
    ------
    CaptureError
        Not a log, or it lacks the columns of a capture.
    """
    found = recover(path)
    raw = dict(found.columns)
    if not {"commanded", "actual"} <= set(raw):
        raise CaptureError(
            f"{path.name} holds {', '.join(raw) or 'no samples'}, not a capture of an axis.",
            code="PC-CAL-003",
            hint="Name a log that `pmac-comp capture` left in its folder.",
        )
    text = str(found.header.get("bench_text", ""))
    scales = Scales.of(parse_bench(text, name=f"bench text in {path.name}") if text else bench)
    place = _places(raw.pop(COUNTER_NAME, None), raw["commanded"].size)
    spread = _Spread(place)
    capture = capture_in_SI(
        raw,
        scales,
        spread.of,
        {**_attributes(found.header), "gaps": len(found.gaps)},
        valid=spread.valid if spread.n > place.size else None,
    )
    return capture, found


def _attributes(header: Mapping[str, Any]) -> dict[str, Attribute]:
    kept = {key: value for key, value in header.items() if isinstance(value, (str, int, float))}
    return {**kept, "source": f"{kept.get('source', 'not stated')}, recovered from its log"}


def _places(cycles: IntArray | None, n: int) -> IntArray:
    """Servo cycle of each sample, counted from the first."""
    if cycles is None:
        return np.arange(n)
    return np.asarray(cycles - cycles[0])


class _Spread:
    """Samples laid on the grid of servo cycles, what is missing as not a number."""

    def __init__(self, place: IntArray) -> None:
        self.n = int(place.max()) + 1
        self._place = place
        self.valid = np.zeros(self.n, dtype=np.bool_)
        self.valid[place] = True

    def of(self, values: FloatArray) -> FloatArray:
        out = np.full(self.n, np.nan)
        out[self._place] = values
        return out
