"""F34: every public function refuses bad numbers by name, and quickly."""

from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import pytest

from pmac_comp.base.errors import ModelError, PmacCompError
from pmac_comp.files.bench import load_bench
from pmac_comp.physics.model import quasi_static as qs
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.drive import DriveModel, simulate
from pmac_comp.physics.model.terms import Coordinate, Site, TableTerm
from pmac_comp.physics.signals import trajectory as tr

pytestmark = [pytest.mark.faults, pytest.mark.timeout(20, func_only=True)]
MODEL = DriveModel.base(load_bench("paper"))
TS = MODEL.bench.servo_period_s
ONE = np.zeros(3)

BAD = {
    "nan": np.array([0.0, np.nan, 0.0]),
    "inf": np.array([0.0, np.inf, 0.0]),
    "empty": np.array([]),
    "complex": np.array([0.0, 1j, 0.0]),
    "object": np.array([0.0, None, 0.0], dtype=object),
    "text": np.array(["a", "b", "c"]),
    "two-dimensional": np.zeros((3, 2)),
}

CALLS = {
    "simulate command": lambda a: simulate(MODEL, a),
    "simulate desired": lambda a: simulate(MODEL, ONE, desired_position_m=a),
    "simulate torque": lambda a: simulate(MODEL, ONE, torque_feedforward_Nm=a),
    "simulate force": lambda a: simulate(MODEL, ONE, external_force_N=a),
    "Trajectory": lambda a: tr.Trajectory(np.arange(a.shape[0]) * TS, a),
    "Trajectory time": lambda a: tr.Trajectory(a, np.zeros(a.shape[0])),
    "compliance": lambda a: qs.compliance_m_per_N(MODEL, a),
    "torsion": lambda a: qs.torsional_compliance_rad_per_Nm(MODEL, a),
    "windup": lambda a: qs.screw_windup_m_per_m_per_s2(MODEL, a),
    "mechanical_error": lambda a: qs.mechanical_error_m(MODEL, ONE, ONE, a, ONE),
    "motor_torque": lambda a: qs.motor_torque_Nm(MODEL, a, ONE, ONE, ONE),
    "table_force": lambda a: qs.table_force_N(MODEL, ONE, a, ONE, ONE),
    "static_error": lambda a: qs.static_error_m(MODEL, a),
    "TableTerm": lambda a: TableTerm(Coordinate.TIME_S, Site.TABLE_FORCE_N, 0.0, 1.0, a),
    "multisine": lambda a: tr.multisine(period_s=TS, amplitude_m=1e-3, frequencies_Hz=a),
    "staircase": lambda a: tr.staircase(
        period_s=TS, positions_m=a, speed_m_per_s=0.1, acceleration_m_per_s2=1.0
    ),
    "path": lambda a: tr.path(a, period_s=TS, speed_m_per_s=0.1, acceleration_m_per_s2=1.0),
}


@pytest.fixture(scope="module", autouse=True)
def _compiled() -> None:
    """Compiling kernels is no part of how quickly bad numbers are refused."""
    simulate(MODEL, ONE)


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize("bad", BAD)
def test_bad_arrays_are_refused(call, bad):
    with pytest.raises(ModelError):
        CALLS[call](BAD[bad])


@pytest.mark.parametrize("name", ["simulate command", "compliance", "mechanical_error"])
def test_the_message_names_array_and_index(name):
    with pytest.raises(ModelError, match="index 1"):
        CALLS[name](BAD["nan"])


@pytest.mark.parametrize("value", [0.0, 1e300, -1e300, 5e-324, 2.2e-308])
@pytest.mark.parametrize("call", CALLS)
def test_extreme_constants_end_in_a_number_or_a_typed_refusal(call, value):
    with np.errstate(over="ignore", invalid="ignore", divide="ignore", under="ignore"):
        try:
            result = CALLS[call](np.full(3, value))
        except PmacCompError:
            return
    arrays = numbers_of(result)
    assert arrays
    for array in arrays:
        assert np.all(np.isfinite(array))


def numbers_of(result: Any) -> list[np.ndarray[Any, Any]]:
    """Arrays and figures of a result: itself, or the fields of a response or a trajectory."""
    parts = [getattr(result, f.name) for f in fields(result)] if is_dataclass(result) else [result]
    return [np.asarray(part) for part in parts if isinstance(part, float | np.ndarray)]


@pytest.mark.parametrize("size", [1, 2, 4])
def test_wrong_lengths_are_refused(size):
    other = np.zeros(size)
    for call in ("simulate desired", "simulate torque", "simulate force", "mechanical_error"):
        with pytest.raises(ModelError):
            CALLS[call](other)
    with pytest.raises(ModelError):
        simulate(MODEL, np.zeros(1))


@pytest.mark.parametrize("substeps", [0, -1, 10_000])
def test_impossible_substeps_are_refused(substeps):
    with pytest.raises(ModelError):
        simulate(MODEL, ONE, substeps=substeps)


def test_commands_at_another_rate_are_refused():
    with pytest.raises(ModelError, match="servo period"):
        simulate(MODEL, tr.sinusoid(period_s=1e-3, amplitude_m=1e-3, frequency_Hz=1.0))


@pytest.mark.parametrize(
    "changes",
    [
        {"amplitude_m": np.nan},
        {"frequency_Hz": 0.0},
        {"frequency_Hz": -1.0},
        {"cycles": np.inf},
        {"period_s": 0.0},
        {"period_s": 1e-300},
        {"cycles": 1e18},
        {"dwell_s": -1.0},
    ],
)
def test_bad_figures_of_a_sinusoid_are_refused(changes):
    good = {"period_s": TS, "amplitude_m": 1e-3, "frequency_Hz": 1.0}
    with pytest.raises(ModelError):
        tr.sinusoid(**{**good, **changes})


def test_a_rigid_bench_has_no_compliance():
    rigid = DriveModel.base(load_bench("emps"))
    with pytest.raises(ModelError, match="rigid"):
        qs.compliance_m_per_N(rigid, 0.0)
    assert qs.motor_torque_Nm(rigid, ONE, ONE, ONE + 1.0).shape == (3,)


@pytest.mark.parametrize("name", ["paper", "emps"])
def test_a_payload_that_takes_away_more_than_the_table_is_refused_and_no_bug(name: str) -> None:
    # A refit on a light axis stepped there beside presliding, whose damping has no root then.
    bench = load_bench(name)
    whole = DriveModel.base(bench).with_effect("payload", {"mass_kg": 1.0})
    own_kg = whole.kernel_vector()[s.RIGID_MASS if whole.is_rigid else s.M_TABLE] - 1.0
    light = whole.with_parameters({"payload.mass_kg": -0.9 * own_kg})
    assert light.kernel_vector()[s.M_TABLE] > 0.0
    none = whole.with_parameters({"payload.mass_kg": -1.1 * own_kg})
    with pytest.raises(ModelError, match="leaves -"):
        none.kernel_vector()
