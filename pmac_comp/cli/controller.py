"""Commands on a controller that change no compensation.

``doctor info status terminal backup restore setup capture``.
"""

import sys
from pathlib import Path
from typing import Annotated

import typer

from pmac_comp.base.errors import ConfigError
from pmac_comp.cli import output
from pmac_comp.cli.options import (
    BenchOption,
    DryRunOption,
    JournalOption,
    JsonOption,
    UrlArgument,
    YesOption,
)
from pmac_comp.cli.progress import ProgressLines
from pmac_comp.files.resources import DEFAULT_JOURNAL


def register(app: typer.Typer) -> None:
    """Add the commands of this group."""
    app.command("doctor")(doctor)
    app.command("info")(info)
    app.command("status")(status)
    app.command("terminal")(terminal)
    app.command("backup")(backup)
    app.command("restore")(restore)
    app.command("setup")(setup)
    app.command("capture")(capture)


def confirmed(question: str, *, yes: bool) -> None:
    """Ask before something changes; a pipe without ``--yes`` counts as no."""
    if yes:
        return
    if not sys.stdin.isatty():
        raise ConfigError(
            f"{question} Nobody can answer here.",
            code="PC-CLI-010",
            hint="Nothing was changed. Add --yes to go on without asking, or --dry-run to look.",
        )
    if not typer.confirm(question, err=True):
        output.say("nothing was changed")
        raise typer.Exit


def doctor(
    url: Annotated[str, typer.Argument(help="Controller to look at, none: this machine")] = "",
    bench: BenchOption = "paper",
    backup: Annotated[
        Path | None,
        typer.Option("--backup", help="Backup that the controller must have come up with"),
    ] = None,
    journal: JournalOption = DEFAULT_JOURNAL,
    compile_kernels: Annotated[
        bool, typer.Option("--compile", help="Compile the numerical kernels now")
    ] = False,
    json_target: JsonOption = "",
) -> None:
    """Check this installation and, with a URL, the controller against the bench file.

    Says where this installation has the folders configs and firmware_plc.
    """
    from pmac_comp.workflow.controller.doctor import examine

    progress = ProgressLines()
    findings = examine(
        url,
        bench,
        backup=backup,
        journal=journal,
        compile_kernels=compile_kernels,
        progress=progress,
    )
    progress.close()

    def show() -> None:
        output.table(
            "", ("state", "check", "found"), [(f.state, f.check, f.found) for f in findings]
        )

    result = {"findings": findings, "ok": all(f.state != "bad" for f in findings)}
    output.finish(result, json_target, show)


def info(url: UrlArgument, json_target: JsonOption = "") -> None:
    """Show what answers at a URL: firmware, type, memory, clock."""
    from pmac_comp.workflow.controller.inspect import controller_info

    result = controller_info(url)
    output.finish(result, json_target, lambda: output.table(url, ("item", "value"), result.items()))


_STATUS_WORDS = {
    "tables_act": "tables act (I51)",
    "verdict": "verdict on tables",  # the law's state stands beside it
    "law_gain": "law gain, 0 to 1",
    "law_correction_ct": "law correction now, counts",
    "law_torque_dac": "law torque now, DAC units",
    "clamped_passes": "passes of the law that were clamped",
}


def status(
    url: UrlArgument,
    bench: BenchOption = "paper",
    journal: JournalOption = DEFAULT_JOURNAL,
    json_target: JsonOption = "",
) -> None:
    """Show motors, compensation tables, law bank, processor load and what the last upload left."""
    from pmac_comp.workflow.controller.inspect import controller_status

    result = controller_status(url, bench, journal)

    def show() -> None:
        output.table(
            "motors",
            ("motor", "position ct", "following error ct", "state"),
            [
                (f"#{m['number']}", m["position_ct"], m["following_error_ct"], m["state"])
                for m in result["motors"]
            ],
        )
        items = result["compensation"].items()
        rows = [(_STATUS_WORDS.get(name, name.replace("_", " ")), value) for name, value in items]
        output.table("compensation", ("item", "value"), rows)
        output.echo(result["processor"]["summary"])

    output.finish(result, json_target, show)


def terminal(
    url: UrlArgument,
    command: Annotated[
        list[str] | None, typer.Option("--command", "-c", help="Send this and stop (repeatable)")
    ] = None,
    json_target: JsonOption = "",
) -> None:
    """Talk to a controller in its own language.

    With -c the first refused command ends it; what follows is not sent. Lines from a pipe are all
    sent, each answered at once. Both end with exit code 5 where something was refused.
    """
    from pmac_comp.workflow.controller.inspect import ask_all, refusal_of, terminal_session

    at_once = not command and not json_target
    with terminal_session(url) as ask:
        if not command:
            output.say("one command per line; end with Ctrl-D")
        given = command or (line.rstrip("\r\n") for line in sys.stdin)
        said = ask_all(
            ask, given, until_refused=bool(command), show=output.echo_now if at_once else None
        )
    if not at_once:
        output.finish(
            said, json_target, lambda: output.echo_all(x for i in said for x in i["answer"])
        )
    refused = refusal_of(said, len(command or said))
    if refused is not None and (command or not sys.stdin.isatty()):
        # Standard output holds its document already: the answers themselves.
        output.show_error(refused, as_json=False)
        raise typer.Exit(refused.exit_code)


def backup(
    url: UrlArgument,
    out: Annotated[Path, typer.Option("--out", "-o", help="Backup file to write")],
    bench: BenchOption = "paper",
    json_target: JsonOption = "",
) -> None:
    """Read everything relevant from the controller into a file, twice, and compare."""
    from pmac_comp.workflow.controller.safekeeping import backup_to_file

    if out.exists():
        raise ConfigError(
            f"There is a file {out} already; the state it may hold cannot be read again.",
            code="PC-CLI-012",
            hint="Name another file with --out.",
        )
    progress = ProgressLines()
    result = backup_to_file(url, bench, output.checked_target(out), progress=progress)
    progress.close()
    output.finish(result, json_target, lambda: output.echo(f"{out}: {result['summary']}"))


def restore(
    url: UrlArgument,
    source: Annotated[Path, typer.Argument(help="Backup file, or a program file to download")],
    bench: BenchOption = "paper",
    other_card: Annotated[
        bool,
        typer.Option("--other-card", help="Take a backup of another card, firmware or memory"),
    ] = False,
    journal: JournalOption = DEFAULT_JOURNAL,
    yes: YesOption = False,
    dry_run: DryRunOption = False,
    json_target: JsonOption = "",
) -> None:
    """Bring a backup back and verify it item by item; interrupted, `recover` undoes it."""
    from pmac_comp.workflow.controller.safekeeping import plan_restore, restore_from_file

    plan = plan_restore(url, bench, source)
    if dry_run:
        shown = plan["lines"] or [f"nothing differs from {source}"]
        output.finish(plan, json_target, lambda: output.echo_all(shown))
        return
    confirmed(f"Restore {source} to {url} ({plan['summary']})?", yes=yes)
    progress = ProgressLines()
    result = restore_from_file(
        url, bench, source, journal=journal, other_card=other_card, progress=progress
    )
    progress.close()
    output.finish(result, json_target, lambda: output.echo(str(result["summary"])))


def setup(
    url: UrlArgument,
    bench: BenchOption = "paper",
    journal: JournalOption = DEFAULT_JOURNAL,
    yes: YesOption = False,
    dry_run: DryRunOption = False,
    json_target: JsonOption = "",
) -> None:
    """Put the I-variables of the bench file on the controller; its motors must be killed.

    Journalled: `rollback` brings the old values back. The clock (I10, I7000-I7002) and what a
    compensation sets itself are left alone.
    """
    from pmac_comp.workflow.controller.commissioning import plan_setup, set_up

    plan = plan_setup(url, bench, killed=not dry_run)

    def show_plan() -> None:
        rows = [(name, card, wanted) for name, (card, wanted) in plan.items()]
        output.table("I-variables", ("name", "on the card", "bench file"), rows)

    if not plan:
        output.finish(
            {"changed": plan}, json_target, lambda: output.echo("nothing differs; nothing to do")
        )
        return
    if dry_run:
        output.finish({"would_change": plan}, json_target, show_plan)
        return
    if json_target != "-":
        show_plan()
    confirmed(f"Change {len(plan)} I-variables on {url}?", yes=yes)
    result = set_up(url, bench, journal)
    output.finish(
        result,
        json_target,
        lambda: output.echo(f"{result['verdict']}: {len(plan)} I-variables as in the bench file"),
    )


def capture(
    url: UrlArgument,
    bench: BenchOption,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the captures")] = Path(
        "runs"
    ),
    motion: Annotated[
        list[str] | None,
        typer.Option(
            "--motion",
            help="e.g. sine:amplitude_mm=10,frequency_Hz=2 or a CSV file with a command "
            "(repeatable); none: the proposed campaign. Without centre_mm or start_mm a motion "
            "lies about the middle of the travel. Keys of sine: amplitude_mm frequency_Hz cycles "
            "centre_mm; of trapezoid: distance_mm speed_mm_per_s acceleration_m_per_s2 "
            "s_curve_ms start_mm repeats; of triangle: amplitude_mm speed_mm_per_s cycles "
            "centre_mm acceleration_m_per_s2",
        ),
    ] = None,
    campaign: Annotated[
        str, typer.Option("--campaign", help="calibration, lead or repeat")
    ] = "calibration",
    recover: Annotated[
        Path | None, typer.Option("--recover", help="Rebuild captures from this capture log")
    ] = None,
    journal: JournalOption = DEFAULT_JOURNAL,
    yes: YesOption = False,
    dry_run: DryRunOption = False,
    json_target: JsonOption = "",
) -> None:
    """Run motions and gather them at servo rate; shows each motion and asks first."""
    from pmac_comp.workflow.capture.capturing import (
        capture_to_folder,
        plan_capture,
        recover_to_folder,
    )

    if recover is not None:
        result = recover_to_folder(recover, bench, out)
        output.finish(result, json_target, lambda: output.echo(str(result["summary"])))
        return
    plan = plan_capture(bench, campaign=campaign, motions=tuple(motion or ()))

    def show_plan() -> None:
        output.table(
            "motions",
            ("name", "duration s", "from mm", "to mm", "peak mm/s", "peak m/s2"),
            plan.rows(),
        )
        output.echo(plan.time_needed())
        if dry_run:
            output.echo("nothing was changed")

    plan.require_room_in(out)
    if dry_run:
        output.finish(plan.as_result(), json_target, show_plan)
        return
    if json_target != "-":
        show_plan()
    one = len(plan.motions) == 1
    these = "this motion" if one else f"these {len(plan.motions)} motions"
    confirmed(f"Run {these} on {url}?", yes=yes)
    progress = ProgressLines()
    result = capture_to_folder(
        url,
        bench,
        plan,
        out,
        journal=journal,
        progress=progress,
        tell=lambda text: output.say(f"note: {text}"),
    )
    progress.close()

    # Remarks were told before the axis moved, when something could still be done about them.
    output.finish(
        result, json_target, lambda: output.echo_all(str(path) for path in result["files"])
    )
