"""How close models of growing freedom come to the EMPS record, on laps not used for fitting.

    python tools/acceptance/identify_emps.py [--record DATA_EMPS.mat]

Each model is fitted to the first two of the four laps and judged on the last two: in closed loop
(from the reference alone) and one sample ahead (from the measured past). The floor is the
repeatability of the laps, 0.26 um rms (ballscrew facts, section 4).
"""

import argparse
import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import ModelError
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import Capture, read_capture
from pmac_comp.physics.identify import identify
from pmac_comp.physics.identify.records import prepare, response_of
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.quasi_static import table_force_N

LAP = 6240  # samples, period of the reference
FITTED_LAPS = 2
GROWTH = (
    ("bias_force",),
    ("bias_force", "friction_asymmetry"),
    ("bias_force", "viscous_nonlinear"),
    ("bias_force", "friction_asymmetry", "viscous_nonlinear"),
    ("bias_force", "friction_asymmetry", "stribeck"),
    ("bias_force", "friction_asymmetry", "viscous_nonlinear", "presliding"),
)


def model_with(bench: Bench, effects: tuple[str, ...]) -> DriveModel:
    """EMPS base model with effects, started at the published symmetric parameters."""
    start = {"chain.mass_kg": 95.1, "coulomb.guide_N": 20.4, "viscous.guide_Ns_per_m": 203.0}
    model = DriveModel.base(bench).with_parameters(start)
    for name in effects:
        model = model.with_effect(name)
    return model


def fitted(record: Capture, bench: Bench, effects: tuple[str, ...]) -> DriveModel:
    """Model fitted to the first laps through the closed loop."""
    valid = np.arange(record.n) < FITTED_LAPS * LAP
    found = identify([replace(record, valid=valid)], bench, model=model_with(bench, effects))
    if found.model is None:
        raise ModelError("The fit gave no model.")
    return found.model


def lap_rms_um(record: Capture, bench: Bench, model: DriveModel) -> list[float]:
    """Closed-loop position error of each lap, rms in um."""
    gap = record.motor_position_m - response_of(prepare(record, bench), model).motor_position_m
    laps = [gap[start : start + LAP] for start in range(0, record.n, LAP)]
    return [1e6 * float(np.sqrt(np.mean(lap**2))) for lap in laps if lap.size > LAP // 2]


def one_step_nm(record: Capture, bench: Bench, model: DriveModel) -> float:
    """Error of the next position from the measured past on the judged laps, rms in nm.

    Two models differ here only below the 50 nm lattice of the encoder, whose own share is 50 nm.
    """
    q, period = record.motor_position_m, bench.servo_period_s
    speed = np.gradient(q, period)
    rest = np.zeros_like(q)
    friction = table_force_N(model, q, speed, rest, np.sign(speed))
    force = torque(record) / bench.lead_m_per_rad - friction
    ahead = 2.0 * q[1:-1] - q[:-2] + period**2 * force[1:-1] / model.parameters["chain.mass_kg"]
    gap = (q[2:] - ahead)[FITTED_LAPS * LAP :]
    return 1e9 * float(np.sqrt(np.mean(gap**2)))


def torque(record: Capture) -> FloatArray:
    """Torque of the record; it always has one."""
    if record.torque_command_Nm is None:
        raise ModelError("The record has no force.")
    return record.torque_command_Nm


def repeatability_um(record: Capture) -> float:
    """Half the difference power of the judged laps: what no model can predict, rms in um."""
    error = record.motor_position_m - record.commanded_position_m
    laps = [error[k * LAP : (k + 1) * LAP] for k in range(record.n // LAP)]
    return 1e6 * float(np.std(laps[-1] - laps[-2]) / np.sqrt(2.0))


def main() -> None:
    default = Path(os.environ.get("PMAC_COMP_EMPS", "../shared/data/emps")) / "DATA_EMPS.mat"
    parser = argparse.ArgumentParser()
    parser.add_argument("--record", type=Path, default=default)
    record = read_capture(parser.parse_args().record)
    bench = load_bench("emps")
    print(f"repeatability of a lap: {repeatability_um(record):.2f} um rms")
    print(f"{'effects beside coulomb and viscous':66s} closed loop per lap, um rms   one step, nm")
    for effects in GROWTH:
        try:
            model = fitted(record, bench, effects)
        except ModelError as error:
            print(f"{', '.join(effects):66s} {error.message}")
            continue
        laps = "  ".join(f"{value:5.2f}" for value in lap_rms_um(record, bench, model))
        print(f"{', '.join(effects):66s} {laps}   {one_step_nm(record, bench, model):8.1f}")
        print("    " + ", ".join(f"{k} {v:.5g}" for k, v in model.parameters.items()))


if __name__ == "__main__":
    main()
