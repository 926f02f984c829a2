"""Experiments that a diagnosis proposes are motions that the capture command takes."""

import itertools
import math

import pytest

from pmac_comp.files.bench import Bench, load_bench, parse_bench
from pmac_comp.physics.diagnose.localise import COORDINATE_UNITS, TURNED
from pmac_comp.physics.diagnose.lookalikes import separating_experiment, telling_experiment
from pmac_comp.physics.model.effect import effect_library
from pmac_comp.workflow.motion.motions import parse_motion


def small() -> Bench:
    """A bench with little travel that is not centred and hardly accelerates."""
    text = load_bench("paper").text
    for old, new in (
        ("min_mm = -300.0", "min_mm = 5.0"),
        ("max_mm = 300.0", "max_mm = 45.0"),
        ("max_speed_mm_per_s = 500.0", "max_speed_mm_per_s = 60.0"),
        ("max_acceleration_m_per_s2 = 12.0", "max_acceleration_m_per_s2 = 0.5"),
    ):
        assert old in text
        text = text.replace(old, new)
    return parse_bench(text)


BENCHES = {
    "paper": load_bench("paper"),
    "paper_x4": load_bench("paper_x4"),
    "emps": load_bench("emps"),
    "small": small(),
}


@pytest.mark.parametrize("name", BENCHES)
def test_every_experiment_runs_within_travel_and_limits(name: str) -> None:
    library, bench = effect_library(), BENCHES[name]
    groups = {
        tuple(sorted((effect.name, other)))
        for effect in library.values()
        for other in (*effect.look_alikes, "lead_linear")
        if other != effect.name
    }
    texts = set(
        itertools.chain.from_iterable(
            separating_experiment(group, library, bench).motions for group in groups
        )
    )
    for coordinate in COORDINATE_UNITS:
        told = telling_experiment(coordinate, bench)
        assert told is not None
        texts.update(told.motions)
    assert len(texts) >= 15
    for text in texts:
        motion = parse_motion(text, bench)  # refuses what leaves the travel or the limits
        assert 0.3 < motion.duration_s < 120.0, text
        moved = float(motion.position_m.max() - motion.position_m.min())
        assert math.isfinite(moved)
        assert moved > 1e-6, text


def test_the_speeds_of_a_level_and_a_slope_differ_widely() -> None:
    found = separating_experiment(
        ("bias_force", "friction_asymmetry"), effect_library(), BENCHES["paper"]
    )
    assert "every speed" in found.text
    speeds = [parse_motion(text, BENCHES["paper"]).row()[4] for text in found.motions]
    assert max(speeds) > 50.0 * min(speeds)


def test_friction_by_place_is_looked_for_at_both_ends_and_not_twice() -> None:
    """With these runs among its captures the diagnosis asked for them again, and said no more."""
    bench = BENCHES["paper"]
    told = telling_experiment(TURNED, bench)
    assert told is not None
    places = [parse_motion(text, bench).position_m for text in told.motions]
    assert min(float(p.min()) for p in places) < -0.28
    assert max(float(p.max()) for p in places) > 0.28
    assert "Where such runs are among these already, look at guide" in told.text


def test_the_run_that_tells_more_suits_what_is_left() -> None:
    reversals = telling_experiment("distance_since_reversal", BENCHES["paper"])
    speeds = telling_experiment("speed", BENCHES["paper"])
    assert reversals is not None
    assert speeds is not None
    assert all(m.startswith(("triangle", "sine")) for m in reversals.motions)
    assert all(m.startswith("trapezoid") for m in speeds.motions)
    assert telling_experiment("taste", BENCHES["paper"]) is None
