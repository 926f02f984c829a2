"""One quantity of the bench file in place of a model that needs several."""

from dataclasses import replace
from typing import Any

import pytest

from pmac_comp.base.threads import working
from pmac_comp.files.bench import load_bench
from pmac_comp.physics.diagnose.growth import Grown, first_noise
from pmac_comp.physics.diagnose.records import prepare
from pmac_comp.physics.diagnose.refit import evaluate, refit
from pmac_comp.physics.diagnose.result import Finding
from pmac_comp.physics.diagnose.simpler import _at_an_end, _unknown, single_cause, stretched
from pmac_comp.physics.diagnose.workbench import Workbench, split
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.simulator.plant import kernel_ballscrew as k
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.servo.closed_loop import closed_loop_capture
from pmac_comp.workflow.motion.campaigns import calibration_motions

BENCH = load_bench("paper_x4")
FINDING = Finding("chain.screw_inertia_kgm2", 4e-4, 2.557e-4, 0.03, "screw inertia")


def _runs() -> list[Any]:
    """A rotor a fifth heavier than the bench file says; everything else as it says."""
    plant = make_plant(BENCH, effects={}, seed=5, spread=0.0)
    plant.par[k.P_J_MOTOR] *= 1.2
    plant.reset()
    wanted = ("sine_low_end", "sine_long", "move_long", "sine_small")
    motions = [m for m in calibration_motions(BENCH) if m.name in wanted]
    return [closed_loop_capture(BENCH, plant, m.position_m) for m in motions]


def test_the_quantity_that_is_off_is_found_alone_with_its_value() -> None:
    fit = prepare(_runs(), BENCH, prefix="run")
    with working() as executor:
        bench = Workbench(fit, split(fit[:3], fit[3:]), executor)
        start = DriveModel.base(BENCH)
        bench = first_noise(bench, start)
        part = bench.fitting_bench()
        base = evaluate(bench, refit(part, evaluate(part, start), rounds=8).model)
        grown = Grown(bench, base, base, ())
        assert single_cause(grown, ()) is None
        found = single_cause(grown, (FINDING,))
    assert found is not None
    assert found[1].parameter == "chain.motor_inertia_kgm2"
    stated = BENCH.nominal.motor_inertia_kgm2 or 0.0
    assert abs(found[1].value / stated - 1.2) < 0.02
    # Both turn with the screw; only its wind-up tells them apart.
    assert "screw_inertia_kgm2 instead" in found[1].text
    # A fifth more of the rotor is a tenth more of all that the motor turns and moves.
    assert "gives 0.91" in found[1].text
    assert found[0].accepted == ()


@pytest.mark.parametrize(
    ("share", "ends"), [(0.02, True), (0.5, False), (1.2, False), (2.02, True)]
)
def test_a_quantity_that_a_refit_took_to_the_end_of_its_range_is_no_finding(share, ends) -> None:
    # A table of 0.8 kg "did as well as any effects" where none did: the refit had stopped there.
    base = DriveModel.base(BENCH)
    spec = base.spec("chain.table_mass_kg")
    loose = replace(base, bench=_unknown(BENCH, spec))
    assert _at_an_end(loose.with_parameters({spec.name: share * spec.nominal}), spec.name) is ends


def test_stated_quantities_all_at_the_ends_of_their_tolerances_are_doubted() -> None:
    # A fifth more of mass was shared out among eight tolerances and called nothing missing.
    base = DriveModel.base(BENCH)
    known = [x for x in base.specs if x.kind == "known" and x.name != "chain.efficiency"]

    def out(count: int, share: float) -> DriveModel:
        moved = {x.name: x.nominal * (1 - share * (x.tolerance_frac or 0.0)) for x in known[:count]}
        return base.with_parameters(moved)

    assert not stretched(base)
    assert not stretched(out(2, 1.0))
    assert not stretched(out(9, 0.7))
    assert stretched(out(8, 1.02))
