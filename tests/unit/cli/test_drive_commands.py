"""identify, predict and diagnose as a user calls them: own effects, any command, poor benches."""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from pmac_comp.cli.app import main
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import Capture, read_capture, write_capture
from pmac_comp.files.model_file import ModelFile, read_model, write_model, written_for
from pmac_comp.physics.identify import model_from_file
from pmac_comp.physics.model.drive import DriveModel, simulate
from pmac_comp.physics.model.effect import load_effects
from pmac_comp.physics.signals import trajectory as tr

ROOT = Path(__file__).resolve().parents[3]
EXAMPLE = ROOT / "configs/effect_worn_stretch.py"
PAPER = load_bench("paper_x4")
TS = PAPER.servo_period_s


def called(*words: object) -> int:
    """Exit code of the command."""
    with pytest.raises(SystemExit) as done:
        main([str(word) for word in words])
    return int(done.value.code or 0)


def record(model: DriveModel, motion: tr.Trajectory) -> Capture:
    """Capture of the model itself, readings rounded as the sensors do."""
    run = simulate(model, motion, quantise=True)
    return Capture(
        time_s=run.time_s,
        commanded_position_m=run.commanded_position_m,
        motor_position_m=run.motor_position_m,
        table_position_m=None if model.bench.scale is None else run.table_position_m,
        torque_command_Nm=run.torque_command_Nm,
    )


@pytest.fixture(scope="module")
def worn(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, float]]:
    """Captures of a drive with the example's effect, and its true parameters."""
    folder = tmp_path_factory.mktemp("worn")
    truth = {"excess_N": 25.0, "centre_m": 0.05, "width_m": 0.03}
    model = DriveModel.base(PAPER).with_effect("worn_stretch", truth, library=load_effects(EXAMPLE))
    motions = [
        tr.trapezoid(period_s=TS, distance_m=0.3, speed_m_per_s=0.15, acceleration_m_per_s2=2.0,
                     s_curve_s=0.02, start_m=-0.15),
        tr.sinusoid(period_s=TS, amplitude_m=0.01, frequency_Hz=3.0, cycles=6, centre_m=-0.2),
        tr.sinusoid(period_s=TS, amplitude_m=0.01, frequency_Hz=3.0, cycles=6, centre_m=0.2),
    ]  # fmt: skip
    for i, motion in enumerate(motions):
        write_capture(folder / f"run{i}.h5", record(model, motion))
    return folder, truth


def test_an_effect_of_a_users_file_is_fitted_stored_and_predicted(
    worn: tuple[Path, Mapping[str, float]], capsys: pytest.CaptureFixture[str]
) -> None:
    folder, truth = worn
    runs, model = sorted(folder.glob("run*.h5")), folder / "model.json"
    assert called("identify", *runs, "--bench", "paper_x4", "--effects", EXAMPLE, "--with",
                  "worn_stretch", "--out", model) == 0  # fmt: skip
    stored = read_model(model)
    excess = stored.parameters["worn_stretch.excess_N"]
    assert excess.std is not None
    assert abs(excess.value - truth["excess_N"]) < 4.0 * excess.std + 0.5
    assert stored.parameters["worn_stretch.centre_mm"].value == pytest.approx(50.0, abs=3.0)
    out = folder / "predicted.csv"
    words = ("predict", "-b", "paper_x4", "-m", model, "-c", runs[0], "-o", out)
    assert called(*words) == 9  # the model's effect is not known without its file
    assert "--effects" in capsys.readouterr().err
    assert called(*words, "--effects", EXAMPLE) == 0
    assert read_capture(out).n == read_capture(runs[0]).n


@pytest.fixture(scope="module")
def stored_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Model file with nominal values."""
    folder = tmp_path_factory.mktemp("model")
    parameters = {
        "parameters": {}, "effects": ["coulomb", "viscous"], "bench_digest": PAPER.digest,
    }  # fmt: skip
    path = folder / "model.json"
    path.write_text(json.dumps({"model_version": 1, **parameters}))
    return path


MOVE = tr.trapezoid(
    period_s=TS, distance_m=0.05, speed_m_per_s=0.2, acceleration_m_per_s2=3.0, s_curve_s=0.02
)
ROWS = {
    "servo period": (MOVE.time_s, MOVE.position_m),
    "half": (MOVE.time_s[::2], MOVE.position_m[::2]),
    "1 kHz": (np.arange(0, MOVE.time_s[-1], 1e-3), None),
    "finer": (np.arange(0, MOVE.time_s[-1], 1e-4), None),
}


@pytest.mark.parametrize("suffix", [".csv", ".h5", ".mat"])
@pytest.mark.parametrize("grid", ROWS)
def test_any_command_is_predicted_on_its_own_times(
    stored_model: Path, tmp_path: Path, suffix: str, grid: str, capsys: pytest.CaptureFixture[str]
) -> None:
    time_s, given = ROWS[grid]
    position = np.interp(time_s, MOVE.time_s, MOVE.position_m) if given is None else given
    command, out = tmp_path / f"move{suffix}", tmp_path / "out.csv"
    if suffix == ".csv":
        rows = [f"{t:.9f},{1e3 * x:.9f}" for t, x in zip(time_s, position, strict=True)]
        command.write_text("time_s,commanded_position_mm\n" + "\n".join(rows))
    elif suffix == ".mat":
        moved = {"commanded_position_mm": 1e3 * position, "motor_position_mm": 1e3 * position}
        savemat(command, {"time_s": time_s, **moved})
    else:
        write_capture(command, Capture(time_s, position, position, None, position, 0 * position))
    words = ("predict", "-b", "paper_x4", "-m", stored_model, "-c", command, "-o", out)
    assert called(*words, "--rounding", "none") == 0
    assert ("note:" in capsys.readouterr().out) == (grid != "servo period")
    lines = [line for line in out.read_text().splitlines() if not line.startswith("#")]
    header = lines[0].split(",")
    assert set(header) == {
        "time_s", "commanded_position_mm", "desired_position_mm", "motor_position_mm",
        "table_position_mm", "torque_command_Nm",
    }  # fmt: skip
    found = read_capture(out)
    assert found.n == time_s.size
    assert found.table_position_m is not None
    best = simulate(model_from_file(read_model(stored_model), PAPER), MOVE).mechanical_error_m
    error = found.table_position_m - found.motor_position_m
    assert np.std(error - np.interp(time_s, MOVE.time_s, best)) < 0.02e-6
    assert called(*words) == 0  # with what rounding in the loop does on average
    rounded = read_capture(out)
    assert rounded.table_position_m is not None
    other = rounded.table_position_m - rounded.motor_position_m
    assert 0.0 < np.std(other - error) < 0.06e-6


def test_a_command_too_coarse_to_be_one_is_refused(
    stored_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = tmp_path / "coarse.csv"
    rows = "\n".join(f"{0.02 * i:.3f},{0.1 * i:.3f}" for i in range(50))
    command.write_text("time_s,commanded_position_mm\n" + rows)
    words = ("predict", "-b", "paper_x4", "-m", stored_model, "-c", command, "-o",
             tmp_path / "out.csv")  # fmt: skip
    assert called(*words) == 2
    assert "20 ms" in capsys.readouterr().err


def written(bench: Bench, path: Path, keep: list[str]) -> Path:
    """Bench file with only some of the [nominal] lines, and no scale where none is kept."""
    lines, table = [], ""
    for line in bench.text.splitlines():
        table = line.strip() if line.startswith("[") else table
        skipped = table == "[scale]" and "scale" not in keep
        nominal = table in {"[nominal]", "[tolerance]"} and "=" in line
        if not skipped and not (nominal and line.split("=")[0].strip() not in keep):
            lines.append(line)
    path.write_text("\n".join(lines))
    return path


def test_a_bench_with_a_motor_encoder_only(tmp_path: Path) -> None:
    bench = written(PAPER, tmp_path / "motor_only.toml", ["motor_inertia_kgm2"])
    model = DriveModel.base(load_bench(str(bench))).with_parameters({"chain.mass_kg": 440.0})
    run = record(model, ROUND)
    write_capture(tmp_path / "run.csv", run)
    out = tmp_path / "model.json"
    assert called("identify", tmp_path / "run.csv", "-b", bench, "-o", out) == 0
    assert read_model(out).parameters["mass_kg"].value == pytest.approx(440.0, rel=0.02)
    assert called("predict", "-b", bench, "-m", out, "-c", tmp_path / "run.csv", "-o",
                  tmp_path / "p.h5") == 0  # fmt: skip
    found = read_capture(tmp_path / "p.h5")
    assert found.table_position_m is None
    assert np.std(found.motor_position_m - run.motor_position_m) < 2e-6


ROUND = tr.sinusoid(period_s=TS, amplitude_m=0.02, frequency_Hz=2.0, cycles=8).then(
    tr.triangle(period_s=TS, amplitude_m=0.02, speed_m_per_s=0.05, cycles=2)
)


def test_a_model_of_another_axis_is_not_predicted_with(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_model(tmp_path / "m.json", ModelFile(parameters={}, **written_for(load_bench("paper"))))
    write_capture(tmp_path / "c.h5", record(DriveModel.base(PAPER), MOVE))
    assert called("predict", "--bench", "paper_x4", "--model", tmp_path / "m.json",
                  "--command", tmp_path / "c.h5", "--out", tmp_path / "o.csv") == 2  # fmt: skip
    assert "encoder.counts_per_rev 10000 in the model, 40000" in capsys.readouterr().err
    assert not (tmp_path / "o.csv").exists()
