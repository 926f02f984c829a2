"""SI gains as I-variables."""

import numpy as np
import pytest

from pmac_comp.files.bench import load_bench, parse_bench
from pmac_comp.simulator.card import Card
from pmac_comp.simulator.closed_loop import run_closed_loop
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.servo_tuning import pmac_gains

PAPER = load_bench("paper")
# The physical form of the paper's gains (K_P 23.7 N m/rad and so on), per mm of table travel.
PER_MM = 2 * np.pi / 10.0
SI = f"""
[controller.si]
Kp_Nm_per_mm = {23.7 * PER_MM}
Ki_Nm_per_mm_s = {298.0 * PER_MM}
Kd_Nm_s_per_mm = {0.227 * PER_MM}
Kvff_Nm_s_per_mm = {0.2295 * PER_MM}
Kaff_Nm_s2_per_mm = {1.112e-3 * PER_MM}
"""


def si_bench():
    head, tail = PAPER.text.split("[controller.ivariables]")
    rest = tail[tail.index("[travel]") :]
    return parse_bench(head.replace('kind = "pmac"', 'kind = "si"') + SI + rest)


def test_gains_are_those_of_the_paper_bench():
    gains = pmac_gains(si_bench())
    for tail in (30, 31, 32, 33, 35):
        stated = PAPER.controller.ivariables[f"I1{tail}"]
        assert gains[tail] == pytest.approx(stated, rel=0.003)
    assert pmac_gains(PAPER) == {}


def test_both_laws_move_the_drive_alike():
    command = 0.004 * np.sin(np.arange(3000) * 0.01) * np.clip(np.arange(3000) / 500, 0, 1)
    runs = [run_closed_loop(b, make_plant(b), command) for b in (PAPER, si_bench())]
    gap = runs[0]["true_table_position_m"] - runs[1]["true_table_position_m"]
    assert np.sqrt(np.mean(gap**2)) < 1.5e-6


def test_card_of_an_si_bench_holds_and_jogs():
    card = Card(si_bench())
    port = card.port()
    card.run_cycles(20)
    port.line("#1J/")
    port.line("#1J=3000")
    card.run_cycles(3000)
    assert float(port.line("#1P").split(b"\r")[0]) == pytest.approx(3000, abs=3)


def test_without_a_torque_scale_there_are_no_gains():
    text = si_bench().text.replace("torque_per_dac_Nm = 5.8319e-4", "torque_per_dac_Nm = 1.0")
    assert pmac_gains(parse_bench(text)) == {}
