"""Rival models on capture files, and beside them what a user would do otherwise."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pmac_comp.base.errors import ModelError
from pmac_comp.base.progress import Progress
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import Capture, told_by
from pmac_comp.workflow.bench.same_axis import captures_of, check_no_copies


def compare_files(
    captures: Sequence[Path],
    validate: Sequence[Path],
    bench: str,
    *,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Fit every rival and the full model to captures, judge them on others.

    The alternatives to compensation are simulated on the commands of the judged captures, with the
    identified model as the plant. On benches without a scale friction models are compared on the
    motor of one record, lap by lap.
    """
    from pmac_comp.physics.identify.compare import compare_models, parted
    from pmac_comp.physics.identify.records import prepare
    from pmac_comp.workflow.model.alternatives import BASIS, compare_alternatives

    loaded = load_bench(bench)
    given = captures_of(captures, loaded), captures_of(validate, loaded)
    check_no_copies([str(p) for p in (*captures, *validate)], [*given[0], *given[1]])
    if loaded.scale is None:
        return _compare_rigid(given[0] + given[1], loaded, progress)
    found = compare_models(*given, loaded, progress=progress)
    commands = [prepare(capture, loaded).commanded_m for capture in parted(*given)[1]]
    ways = compare_alternatives(found.identification.model, commands, progress=progress)
    return {
        "kind": "comparison",
        **_of_what([*given[0], *given[1]], loaded),
        "judged_on": found.judged_on,
        "elsewhere_share": found.elsewhere_share,
        "remarks": _remarks(found.elsewhere_share),
        "models": [asdict(row) for row in found.rows],
        "alternatives": {"simulated": True, "basis": BASIS, "rows": [asdict(w) for w in ways]},
    }


def _compare_rigid(
    captures: Sequence[Capture], bench: Bench, progress: Progress | None
) -> dict[str, Any]:
    """Benches without a scale: friction models on the motor of one record, lap by lap."""
    from pmac_comp.physics.identify.compare_rigid import compare_rigid

    if len(captures) != 1:
        raise ModelError(
            f"{len(captures)} captures were given; without a scale one record is fitted in its "
            "first half and judged in its second.",
            code="PC-CMP-007",
            hint="Give one record, best of a motion that repeats itself.",
        )
    found = compare_rigid(captures[0], bench, progress=progress)
    return {
        "kind": "comparison",
        **_of_what(captures, bench),
        "judged_on": "measured",
        "models": [asdict(row) for row in found.rows],
        "refused": found.refused,
        "laps": {"fitted": found.fitted_laps, "all": found.n_laps},
        "floor_um": found.floor_um,
        "lattice_nm": found.lattice_nm,
        "alternatives": {"simulated": True, "basis": "", "rows": []},
    }


def floor_lines(result: Mapping[str, Any]) -> list[str]:
    """What the laps of a bench without a scale differ by, and the best model, for people."""
    if result["floor_um"] is None:
        return []
    best_um = min((row["left_rms_um"] for row in result["models"]), default=math.nan)
    return [
        f"  laps differ from each other by {result['floor_um']:.2f} um rms, the floor of any "
        f"model; the best leaves {best_um:.2f} um. One step ahead the encoder's lattice is "
        f"{result['lattice_nm']:.0f} nm."
    ]


def _remarks(elsewhere_share: float) -> list[str]:
    """What of the judged captures was left out, for people."""
    if elsewhere_share == 0.0:
        return []
    return [
        f"{100.0 * elsewhere_share:.0f} % of the judged samples lie where no fitted run went, so "
        "that the static error there is unknown: they are left out"
    ]


def _of_what(captures: Sequence[Capture], bench: Bench) -> dict[str, Any]:
    """Which bench, and where its captures come from: a simulation is never called measured."""
    return {"bench": bench.name, "sources": told_by(captures, "source")}
