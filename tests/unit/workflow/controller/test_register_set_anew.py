"""Homing sets the position register anew while a law acts: the axis must not feel it."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from pmac_comp.base.arrays import FloatArray
from pmac_comp.files.bench import load_bench
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.contents.law_bank import Index, WorkIndex
from pmac_comp.machine.controller.law import law_goal, law_state
from pmac_comp.simulator.card.card import Card
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.capture.simulated import default_servo, embedded
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.controller.deploy import deploy
from tests.compensations import friction_law

BENCH = load_bench("paper")
LAW = friction_law(
    viscous_s=3.7e-6,
    torque_viscous_Nm_s_per_m=0.5,
    torque_coulomb_Nm=0.45,
    lookahead_s=1.6e-3,
    jerk_limit_m_per_s3=400.0,  # as that of every law which is computed from a model
)
PLACE_ct = 80_000.0


def outputs_Nm(axis: Axis, card: Card, command: str, cycles: int) -> FloatArray:
    """Torque command of motor 1 in each servo cycle after a command."""
    axis.link.command(command)
    found = []
    for _ in range(cycles):
        card.run_cycles(1)
        word = int(card.memory.x[0xBF])
        found.append(((word + 0x800000) % 0x1000000 - 0x800000) / 256.0)
    return np.array(found) * BENCH.drive.torque_per_dac_Nm


@contextmanager
def armed(route: str, folder: Path) -> Iterator[tuple[Axis, Card, Context]]:
    """Axis at a place, with the law of a route."""
    source = default_servo().read_text(encoding="utf-8") if route == "servo" else None
    card = Card(BENCH, servo_source=source)
    with embedded(card) as link:
        axis = Axis(link, BENCH, "test", simulated=True)
        if route == "servo":
            link.command("I159=1")
        axis.enable()
        context = context_of(axis, folder)
        deploy(axis, Compensation(route, LAW), context)
        axis.move_to(PLACE_ct)
        card.run_cycles(1000)
        yield axis, card, context


@pytest.mark.parametrize("place_ct", [5.0, 300.0, PLACE_ct], ids="{:.0f} counts".format)
@pytest.mark.parametrize("route", ["law", "servo"])
def test_a_register_set_anew_is_no_motion(tmp_path: Path, route: str, place_ct: float) -> None:
    """At 80 000 counts 180 m/s in one servo cycle; homed again it is a few counts."""
    with armed(route, tmp_path) as (axis, card, context):
        axis.move_to(place_ct)
        card.run_cycles(1000)
        before = law_state.read_law_head(axis.link, context.block)
        rest_Nm = outputs_Nm(axis, card, "", 20)
        after_Nm = outputs_Nm(axis, card, "#1HMZ", 200)
        head = law_state.read_law_head(axis.link, context.block)
        assert abs(head.position_ct) < 5.0
        assert np.max(np.abs(after_Nm - rest_Nm[-1])) < 0.5  # the fraction of a count, kicked away
        assert head.gain == 1.0
        assert head.correction_ct == pytest.approx(before.correction_ct, abs=0.2)
        assert head.friction_state == pytest.approx(before.friction_state, abs=0.1)
        # The next motion is one: the law goes on from there.
        axis.move_to(2_000.0)
        moved = law_state.read_law_head(axis.link, context.block)
        assert moved.friction_state > 0.3
        assert moved.n_clamped == before.n_clamped


@pytest.mark.parametrize("route", ["law", "servo"])
def test_a_home_search_runs_through_its_trigger(tmp_path: Path, route: str) -> None:
    with armed(route, tmp_path) as (axis, card, context):
        before = law_state.read_law_head(axis.link, context.block)
        # To the index of this revolution and back, at 20 mm/s.
        axis.link.write_buffer(["I7012=1", "I123=20", "I126=0"])
        search_Nm = outputs_Nm(axis, card, "#1HM", 3000)
        assert abs(float(axis.link.query("#1P")[0])) < 5.0
        head = law_state.read_law_head(axis.link, context.block)
        assert head.position_ct == pytest.approx(0.0, abs=5.0)
        assert np.max(np.abs(search_Nm)) < 2.0
        assert head.gain == 1.0
        assert head.n_clamped == before.n_clamped


@pytest.mark.parametrize("route", ["law", "servo"])
def test_a_motion_harder_than_the_bench_file_says_is_a_motion(tmp_path: Path, route: str) -> None:
    """Only a single step of the command is none: the law follows from the second cycle on."""
    with armed(route, tmp_path) as (axis, card, context):
        limit = law_goal.HARDER * context.limits.hardest_ct_per_s2 * BENCH.servo_period_s**2
        work = Index.WORK_PLC if route == "law" else Index.WORK_SERVO
        speed = context.block.p(work + WorkIndex.VELOCITY)
        axis.link.write_buffer(["I119=100", "I120=0", "I121=0", "I122=100"])  # a step of the speed
        axis.link.command("#1J+")
        found = []
        for _ in range(60):
            card.run_cycles(1)
            found.append(float(card.variables.read("P", speed)))
        assert np.max(np.abs(np.diff(found))) > 2.0 * limit
        assert found[-1] == pytest.approx(100e3 * BENCH.servo_period_s, rel=1e-3)
