"""Calibration runs of a simulated drive and the model that its bench file's base gives of them."""

from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import Capture
from pmac_comp.physics.identify import identify
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.simulator.plant import make_plant
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
