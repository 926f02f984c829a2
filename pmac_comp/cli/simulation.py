"""Commands around the simulated controller: ``demo`` and ``sim``."""

import json
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from pmac_comp.cli import output
from pmac_comp.cli.options import BenchOption, JsonOption, SeedOption
from pmac_comp.cli.progress import ProgressLines


class DpramChoice(StrEnum):
    """Dual-ported RAM of the simulated card."""

    small = "small"
    large = "large"
    none = "none"


PlantOption = Annotated[
    str,
    typer.Option("--plant", metavar="FILE[:FACTORY]", help="Drive of your own (make_plant(bench))"),
]


def register(app: typer.Typer) -> None:
    """Add the commands of this group."""
    app.command("demo")(demo)
    app.command("sim")(sim)


def demo(
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for captures, model and report")
    ] = Path("pmac-comp-demo"),
    bench: BenchOption = "paper",
    plant: PlantOption = "",
    route: Annotated[
        str, typer.Option("--route", help="law, servo, table, cam or program")
    ] = "law",
    seed: SeedOption = 0,
    json_target: JsonOption = "",
) -> None:
    """Run the whole job on the simulated Turbo PMAC and end with a report."""
    from pmac_comp.workflow.demo import run_demo

    progress = ProgressLines()
    result = run_demo(
        out, bench=bench, plant=plant or None, route=route, seed=seed, progress=progress
    )
    progress.close()
    from pmac_comp.report.run import write_run_report

    path = write_run_report(result, out / "report.html")

    def show() -> None:
        for line in result.summary():
            output.echo(line)
        output.echo(f"report: {path}")

    output.finish({**result.as_result(), "report": path}, json_target, show)


def _tell_endpoints(endpoints: dict[str, Any], json_target: str) -> None:
    """One line for programs that wait for it, in any case; in the file of ``--json`` as well."""
    if json_target not in {"", "-"}:
        output.write_json(json_target, endpoints)
    output.echo(json.dumps(endpoints))
    sys.stdout.flush()  # who started us may wait for it


def sim(
    tcp: Annotated[
        int | None,
        typer.Option(
            "--tcp", min=0, max=65535, help="Packet port over TCP (0: any; no port named: 1025)"
        ),
    ] = None,
    udp: Annotated[
        int | None,
        typer.Option("--udp", min=0, max=65535, help="Packet port over UDP (0: any)"),
    ] = None,
    ascii_port: Annotated[
        int | None,
        typer.Option(
            "--ascii-port", min=0, max=65535, help="ASCII port as behind a terminal server"
        ),
    ] = None,
    pty: Annotated[bool, typer.Option("--pty", help="Serial line on a pseudo terminal")] = False,
    host: Annotated[str, typer.Option("--host", help="Address to listen on")] = "127.0.0.1",
    bench: BenchOption = "paper",
    plant: PlantOption = "",
    servo: Annotated[
        Path | None,
        typer.Option(
            "--servo",
            help="Source of the open servo to run; feedforward_servo.txt for p_block of the bench",
        ),
    ] = None,
    speed: Annotated[
        str,
        typer.Option(
            "--speed",
            help="real, a factor, or max; captures bear the host's dates, so that what drifts "
            "seems as much faster",
        ),
    ] = "real",
    dpram: Annotated[
        DpramChoice | None,
        typer.Option("--dpram", help="Dual-ported RAM; not given: that of the bench file"),
    ] = None,
    flash: Annotated[Path | None, typer.Option("--flash", help="Flash image on disk")] = None,
    force: Annotated[
        Path | None, typer.Option("--force", help="CSV of the external force: time_s,force_N")
    ] = None,
    supported: Annotated[
        bool, typer.Option("--supported", help="Print what the simulated card supports, and stop")
    ] = False,
    json_target: JsonOption = "",
    faults: Annotated[
        bool, typer.Option("--faults", help="Let clients command faults (tests only)")
    ] = False,
) -> None:
    """Serve a simulated Turbo PMAC; prints one JSON line with its endpoints when ready.

    --json FILE keeps that line too.
    """
    if supported:
        from pmac_comp.simulator.dialog.support import report, report_lines

        output.finish(report(), json_target, lambda: output.echo_all(report_lines()))
        return
    from pmac_comp.workflow.capture.simulated import serve_forever

    serve_forever(
        tcp=tcp,
        udp=udp,
        ascii_port=ascii_port,
        pty=pty,
        host=host,
        bench=bench,
        plant=plant or None,
        servo=servo,
        speed=speed,
        dpram=None if dpram is None else dpram.value,
        flash=flash,
        force=force,
        faults=faults,
        starting=lambda: output.say(
            "starting; the first time on a machine its kernels are compiled, about a minute"
        ),
        ready=lambda endpoints: _tell_endpoints(endpoints, json_target),
    )
