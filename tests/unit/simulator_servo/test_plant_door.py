"""Plants of a user's own: loading, guarding, recording."""

import math
import subprocess
import sys

import numpy as np
import pytest

from pmac_comp.base.errors import ConfigError, ModelError, NonFinite
from pmac_comp.files.bench import load_bench
from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.plant import BallscrewPlant, GuardedPlant, load_plant
from pmac_comp.simulator.servo.closed_loop import run_closed_loop

BENCH = load_bench("paper")
OWN = """
class Axis:
    def __init__(self, bench, mass=1.1e-3):
        self.ts, self.lead, self.inertia = bench.servo_period_s, bench.lead_m_per_rad, mass
        self.reset()

    def reset(self, table_position_m=0.0):
        self.angle, self.speed = table_position_m / self.lead, 0.0

    def step(self, torque_command_Nm):
        self.speed += self.ts * (torque_command_Nm - 0.02 * self.speed) / self.inertia
        self.angle += self.ts * self.speed
        return self.angle, self.angle * self.lead


def make_plant(bench):
    return Axis(bench)


def heavy(bench):
    return Axis(bench, 1.5e-3)


def nothing(bench):
    return 3


def diverging(bench):
    axis = Axis(bench)
    axis.inertia = -1e-9
    return axis
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "axis.py"
    path.write_text(OWN)
    return path


def test_default_and_named_factories(file):
    assert load_plant(str(file), BENCH).plant.inertia == 1.1e-3
    assert load_plant(f"{file}:heavy", BENCH).plant.inertia == 1.5e-3


@pytest.mark.parametrize(
    ("suffix", "code"), [(":absent", "012"), (":nothing", "013"), ("x", "010"), (":no-name", "010")]
)
def test_what_cannot_be_a_plant_is_refused(file, suffix, code):
    with pytest.raises(ConfigError) as caught:
        load_plant(f"{file}{suffix}", BENCH)
    assert caught.value.code == f"PC-PLT-{code}"


@pytest.mark.parametrize("text", ["import nonsense_module_x", "def f(:", "x = undefined_name"])
def test_files_that_do_not_load_are_refused(tmp_path, text):
    path = tmp_path / "bad.py"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_plant(str(path), BENCH)
    assert caught.value.code == "PC-PLT-011"


COMPILED = """
from numba import njit


@njit(cache=True)
def halved(x):
    return 0.5 * x


@njit(cache=True)
def advanced(x, torque):
    return x + 1e-9 * halved(torque)


class Axis:
    def reset(self, table_position_m=0.0):
        self.x = table_position_m

    def step(self, torque_command_Nm):
        self.x = advanced(self.x, torque_command_Nm)
        return self.x, self.x


def make_plant(bench):
    axis = Axis()
    axis.reset()
    return axis
"""


def test_compiled_functions_that_its_author_ran_are_found_again(tmp_path, monkeypatch):
    (tmp_path / "my_compiled_axis.py").write_text(COMPILED)
    code = "import my_compiled_axis as a; print(a.advanced(0.0, 2.0))"
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True)
    plant = load_plant(str(tmp_path / "my_compiled_axis.py"), BENCH)
    assert plant.step(2.0)[0] == pytest.approx(1e-9, rel=1e-6, abs=0.0)
    again = load_plant(str(tmp_path / "my_compiled_axis.py"), BENCH)  # as a changed file would be
    assert again.step(2.0)[0] == pytest.approx(1e-9, rel=1e-6, abs=0.0)


def test_compiled_functions_are_found_whatever_the_file_was_called_when_they_were_kept(
    tmp_path, monkeypatch
):
    """`pmac-comp` and `python -m pmac_comp` in the file's folder see it under different paths."""
    file = tmp_path / "my_other_axis.py"
    file.write_text(COMPILED)
    before = "import importlib.util as u, sys; s = u.spec_from_file_location(N, F); "
    code = before + "m = u.module_from_spec(s); sys.modules[N] = m; s.loader.exec_module(m); "
    code = (
        f"N, F = 'pmac_comp_user_plant_my_other_axis', {str(file)!r}; {code} m.advanced(0.0, 2.0)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    monkeypatch.syspath_prepend(tmp_path)
    assert load_plant(str(file), BENCH).step(2.0)[0] == pytest.approx(1e-9, rel=1e-6, abs=0.0)
    assert sys.modules["my_other_axis"].__file__ == str(file)


def test_a_file_named_like_a_module_does_not_take_its_place(tmp_path):
    import json

    (tmp_path / "json.py").write_text(COMPILED)
    load_plant(str(tmp_path / "json.py"), BENCH)
    assert sys.modules["json"] is json


WRONG = """
class Axis:
    def reset(self, table_position_m=0.0):
        {reset}

    def step(self, torque_command_Nm):
        {step}


def make_plant(bench):
    {make}
"""


@pytest.mark.parametrize(
    ("body", "code", "words"),
    [
        ({"make": "return bench.screw.lenght_mm"}, "015", ["line 11", "lenght_mm"]),
        ({"reset": "self.x = 1 / 0"}, "015", ["reset", "line 4", "ZeroDivisionError"]),
        ({"step": "return self.speed, 0.0"}, "015", ["step", "servo cycle 1", "line 7"]),
        ({"step": "return 1.0"}, "016", ["returned 1.0"]),
        ({"step": "return 1.0, 2.0, 3.0"}, "016", ["(1.0, 2.0, 3.0)"]),
        ({"step": "return [[0.0, 1.0], [0.0, 1.0]]"}, "016", ["step returned"]),
        ({"step": "return 'far', 'away'"}, "016", ["far"]),
        ({"step": "return None"}, "016", ["None"]),
        ({"step": "return float('nan'), 0.0"}, "014", ["servo cycle 1"]),
        ({"step": "return 0.0, float('inf')"}, "014", ["servo cycle 1"]),
    ],
)
def test_wrong_plants_are_told_before_the_card_starts(tmp_path, body, code, words):
    parts = {"reset": "pass", "step": "return 0.0, 0.0", "make": "return Axis()", **body}
    path = tmp_path / "axis.py"
    path.write_text(WRONG.format(**parts))
    with pytest.raises((ConfigError, ModelError, NonFinite)) as caught:
        load_plant(str(path), BENCH)
    assert caught.value.code == f"PC-PLT-{code}"
    assert caught.value.hint
    for word in ("axis.py", *words):
        assert word in str(caught.value)


def test_plant_that_fails_later_stops_the_server_with_its_cycle(tmp_path):
    path = tmp_path / "axis.py"
    path.write_text(
        WRONG.format(
            reset="self.k = 0",
            step="self.k += 1; return (0.0, 0.0) if self.k < 50 else 1 / 0",
            make="return Axis()",
        )
    )
    card = Card(BENCH, plant=load_plant(str(path), BENCH))
    card.run_cycles(49)
    with pytest.raises(ModelError, match=r"axis\.py: step failed in servo cycle 50"):
        card.run_cycles(1)


def test_step_of_a_class_that_inherits_from_the_drive_is_the_users(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(
        "from pmac_comp.simulator.plant import BallscrewPlant, make_plant as base\n"
        "class Mine(BallscrewPlant):\n"
        "    def step(self, torque):\n"
        "        angle, table = super().step(torque)\n"
        "        return angle, table + 1e-3\n"
        "def make_plant(bench):\n"
        "    one = base(bench)\n"
        "    one.__class__ = Mine\n"
        "    return one\n"
    )
    plant = load_plant(str(path), BENCH)
    assert isinstance(plant, GuardedPlant)
    assert plant.step(0.0)[1] == pytest.approx(1e-3, abs=1e-5)


def test_own_drive_from_a_user_file_stays_compiled(tmp_path):
    path = tmp_path / "ours.py"
    path.write_text(
        "from pmac_comp.simulator.plant import make_plant as base\n"
        "def make_plant(bench):\n"
        "    return base(bench, effects={'backlash': {'gap_um': 6.0}}, seed=4)\n"
    )
    plant = load_plant(str(path), BENCH)
    assert isinstance(plant, BallscrewPlant)
    assert plant.effects == {"backlash": {"gap_um": 6.0}}


def test_card_moves_a_users_axis_and_records_it(file):
    plant = load_plant(str(file), BENCH)
    assert isinstance(plant, GuardedPlant)
    card = Card(BENCH, plant=plant)
    plant.record(5000)
    port = card.port()
    card.run_cycles(20)
    port.line("#1J/")
    port.line("#1J=4000")
    card.run_cycles(2500)
    assert float(port.line("#1P").split(b"\r")[0]) == pytest.approx(4000, abs=2)
    truth = plant.recorded()
    assert truth["cycle"].tolist() == list(range(1, 2521))
    assert truth["motor_position_m"][-1] == pytest.approx(4e-3, abs=3e-6)
    np.testing.assert_array_equal(truth["motor_position_m"], truth["table_position_m"])


def test_diverging_plants_are_stopped_with_their_cycle(file):
    plant = load_plant(f"{file}:diverging", BENCH)
    with pytest.raises(NonFinite, match=r"axis\.py.*servo cycle"):
        run_closed_loop(BENCH, plant, 0.001 * np.sin(np.arange(5000) * math.pi / 500))
