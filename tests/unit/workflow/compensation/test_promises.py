"""A promise begins as the run begins: approach, rests, counts, tables, and the grip of friction."""

from dataclasses import replace

import numpy as np
import pytest

from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.physics.compensate.grip import gripping_model
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.lead import LeadMap
from pmac_comp.physics.compensate.loop import counted_loop, model_loop
from pmac_comp.physics.compensate.promise import promise, run_with_law
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.signals.trajectory import Trajectory, trapezoid
from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.plant import make_plant
from pmac_comp.workflow.accuracy.outcome import ROUNDING
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.simulated import TruthRecorder, embedded
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.compensation.promises import Promiser, static_of, worse_remarks
from pmac_comp.workflow.motion.approach import RUN_UP_m, approach
from pmac_comp.workflow.motion.motions import Motion
from tests.compensations import TRAVEL_m, lead_map
from tests.generators.true_values import friction_of

BENCH = load_bench("paper")
LEAD = lead_map(reversal_um=-6.0, reversal_um_per_m=-10.0, noise_um=0.05)
SLIDES_m = 12e-6
_RUNS = 8  # counts of 1 um scatter one run by 0.6 um rms


def move() -> Motion:
    shape = trapezoid(
        period_s=BENCH.servo_period_s,
        distance_m=0.03,
        speed_m_per_s=0.2,
        acceleration_m_per_s2=3.0,
        s_curve_s=0.015,
        start_m=0.05,
    )
    return Motion("move", shape)


def test_approach_comes_from_within_the_travel_and_rests_on_the_start() -> None:
    for start_m, way in ((0.2, -1.0), (-0.2, 1.0)):
        command = approach(BENCH, start_m)
        inward = way * (command - start_m)
        assert inward.max() == pytest.approx(RUN_UP_m, rel=1e-6)
        assert inward.min() > -1e-9
        moving = np.flatnonzero(np.abs(np.diff(command)) > 0.0)
        assert command[-1] == start_m
        assert (command.size - moving[-1]) * BENCH.servo_period_s == pytest.approx(0.5, abs=0.02)


def test_promise_of_the_run_as_it_begins_is_what_a_card_measures() -> None:
    plant = make_plant(
        BENCH,
        effects={"presliding": {"distance_um": SLIDES_m * 1e6, "place": "rotary"}},
        spread=0.0,
    )
    model = DriveModel.base(
        BENCH,
        friction_of(plant.truth),
    ).with_effect("presliding@rotary", {"distance_m": SLIDES_m})
    card = Card(BENCH, plant=plant)
    recorder = TruthRecorder(card, 60.0)
    motion = move()
    with embedded(card) as link:
        axis = Axis(link, BENCH, "card", simulated=True)
        axis.enable()
        captures = [axis.run(motion) for _ in range(_RUNS)]
    found = recorder.truth()
    assert found is not None
    each_um = []
    for capture in captures:
        true = found.of(capture)
        assert true is not None
        each_um.append(float(np.std(true[1] - capture.commanded_position_m) * 1e6))
    measured_um = float(np.mean(each_um))
    promiser = Promiser.of(BENCH, Compensation("law", CompensationLaw()), model)
    assert promiser is not None
    begun = promiser.of_run(captures[0])["total_before_um"]
    relaxed = promise(CompensationLaw(), model_loop(model), motion.trajectory).total_before_um
    assert begun == pytest.approx(measured_um, rel=0.05)
    assert abs(begun - measured_um) < 0.5 * abs(relaxed - measured_um)


def test_law_and_output_agree_about_every_rest() -> None:
    motion = move().trajectory
    r = np.concatenate([approach(BENCH, float(motion.position_m[0])), motion.position_m])
    law = CompensationLaw(
        torque_coulomb_Nm=0.5, torque_limit_Nm=10.0, torque_breakaway_m=2e-6, coulomb_m=0.9e-6
    )
    loop = counted_loop(DriveModel.base(BENCH).with_effect("presliding@all"))
    sent, signals = run_with_law(law, loop, r, motion.sample_period_s)
    again, _ = run_with_law(law, lambda *_: signals, r, motion.sample_period_s)
    np.testing.assert_allclose(again.torque_Nm, sent.torque_Nm, atol=1e-3)


def test_tables_turn_side_with_the_motion_after_the_hysteresis() -> None:
    along = static_of(Compensation("table", CompensationLaw(), LEAD, backlash=True), BENCH)
    assert along is not None
    out = np.linspace(0.0, 0.01, 2000)
    command = np.concatenate([out, out[::-1], np.full(200, 0.0)])
    got = along(command)
    # Forward error less backward error is -6 um here: half of it either way beside the mean.
    half = 0.5 * (got.table_m - got.mean_m)
    assert half[1000] == pytest.approx(-half[3000], rel=0.02)
    assert 2.0 * abs(half[1000]) == pytest.approx(3e-6, rel=0.05)
    # Position zero has no correction, whatever the map says there: the rest is the lead error.
    assert np.ptp(got.lead_m + got.mean_m) < 0.1e-6
    assert np.sign(got.table_m - got.mean_m)[2002] == np.sign(half[1000])


def test_promise_of_a_table_holds_the_lead_error_that_it_takes_away() -> None:
    table = Compensation(
        "table", CompensationLaw(), replace(LEAD, reversal_m=0.0 * LEAD.reversal_m)
    )
    promiser = Promiser.of(BENCH, table, DriveModel.base(BENCH))
    assert promiser is not None
    far = Trajectory(move().trajectory.time_s, 5.0 * (move().position_m - 0.05))
    got = promiser.of_motion(far)
    bare = Promiser.of(BENCH, Compensation("table", CompensationLaw()), DriveModel.base(BENCH))
    assert bare is not None
    plain = bare.of_motion(far)
    assert got["total_before_um"] != pytest.approx(plain["total_before_um"], rel=0.02)
    assert got["total_after_um"] == pytest.approx(plain["total_after_um"], rel=0.02)


def test_grip_that_captures_showed_is_in_the_model_that_promises() -> None:
    model = DriveModel.base(BENCH)
    law = CompensationLaw(torque_breakaway_m=8e-6)
    assert gripping_model(model, law) is model
    noted = replace(law, provenance={"grip_m": 6e-6})
    slides = gripping_model(model, noted)
    assert slides.parameters["presliding.distance_m"] == 6e-6
    assert gripping_model(slides, noted) is slides
    # An onset over some tenths of a micrometre is no grip; a distance of the same size is.
    short = {"distance_m": 0.3e-6, "rotary_m": 0.2e-6}
    onset = model.with_effect("presliding@all", short)
    assert gripping_model(onset, noted).parameters["presliding.distance_m"] == 6e-6
    far = model.with_effect("presliding@guide", {"distance_m": 9e-6})
    assert gripping_model(far, noted) is far


def test_rounding_of_a_coarse_encoder_is_told_and_a_fine_one_has_none() -> None:
    def rounding_um(bench: Bench) -> float:
        table = Compensation("table", CompensationLaw())
        promiser = Promiser.of(bench, table, DriveModel.base(bench))
        assert promiser is not None
        return promiser.of_motion(move().trajectory)[ROUNDING]

    with_steps = rounding_um(BENCH)
    fine = BENCH.model_copy(
        update={"encoder": BENCH.encoder.model_copy(update={"extension": "1/T"})}
    )
    assert with_steps > 0.02
    assert rounding_um(fine) == 0.0


def test_motion_that_a_table_makes_worse_is_said_with_its_figures() -> None:
    # A lead error that falls towards the far end stands against the lag of the way back.
    x = TRAVEL_m
    worse = LeadMap(x, -0.6e-3 * (x - 0.065), 0.0 * x, 0.05e-6)
    motions = [move()]
    texts: list[str] = []
    for lead in (worse, replace(worse, error_m=-worse.error_m)):
        promiser = Promiser.of(
            BENCH, Compensation("table", CompensationLaw(), lead), DriveModel.base(BENCH)
        )
        assert promiser is not None
        texts += worse_remarks(promiser, motions)
    assert len(texts) == 1
    assert "move: total error" in texts[0]
    assert "%)" in texts[0]
