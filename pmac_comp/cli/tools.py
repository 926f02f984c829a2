"""Commands on files alone: ``convert``, ``config``, ``report``."""

from pathlib import Path
from typing import Annotated

import typer

from pmac_comp.cli import output
from pmac_comp.cli.options import BenchArgument, JsonOption

config_app = typer.Typer(name="config", help="Bench files: show, check, example, servo.")


def register(app: typer.Typer) -> None:
    """Add the commands of this group."""
    app.command("convert")(convert)
    app.command("report")(report)
    app.add_typer(config_app, name="config")


def convert(
    source: Annotated[Path, typer.Argument(help="Capture: .h5 .csv .mat")],
    target: Annotated[Path, typer.Argument(help="Capture to write: .h5 .csv")],
    json_target: JsonOption = "",
) -> None:
    """Convert a capture: HDF5, CSV or MAT to HDF5 or CSV. An earlier capture is not replaced."""
    from pmac_comp.files.capture import read_capture, write_capture

    capture = read_capture(source)
    write_capture(output.checked_target(target), capture)
    result = {
        "source": source,
        "target": target,
        "samples": capture.n,
        "sample_period_s": capture.sample_period_s,
        "has_table": capture.table_position_m is not None,
        "has_torque": capture.torque_command_Nm is not None,
    }
    output.finish(
        result, json_target, lambda: output.echo(f"{target}: {capture.n} samples written")
    )


def report(
    run: Annotated[
        Path,
        typer.Argument(
            help="Result of verify, demo, identify, compare, improve or diagnose (JSON)"
        ),
    ],
    out: Annotated[Path, typer.Option("--out", help="HTML file to write")] = Path("report.html"),
    json_target: JsonOption = "",
) -> None:
    """Write the self-contained HTML report of a stored result."""
    from pmac_comp.report.stored import report_from_file

    path = report_from_file(run, output.checked_target(out))
    output.finish({"report": path}, json_target, lambda: output.echo(f"report: {path}"))


@config_app.command("show")
def config_show(
    bench: BenchArgument,
    json_target: JsonOption = "",
) -> None:
    """Print every key of a bench file and what it is, defaults included, and what follows."""
    from pmac_comp.files.bench import load_bench
    from pmac_comp.workflow.bench.view import as_result, bench_rows

    loaded = load_bench(bench)
    result = as_result(loaded)

    def show() -> None:
        output.table(
            loaded.name or str(bench), ("key", "value", "from", "what it is"), bench_rows(loaded)
        )
        output.table("follows from it", ("quantity", "value"), list(result["derived"].items()))

    output.finish(result, json_target, show)


@config_app.command("check")
def config_check(
    bench: BenchArgument,
    json_target: JsonOption = "",
) -> None:
    """Check a bench file: keys, values, whether its figures fit each other and its gains ring."""
    from pmac_comp.files.bench import load_bench
    from pmac_comp.workflow.bench.remarks import loop_remarks, remarks

    loaded = load_bench(bench)
    found = remarks(loaded) + loop_remarks(loaded)

    def show() -> None:
        output.echo(f"{bench}: no wrong keys or values")
        for line in found:
            output.echo(f"  note: {line}")

    output.finish({"bench": str(bench), "ok": True, "remarks": found}, json_target, show)


@config_app.command("example")
def config_example(
    name: Annotated[str, typer.Argument(help="Bundled bench: paper, paper_x4, emps")] = "paper",
    json_target: JsonOption = "",
) -> None:
    """Print a bundled bench file to start from."""
    from pmac_comp.files.bench import load_bench

    loaded = load_bench(name)
    output.finish(
        {"name": name, "text": loaded.text}, json_target, lambda: output.echo(loaded.text.rstrip())
    )


@config_app.command("servo")
def config_servo(
    bench: BenchArgument,
    json_target: JsonOption = "",
) -> None:
    """Print the open servo's source for a bench file's p_block, for the vendor's compiler."""
    from pmac_comp.workflow.bench.view import servo_result

    result = servo_result(bench)
    output.finish(result, json_target, lambda: output.echo(result["text"].rstrip()))
