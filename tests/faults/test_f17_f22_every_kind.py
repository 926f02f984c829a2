"""F17, F19, F22, F30: other clients, writers, motion and Ctrl-C amid every kind of change."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from pmac_comp.base.errors import (
    ChangeInterrupted,
    ControllerState,
    LeaseHeld,
    PmacCompError,
    SafetyRefusal,
)
from pmac_comp.machine.controller.change import journals
from pmac_comp.machine.controller.change.lease import host_lock
from pmac_comp.machine.controller.contents.law_bank import Index, LawBlock
from pmac_comp.machine.controller.whole import recovery, waiting
from tests.faults.change_bench import WATCHED_I, ChangeBench, Standing, standing
from tests.faults.test_f01_f29_every_kind import SCENARIOS, thinned
from tests.faults.test_f29_f30_killed import plain_signals, signalled  # noqa: F401 - a fixture
from tests.faults.upload_bench import SameIds

pytestmark = pytest.mark.faults
Count = Callable[[int], None]
BLOCK = LawBlock()
CHANGES = [s for s in SCENARIOS if s.name != "rollback"]
OUTPUT = ("variables", WATCHED_I.index(129))  # Ixx29, which the law writes
# What another client does, and the pieces that it changes itself.
ACTIONS: dict[str, tuple[tuple[str, ...], set[object]]] = {
    "bank index": ((f"P{BLOCK.p(Index.BANK)}=1-P{BLOCK.p(Index.BANK)}",), {"law", OUTPUT}),
    "bank values": (tuple(f"P{BLOCK.bank(bank, 3)}=9" for bank in (0, 1)), {"law", OUTPUT}),
    "lease": ((f"P{BLOCK.p(Index.LEASE)}=4711",), set()),
    "PLC 0": (("OPEN PLC 0 CLEAR", "CLOSE"), {("PLC", 0), OUTPUT}),
    "motion program": (("OPEN PROG 710 CLEAR", "X5", "CLOSE"), {("PROG", 710)}),
    "number": (("7",), set()),
}

LAST_LOOKS = 8  # requests: what comes after a change's last look at a piece is found by `status`


@pytest.fixture
def rig(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> ChangeBench:
    ids = SameIds()
    monkeypatch.setattr(journals, "secrets", ids)
    return ChangeBench(tmp_path, request.param, ids)


every_change = pytest.mark.parametrize("rig", CHANGES, ids=lambda s: s.name, indirect=True)


def requests_of(rig: ChangeBench) -> range:
    """Numbers of the requests of the change."""
    rig.restart()
    asked: list[int] = []
    rig.bench.on_request = asked.append
    assert rig.attempt() is None
    return range(asked[0], asked[-1] + 1)


def with_lines_at(rig: ChangeBench, k: int, lines: tuple[str, ...]) -> PmacCompError | None:
    """The change, while another client sends lines just before its k-th request."""
    bench = rig.restart()
    other = bench.side_port()

    def act(n: int) -> None:
        if n == k:
            for line in lines:
                other(line)

    bench.on_request = act
    return rig.attempt()


def pieces(found: Standing) -> dict[object, object]:
    """What stands, piece by piece."""
    out: dict[object, object] = {(p[0], p[1]): p for p in found.programs}
    for name in ("variables", "definitions", "tables"):
        out |= {(name, k): value for k, value in enumerate(getattr(found, name))}
    return out | {name: getattr(found, name) for name in ("axes", "law", "clamp_ct", "target")}


def unlike(rig: ChangeBench, found: Standing, meant: Standing) -> set[object]:
    """Pieces that the change is about and that do not stand as meant."""
    before, after, now = pieces(rig.before), pieces(rig.after), pieces(found)
    goal = pieces(meant)
    own = {k for k in before.keys() | after.keys() if before.get(k) != after.get(k)}
    return {k for k in own if now.get(k) != goal.get(k)}


@every_change
def test_f17_another_client_acts_in_any_change(
    *, rig: ChangeBench, exhaustive: bool, count_runs: Count
) -> None:
    """A change that ends as done stands whole, but for what comes after its last look at it."""
    every = requests_of(rig)
    for action in ACTIONS:
        for k in thinned(every, 2, exhaustive=exhaustive):
            act_and_judge(rig, every, k, action)
            count_runs(1)


@pytest.mark.parametrize(
    "rig", [s for s in CHANGES if s.name == "law route"], ids=lambda s: s.name, indirect=True
)
def test_f17_a_bank_switched_amid_the_last_looks_is_found(
    rig: ChangeBench, count_runs: Count
) -> None:
    """The law stops at once then: an upload that looked at it first called that done."""
    every = requests_of(rig)
    for k in every[-LAST_LOOKS - 4 : -3]:  # behind it: number, claim, closing
        error = with_lines_at(rig, k, ACTIONS["bank index"][0])
        assert error is not None, k
        assert error.left is not ControllerState.NEW, k
        count_runs(1)


def act_and_judge(rig: ChangeBench, every: range, k: int, action: str) -> None:
    lines, theirs = ACTIONS[action]
    error = with_lines_at(rig, k, lines)
    found = standing(rig.fresh())
    after, before = (unlike(rig, found, meant) - theirs for meant in (rig.after, rig.before))
    where = (action, k, every, error)
    if error is None:
        assert not after or k > every[-1] - LAST_LOOKS, where
    elif error.left is ControllerState.NEW:
        assert not after, where
    elif error.left is ControllerState.OLD and error.context.get("confirmed"):
        assert not before, where
    with suppress(PmacCompError):
        result = recovery.recover(rig.bench.link, rig.bench.context)
        if result.verdict is ControllerState.NEW:
            assert not unlike(rig, standing(rig.bench), rig.after) - theirs, (*where, result)


@every_change
def test_f19_any_change_is_refused_while_somebody_writes(
    rig: ChangeBench, count_runs: Count
) -> None:
    """By the lock of this host, and by the lease on the controller; nothing is written."""
    bench = rig.restart()
    with host_lock(bench.context), host_lock(bench.context, ".upload"):
        error = rig.attempt()
    assert isinstance(error, LeaseHeld), error
    assert standing(bench) == rig.before
    bench = rig.restart()
    owner, end = BLOCK.p(Index.LEASE), BLOCK.p(Index.LEASE) + 1
    bench.link.write_buffer([f"P{end}=1000000", f"P{owner}=4711"])
    error = rig.attempt()
    assert isinstance(error, LeaseHeld), error
    assert error.context["owner"] == 4711
    assert error.left is ControllerState.OLD
    assert standing(bench) == rig.before
    assert bench.p(owner) == 4711
    count_runs(2)


def acts_at(rig: ChangeBench) -> int:
    """Request with which the change first acts on the motor: bank index, gain or tables."""
    bench = rig.restart()
    first: list[int] = []
    seen: list[tuple[float, ...]] = []

    def look(n: int) -> None:
        now = (bench.p(BLOCK.p(Index.BANK)), bench.p(BLOCK.p(Index.TARGET)), float(bench.i51))
        if seen and seen[-1] != now:
            first.append(n)
        seen.append(now)

    bench.on_request = look
    assert rig.attempt() is None
    return first[0] if first else 0


@every_change
def test_f22_motion_that_starts_in_any_change(
    *, rig: ChangeBench, exhaustive: bool, count_runs: Count
) -> None:
    """What acts on a motor is not changed once it moves; then nothing is written back either."""
    every, acting = requests_of(rig), acts_at(rig)
    for k in thinned(every, 6, exhaustive=exhaustive):
        error = with_lines_at(rig, k, ("#1J+",))
        if error is None:
            assert k > acting - 4, (k, acting, every)
            assert unlike(rig, standing(rig.bench), rig.after) == set(), k
        else:
            assert error.left is not None, (k, error)
            assert isinstance(error, SafetyRefusal), (k, error)
        bench = rig.bench
        if error is not None and waiting.left_open(bench.context):
            stands = standing(bench)
            with pytest.raises(PmacCompError):
                recovery.recover(bench.link, bench.context)
            assert standing(bench) == stands
        bench.link.command("#1J/")
        bench.clock.sleep_s(0.5)
        bench.link.command("#1J=0")
        bench.clock.sleep_s(1.0)
        if error is not None:
            rig.recover(resume=False)
        count_runs(1)


@pytest.mark.usefixtures("plain_signals")
@pytest.mark.parametrize("rig", SCENARIOS, ids=lambda s: s.name, indirect=True)
def test_f30_ctrl_c_in_any_change(*, rig: ChangeBench, exhaustive: bool, count_runs: Count) -> None:
    """The first ends with a verdict that is true, the second at once and open for `recover`."""
    every = requests_of(rig)
    for k in thinned(every, 3, exhaustive=exhaustive):
        rig.restart()
        signalled(k)(rig.bench)
        try:
            error = rig.attempt()
        except KeyboardInterrupt:  # before the change was begun
            assert standing(rig.fresh()) == rig.before, k
        else:
            assert isinstance(error, ChangeInterrupted), k
            rig.fresh()
            if error.context.get("confirmed") and error.left is not ControllerState.DISABLED:
                rig.judge(error.left)
        rig.recover(resume=bool(k % 2))
        rig.restart()
        signalled(k, times=2)(rig.bench)
        with pytest.raises((KeyboardInterrupt, ChangeInterrupted)):
            rig.scenario.change(rig.bench.link, rig.bench.context)
        rig.recover(resume=bool(k % 2))
        count_runs(2)
