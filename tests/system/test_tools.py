"""The benches of tools/: what the type checker does not see of them, kernels and commands."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench
from pmac_comp.machine.client.commander import Commander
from pmac_comp.physics.model.drive import DriveModel, simulate
from pmac_comp.physics.signals import trajectory as tr
from tools import bench_model, bench_upload, bench_wire

ROOT = Path(__file__).resolve().parents[2]
BENCHES = sorted(path.stem for path in (ROOT / "tools").glob("bench_*.py"))
OPTIONS = {"bench_model": ["--quick"]}
# Packets of 1000 entries, and of the listings before and after that take them down again.
CARRYING = 11
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
    assert 0.0 < found["upload_without_syncs_and_watch_s"] < found["total_s"]
    assert found["requests"] - found["requests_beyond_the_table"] == CARRYING
    assert 10 <= found["requests_beyond_the_table"] <= 40
    # The same bytes without any work between them.
    assert 0.5 < found["ratio"] < 20.0


@pytest.mark.system
def test_the_wire_is_timed_with_one_client_and_many(monkeypatch):
    monkeypatch.setattr(bench_wire, "SINGLE", 5)
    monkeypatch.setattr(bench_wire, "BULK", 20)
    monkeypatch.setattr(bench_wire, "rate", lambda count, act: (count, act()))
    seconds = 0.3
    with bench_wire.served_card() as port:
        asked = bench_wire.ours(port)
        with Commander.open(f"tcp://127.0.0.1:{port}") as link:
            stored = link.query_many(f"P{k}" for k in range(bench_wire.LINES))
            program = link.query("LIST PROG 99")
        polls, _, worst_s = bench_wire.many_clients(port, seconds)
    # What is counted is what was answered, and what was sent stands on the card.
    assert asked["single questions"] == (5, [["0"]] * 5)
    assert asked["bulk reads"] == (20, ["0"] * 20)
    assert stored == [str(k) for k in range(bench_wire.LINES)]
    assert sum(line.startswith("X") for line in program) == bench_wire.LINES - 3
    count, pieces = asked["memory bytes"]
    assert count == sum(map(len, pieces)) == 160_000
    n_polls = round(polls * seconds)
    assert n_polls == pytest.approx(polls * seconds)
    assert bench_wire.CLIENTS <= n_polls <= 4 * bench_wire.CLIENTS
    assert 0.0 < worst_s < seconds + 10.0


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
