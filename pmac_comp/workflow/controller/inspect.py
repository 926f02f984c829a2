"""Looking at a controller: who answers, what the motors do, what compensation is on it.

What lives here: questions to a card and the words for what they tell, and the terminal. What may
not: anything that changes a card or a journal.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from pmac_comp.base.errors import CommandRefused
from pmac_comp.files.bench import load_bench
from pmac_comp.files.resources import DEFAULT_JOURNAL
from pmac_comp.machine.client.terminal import Ask, open_terminal, terminal_of
from pmac_comp.machine.controller.card.identity import read_identity
from pmac_comp.machine.controller.card.link import Link
from pmac_comp.machine.controller.card.processor_load import read_load
from pmac_comp.machine.controller.card.variables import read_many
from pmac_comp.machine.controller.change.alike import left_open_alike
from pmac_comp.machine.controller.change.claim import claim_refusal, read_claim
from pmac_comp.machine.controller.change.context import Context
from pmac_comp.machine.controller.change.lease import read_clock, read_lease
from pmac_comp.machine.controller.change.manifest import Action, CLOCK_PER_s, Lease
from pmac_comp.machine.controller.contents.law_bank import LawBlock
from pmac_comp.machine.controller.law import law_goal, law_state
from pmac_comp.machine.controller.law.law_checks import law_elsewhere
from pmac_comp.machine.controller.law.law_state import LawForm
from pmac_comp.machine.controller.motors import motors
from pmac_comp.machine.controller.settings.guard_install import guard_settings
from pmac_comp.machine.controller.tables.table_recovery import status_by_journal
from pmac_comp.machine.controller.tables.table_status import (
    TableStatus,
    announced_elsewhere,
    read_head,
    table_status,
)
from pmac_comp.machine.controller.tables.upload_checks import flash_refusals
from pmac_comp.machine.controller.whole import recovery, waiting
from pmac_comp.machine.transport.url import parse_url
from pmac_comp.workflow.capture.axis import Axis
from pmac_comp.workflow.capture.context import context_to_look
from pmac_comp.workflow.capture.session import open_axis, open_link
from pmac_comp.workflow.controller.owners import is_of_axis
from pmac_comp.workflow.law.law_cost import load_text

_BENCH_FOR_LOOKING = "paper"  # sim:// needs some bench; a real controller does not


def controller_info(url: str) -> dict[str, Any]:
    """Identity of what answers, as a mapping for people and ``--json``."""
    if parse_url(url).scheme == "gpascii":
        with terminal_session(url) as ask:
            return {"url": url, "kind": "Power PMAC", "version": " ".join(ask("vers"))}
    with open_link(url, load_bench(_BENCH_FOR_LOOKING)) as link:
        identity = read_identity(link)
        names = ("I3", "I4", "I6", "I9", "I10", "I51")
        values = read_many(link, list(names))
    return {
        "url": url,
        "simulated": identity.is_simulated,
        **identity.as_dict(),
        "servo_rate_Hz": 1.0 / identity.servo_period_s,
        **{name: int(value) for name, value in values.items()},
    }


def controller_status(url: str, bench: str, journal: Path | None = None) -> dict[str, Any]:
    """Motors, compensation and processor of a controller, and what ``journal`` knows.

    Nothing is changed.
    """
    with open_axis(url, bench) as axis:
        readings = motors.read_motors(axis.link, axis.bench.motor_numbers)
        context = context_to_look(axis, journal or DEFAULT_JOURNAL)
        compensation = _compensation_status(axis, context)
        load = read_load(axis.link, axis.bench.servo_period_s)
    return {
        "motors": [
            {
                "number": reading.motor,
                "position_ct": reading.position_ct,
                "following_error_ct": reading.following_error_ct,
                "state": _state(reading.status),
                "bits": reading.status.names(),
            }
            for reading in readings.values()
        ],
        "compensation": compensation,
        "processor": {"summary": load_text(load)} | ({} if load is None else load.as_dict()),
    }


def _compensation_status(axis: Axis, context: Context) -> dict[str, Any]:
    """Tables, law, guard and lease on a card, and what was left open of changes to them."""
    link = axis.link
    since = waiting.number_since_ours(link, context)
    state = judged_tables(link, context, since)
    head = law_state.read_law_head(link, context.block)
    form = law_goal.running_form(link, context, head)
    tables = ", ".join(
        f"{table.kind.value} #{table.motor}, {len(table.entries)} entries" for table in state.tables
    )
    changed = "; another folder or host has changed the controller since" if since else ""
    return {
        "tables": tables or "none",
        "tables_act": state.i51,
        "verdict": state.decision.state.value,
        "why": f"tables: {_why(state, axis)}; law: {_law_text(axis, context, form, head)}",
        "left_open": _left_open_text(link, context),
        "last_change": (recovery.last_change(context) or "none from this folder") + changed,
        "guard": _guard_text(link, context),
        "lease": lease_text(read_lease(link, context), read_clock(link)),
        "law": form.name.lower(),
        "law_bank": head.bank,
        "law_gain": head.gain,
        "law_correction_ct": head.correction_ct,
        "law_torque_dac": head.torque_dac,
        "clamped_passes": head.n_clamped,
    }


def _left_open_text(link: Link, context: Context) -> str:
    """Changes that have not ended and what forbids the next one, with the way out; or nothing."""
    told = []
    if still_open := "; ".join(waiting.left_open(context)):
        told.append(f"{still_open}: run `pmac-comp recover`")
    if waiting.open_elsewhere(link, context):
        told.append("a change from another folder or host has not ended: `pmac-comp recover` there")
    claimed = claim_refusal(read_claim(link), context)
    refusals = [*flash_refusals(read_head(link, context)), *([] if claimed is None else [claimed])]
    told += [f"{r.message[0].lower()}{r.message[1:]} {r.advice}" for r in refusals]
    # Of a card that answers alike, beside what is known of this one.
    return "; ".join([*(told or ["nothing"]), *filter(None, [left_open_alike(context)])])


def judged_tables(link: Link, context: Context, since: int) -> TableStatus:
    """Tables on a card, judged by what this folder and bench files of other axes know of them.

    ``since`` is the number of a change that another folder or host made since ours, 0 for none.
    """
    state = (table_status if since else status_by_journal)(link, context)
    if state.decision.action is not Action.DISABLE:
        return state
    other = announced_elsewhere(link, context, state.tables)
    return replace(state, decision=other or state.decision)


def _why(state: TableStatus, axis: Axis) -> str:
    """Why the tables are judged so; a last change that took an axis' tables off is no news of it.

    What stands then are the tables of other axes.
    """
    if not state.tables or any(is_of_axis(axis, table) for table in state.tables):
        return state.decision.reason
    return f"{state.decision.reason}, none of them of motor #{axis.motor}"


def _guard_text(link: Link, context: Context) -> str:
    """Whether the guard keeps half-written tables off, whoever switches them on."""
    refusal, goal = guard_settings(link, context)
    if refusal:
        return f"none: {refusal}"
    if not goal.is_empty:
        return "does not run; the next upload of tables puts it there"
    return "runs (PLC 1)"


def _law_text(axis: Axis, context: Context, form: LawForm, head: law_state.LawHead) -> str:
    """Whether a law acts, and which p_block that of another bench file has."""
    said = _own_law_text(axis.link, context.block, form, head)
    other = law_elsewhere(axis.link, context, axis.motor) if form is LawForm.NONE else None
    if other is None:
        return said
    return f"{said} of this bench file; PLC 0 is the law of the p_block from P{other}"


def _own_law_text(link: Link, block: LawBlock, form: LawForm, head: law_state.LawHead) -> str:
    stopped = form is LawForm.NONE and head.form is not LawForm.NONE and head.correction_ct
    # After $$$*** the variables stand, and nothing follows them any more.
    if stopped and head.motor in law_goal.followers(link):
        return (
            "its program was stopped; its last correction stands: `pmac-comp remove` takes it off"
        )
    if form is LawForm.NONE:
        return "none runs"
    if head.is_armed:
        return "armed"
    # The open servo stays where the vendor's tool put it, with a law or without.
    is_loaded = law_state.read_bank(link, block, head.bank) is not None
    return "loaded, not armed" if is_loaded else "its program runs, and no law is loaded"


def lease_text(lease: Lease, now: int) -> str:
    """Who may write, and for how long, at a time on the controller's clock."""
    left_s = (lease.expires - now) / CLOCK_PER_s
    if lease.is_free:
        return "free"
    if not lease.is_held_against(0, now):
        return f"left behind by owner {lease.owner}, expired"
    return f"held by owner {lease.owner} for {left_s:.0f} s more"


def _state(status: motors.MotorStatus) -> str:
    if status.trips:
        return "tripped: " + ", ".join(status.trips)
    if not status.is_activated:
        return "not activated"
    if status.is_killed:
        return "killed"
    if not status.is_closed_loop:
        return "open loop"
    return "holding" if status.is_commanded_still else "moving"


@contextmanager
def terminal_session(url: str) -> Iterator[Ask]:
    """A function that asks a controller one line; refusals come back as text."""
    if parse_url(url).scheme == "sim":
        with open_link(url, load_bench(_BENCH_FOR_LOOKING)) as link:
            yield terminal_of(link)
        return
    with open_terminal(url) as ask:
        yield ask


def ask_all(
    ask: Ask,
    lines: Iterable[str],
    *,
    until_refused: bool,
    show: Callable[[Sequence[str]], None] | None = None,
) -> list[dict[str, Any]]:
    """Answers to lines in their order, shown as they come; a refused one may end it.

    What follows a refused line may need it.
    """
    said: list[dict[str, Any]] = []
    for line in lines:
        answer = ask(line)
        if show is not None:
            show(answer)
        said.append({"command": line, "answer": list(answer), "refused": answer.is_refusal})
        if answer.is_refusal and until_refused:
            break
    return said


def refusal_of(said: list[dict[str, Any]], n_given: int) -> CommandRefused | None:
    """What a conversation ends with if commands of it were refused."""
    refused = [str(item["command"]) for item in said if item["refused"]]
    if not refused:
        return None
    left = n_given - len(said)
    rest = f" {left} more behind it were not sent." if left else ""
    return CommandRefused(
        f"The controller refused {', '.join(refused)}.{rest}",
        code="PC-ERR-001",
        hint="The answer says why; `pmac-comp status URL` shows motors and compensation.",
    )
