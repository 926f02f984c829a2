"""Commands of the compensation: compute, compare, upload, take back, verify, improve."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pmac_comp.base.errors import ConfigError, SafetyRefusal
from pmac_comp.cli import output
from pmac_comp.cli.controller import confirmed
from pmac_comp.cli.options import (
    BenchOption,
    CompensationArgument,
    DryRunOption,
    EffectsOption,
    JournalOption,
    JsonOption,
    PersistOption,
    ReportOption,
    SeedOption,
    UrlArgument,
    YesOption,
    refuse_unused,
)
from pmac_comp.cli.progress import ProgressLines
from pmac_comp.files.resources import DEFAULT_JOURNAL

if TYPE_CHECKING:
    from pmac_comp.workflow.previews import RunsPreview

_OF_A_MEASUREMENT = ("url", "out", "motion", "repeats", "static", "seed", "refine")
_OF_ONE_MOTION = ("command", "aim")
RouteOption = Annotated[str, typer.Option("--route", help="table, law, servo, cam or program")]


def register(app: typer.Typer) -> None:
    """Add the commands of this group."""
    app.command("compensate")(compensate)
    app.command("diff")(diff)
    app.command("upload")(upload)
    app.command("recover")(recover)
    app.command("rollback")(rollback)
    app.command("remove")(remove)
    app.command("verify")(verify)
    app.command("improve")(improve)


def compensate(
    ctx: typer.Context,
    bench: BenchOption,
    model: Annotated[Path, typer.Option("--model", "-m", help="Model file of `identify`")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Compensation file to write")] = Path(
        "compensation.json"
    ),
    route: RouteOption = "law",
    slow: Annotated[
        list[Path] | None,
        typer.Option(
            "--slow",
            help="Slow run in both directions for lead and backlash table; a file or folder",
        ),
    ] = None,
    captures: Annotated[
        list[Path] | None,
        typer.Option("--captures", help="Calibration runs that trim the law; a file or a folder"),
    ] = None,
    command: Annotated[
        str,
        typer.Option(
            "--command", "-c", help="The motion of cam and program: CSV, or as `capture --motion`"
        ),
    ] = "",
    aim: Annotated[
        str,
        typer.Option(
            "--aim",
            help="What cam and program take away: total (table to command, with the lag) or "
            "mechanical (e_r)",
        ),
    ] = "total",
    limit: Annotated[
        bool,
        typer.Option("--limit", help="Clip to the limits and to the measured travel, and say so"),
    ] = False,
    every: Annotated[
        int,
        typer.Option("--every", min=1, max=4, help="Servo cycles per pass of the law (route law)"),
    ] = 1,
    effects: EffectsOption = None,
    json_target: JsonOption = "",
) -> None:
    """Compute the compensation from a model, limited and quantised, with its cost."""
    from pmac_comp.workflow.compensation.compensate import aim_of, compensate_files
    from pmac_comp.workflow.compensation.file import check_route
    from pmac_comp.workflow.law.routes import MOTION_ROUTES
    from pmac_comp.workflow.law.static_map import Limit
    from pmac_comp.workflow.motion.commands import capture_paths

    if check_route(route) not in MOTION_ROUTES:
        refuse_unused(
            ctx,
            _OF_ONE_MOTION,
            f"The route {route} is for every motion",
            "the routes cam and program are for the one of --command.",
        )
    progress = ProgressLines()
    result = compensate_files(
        bench,
        model,
        output.checked_target(out),
        route=route,
        slow=capture_paths(slow or ()),
        captures=capture_paths(captures or ()),
        command=command,
        aim=aim_of(aim),
        limit=Limit.CLIP if limit else Limit.REFUSE,
        every_cycles=every,
        effects=effects,
        progress=progress,
    )
    progress.close()

    def show() -> None:
        output.table("compensation", ("item", "value"), result["summary"].items())
        for line in result["remarks"]:
            output.echo(f"  note: {line}")
        output.echo(f"compensation: {out}")

    output.finish(result, json_target, show)


def diff(
    url: UrlArgument,
    new: CompensationArgument,
    bench: BenchOption = "paper",
    plot: Annotated[Path | None, typer.Option("--plot", help="SVG or PNG to write")] = None,
    json_target: JsonOption = "",
) -> None:
    """Show the compensation on the controller against a new one, in numbers and as a plot."""
    from pmac_comp.workflow.compensation.file import check_bench
    from pmac_comp.workflow.controller.difference import difference

    if plot is not None and plot.suffix.lower() not in {".svg", ".png"}:
        raise ConfigError(
            f"{plot} has a suffix that is not a plot format.",
            code="PC-CLI-004",
            hint="Use .svg or .png.",
        )
    check_bench(new, bench)
    result = difference(url, bench, new)
    if plot is not None:
        from pmac_comp.report.figures import save_difference_plot

        save_difference_plot(result.curves, output.checked_target(plot))

    def show() -> None:
        output.table("old against new", ("quantity", "old", "new", "unit"), result.rows)
        output.echo_all(result.lines())
        if plot is not None:
            output.echo(f"plot: {plot}")

    output.finish(result.as_result(), json_target, show)


def upload(
    url: UrlArgument,
    new: CompensationArgument,
    bench: BenchOption = "paper",
    persist: PersistOption = False,
    journal: JournalOption = DEFAULT_JOURNAL,
    yes: YesOption = False,
    dry_run: DryRunOption = False,
    json_target: JsonOption = "",
) -> None:
    """Upload a compensation as one transaction; ends in OLD, NEW or DISABLED."""
    from pmac_comp.workflow.compensation.file import check_bench
    from pmac_comp.workflow.controller.upload_flow import upload_file
    from pmac_comp.workflow.controller.upload_plan import plan_upload

    check_bench(new, bench)
    plan = plan_upload(url, bench, new, journal=journal, persist=persist)

    def show_plan() -> None:
        output.echo_all([*plan.text, *(plan.lines if dry_run else ())])

    plan.require_allowed()  # before a plan of what will not be
    if dry_run:
        output.finish(plan.as_result(), json_target, show_plan)
        return
    if json_target != "-":
        show_plan()
    confirmed(f"Upload {new} to {url}?", yes=yes)
    progress = ProgressLines()
    result = upload_file(url, bench, new, journal, persist=persist, progress=progress)
    progress.close()

    def show() -> None:
        output.echo_all(_ended(result))

    output.finish(result, json_target, show)


def recover(
    url: UrlArgument,
    bench: BenchOption = "paper",
    journal: JournalOption = DEFAULT_JOURNAL,
    keep: Annotated[
        bool,
        typer.Option(
            "--keep", help="Write nothing: take what stands and close what was left open here"
        ),
    ] = False,
    dry_run: DryRunOption = False,
    json_target: JsonOption = "",
) -> None:
    """Settle what an interrupted upload left; ends in OLD, NEW or DISABLED."""
    from pmac_comp.workflow.controller.upload_flow import recover_upload
    from pmac_comp.workflow.previews import preview_recovery

    if dry_run:
        plan = preview_recovery(url, bench, journal)
        output.finish(plan, json_target, lambda: output.echo_all(_told("settle", plan)))
        _end_rehearsal([] if keep else plan["refusals"])
        return
    progress = ProgressLines()
    result = recover_upload(url, bench, journal, keep=keep, progress=progress)
    progress.close()
    output.finish(result, json_target, lambda: output.echo_all(_ended(result, _SETTLED)))


def rollback(
    url: UrlArgument,
    bench: BenchOption = "paper",
    journal: JournalOption = DEFAULT_JOURNAL,
    persist: PersistOption = False,
    yes: YesOption = False,
    dry_run: DryRunOption = False,
    json_target: JsonOption = "",
) -> None:
    """Bring back what the last upload replaced, verified."""
    from pmac_comp.workflow.controller.upload_flow import rollback_upload
    from pmac_comp.workflow.previews import preview_rollback

    plan = preview_rollback(url, bench, journal)
    if dry_run:
        shown = [*_told("take back", plan)[:-1], *plan["motion"], "nothing was changed"]
        output.finish(plan, json_target, lambda: output.echo_all(shown))
        _end_rehearsal(plan["refusals"])
        return
    if json_target != "-":
        output.echo_all([plan["summary"], *plan["motion"]])
    confirmed(f"Roll back the last upload on {url}?", yes=yes)
    progress = ProgressLines()
    result = rollback_upload(url, bench, journal, persist=persist, progress=progress)
    progress.close()
    output.finish(result, json_target, lambda: output.echo_all(_ended(result)))


def remove(
    url: UrlArgument,
    bench: BenchOption = "paper",
    journal: JournalOption = DEFAULT_JOURNAL,
    yes: YesOption = False,
    dry_run: DryRunOption = False,
    json_target: JsonOption = "",
) -> None:
    """Take the axis' compensation tables and law off, whoever put them on; `rollback` undoes it."""
    from pmac_comp.workflow.controller.removal import plan_removal, remove_compensation

    plan = plan_removal(url, bench)
    parts = [*plan["would_remove"], *plan["motion"]]
    if dry_run or not parts:
        told = [*(parts or ["nothing to remove"]), *plan["stays"]]
        output.finish(plan, json_target, lambda: output.echo_all(told))
        return
    if json_target != "-":
        output.echo_all(parts)
    confirmed(f"Take this off {url}?", yes=yes)
    progress = ProgressLines()
    result = remove_compensation(url, bench, journal, progress=progress)
    progress.close()
    shown = ["removed and verified", *(f"  - {text}" for text in result["said"]), result["next"]]
    output.finish(result, json_target, lambda: output.echo_all(shown))


_MEANS = {
    "NEW": "what was uploaded stands on the controller",
    "OLD": "what stood before stands on the controller",
    "DISABLED": "compensation is off on the controller, or not whole",
}


# What a recovery finds done may have been a removal or a set-up as well.
_SETTLED = {**_MEANS, "NEW": "what the last change meant stands on the controller"}


def _ended(result: dict[str, Any], means: Mapping[str, str] = _MEANS) -> list[str]:
    """The verdict and what it rests on, one statement a line, then what may follow."""
    verdict, said = result["verdict"], result["said"]
    if len(said) == 1:
        return [f"{verdict}: {said[0]}", result["next"]]
    return [f"{verdict}: {means[verdict]}", *(f"  - {text}" for text in said), result["next"]]


def _told(verb: str, plan: dict[str, Any]) -> list[str]:
    refused = [f"  refused: {message}" for message in plan["refusals"]]
    return [f"would {verb}: {plan['summary']}", *refused, "nothing was changed"]


def _end_rehearsal(refusals: Sequence[str]) -> None:
    """Leave as the command itself would where it is refused; what was told stands above."""
    if refusals:
        raise typer.Exit(SafetyRefusal.exit_code)


def _show_runs(plan: "RunsPreview", *, dry_run: bool = False) -> None:
    from pmac_comp.workflow.previews import MOTION_COLUMNS

    output.table("motions", MOTION_COLUMNS, plan.rows())
    output.echo_all(plan.lines())
    if dry_run:
        output.echo("nothing was changed")


def verify(
    ctx: typer.Context,
    url: Annotated[
        str, typer.Argument(help="Controller, or nothing with --before and --after")
    ] = "",
    bench: BenchOption = "paper",
    model: Annotated[
        Path | None, typer.Option("--model", "-m", help="Model file, for the promise")
    ] = None,
    law: Annotated[
        Path | None, typer.Option("--compensation", help="Compensation file, for the promise")
    ] = None,
    before: Annotated[
        list[Path] | None,
        typer.Option("--before", help="Stored runs without it; file or folder"),
    ] = None,
    after: Annotated[
        list[Path] | None,
        typer.Option("--after", help="Stored runs with it; file or folder"),
    ] = None,
    motion: Annotated[
        list[str] | None, typer.Option("--motion", help="As in `capture` (repeatable)")
    ] = None,
    repeats: Annotated[int, typer.Option("--repeats", min=1, help="Pairs of runs a motion")] = 2,
    static: Annotated[
        int,
        typer.Option("--static", min=0, help="Runs of ISO 230-2 on each side; 0 leaves it out"),
    ] = 5,
    seed: SeedOption = 0,
    refine: Annotated[
        int, typer.Option("--refine", min=0, help="Learning passes on the repeated motion")
    ] = 0,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for captures and result")
    ] = None,
    journal: JournalOption = DEFAULT_JOURNAL,
    report: ReportOption = None,
    yes: YesOption = False,
    dry_run: DryRunOption = False,
    json_target: JsonOption = "",
) -> None:
    """Measure before and after on fresh runs, alternating, against the promise."""
    from pmac_comp.workflow.compensation.file import check_bench, named_compensation
    from pmac_comp.workflow.motion.commands import capture_paths
    from pmac_comp.workflow.previews import preview_verification, require_standing
    from pmac_comp.workflow.verification.verify import verify_on_controller
    from pmac_comp.workflow.verification.verify_stored import verify_files

    if law is not None:
        check_bench(law, bench)
    progress = ProgressLines()
    if before or after:
        refuse_unused(
            ctx,
            _OF_A_MEASUREMENT,
            "Stored runs are compared (--before, --after)",
            "--json FILE and --report FILE keep the result. Without --before and --after runs are "
            "made on the controller.",
        )
        first = capture_paths(before or (), side="before")
        second = capture_paths(after or (), side="after")
        outcome = verify_files(bench, first, second, model=model, law=law)
    else:
        if not url:
            raise ConfigError(
                "There is nothing to verify: no controller and no stored runs.",
                code="PC-CLI-011",
                hint="Give a URL, or stored runs with --before and --after.",
            )
        plan = preview_verification(
            bench,
            named_compensation(law),
            motions=tuple(motion or ()),
            repeats=repeats,
            static_runs=static,
            seed=seed,
            refine=refine,
        )
        if dry_run:
            require_standing(url, bench, named_compensation(law))
            output.finish(plan.as_result(), json_target, lambda: _show_runs(plan, dry_run=True))
            return
        if json_target != "-":
            _show_runs(plan)
        confirmed(f"Run verification motions on {url}?", yes=yes)
        outcome = verify_on_controller(
            url,
            bench,
            model=model,
            law=law,
            motions=tuple(motion or ()),
            repeats=repeats,
            static_runs=static,
            seed=seed,
            refine=refine,
            out=out,
            journal=journal,
            progress=progress,
        )
    progress.close()
    if report is not None:
        from pmac_comp.report.run import write_verification_report

        write_verification_report(outcome, output.checked_target(report))

    def lines() -> list[str]:
        kept = [] if out is None else [f"runs and result: {out}"]
        return [*outcome.lines(), *kept]

    output.finish_with_report(outcome.as_result(out), lines, json_target, report)


def improve(
    url: UrlArgument,
    bench: BenchOption,
    model: Annotated[Path | None, typer.Option("--model", "-m", help="Model to start from")] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for everything")] = Path(
        "pmac-comp-improve"
    ),
    route: Annotated[str, typer.Option("--route", help="table, law or servo")] = "law",
    seed: SeedOption = 0,
    effects: EffectsOption = None,
    yes: YesOption = False,
    dry_run: DryRunOption = False,
    json_target: JsonOption = "",
) -> None:
    """Diagnose, grow the model, recompute the compensation, upload it and verify.

    Leaves captures, both models, compensations and verifications in the folder, with a page of the
    diagnosis and one of what each model's compensation leaves. Where the grown model is not better,
    the first compensation is put back.
    """
    from pmac_comp.workflow.improve import JOURNAL, improve_on_controller
    from pmac_comp.workflow.previews import preview_improvement

    plan = preview_improvement(bench, route=route, seed=seed)
    if dry_run:
        output.finish(plan.as_result(), json_target, lambda: _show_runs(plan, dry_run=True))
        return
    if json_target != "-":
        _show_runs(plan)
    confirmed(f"Run motions on {url} and upload new compensation?", yes=yes)
    progress = ProgressLines()
    result = improve_on_controller(
        url, bench, out, model=model, route=route, seed=seed, effects=effects, progress=progress
    )
    progress.close()

    from pmac_comp.report.diagnosis import write_diagnosis_report
    from pmac_comp.report.improvement import write_improvement_report

    write_diagnosis_report(result.diagnosis, out / "diagnosis.html")
    page = write_improvement_report(result, out / "improvement.html")

    def lines() -> list[str]:
        return [
            *result.lines(),
            f"it is {out / f'compensation_{result.kept}.json'}, of the model "
            f"{out / f'{result.kept}_model.json'}; `pmac-comp remove {url} --bench {bench} "
            f"--journal {out / JOURNAL}` takes it off",
        ]

    output.finish_with_report(result.as_result(), lines, json_target, page)
