"""Captures in m under a header in mm: what cannot be identified says what may be wrong."""

from pathlib import Path

import numpy as np
import pytest

from pmac_comp.base.errors import NotIdentifiable
from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture, write_capture
from pmac_comp.workflow import identification

BENCH = load_bench("paper")


@pytest.mark.parametrize(("span_m", "n_told"), [(20e-6, 1), (20e-3, 0)])
def test_captures_that_hardly_move_are_asked_for_their_unit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, span_m: float, n_told: int
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise NotIdentifiable("no motion")

    monkeypatch.setattr(identification, "identify_captures", refuse)
    time_s = np.arange(2000) * BENCH.servo_period_s
    command_m = 0.5 * span_m * np.sin(2.0 * np.pi * 3.0 * time_s)
    file = tmp_path / "run.h5"
    write_capture(file, Capture(time_s, command_m, command_m, table_position_m=command_m))
    with pytest.raises(NotIdentifiable) as refused:
        identification.identify_files([file], "paper")
    notes = getattr(refused.value, "__notes__", [])
    assert sum("are its positions in m?" in note for note in notes) == n_told
