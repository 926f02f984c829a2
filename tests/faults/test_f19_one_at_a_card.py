"""F19: one command at a time at a card, whatever folder or host it is started from."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from pmac_comp.base.errors import ControllerState, ForeignChange, LeaseHeld, SafetyRefusal
from pmac_comp.files.bench import load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.machine.controller.change.journals import new_transaction_id
from pmac_comp.machine.controller.change.lease import card_lock, read_lease
from pmac_comp.machine.controller.contents.law_bank import Index
from pmac_comp.machine.controller.tables.upload import upload_tables
from pmac_comp.machine.transport.url import card_address
from pmac_comp.simulator.card.card import Card
from pmac_comp.workflow.capture.at_work import at_work, measuring
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.axis_setup import AxisSetup
from pmac_comp.workflow.capture.context import context_of
from pmac_comp.workflow.capture.simulated import embedded, make_card
from pmac_comp.workflow.compensation.file import Compensation
from pmac_comp.workflow.controller.deploy import deploy
from pmac_comp.workflow.controller.removal import remove_from, standing_on
from pmac_comp.workflow.motion.motions import Motion, parse_motion
from pmac_comp.workflow.verification.runs import runs_of
from pmac_comp.workflow.verification.verify import alternating
from tests.compensations import friction_law, lead_map
from tests.faults.upload_bench import new_table

pytestmark = pytest.mark.faults
Count = Callable[[int], None]
BENCH = load_bench("paper")
URL = "tcp://card:1025"
MOTION = parse_motion("sine:amplitude_mm=3,frequency_Hz=4,cycles=4,centre_mm=40", BENCH)
TABLE = Compensation("table", friction_law(), lead_map())
LAW = Compensation("law", friction_law())
GATHERING = ("I5000=0", "I5050=1", "I5001=$80008B", "I5049=1", "DEFINE GATHER 1000", "GATHER")


@pytest.fixture
def card() -> Card:
    return make_card(BENCH)


@pytest.fixture
def axis(card: Card, tmp_path: Path) -> Iterator[Axis]:
    with embedded(card) as link:
        found = Axis(link, BENCH, "card", setup=AxisSetup(tmp_path / "here"))
        found.enable()
        yield found


def elsewhere(axis: Axis, folder: Path) -> Axis:
    """The same card by another terminal in another folder."""
    return Axis(axis.link, BENCH, "card", setup=AxisSetup(folder))


@pytest.mark.parametrize("url", [URL, "udp://CARD", "ssh://user@gateway/card:1025"])
def test_f19_another_folder_of_this_host_is_refused(
    axis: Axis, tmp_path: Path, url: str, count_runs: Count
) -> None:
    other = elsewhere(axis, tmp_path / "there")
    with measuring(axis, URL):
        axis.link.command("P7190=0")
        with pytest.raises(LeaseHeld, match="Another pmac-comp on this host") as refused:
            at_work(other, url).__enter__()
        assert refused.value.code == "PC-WRK-001"
        assert refused.value.left is ControllerState.OLD
        assert axis.link.query("P7190") == ["0"]
    with measuring(other, url):
        pass  # free again
    count_runs(1)


def test_a_card_is_named_by_host_and_port_or_by_its_device(tmp_path: Path) -> None:
    same = ("tcp://localhost:5001", "udp://127.0.0.1:5001", "tcp://127.0.0.1:5001?dialog=ascii")
    assert {card_address(url) for url in same} == {"127.0.0.1:5001"}
    link = tmp_path / "by-id"
    link.symlink_to(tmp_path / "tty")
    assert card_address(f"serial://{link}") == card_address(
        f"serial://{tmp_path / 'tty'}?baud=9600"
    )
    with card_lock("a"), card_lock("b"):
        pass


def test_f19_another_host_is_refused_throughout_a_measurement(
    axis: Axis, tmp_path: Path, count_runs: Count
) -> None:
    there = context_of(elsewhere(axis, tmp_path / "there"), tmp_path / "there")
    here = context_of(axis, tmp_path / "here")
    of_another = replace(new_table(40), motor=2, source=2, target=2)
    refused = 0

    def change_it() -> None:
        nonlocal refused
        with pytest.raises(LeaseHeld, match="Another command, on this host or another"):
            upload_tables(axis.link, there, [of_another])
        refused += 1

    with measuring(axis, URL):
        change_it()
        axis.run(MOTION)  # borrows axis definitions, which is a change of its own
        change_it()
        axis.link.clock.sleep_s(100.0)
        axis.run(MOTION)
        axis.link.clock.sleep_s(100.0)
        change_it()
        assert read_lease(axis.link, here).owner == here.owner
    assert read_lease(axis.link, here).is_free
    upload_tables(axis.link, there, [of_another])
    count_runs(refused)


@pytest.mark.parametrize("lines", [GATHERING, ("OPEN PROG 9 CLEAR",)], ids=["gather", "buffer"])
def test_f19_nothing_is_measured_beside_what_somebody_else_runs(
    axis: Axis, card: Card, lines: tuple[str, ...], count_runs: Count
) -> None:
    with embedded(card) as other:
        for line in lines:
            other.command(line)
        refused_beside(axis)
        other.write_buffer(["CLOSE", "ENDGATHER"])
    with measuring(axis, URL):
        pass
    count_runs(1)


def refused_beside(axis: Axis) -> None:
    with pytest.raises(SafetyRefusal, match=r"running|open") as refused:
        measuring(axis, URL).__enter__()
    assert refused.value.code in {"PC-UPL-020", "PC-UPL-021"}
    assert refused.value.left is ControllerState.OLD
    assert axis.link.query("P7078") == ["0"]


def test_f19_nothing_is_measured_while_a_motion_program_runs(axis: Axis, count_runs: Count) -> None:
    axis.link.write_buffer(["&1#1->X", "OPEN PROG 9 CLEAR", "DWELL5000", "CLOSE"])
    axis.link.command("&1B9R")
    with pytest.raises(SafetyRefusal, match="motion program runs"):
        measuring(axis, URL).__enter__()
    count_runs(1)


def test_what_a_killed_measurement_of_this_folder_left_is_taken_off_first(axis: Axis) -> None:
    with measuring(axis, URL):
        axis.run(MOTION)
        axis.setup = AxisSetup(axis.setup.store)  # as by SIGKILL: nothing is given back
        axis.link.write_buffer(list(GATHERING))
    with measuring(axis, URL):
        axis.run(MOTION)


def test_f29_nothing_begins_while_the_motion_of_a_killed_measurement_runs(
    axis: Axis, count_runs: Count
) -> None:
    with measuring(axis, URL):
        axis.run(MOTION)
        axis.setup = AxisSetup(axis.setup.store)  # as by SIGKILL: nothing is given back
    axis.link.write_buffer(["OPEN PROG 9 CLEAR", "DWELL5000", "CLOSE"])
    axis.link.command("&1B9R")
    with pytest.raises(SafetyRefusal, match="motion program runs") as refused:
        measuring(axis, URL).__enter__()
    assert "-c '&1A'" in refused.value.advice
    axis.link.command("&1A")
    axis.link.clock.sleep_s(0.1)
    with measuring(axis, URL):
        axis.run(MOTION)
    count_runs(1)


def took_it_off(axis: Axis, folder: Path) -> None:
    remove_from(axis, context_of(axis, folder), standing_on(axis))


def said_so(axis: Axis, folder: Path) -> None:
    del folder
    axis.link.command(f"P{7000 + Index.CHANGE}=-{new_transaction_id()}")


def switched(axis: Axis, folder: Path) -> None:
    del folder
    axis.link.command("I51=1-I51")


def disarmed(axis: Axis, folder: Path) -> None:
    del folder
    axis.link.command(f"P{7000 + Index.TARGET}=1-P{7000 + Index.TARGET}")


@pytest.mark.parametrize("side", [False, True], ids=["without", "with"])
@pytest.mark.parametrize("when", ["between", "during"])
@pytest.mark.parametrize(
    ("compensation", "act"),
    [
        (TABLE, took_it_off),
        (LAW, took_it_off),
        (TABLE, said_so),
        (TABLE, switched),
        (LAW, disarmed),
    ],
    ids=["table removed", "law removed", "changed", "I51", "gain"],
)
def test_f17_no_run_is_kept_with_another_compensation_than_it_says(
    *,
    axis: Axis,
    tmp_path: Path,
    compensation: Compensation,
    act: Callable[[Axis, Path], None],
    when: str,
    side: bool,
    count_runs: Count,
) -> None:
    """A change between runs is found before the next, one during a run before it is kept."""
    if when == "between" and act in {switched, disarmed}:
        pytest.skip("each run sets it anew")
    context = context_of(axis, tmp_path / "here")
    deploy(axis, compensation, context)
    at = int(side)  # runs before
    kept: list[Capture] = []
    run, there = axis.run, tmp_path / "there"

    def disturbed(motion: Motion) -> Capture:
        if when == "during" and len(kept) == at:
            act(axis, there)
        return run(motion)

    def keep(capture: Capture) -> None:
        kept.append(capture)
        if when == "between" and len(kept) == at:
            act(axis, there)

    axis.run = disturbed  # type: ignore[method-assign, assignment]
    runs = runs_of(axis, context, compensation, [MOTION])
    if when == "between" and not at:
        act(axis, there)
    with pytest.raises(ForeignChange, match="was changed") as refused:
        list(alternating(runs, [(MOTION, 1)], {}, None, keep))
    assert refused.value.code == "PC-WRK-003"
    assert len(kept) == at
    count_runs(1)


def test_nothing_is_found_where_nobody_came(axis: Axis, tmp_path: Path) -> None:
    context = context_of(axis, tmp_path / "here")
    deploy(axis, TABLE, context)
    kept: list[Capture] = []
    with measuring(axis, URL):
        runs = runs_of(axis, context, TABLE, [MOTION])
        list(alternating(runs, [(MOTION, 2)], {}, None, kept.append))
    assert len(kept) == 4
