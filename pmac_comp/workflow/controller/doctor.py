"""Is everything as it should be: this installation, and a controller against its bench file."""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pmac_comp import __version__
from pmac_comp.base.errors import FlashSuspect, PmacCompError
from pmac_comp.base.progress import Progress
from pmac_comp.base.units import US_PER_S
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.resources import DEFAULT_JOURNAL, data_folder
from pmac_comp.workflow.bench.remarks import loop_remarks, remarks

if TYPE_CHECKING:
    from pmac_comp.workflow.capture.axis import Axis

_CLOCK_TOLERANCE = 1e-4


@dataclass(frozen=True)
class Finding:
    """One check: ``ok``, ``note`` or ``bad``."""

    state: str
    check: str
    found: str


def examine(
    url: str,
    bench: str,
    *,
    backup: Path | None = None,
    journal: Path = DEFAULT_JOURNAL,
    compile_kernels: bool = False,
    progress: Progress | None = None,
) -> list[Finding]:
    """All findings on this machine and, with a URL, on the controller.

    With a backup the controller's configuration is held against it: a card that lost its flash
    comes up with other values. The journal tells which tables this folder meant.
    """
    loaded = load_bench(bench)
    findings = list(_installation())
    findings += [Finding("note", "bench file", line) for line in remarks(loaded)]
    if compile_kernels:
        findings += list(_compiled(loaded, progress))
        findings += [Finding("note", "bench file", line) for line in loop_remarks(loaded)]
    if url:
        findings += list(_controller(url, loaded, backup, journal))
    return findings


def _installation() -> Iterator[Finding]:
    yield Finding("ok", "pmac-comp", f"{__version__} on Python {sys.version.split()[0]}")
    for name in ("configs", "firmware_plc"):
        folder = data_folder(name)
        count = sum(1 for _ in folder.iterdir())
        yield Finding("ok" if count else "bad", name, f"{count} files in {folder}")


def _compiled(bench: Bench, progress: Progress | None) -> Iterator[Finding]:
    """Run each kernel once, so that its compiled form is in the cache.

    The simulated card shares no kernel with the model: another process compiles it meanwhile.
    """
    import time
    from multiprocessing import get_context

    from pmac_comp.physics.compensate.evaluation import evaluate_law
    from pmac_comp.physics.compensate.law import CompensationLaw
    from pmac_comp.physics.model.drive import DriveModel, simulate
    from pmac_comp.physics.signals.trajectory import dwell
    from pmac_comp.workflow.capture.simulated import warm_up

    def tell(text: str, fraction: float) -> None:
        if progress is not None:
            progress(text, fraction)

    start = time.monotonic()
    rest = dwell(period_s=bench.servo_period_s, duration_s=0.05)
    beside = get_context("spawn").Process(target=warm_up, args=(bench,))
    beside.start()
    tell("compiling the drive model", 0.0)
    simulate(DriveModel.base(bench), rest.position_m)
    tell("compiling the law", 0.5)
    evaluate_law(CompensationLaw(), rest.position_m, bench.servo_period_s)
    tell("compiling the simulated card", 0.6)
    beside.join()
    if beside.exitcode:  # what could not be compiled there is compiled here, or says why
        warm_up(bench)
    tell("kernels are compiled", 1.0)
    yield Finding("ok", "kernels", f"compiled or loaded in {time.monotonic() - start:.1f} s")


def _controller(url: str, bench: Bench, backup: Path | None, journal: Path) -> Iterator[Finding]:
    from pmac_comp.workflow.capture.session import open_axis

    with open_axis(url, bench) as axis:
        yield from _identity(axis, bench)
        yield _flash(axis, backup)
        yield from _variables(axis, bench)
        yield from _law(axis, bench)
        yield from _conversion(axis, bench)
        yield from _processor(axis, bench)
        yield from _motors(axis)
        yield from _override(axis)
        yield from _reference(axis, bench)
        yield from _compensation(axis, journal)
        yield from _claim(axis)


def _identity(axis: "Axis", bench: Bench) -> Iterator[Finding]:
    from pmac_comp.machine.controller.card.identity import read_identity

    found = read_identity(axis.link)
    kind = "simulated " if axis.simulated else ""
    said = f"{kind}{found.card_name}, firmware {found.firmware.strip()}"
    yield Finding("ok", "controller", said)
    off = found.servo_period_s / bench.servo_period_s - 1.0
    yield Finding(
        "ok" if abs(off) < _CLOCK_TOLERANCE else "bad",
        "servo period",
        f"{found.servo_period_s * US_PER_S:.3f} us by I10, bench file "
        f"{bench.servo_period_s * US_PER_S:.3f} us",
    )
    wanted = bench.controller.dpram
    yield Finding(
        "ok" if found.dpram == wanted else "bad",
        "dual-ported RAM",
        f"{found.dpram}, bench file {wanted}",
    )
    yield Finding("ok", "free memory", f"{found.free_long_words} long words")


def _flash(axis: "Axis", backup: Path | None) -> Finding:
    """Whether the card came up with what was saved."""
    from pmac_comp.machine.controller.settings import backup as kept

    try:
        if backup is None:
            kept.check_flash_status(axis.link)
            return Finding("ok", "flash", "no error reported; --backup FILE compares values too")
        kept.check_flash(axis.link, kept.load_backup(backup))
    except FlashSuspect as error:
        return Finding("bad", "flash", f"{error.message} {error.advice}")
    return Finding("ok", "flash", f"no error reported, motor variables as in {backup.name}")


def _variables(axis: "Axis", bench: Bench) -> Iterator[Finding]:
    from pmac_comp.workflow.capture.as_described import differing_variables, variables_text

    differing = differing_variables(axis.link, bench)
    agreed = f"{len(bench.controller.ivariables)} agree with the bench file"
    yield Finding(
        "bad" if differing else "ok",
        "I-variables",
        f"bench file in brackets: {variables_text(differing)}" if differing else agreed,
    )


def _law(axis: "Axis", bench: Bench) -> Iterator[Finding]:
    from pmac_comp.workflow.capture.card_law import law_refusals

    for refusal in law_refusals(axis.link, bench):
        yield Finding("bad", "law and units", f"{refusal.message} {refusal.advice}")


def _conversion(axis: "Axis", bench: Bench) -> Iterator[Finding]:
    """Whether the card reads the encoder as the bench file says; a capture is refused else."""
    from pmac_comp.workflow.capture.as_described import conversion_refusals

    for refusal in conversion_refusals(axis.link, bench):
        yield Finding("bad", "encoder conversion", f"{refusal.message} {refusal.advice}")


def _processor(axis: "Axis", bench: Bench) -> Iterator[Finding]:
    """How busy the card is, and whether its clock is the one that a law's cost is counted with."""
    from pmac_comp.machine.controller.card.processor_load import read_load
    from pmac_comp.machine.controller.card.variables import read_one
    from pmac_comp.workflow.law.law_cost import BUSIEST_FRAC, load_text

    clock_MHz = 10.0 * (read_one(axis.link, "I52") + 1.0)
    if clock_MHz != bench.controller.cpu_clock_MHz:
        yield Finding(
            "note",
            "processor",
            f"runs at {clock_MHz:g} MHz (I52); the bench file counts with cpu_clock_MHz = "
            f"{bench.controller.cpu_clock_MHz:g}",
        )
    load = read_load(axis.link, bench.servo_period_s)
    known = load is not None
    busy = load is not None and load.foreground_frac > BUSIEST_FRAC
    yield Finding("bad" if busy else "ok" if known else "note", "processor", load_text(load))


def _motors(axis: "Axis") -> Iterator[Finding]:
    from pmac_comp.machine.controller.motors.motors import read_motor

    reading = read_motor(axis.link, axis.motor)
    trips = ", ".join(reading.status.trips)
    state = "killed" if reading.status.is_killed else "enabled"
    yield Finding(
        "bad" if trips else "ok",
        f"motor #{reading.motor}",
        trips or f"{state}, following error {reading.following_error_ct:.1f} counts",
    )


def _override(axis: "Axis") -> Iterator[Finding]:
    """Whether jogs and runs would go at the speed that they are meant for."""
    from pmac_comp.machine.controller.motors.feed_override import jog_refusals, run_refusals
    from pmac_comp.workflow.capture.as_described import RUN_SYSTEM

    found = [*jog_refusals(axis.link, axis.motor), *run_refusals(axis.link, RUN_SYSTEM)]
    for refusal in found[:1]:
        yield Finding("note", "feed override", f"{refusal.message} {refusal.advice}")


def _reference(axis: "Axis", bench: Bench) -> Iterator[Finding]:
    from pmac_comp.workflow.capture.as_described import place_remarks

    for remark in place_remarks(axis.link, bench):
        yield Finding("note", "zero and limits", remark)


def _compensation(axis: "Axis", journal: Path) -> Iterator[Finding]:
    from pmac_comp.machine.controller.law.law_checks import owner_refusals
    from pmac_comp.machine.controller.whole.waiting import number_since_ours
    from pmac_comp.workflow.capture.context import context_to_look
    from pmac_comp.workflow.controller.inspect import judged_tables

    context = context_to_look(axis, journal)
    for taken in owner_refusals(axis.link, context, axis.motor):
        yield Finding("note", "route law", f"{taken.message} {taken.advice}")
    try:
        state = judged_tables(axis.link, context, number_since_ours(axis.link, context))
    except PmacCompError as error:
        yield Finding("bad", "compensation", error.message)
        return
    yield Finding(
        "note" if state.decision.state.value == "DISABLED" else "ok",
        "compensation",
        f"tables {state.decision.state.value}: {state.decision.reason}",
    )


def _claim(axis: "Axis") -> Iterator[Finding]:
    """Whether bench files of other axes of this card see that something is changed."""
    from pmac_comp.machine.controller.change.claim import (
        FOREIGN,
        REGISTER,
        claim_refusal,
        read_claim,
    )
    from pmac_comp.workflow.capture.context import context_to_look

    found = read_claim(axis.link)
    other = claim_refusal(found, context_to_look(axis))
    if other is not None:
        yield Finding("note", "other axes", f"{other.message} {other.advice}")
    if found == FOREIGN:
        yield Finding(
            "note",
            "other axes",
            f"L:${REGISTER:X} holds something that is not ours: bench files with another p_block "
            "do not see from another host that this one changes the controller",
        )
