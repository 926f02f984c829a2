"""How sharply friction sets in: part of a model, and no finding."""

from types import SimpleNamespace
from typing import Any

import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.diagnose import onset
from pmac_comp.physics.diagnose.onset import freed, holds_onset, not_outgrown, told, with_onset
from pmac_comp.physics.model.drive import DriveModel

BENCH = load_bench("paper_x4")


def _gripping(distance_m: float, rotary_m: float = 1e-8) -> DriveModel:
    base = DriveModel.base(BENCH)
    return base.with_effect("presliding@all", {"distance_m": distance_m, "rotary_m": rotary_m})


def test_an_onset_is_told_as_no_finding_and_presliding_is_not_told_as_an_onset():
    (line,) = told(_gripping(0.03e-6), ("backlash",))
    assert "0.03 um" in line
    assert "no finding" in line
    assert told(_gripping(20e-6), ()) == ()
    assert told(_gripping(0.03e-6, 5e-6), ()) == ()
    assert told(_gripping(0.03e-6), ("presliding",)) == ()
    assert told(DriveModel.base(BENCH), ()) == ()


@pytest.mark.parametrize("effects", [("coulomb", "viscous", "presliding"), ("viscous",)])
def test_nothing_is_simulated_where_friction_grips_already_or_there_is_none(effects):
    # Where something were, the missing workbench would show.
    point = SimpleNamespace(model=SimpleNamespace(effects=effects))
    assert with_onset(None, point) is point  # type: ignore[arg-type, comparison-overlap]


def test_a_distance_that_an_encoder_resolves_is_no_onset(monkeypatch):
    monkeypatch.setattr(onset, "evaluate", lambda bench, model: SimpleNamespace(model=model))
    monkeypatch.setattr(onset, "refit", lambda bench, point, *, rounds: point)
    bench: Any = SimpleNamespace(fitting_bench=lambda: None)
    short: Any = SimpleNamespace(model=_gripping(0.03e-6))
    assert not_outgrown(bench, short) is short
    grown: Any = SimpleNamespace(model=_gripping(0.03e-6, 2e-6))
    assert holds_onset(grown.model)
    assert not holds_onset(not_outgrown(bench, grown).model)


@pytest.mark.parametrize(("distance_m", "kept"), [(0.05e-6, True), (3e-6, False)])
def test_what_stood_for_an_onset_goes_back_unless_it_takes_the_onset_along(
    monkeypatch, distance_m, kept
):
    moved = SimpleNamespace(model=_gripping(distance_m))
    monkeypatch.setattr(onset, "_outspoken", lambda part: part)
    monkeypatch.setattr(onset, "evaluate", lambda bench, model: SimpleNamespace(model=model))
    monkeypatch.setattr(onset, "settled", lambda part, point: (moved, {}))
    bench: Any = SimpleNamespace(fitting_bench=lambda: None)
    point: Any = SimpleNamespace(model=_gripping(0.03e-6))
    assert freed(bench, point).model is (moved.model if kept else point.model)
