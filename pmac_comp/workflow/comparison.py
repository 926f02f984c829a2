"""Rival models on capture files: one table of what each leaves uncorrected."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import read_capture
from pmac_comp.workflow.identification import check_period

Progress = Callable[[str, float], None]


def compare_files(
    captures: Sequence[Path],
    validate: Sequence[Path],
    bench: str,
    *,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Fit every rival and the full model to captures, judge them on others."""
    from pmac_comp.physics.identify.compare import compare_models

    loaded = load_bench(bench)
    read = {path: read_capture(path) for path in [*captures, *validate]}
    for path, capture in read.items():
        check_period(capture, loaded, path.name)
    found = compare_models(
        [read[path] for path in captures],
        [read[path] for path in validate],
        loaded,
        progress=progress,
    )
    return {
        "kind": "comparison",
        "judged_on": found.judged_on,
        "models": [asdict(row) for row in found.rows],
    }
