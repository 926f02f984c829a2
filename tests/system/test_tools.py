"""The benches of tools/: what the type checker does not see of them, kernels and commands."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.physics.model.drive import DriveModel, simulate
from pmac_comp.physics.signals import trajectory as tr
from tools import bench_model, bench_upload, bench_wire

ROOT = Path(__file__).resolve().parents[2]
BENCHES = sorted(path.stem for path in (ROOT / "tools").glob("bench_*.py"))
OPTIONS = {"bench_model": ["--quick"]}
TOLERANCE = np.array([1e-12, 1e-12, 1e-8, 1e-8, 1e-5])  # m, m, N m, N m, N


@pytest.fixture(scope="module")
def model():
    return DriveModel.base(load_bench("paper"))


@pytest.fixture(scope="module")
def motion(model):
    return tr.sinusoid(
        period_s=model.bench.servo_period_s, amplitude_m=0.01, frequency_Hz=5.0, cycles=3.0
    )


@pytest.fixture(scope="module")
def case(model, motion):
    return bench_model.Case(model, motion, model.substeps)


def test_the_model_is_timed_in_the_loop_that_the_package_runs(case, model, motion):
    response = simulate(model, motion)
    wanted = [
        response.motor_position_m,
        response.table_position_m,
        response.torque_command_Nm,
        response.motor_torque_Nm,
        response.joint_force_N,
    ]
    assert np.array_equal(case.numba(), wanted)


def test_its_yardstick_in_c_solves_the_same_equations(case, tmp_path):
    library = bench_model.compiled_c(tmp_path)
    if library is None:
        pytest.skip("no C compiler")
    ours = case.numba().copy()
    assert np.all(np.abs(case.c(library) - ours).max(axis=1) < TOLERANCE)


@pytest.mark.system
def test_an_upload_is_taken_apart_and_replayed(monkeypatch):
    monkeypatch.setattr(bench_upload, "ROUNDS", 2)
    server = bench_upload.Served()
    try:
        found = bench_upload.measure(server)
    finally:
        server.stop()
    assert found["apart_watch_s"] > 0.0
    assert found["requests_beyond_the_table"] <= 40
    assert found["ratio"] > 0.0


@pytest.mark.system
def test_the_wire_is_timed_with_one_client_and_many(monkeypatch):
    for name, value in {"SINGLE": 5, "BULK": 20, "CHUNKS": 1}.items():
        monkeypatch.setattr(bench_wire, name, value)
    with bench_wire.served_card() as port:
        rates = bench_wire.ours(port)
        polls, _, worst_s = bench_wire.many_clients(port, seconds=0.3)
    assert min(rates.values()) > 0.0
    assert polls > 0.0
    assert worst_s > 0.0


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize("name", BENCHES)
def test_a_bench_runs_to_its_end(name):
    command = [sys.executable, f"tools/{name}.py", *OPTIONS.get(name, [])]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=3600.0, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout
