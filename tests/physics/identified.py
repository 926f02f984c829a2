"""Runs of simulated drives: those that calibrate, with their model, and moves that rest."""

from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.identify import identify
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.signals.trajectory import trapezoid
from pmac_comp.simulator.plant import Plant, make_plant
from pmac_comp.simulator.plant.effects import PlantEffects
from pmac_comp.simulator.servo.closed_loop import closed_loop_capture
from pmac_comp.workflow.motion.campaigns import calibration_motions

SLOW = frozenset({"move_slow", "triangle_slow"})  # long runs, for friction at low speed


def identified(
    bench: Bench, effects: PlantEffects, seed: int, without: frozenset[str] = frozenset()
) -> tuple[list[Capture], DriveModel]:
    """Runs of a drive with effects that the base model does not hold, and that model of them."""
    plant = make_plant(bench, effects=effects, seed=seed)
    motions = [m for m in calibration_motions(bench) if m.name not in without]
    runs = [closed_loop_capture(bench, plant, m.position_m) for m in motions]
    model = identify(runs, bench).model
    assert model is not None
    return runs, model


def moves_with_rests(bench: Bench, plant: Plant, *, n: int = 2) -> list[Capture]:
    """Runs that go, rest, come back and rest."""
    return [
        closed_loop_capture(
            bench,
            plant,
            trapezoid(
                period_s=bench.servo_period_s,
                distance_m=size_m,
                speed_m_per_s=0.2,
                acceleration_m_per_s2=3.0,
                s_curve_s=0.015,
                dwell_s=0.2,
            ).position_m,
        )
        for size_m in (0.05, 0.12, 0.2)[:n]
    ]
