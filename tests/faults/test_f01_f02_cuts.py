"""F01, F02: the connection is cut at every byte of an upload, in both directions."""

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import pytest

from pmac_comp.base.errors import ControllerState, PmacCompError
from pmac_comp.machine.controller.change import journals
from pmac_comp.machine.transport.tap import Fault, FaultKind, Way
from tests.fault_table import all_of
from tests.faults.same_state import stand_ins
from tests.faults.upload_bench import SameIds, UploadBench
from tests.unit.machine_controller.card_bench import CardBench

pytestmark = pytest.mark.faults
Count = Callable[[int], None]


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[UploadBench]:
    with pytest.MonkeyPatch.context() as patch:
        ids = SameIds()
        patch.setattr(journals, "secrets", ids)
        yield UploadBench(tmp_path_factory.mktemp("cuts"), ids=ids)


def edges(rig: UploadBench) -> dict[Way, list[int]]:
    """Byte numbers at which requests (or their answers) end, from a run without faults."""
    found: dict[Way, list[int]] = {Way.SEND: [0], Way.RECEIVE: [0]}

    def note(_n: int) -> None:
        found[Way.SEND].append(rig.bench.tap.sent)
        found[Way.RECEIVE].append(rig.bench.tap.received)

    def install(bench: CardBench) -> None:
        bench.on_request = note

    assert rig.upload_with(install) is None
    assert rig.state is ControllerState.NEW
    found[Way.SEND].append(rig.bench.tap.sent)
    found[Way.RECEIVE].append(rig.bench.tap.received)
    return {way: sorted(set(points)) for way, points in found.items()}


def points(ends: list[int], *, exhaustive: bool) -> Iterator[int]:
    if exhaustive:
        yield from all_of(range(ends[-1] + 1))
        return
    for begin, end in pairwise(ends):
        yield from sorted({begin, (begin + end) // 2, max(begin, end - 1)})


def run_cuts(rig: UploadBench, way: Way, at: Sequence[tuple[int, bool]], *, lose: bool) -> int:
    for n, resume in at:
        kind = FaultKind.SILENCE if lose else FaultKind.CUT

        def install(bench: CardBench, fault: Fault = Fault(kind, way, n)) -> None:
            bench.tap.schedule([fault])

        error = rig.upload_with(install)
        state = rig.state  # asserts that no unknown table acts
        if error is None:
            assert state is ControllerState.NEW, n
            continue
        assert error.left is not None, (n, error)
        if error.context.get("confirmed"):
            assert error.left is state, (n, error, state)
        assert rig.recover(resume=resume) in {ControllerState.OLD, ControllerState.NEW}
    return len(at)


@pytest.mark.parametrize("way", [Way.SEND, Way.RECEIVE])
def test_f01_cut_at_every_byte(
    *, rig: UploadBench, way: Way, exhaustive: bool, count_runs: Callable[[int], None]
) -> None:
    at = [(n, n % 2 == 0) for n in points(edges(rig)[way], exhaustive=exhaustive)]
    count_runs(run_cuts(rig, way, at, lose=False))


@pytest.mark.parametrize("way", [Way.SEND, Way.RECEIVE])
def test_f02_silence_from_every_byte(
    *, rig: UploadBench, way: Way, exhaustive: bool, count_runs: Count, count_places: Count
) -> None:
    """The peer falls silent: what was under way is lost and nobody says so."""
    if exhaustive:
        places = rig.places(way, FaultKind.SILENCE)
        count_places(sum(map(len, places)))
        at = all_of(stand_ins(places))
    else:
        at = [(n, n % 2 == 0) for n in points(edges(rig)[way], exhaustive=False)][::5]
    count_runs(run_cuts(rig, way, at, lose=True))


def test_f01_recovery_itself_may_be_cut(
    rig: UploadBench, count_runs: Callable[[int], None]
) -> None:
    sent = edges(rig)[Way.SEND]
    middle = sent[len(sent) // 2]
    runs = cut = 0
    for at in range(0, 3000, 150):
        rig.upload_with(lambda b: b.tap.schedule([Fault(FaultKind.CUT, Way.SEND, middle)]))
        rig.bench.reconnect()
        rig.bench.tap.sent = 0
        rig.bench.tap.schedule([Fault(FaultKind.CUT, Way.SEND, at)])
        try:
            rig.recover_once()
        except PmacCompError:
            cut += 1
        assert rig.state in ControllerState  # no table acts that nobody meant
        assert rig.recover() is ControllerState.NEW  # what was begun is ended
        runs += 1
    assert cut >= 5
    count_runs(runs)


def test_f01_folder_holds_what_a_person_needs(rig: UploadBench) -> None:
    rig.upload_with(lambda _b: None)
    names = {path.suffix for path in Path(rig.folder).iterdir()}
    assert {".journal", ".json"} <= names
