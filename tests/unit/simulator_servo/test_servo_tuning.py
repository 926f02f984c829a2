"""SI gains as I-variables."""

import numpy as np
import pytest

from pmac_comp.files.bench import parse_bench
from pmac_comp.simulator.card.card import Card
from pmac_comp.simulator.plant import make_plant
from pmac_comp.simulator.servo.closed_loop import run_closed_loop
from pmac_comp.simulator.servo.servo_tuning import pmac_gains
from tests.generators.control_laws import PAPER, SI, other_law


def test_gains_are_those_of_the_paper_bench():
    gains = pmac_gains(other_law("si", SI))
    for tail in (30, 31, 32, 33, 35):
        stated = PAPER.controller.ivariables[f"I1{tail}"]
        assert gains[tail] == pytest.approx(stated, rel=0.003)
    assert pmac_gains(PAPER) == {}


def test_both_laws_move_the_drive_alike():
    command = 0.004 * np.sin(np.arange(3000) * 0.01) * np.clip(np.arange(3000) / 500, 0, 1)
    runs = [run_closed_loop(b, make_plant(b), command) for b in (PAPER, other_law("si", SI))]
    gap = runs[0]["true_table_position_m"] - runs[1]["true_table_position_m"]
    assert np.sqrt(np.mean(gap**2)) < 1.5e-6


def test_card_of_an_si_bench_holds_and_jogs():
    card = Card(other_law("si", SI))
    port = card.port()
    card.run_cycles(20)
    port.line("#1J/")
    port.line("#1J=3000")
    card.run_cycles(3000)
    assert float(port.line("#1P").split(b"\r")[0]) == pytest.approx(3000, abs=3)


def test_without_a_torque_scale_there_are_no_gains():
    text = other_law("si", SI).text.replace(
        "torque_per_dac_Nm = 5.8319e-4", "torque_per_dac_Nm = 1.0"
    )
    assert pmac_gains(parse_bench(text)) == {}
