"""Backlash of a light table, which friction at the guide imitates well enough to hold a fit."""

from pmac_comp.physics.diagnose import diagnose
from pmac_comp.physics.model.effect import effect_library
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.servo.closed_loop import closed_loop_capture
from tests.generators.motions import sine, strokes
from tests.generators.other_benches import LIGHT, bench_of


def test_a_gap_that_the_base_fit_took_for_friction_at_the_guide_is_found():
    bench = bench_of(LIGHT, "22 kg on 5 mm of pitch")
    plant = make_plant(bench, effects={"backlash": {"gap_um": 3.0}}, seed=3)
    commands = [
        sine(bench, 0.03, 0.7, 3.0, 0.0),
        sine(bench, 0.01, 2.0, 3.0, -0.05),
        sine(bench, 0.005, 4.0, 3.0, 0.05),
        strokes(bench, -0.05, 0.04, [0.15, 0.1, 0.15], 4.0),
        sine(bench, 0.02, 1.3, 3.0, 0.02),
    ]
    *fitting, judging = [closed_loop_capture(bench, plant, c) for c in commands]
    library = {name: effect_library()[name] for name in ("backlash", "preload_loss")}
    found = diagnose(fitting, bench, validate=[judging], effects=library)
    assert found.named == ("backlash",)
    assert found.gap_after_um < 0.3 * found.gap_before_um
    (gap,) = found.estimates
    assert abs(gap.value - 3.0) < 0.3
