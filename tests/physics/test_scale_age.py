"""A scale that is read late: found behind the viscous friction that looks like it."""

import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.identify.scale_age import measured_scale_age
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.plant.effects import PlantEffects
from pmac_comp.simulator.servo.closed_loop import closed_loop_capture
from pmac_comp.workflow.accuracy.late_scale import scale_age_s
from pmac_comp.workflow.compensation.computing import compute_compensation
from pmac_comp.workflow.law import beyond_model
from pmac_comp.workflow.motion.campaigns import calibration_motions
from tests.physics.identified import SLOW, identified

BENCH = load_bench("paper_x4")


@pytest.mark.parametrize(
    "time_us", [5.0, *(pytest.param(t, marks=pytest.mark.slow) for t in (-2.0, 14.0))]
)
def test_a_late_scale_is_told_from_viscous_friction_of_the_guide(time_us: float) -> None:
    runs, model = identified(BENCH, {"channel_skew": {"time_us": time_us}}, seed=7, without=SLOW)
    found = measured_scale_age(runs, BENCH, model)
    assert found is not None
    assert found.time_s == pytest.approx(1e-6 * time_us, abs=0.6e-6)
    assert found.with_um < 0.8 * found.without_um
    # What it hid behind was wrong by as much as the lag is worth.
    true = make_plant(BENCH, effects={}, seed=7).truth.guide_viscous_Ns_per_m
    name = "viscous.guide_Ns_per_m"
    assert abs(found.values[name] - true) < 0.6 * abs(model.parameters[name] - true)


@pytest.mark.slow
def test_a_scale_that_is_read_early_is_told_beside_friction_that_curves() -> None:
    effects: PlantEffects = {
        "channel_skew": {"time_us": -10.0},
        "viscous_nonlinear": {"coefficient_N": 138.0, "exponent": 0.5},
    }
    runs, model = identified(BENCH, effects, seed=41)
    found = measured_scale_age(runs, BENCH, model)
    assert found is not None
    assert found.time_s == pytest.approx(-10e-6, abs=1.2e-6)


@pytest.mark.parametrize(
    "effects",
    [
        pytest.param({"viscous": {"guide_Ns_per_m": 600.0}}, marks=pytest.mark.slow),
        pytest.param({"viscous_nonlinear": {}}, marks=pytest.mark.slow),
        pytest.param({"chain_damping": {}}, marks=pytest.mark.slow),
        pytest.param({"actuator_delay": {"time_us": 400.0}}, marks=pytest.mark.slow),
    ],
    ids=["viscous", "viscous_nonlinear", "chain_damping", "actuator_delay"],
)
def test_a_drive_whose_scale_is_not_late_shows_none(effects: PlantEffects) -> None:
    runs, model = identified(BENCH, effects, seed=3)
    assert measured_scale_age(runs, BENCH, model) is None


@pytest.mark.slow
def test_the_law_leaves_alone_what_the_scale_alone_says(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        beyond_model, "found_clearance", lambda *_: None
    )  # its fit is not the point
    laws = []
    for effects in ({}, {"channel_skew": {"time_us": 5.0}}):
        runs, model = identified(BENCH, effects, seed=7)
        laws.append(compute_compensation(BENCH, model, route="law", captures=tuple(runs)).law)
    plain, late = laws
    # Taken for an error of the table, 5 us would be in it whole.
    assert late.viscous_s == pytest.approx(plain.viscous_s, abs=1e-6)
    assert late.inertia_s2 == pytest.approx(plain.inertia_s2, rel=0.05)
    assert scale_age_s(plain.provenance) == 0.0
    assert scale_age_s(late.provenance) == pytest.approx(5e-6, abs=0.6e-6)


def test_where_there_is_nothing_to_look_at_none_is_found() -> None:
    model = DriveModel.base(BENCH)
    assert measured_scale_age([], BENCH, model) is None
    without = BENCH.model_copy(update={"scale": None})
    runs = [
        closed_loop_capture(BENCH, make_plant(BENCH, effects={}, seed=1), m.position_m)
        for m in calibration_motions(BENCH)[:1]
    ]
    assert measured_scale_age(runs, without, model) is None
