"""Every file of firmware_plc on the simulated card: downloaded, listed back, executed."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pmac_comp.base.errors import InternalError, MotorNotSafe, SafetyRefusal
from pmac_comp.files.bench import load_bench
from pmac_comp.files.resources import data_folder, firmware_path
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.processor_load import read_load
from pmac_comp.machine.controller.change import lease
from pmac_comp.machine.controller.contents import programs
from pmac_comp.machine.controller.contents.law_bank import (
    BankIndex,
    Index,
    LawBlock,
    LawParameters,
    WorkIndex,
    evaluate,
)
from pmac_comp.machine.controller.gather import gather
from pmac_comp.machine.controller.gather.gather_plan import GatherPlan, GatherSource, bench_sources
from pmac_comp.machine.controller.gather.gather_samples import GatherResult
from pmac_comp.machine.controller.law import (
    law_arming,
    law_cost,
    law_goal,
    law_install,
    law_state,
    law_upload,
)
from pmac_comp.machine.controller.motors import motion
from pmac_comp.physics.compensate.evaluation import WOUND_FADE, WOUND_YIELD
from pmac_comp.simulator.card.card import Card
from tests.unit.machine_controller.card_bench import (
    AXIS_LINES,
    CardBench,
    make_plc_bench,
    program_of,
)

UNIT = 3072.0  # 32 * I108


def download_source(link: Link, found: programs.Source) -> None:
    """Send the commands of a file, then its programs, each verified."""
    if found.commands:
        link.write_buffer(list(found.commands))
    for program in found.programs:
        programs.download(link, program)


def source(name: str, **options: int) -> programs.Source:
    text = firmware_path(name).read_text(encoding="utf-8")
    return programs.parse_source(programs.render(text, **options))


@pytest.mark.parametrize(
    "name",
    [p.name for p in sorted(data_folder("firmware_plc").iterdir()) if p.suffix != ".txt"],
)
def test_each_file_lists_back_token_by_token(tmp_path: Path, name: str) -> None:
    bench = CardBench(tmp_path)
    found = source(name)
    download_source(bench.link, found)
    for program in found.programs:
        assert programs.is_present(bench.link, program)
        lines = programs.listing(bench.link, program.kind, program.number)
        assert lines is not None
        assert len(programs.canonical(lines)) == len(program.tokens)


def test_a_changed_token_is_found(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    guard = source("comp_guard.plc").program
    other = programs.Program(guard.kind, guard.number, (*guard.lines[:-1], "P7081=3", "ENDIF"))
    programs.download(bench.link, other)
    assert not programs.is_present(bench.link, guard)


def test_setup_points_the_definitions_where_the_law_reads(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    download_source(bench.link, source("bench_setup.pmc"))
    answers = bench.link.query("M7000->M7001->M7002->I5003I5006")
    assert answers == ["X:$0,24", "D:$88", "X:$10F8,24,S", "$80010B", "$4000BF"]


def test_guard_switches_tables_off_while_the_manifest_says_writing(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    download_source(bench.link, source("bench_setup.pmc"))
    download_source(bench.link, source("comp_guard.plc"))
    bench.link.command("ENABLE PLC 1")
    bench.clock.sleep_s(0.1)
    scans = bench.p(7080)
    assert scans > 0
    bench.link.command("P7071=1")
    bench.link.command("I51=1")
    before = bench.p(7080)
    while bench.i51:
        bench.card.run_cycles(1)
    assert bench.p(7080) - before <= 5
    assert bench.p(7081) == 1
    assert bench.p(7082) == 1


def test_guard_reports_an_expired_lease(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    download_source(bench.link, source("bench_setup.pmc"))
    download_source(bench.link, source("comp_guard.plc"))
    end = lease.read_clock(bench.link) + 300
    bench.link.write_buffer(["ENABLE PLC 1", f"P7079={end}", "P7078=5"])
    bench.clock.sleep_s(0.2)
    assert bench.p(7081) == 0
    bench.clock.sleep_s(0.15)
    assert bench.p(7081) == 2


LAW = LawParameters(
    A0=11.3, V0=0.0087, S0=0.93, RF=0.004, C1=3e-6, S_INV=0.05, NR=0.072, GL=0.3, TG=-35.0,
    TJ=2.0, TK=0.7, TB=0.31, TC=400.0, J0=3.0, L1=2.5, JL=0.003, T_INV=0.1, T0=5.0,
    GH=2.5, TE=0.9, T_LIMIT=9000.0, GB=0.4, GW=1.5, TR=60.0, PR=25.0, TH=40.0, NH=0.72, PH=-70.0,
    BS=1.4, BD=0.003, BO=0.004, BT=45.0, SX=0.8, TX=150.0, SS=0.13, TP=0.02, TI=-1.5, UF=0.007,
    TF=220.0, TL=-160.0,
)  # fmt: skip


# Without a clearance, whose places in the bank hold friction that differs by direction.
UNEVEN = replace(LAW, GH=0.0, GW=0.0, GB=0.0, GL=1.0, TG=0.0, VU=0.0061, TU=0.22)
RIPPLING = replace(UNEVEN, TR=0.0, RS=0.2, RT=12.0, RV=3.0)  # and torque that ripples in proportion
NO_BED = replace(LAW, BS=0.0, BD=0.0, BO=0.0, BT=0.0, SL=0.75)  # where friction may lag
LOOSE_RIPPLING = replace(NO_BED, TR=0.0, RS=0.2, RT=12.0, RV=3.0)  # beside a clearance
_DRAG = {
    "BS": -900.0,
    "BD": 0.8,
    "BO": 0.0,
    "BT": 45.0,
    "TP": 0.0,
    "SL": 0.75,
}  # in the places of the bed
SMOOTH = replace(UNEVEN, SX=-UNEVEN.S0, TX=-UNEVEN.TC, BS=0.0, BD=0.0, BO=0.0, BT=0.0, SL=0.6)
DRAGGING, LOOSE_DRAGGING = replace(UNEVEN, **_DRAG), replace(LAW, **_DRAG)


def run_with_law(bench: CardBench, law: LawParameters) -> GatherResult:
    law_upload.upload_law(bench.link, bench.context, law)
    law_arming.arm(bench.link, bench.context)
    return gathered_motion(bench)


def gathered_motion(bench: CardBench) -> GatherResult:
    time = np.arange(0, 0.8, bench.bench.servo_period_s)
    ramp = np.clip(time / 0.2, 0, 1) * np.clip((0.8 - time) / 0.2, 0, 1)
    path = 3000 * np.sin(2 * np.pi * 4 * time) * ramp**2 * (3 - 2 * ramp)
    program = program_of(path, bench.bench)
    bench.link.write_buffer(AXIS_LINES)
    programs.download(bench.link, program)
    sources = (*bench_sources(1, 2), GatherSource("word", 0x4010F8))
    ring = GatherPlan(sources)

    def go() -> None:
        motion.start(bench.link, program.number)

    result = gather.gather_ring(bench.link, ring, 3.5, bench.bench.servo_period_s, during=go)
    motion.wait_for_end(bench.link, timeout_s=5.0)
    return result.require_whole()


@pytest.mark.parametrize(
    "law", [LAW, UNEVEN, DRAGGING, SMOOTH], ids=["clearance", "uneven", "drag", "smooth"]
)
def test_plc_form_computes_the_law_of_the_reference(tmp_path: Path, law: LawParameters) -> None:
    bench = make_plc_bench(tmp_path)
    law_install.install_law(bench.link, bench.context, 1)
    result = run_with_law(bench, law)
    commanded = result.raw["commanded"] / UNIT
    assert np.ptp(commanded) > 4000
    expected = evaluate(law, commanded, clamp_ct=60.0)
    assert expected.n_clamped == 0
    # The gathered word is what PLC 0 wrote after the cycle: within half a unit of 1/1024 count.
    word = result.raw["word"] / 1024.0
    shift = find_shift(word, expected.correction_ct)
    assert shift in {0, 1}
    n = len(word) - shift
    deviation = word[shift:] - expected.correction_ct[:n]
    # States of the friction before the record started are not known to the reference.
    settled = np.flatnonzero(np.abs(commanded - commanded[0]) > 500)[0]
    assert np.max(np.abs(deviation[settled : n - shift])) < 0.03
    assert np.max(np.abs(word)) > 4.0


def in_passes(law: LawParameters, n: int) -> LawParameters:
    """The law as it reads where a pass of n servo cycles is the unit of time."""
    powers = {"A0": 2, "V0": 1, "J0": 3, "L1": 1, "JL": -3, "TJ": 2, "TK": 3, "TI": 3, "TB": 1,
              "TE": 2, "RF": -1, "UF": -1, "VU": 1, "TU": 1, "RT": 2, "RV": 1, "TF": 1,
              "TL": 1}  # fmt: skip
    powers |= {} if law.drags else {"BS": 2}
    return replace(law, **{k: getattr(law, k) / n**power for k, power in powers.items()})


def deviation_ct(result: GatherResult, law: LawParameters, n: int) -> np.ndarray:
    """Correction sent less that of the reference at the passes in motion, once it is settled.

    At rest the reference fades friction by passes, the card by servo cycles.
    """
    commanded = result.raw["commanded"] / UNIT
    word = result.raw["word"] / 1024.0
    tried = []
    for phase in range(n):
        at = commanded[phase::n]
        use = np.abs(np.diff(at, prepend=at[0])) > 0.01
        use[: int(np.flatnonzero(np.abs(at - at[0]) > 500)[0])] = False
        expected = evaluate(in_passes(law, n), at, clamp_ct=60.0).correction_ct
        for shift in range(4):
            sent = word[phase + shift :: n]
            size = min(sent.size, expected.size)
            tried.append((sent[:size] - expected[:size])[use[:size]])
    return min(tried, key=lambda left: float(np.max(np.abs(left))))


@pytest.mark.parametrize(
    "law", [LAW, UNEVEN, DRAGGING, SMOOTH], ids=["clearance", "uneven", "drag", "smooth"]
)
def test_plc_form_of_every_second_cycle_computes_the_same_law(
    tmp_path: Path, law: LawParameters
) -> None:
    bench = make_plc_bench(tmp_path)
    law_install.install_law(bench.link, bench.context, 1, every_cycles=2)
    # Of a bed, a gap's lag and Stribeck's speed the bank holds figures by the pass.
    law = law if law.drags else replace(law, BS=0.0, BD=0.0, BO=0.0, BT=0.0)
    left = deviation_ct(run_with_law(bench, law), law, 2)
    assert np.max(np.abs(left)) < 0.03


def test_a_pass_that_is_late_sees_the_same_motion(tmp_path: Path) -> None:
    bench = make_plc_bench(tmp_path)
    law_install.install_law(bench.link, bench.context, 1)
    smooth = LawParameters(A0=11.3, V0=0.0087, C1=3e-6, S_INV=0.05, T_INV=0.1, JL=1.0)
    law_upload.upload_law(bench.link, bench.context, smooth)
    law_arming.arm(bench.link, bench.context)
    bench.link.command("I8=2")  # passes come every third cycle, and were meant for each
    result = gathered_motion(bench)
    left = deviation_ct(result, smooth, 3)
    assert np.max(np.abs(result.raw["word"])) > 1.5 * 1024
    assert np.max(np.abs(left)) < 0.05


def make_servo_bench(tmp_path: Path) -> CardBench:
    """A card whose motor 1 runs through the open servo."""
    servo = firmware_path("feedforward_servo.txt").read_text(encoding="utf-8")
    bench = CardBench(tmp_path, card=Card(load_bench("paper"), servo_source=servo))
    bench.link.command("I159=1")
    bench.link.command("#1J/")
    law_install.require_open_servo(bench.link, bench.context, 1)
    return bench


PUSHING = replace(LAW, NR=-LAW.NR)  # two coggings instead of one and a friction by the turn
WOBBLING = replace(LAW, TR=-0.03)  # against the wobble of the lead: by the speed cubed
each_law = pytest.mark.parametrize(
    "law",
    [LAW, PUSHING, WOBBLING, UNEVEN, RIPPLING, LOOSE_RIPPLING, DRAGGING, LOOSE_DRAGGING],
    ids=[
        "friction by the turn",
        "second cogging",
        "wobble",
        "uneven",
        "ripple",
        "ripple beside clearance",
        "drag",
        "drag beside clearance",
    ],
)


@each_law
def test_plc_form_sends_the_torque_of_the_reference(tmp_path: Path, law: LawParameters) -> None:
    bench = make_plc_bench(tmp_path)
    law_install.install_law(bench.link, bench.context, 1)
    law_upload.upload_law(bench.link, bench.context, law)
    law_arming.arm(bench.link, bench.context)
    commanded, (_, torque) = stepped_motion(bench, 7122, 7124)
    expected, other = (
        evaluate(one, commanded, clamp_ct=60.0, latency_cycles=1).torque_dac
        for one in (law, replace(law, NR=-law.NR))
    )
    moving = slice(int(np.flatnonzero(np.abs(commanded) > 500)[0]), None)
    shift = min(range(3), key=lambda k: off(torque, expected, k, moving))
    assert off(torque, expected, shift, moving) < 2.0
    assert off(torque, other, shift, moving) > 20.0


@pytest.mark.parametrize("form", ["law", "servo"])
def test_what_stands_against_the_integrator_does_not_ripple(tmp_path: Path, form: str) -> None:
    # It pushes nothing, together with what the integrator holds: a share of it would be too much.
    if form == "law":
        bench, torque, held = make_plc_bench(tmp_path), 7124, 7130
        law_install.install_law(bench.link, bench.context, 1)
    else:
        bench, torque, held = make_servo_bench(tmp_path), 7140, 7123
    law_upload.upload_law(bench.link, bench.context, RIPPLING)
    law_arming.arm(bench.link, bench.context)
    bench.link.command(f"P{held}=3000")
    commanded, (against, sent) = stepped_motion(bench, held, torque)
    expected = evaluate(RIPPLING, commanded, clamp_ct=60.0).torque_dac
    moving = slice(int(np.flatnonzero(np.abs(commanded) > 500)[0]), None)
    assert np.min(against[moving]) > 300.0
    assert min(off(sent - against, expected, k, moving) for k in range(3)) < 2.0


@pytest.mark.parametrize("form", ["law", "servo"])
def test_the_table_s_friction_fades_at_rest_as_its_bank_says(tmp_path: Path, form: str) -> None:
    if form == "law":
        bench, work = make_plc_bench(tmp_path), Index.WORK_PLC
        law_install.install_law(bench.link, bench.context, 1)
    else:
        bench, work = make_servo_bench(tmp_path), Index.WORK_SERVO
    used = set()
    for fade, way in ((0.002, 3000), (0.012, -3000)):
        law_upload.upload_law(bench.link, bench.context, replace(LAW, UF=fade))
        law_arming.arm(bench.link, bench.context)
        used.add(law_state.read_law_head(bench.link, bench.context.block).bank_in_use)
        bench.link.command(f"#1J:{way}")
        states = []
        for _ in range(1200):
            bench.card.run_cycles(1)
            states.append(abs(bench.p(7000 + work + WorkIndex.STATE)))
        # A hundred cycles; at first the acceleration that the law follows still comes to rest.
        last = int(np.flatnonzero(np.diff(states))[-1])
        assert states[last] == pytest.approx(states[last - 40] * (1.0 - fade) ** 40, rel=1e-6)
        assert 0.1 < states[-1] < 0.999 * max(states)
    assert used == {0, 1}


@pytest.mark.parametrize("form", ["law", "servo"])
def test_after_a_hard_end_the_correction_lets_go_and_after_a_soft_one_it_stays(
    tmp_path: Path, form: str
) -> None:
    if form == "servo":
        bench, correction, work = make_servo_bench(tmp_path), 7139, Index.WORK_SERVO
    else:
        bench, correction, work = make_plc_bench(tmp_path), 7122, Index.WORK_PLC
        law_install.install_law(bench.link, bench.context, 1)
    law = replace(NO_BED, GH=0.0, GW=0.0, GB=0.0, GL=1.0, TG=0.0, UF=0.02, JL=1.0)
    law_upload.upload_law(bench.link, bench.context, law)
    law_arming.arm(bench.link, bench.context)
    left = []
    for acceleration_ms in (20, 2000):
        bench.link.command(f"I120={acceleration_ms}I121={acceleration_ms // 2}")
        bench.link.command("#1J^6000")
        commanded, sent, states = [], [], []
        for _ in range(12_000):
            bench.card.run_cycles(1)
            commanded.append(bench.card.variables.read("M", 161) / UNIT)
            sent.append(bench.p(correction))
            states.append(bench.p(7000 + work + WorkIndex.STATE))
        assert len(set(commanded[-300:])) == 1
        expected = evaluate(law, np.array(commanded), clamp_ct=60.0).correction_ct
        assert sent[-200:] == pytest.approx(expected[-200:], abs=0.03)
        left.append(states[-1] / max(states))
    assert left[0] < 0.3
    assert left[1] > 0.8


@pytest.mark.parametrize("form", ["law", "law, every second cycle", "servo"])
def test_torque_against_the_integrator_gives_way_at_rest_where_it_pushes_as_friction(
    tmp_path: Path, form: str
) -> None:
    if form == "servo":
        bench, work, held = make_servo_bench(tmp_path), Index.WORK_SERVO, 7123
    else:
        bench, work, held = make_plc_bench(tmp_path), Index.WORK_PLC, 7130
        law_install.install_law(bench.link, bench.context, 1)
    every = 2 if "second" in form else 1
    bench.link.command(f"I8={every - 1}")
    # Without a look ahead, whose acceleration would turn the friction state as it comes to rest.
    law_upload.upload_law(bench.link, bench.context, replace(LAW, L1=0.0))
    law_arming.arm(bench.link, bench.context)
    breaks = LAW.TC + LAW.TX
    for way, with_friction in ((6000, True), (-6000, True), (6000, False)):
        bench.link.command(f"#1J^{way}")
        bench.card.run_cycles(60)
        bench.link.command(f"P{held}={way if with_friction else -way}")
        kept, state = [], []
        for _ in range(600):
            bench.card.run_cycles(every)
            kept.append(bench.p(held))
            state.append(bench.p(7000 + work + WorkIndex.TORQUE_STATE))
        assert kept[21] / kept[20] == pytest.approx(WOUND_FADE, abs=1e-9)
        last = int(np.flatnonzero(np.diff(state))[-1])
        # Not as long as a motion would begin by what the law knows: between short moves it stays.
        assert np.diff(kept)[last - 40 : last] == pytest.approx(0.0)
        rest = slice(last + 2, last + 42)
        goes = WOUND_YIELD * every * breaks * np.array(state[rest]) if with_friction else 0.0
        assert np.diff(kept)[rest] == pytest.approx(-goes, rel=1e-6)
        assert kept[-1] == kept[last + 104]
        bench.clock.sleep_s(0.3)


def off(sent: np.ndarray, expected: np.ndarray, shift: int, use: slice) -> float:
    """Largest deviation from an expectation that comes some cycles later."""
    return float(np.max(np.abs(sent[shift:] - expected[: expected.size - shift])[use]))


def stepped_motion(bench: CardBench, correction: int, torque: int) -> tuple[np.ndarray, np.ndarray]:
    """Commanded position in counts and what two P-variables held, cycle by cycle."""
    path = 2000 * (1 - np.cos(2 * np.pi * np.arange(0, 0.5, bench.bench.servo_period_s) / 0.5))
    program = program_of(path, bench.bench)
    bench.link.write_buffer(AXIS_LINES)
    programs.download(bench.link, program)
    motion.start(bench.link, program.number)
    commanded, sent = [], []
    for _ in range(6000):
        bench.card.run_cycles(1)
        commanded.append(bench.card.variables.read("M", 161) / UNIT)
        sent.append((bench.p(correction), bench.p(torque)))
    return np.array(commanded), np.array(sent).T


@each_law
def test_servo_form_computes_the_law_of_the_reference(tmp_path: Path, law: LawParameters) -> None:
    bench = make_servo_bench(tmp_path)
    law_upload.upload_law(bench.link, bench.context, law)
    law_arming.arm(bench.link, bench.context)
    commanded, (correction, torque) = stepped_motion(bench, 7139, 7140)
    assert np.ptp(commanded) > 3900
    expected = evaluate(law, commanded, clamp_ct=60.0)
    moving = np.flatnonzero(np.abs(commanded) > 500)[0]
    assert np.max(np.abs(correction - expected.correction_ct)[moving:]) < 0.03
    assert np.max(np.abs(torque - expected.torque_dac)[moving:]) < 2.0


def test_two_algorithms_are_refused(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    with pytest.raises(SafetyRefusal, match="open servo does not run"):
        law_install.require_open_servo(bench.link, bench.context, 1)
    bench.link.command("I159=1")
    with pytest.raises(MotorNotSafe, match="correct twice"):
        law_install.install_law(bench.link, bench.context, 1)


def find_shift(a: np.ndarray, b: np.ndarray) -> int:
    return min(range(4), key=lambda k: float(np.sum((a[k:] - b[: len(b) - k]) ** 2)))


def test_plc_form_clamps_and_limits_by_itself(tmp_path: Path) -> None:
    bench = make_plc_bench(tmp_path)
    law_install.install_law(bench.link, bench.context, 1)
    wild = LawParameters(
        A0=5000.0, V0=3.0, S0=20.0, S_INV=0.05, TC=30000.0, T_INV=1, T_LIMIT=300, JL=1.0
    )
    result = run_with_law(bench, wild)
    assert np.max(np.abs(result.raw["word"])) <= 60 * 1024 + 1
    assert law_state.read_law_head(bench.link, LawBlock()).n_clamped > 0
    assert abs(bench.card.variables.read_i(129)) <= 300


def test_a_killed_motor_gets_no_correction_and_no_torque(tmp_path: Path) -> None:
    bench = make_plc_bench(tmp_path)
    law_install.install_law(bench.link, bench.context, 1)
    law_upload.upload_law(bench.link, bench.context, LawParameters(T0=200.0, T_LIMIT=500.0))
    law_arming.arm(bench.link, bench.context)
    assert bench.card.variables.read_i(129) == 200
    bench.link.command("#1K")
    bench.clock.sleep_s(0.01)
    assert bench.card.variables.read_i(129) == 0
    head = law_state.read_law_head(bench.link, LawBlock())
    assert head.gain == 0
    assert head.bank_in_use is None


def test_heartbeat_lost_ramps_the_gain_down(tmp_path: Path) -> None:
    bench = make_plc_bench(tmp_path)
    law_install.install_law(bench.link, bench.context, 1)
    law_upload.upload_law(bench.link, bench.context, LawParameters(T0=200.0, T_LIMIT=500.0))
    law_arming.arm(bench.link, bench.context)
    bench.link.command("P7005=500")
    bench.clock.sleep_s(0.1)
    assert bench.p(7003) == 1.0
    bench.clock.sleep_s(1.0)
    assert bench.p(7003) == 0.0
    assert bench.p(7002) == 0.0


def test_an_unsealed_bank_is_never_taken_over(tmp_path: Path) -> None:
    bench = make_plc_bench(tmp_path)
    law_install.install_law(bench.link, bench.context, 1)
    law_upload.upload_law(bench.link, bench.context, LawParameters(T0=200.0, T_LIMIT=500.0))
    law_arming.arm(bench.link, bench.context)
    bench.link.write_buffer(["P7010=9", "P7026=800", "P7031=800", "P7001=0"])
    for _ in range(60):
        bench.card.run_cycles(30)
        assert abs(bench.card.variables.read_i(129)) <= 200
    assert bench.p(7003) == 0.0


def test_the_old_law_ends_the_ramp_where_the_new_bank_is_not_sealed(tmp_path: Path) -> None:
    bench = make_plc_bench(tmp_path)
    law_install.install_law(bench.link, bench.context, 1)
    run_with_law(bench, LAW)

    def sent_ct() -> float:
        return bench.p(7003) * bench.p(7122)

    sent = [sent_ct()]
    assert abs(sent[0]) > 0.2
    bench.link.command("P7001=1-P7001")
    for _ in range(600):
        bench.card.run_cycles(1)
        assert bench.p(7168) == pytest.approx(1.0 / LAW.S_INV)
        assert bench.p(7175) == pytest.approx(1.0 / LAW.T_INV)
        sent.append(sent_ct())
    assert bench.p(7120) == -2.0
    assert abs(sent[-1]) < abs(sent[0])
    assert np.max(np.abs(np.diff(sent))) < 0.05


@pytest.mark.parametrize("name", ["motion_sine.pmc", "motion_trapezoid.pmc", "motion_pvt.pmc"])
def test_motion_files_run_and_come_back(tmp_path: Path, name: str) -> None:
    bench = make_plc_bench(tmp_path)
    parameters = {
        "motion_sine.pmc": ["P7190=0", "P7191=4000", "P7192=500", "P7193=2"],
        "motion_trapezoid.pmc": [
            "P7190=0", "P7191=3000", "P7192=20000", "P7193=1", "P7194=100", "P7195=15", "P7196=100"
        ],
        "motion_pvt.pmc": [],
    }  # fmt: skip
    expected = {
        "motion_sine.pmc": 4000,
        "motion_trapezoid.pmc": 3000,
        "motion_pvt.pmc": 1000,
    }
    found = source(name)
    download_source(bench.link, found)
    bench.link.write_buffer(["I5190=1000", "I5113=0", "I42=0", *parameters[name]])
    motion.start(bench.link, found.program.number)
    highest = 0.0
    for _ in range(400):
        bench.card.run_cycles(23)
        highest = max(highest, float(bench.link.query("#1P")[0]))
        if not motion.program_status(bench.link).running:
            break
    assert not motion.program_status(bench.link).run_time_error
    assert highest == pytest.approx(expected[name], rel=0.02)
    bench.clock.sleep_s(0.3)
    assert abs(float(bench.link.query("#1P")[0])) < 20


def variables_of(name: str) -> set[int]:
    """Variables of the block that a firmware file's statements name, parameters included."""
    text = firmware_path(name).read_text(encoding="utf-8")
    lines = (line.partition(";")[0] for line in text.splitlines())
    return {int(n) for line in lines for n in re.findall(r"(?<![A-Z])P(7[01]\d\d)\b", line)}


def test_motions_and_homing_share_no_variable_with_the_law() -> None:
    # A sinusoid that ran beside an armed law used to overwrite its bed, homing its bank.
    moving = variables_of("homing.plc")
    for name in ("motion_sine.pmc", "motion_trapezoid.pmc", "motion_pvt.pmc"):
        moving |= variables_of(name)
    law = variables_of("feedforward_law.plc0") | variables_of("feedforward_servo.txt")
    block = LawBlock()
    last = max(BankIndex)
    law |= {block.bank(bank, k) for bank in (0, 1) for k in range(last + 1)}
    assert len(law) > 100
    assert min(moving) == 7190
    assert not moving & law
    kept = {block.bank(bank, k) for bank in (0, 1) for k in range(last + 1)}
    assert len(kept) == 2 * (last + 1)  # no two values of the banks in one place
    written = {7000 + n for n in (*range(70, 84), *range(10))}
    assert not kept & written  # manifest, lease and head


def test_files_move_to_another_block_and_motor() -> None:
    moved = source("feedforward_law.plc0", motor=3, first_p=6000)
    text = "\n".join(moved.program.lines)
    assert "P70" not in text
    assert "P6113" in text
    assert "I329" in text
    setup = source("bench_setup.pmc", motor=3, scale_motor=5).commands
    assert {"M7001->D:$188", "M7010->D:$28B", "M7002->X:$10F8,0,24,S"} <= set(setup)
    assert {"I5001=$800188", "I5003=$80028B", "I5005=$400000", "I5006=$4001BF"} <= set(setup)
    cleared = programs.render("P7000..7199=0 M7000=P7010", first_p=3000)
    assert cleared == "P3000..3199=0 M7000=P3010\n"


def test_plc_form_leaves_the_scratch_alone_by_which_an_open_servo_is_known() -> None:
    block = LawBlock()
    scratch = block.p(Index.SCRATCH_SERVO)
    statements = "\n".join(law_goal.law_program(block, 1).lines)
    assert f"P{block.p(Index.COPY)}=" in statements
    assert f"P{scratch}" not in statements
    servo = firmware_path("feedforward_servo.txt").read_text(encoding="utf-8")
    assert servo.count(f"\nP{scratch}=") > 1


def test_cost_of_the_law_is_counted() -> None:
    without_gap = {"uneven", "ripple"}  # a law has these or a gap
    parts = {"friction_per_turn", "cogging", "place", "gap", "bed", "stribeck", "wobble"}
    parts |= without_gap | {"drag"}  # that one or a bed
    plain = law_cost.operation_count(parts)
    assert plain > 60
    assert plain < 0.5 * law_cost.operation_count()
    period = 442e-6 * 80e6  # CPU cycles of a servo period at 80 MHz
    # All that a law may have at once: every second cycle.
    of_gap = ({"uneven", "ripple", "wobble"}, {"uneven", "bed", "friction_per_turn", "wobble"})
    of_turn = ({"gap", "ripple", "wobble"}, {"gap", "ripple", "friction_per_turn"})
    for has_bed_or_neither in (*of_gap, *of_turn, {"gap", "friction_per_turn", "wobble"}):
        lacking = {*has_bed_or_neither, "drag"}
        operations = law_cost.operation_count(lacking)
        assert law_cost.law_cost_cycles(lacking) == pytest.approx(240.0 * operations)
        assert 0.5 * 240.0 * operations < 0.84 * period
        # What a law does not have is passed over, at the price of a test.
        assert plain < 0.6 * operations
        for part in parts - lacking:
            assert plain < law_cost.operation_count({*lacking, part}) < operations
    # Torque by the turn or a gap fit into every cycle, beside phase, servo and background tasks; a
    # bed does not.
    of_turn = ({"friction_per_turn", "cogging"}, {"wobble", "cogging"}, {"ripple", "stribeck"})
    alone = (*of_turn, {"gap"}, {"uneven"}, {"drag"}, {"cogging", "stribeck"})
    for has in alone:
        assert law_cost.law_cost_cycles(parts - has) < 0.84 * period


@pytest.mark.parametrize("parts", [frozenset(), frozenset({"gap", "bed", "stribeck"})])
def test_cost_of_the_open_servo_is_what_the_card_takes(
    tmp_path: Path, parts: frozenset[str]
) -> None:
    """Task times of a card whose law moves, over those of the same loop without a law."""
    bench = make_servo_bench(tmp_path)
    zero = {
        "gap": {"GH": 0.0, "GW": 0.0, "GB": 0.0, "GL": 1.0, "TG": 0.0},
        "bed": {"BS": 0.0, "BT": 0.0},
        "stribeck": {"SS": 0.0},
    }
    lacking = {*(zero.keys() - parts), "uneven", "ripple", "wobble"}
    law = replace(LAW, **{k: v for part in zero.keys() - parts for k, v in zero[part].items()})
    law_upload.upload_law(bench.link, bench.context, law)
    law_arming.arm(bench.link, bench.context)
    bench.link.command("#1J=20000")
    bench.clock.sleep_s(0.1)
    with_law = read_load(bench.link, bench.bench.servo_period_s)
    bench.link.command("P7007=0")
    bench.clock.sleep_s(0.01)
    without = read_load(bench.link, bench.bench.servo_period_s)
    assert with_law is not None
    assert without is not None
    counted = with_law.share_frac(law_cost.servo_cost_cycles(lacking), 1)
    assert with_law.servo_frac - without.servo_frac == pytest.approx(counted, rel=0.15)
    assert with_law.foreground_frac < 0.95  # with everything it fits


@pytest.mark.parametrize(
    ("tests", "count"),
    [("_TESTS", law_cost.operation_count), ("_SERVO_TESTS", law_cost.servo_operation_count)],
)
def test_a_test_that_the_program_no_longer_has_is_no_cost_but_a_bug(
    monkeypatch: pytest.MonkeyPatch, tests: str, count: Callable[[], int]
) -> None:
    assert count() > 0
    gone = "IF(P7120!=P7099)"  # as where a guard of the firmware was changed and its text here not
    monkeypatch.setattr(law_cost, tests, {*getattr(law_cost, tests), gone})
    with pytest.raises(InternalError, match=r"IF\(P7120!=P7099\)") as told:
        count()
    assert told.value.code == "PC-BUG-002"


def test_homing_without_a_trigger_gives_up_in_time(tmp_path: Path) -> None:
    bench = CardBench(tmp_path)
    download_source(bench.link, source("bench_setup.pmc"))
    download_source(bench.link, source("homing.plc"))
    bench.link.write_buffer(["I123=10", "I7012=2", "I7013=0", "P7199=700", "ENABLE PLC 2"])
    bench.clock.sleep_s(0.9)
    assert bench.p(7190) == 1
    assert float(bench.link.query("#1P")[0]) > 100
    bench.clock.sleep_s(1.5)
    assert bench.p(7190) == 3


def homing_bench(folder: Path, *settings: str) -> CardBench:
    bench = CardBench(folder)
    download_source(bench.link, source("bench_setup.pmc"))
    download_source(bench.link, source("homing.plc"))
    bench.link.write_buffer([*settings, "P7199=20000", "ENABLE PLC 2"])
    return bench


@pytest.mark.parametrize(
    ("settings", "zero_mm"),
    [
        # home switch 10 mm before the negative end; index once a revolution
        (("I123=-100", "I7012=2", "I7013=0"), -290.0),
        (("I123=10", "I7012=1", "I126=0"), 10.0),
    ],
)
def test_homing_finds_its_trigger_and_ends_at_rest_there(
    tmp_path: Path, settings: tuple[str, ...], zero_mm: float
) -> None:
    bench = homing_bench(tmp_path, *settings)
    for _ in range(100):
        bench.clock.sleep_s(0.1)
        if bench.p(7190) != 1:
            break
    assert bench.p(7190) == 2
    assert abs(float(bench.link.query("#1P")[0])) < 10
    assert bench.link.query("M7011M7012M7015") == ["1", "1", "0"]
    counts_per_mm = bench.bench.encoder.counts_per_rev / bench.bench.screw.pitch_mm
    encoder_ct = int(bench.link.query("RX:$78001")[0])
    assert encoder_ct == pytest.approx(zero_mm * counts_per_mm, abs=60)


def test_homing_leaves_a_killed_motor_killed(tmp_path: Path) -> None:
    bench = homing_bench(tmp_path, "I123=-10", "I7012=2", "I7013=0")
    bench.clock.sleep_s(1.0)
    assert bench.p(7190) == 1
    bench.link.command("#1K")
    bench.clock.sleep_s(0.5)
    assert bench.p(7190) == 3
    assert bench.link.query("M7003") == ["1"]
