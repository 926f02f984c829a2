"""Commands on captures and models: ``identify``, ``predict``, ``diagnose``, ``compare``."""

from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from pmac_comp.cli import output
from pmac_comp.cli.options import (
    BenchOption,
    CapturesArgument,
    EffectsOption,
    JsonOption,
    ReportOption,
    ValidateOption,
)
from pmac_comp.cli.progress import ProgressLines


class FrictionChoice(StrEnum):
    """How ``identify`` finds the form of friction."""

    auto = "auto"
    coulomb = "coulomb"


class RoundingChoice(StrEnum):
    """How ``predict`` treats the rounding of encoder and scale."""

    expected = "expected"
    none = "none"


def register(app: typer.Typer) -> None:
    """Add the commands of this group."""
    app.command("identify")(identify)
    app.command("predict")(predict)
    app.command("diagnose")(diagnose)
    app.command("compare")(compare)


def identify(
    captures: CapturesArgument,
    bench: BenchOption,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Model file to write")] = None,
    model: Annotated[
        Path | None, typer.Option("--model", help="Start from this model and its effects")
    ] = None,
    with_effect: Annotated[
        list[str] | None, typer.Option("--with", help="Add an effect by name (repeatable)")
    ] = None,
    friction: Annotated[
        FrictionChoice,
        typer.Option(
            "--friction",
            help="auto: Coulomb and viscous, and presliding, Stribeck friction or friction that "
            "turns over with speed where the captures show them on samples that were not fitted; "
            "coulomb: the base model only",
        ),
    ] = FrictionChoice.auto,
    report: ReportOption = None,
    effects: EffectsOption = None,
    json_target: JsonOption = "",
) -> None:
    """Identify friction and stiffness together from captures, with intervals.

    With --model or --with, exactly these effects are fitted. Otherwise the form of friction is
    chosen by the captures (--friction), and the output says which one and why.
    """
    from pmac_comp.workflow.model.identification import identify_files
    from pmac_comp.workflow.motion.commands import capture_paths

    progress = ProgressLines()
    outcome = identify_files(
        capture_paths(captures),
        bench,
        model=model,
        added=tuple(with_effect or ()),
        effects=effects,
        friction=friction.value,
        progress=progress,
    )
    progress.close()
    if out is not None:
        outcome.write(output.checked_target(out))
    if report is not None:
        from pmac_comp.report.identification import write_identification_report

        write_identification_report(outcome, output.checked_target(report))

    def show() -> None:
        output.table(
            "identified",
            ("parameter", "value", "unit", "std", "lower 95 %", "upper 95 %", "bench file"),
            outcome.rows(),
        )
        left = ", ".join(f"{what} {value:.3g} {unit}" for what, value, unit in outcome.left())
        output.echo(f"left by the model, rms: {left}")
        for line in outcome.statements():
            output.echo(f"  {line}")
        for path, what in ((out, "model"), (report, "report")):
            if path is not None:
                output.echo(f"{what}: {path}")

    output.finish(outcome.as_result(), json_target, show)


def predict(
    bench: BenchOption,
    model: Annotated[Path, typer.Option("--model", "-m", help="Model file")],
    command: Annotated[
        Path, typer.Option("--command", "-c", help="Command as CSV, or a capture (.csv .h5 .mat)")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Capture to write")],
    effects: EffectsOption = None,
    rounding: Annotated[
        RoundingChoice,
        typer.Option(
            "--rounding",
            help="expected: the loop runs on rounded readings, the mean of what can be foreseen is "
            "given; none: the loop runs on exact readings",
        ),
    ] = RoundingChoice.expected,
    json_target: JsonOption = "",
) -> None:
    """Predict motor and table position and torque for a command.

    The command is a CSV file with time_s,commanded_position_mm, which begins at rest, or any
    capture, whose corrected command and load are used where it holds them, and how it began: the
    torque held at rest, or the speed of a capture that was cut out of a motion. The answer has the
    columns of a capture at the times of the command; a command on another grid than the servo's is
    interpolated. Positions are those of motor and table before encoder and scale round them; zero
    is the middle of a count. An earlier prediction is replaced, a captured run is not.
    """
    from pmac_comp.workflow.model.prediction import predict_files

    result = predict_files(
        bench,
        model,
        command,
        output.checked_target(out),
        effects=effects,
        rounding=rounding.value,
    )

    def show() -> None:
        if result["resampled"]:
            output.echo(f"note: {result['resampled']}")
        output.echo(
            f"{out}: {result['samples']} samples predicted, table - motor "
            f"{result['mechanical_rms_um']:.3f} um rms, motor - command "
            f"{result['control_rms_um']:.3f} um rms"
        )

    output.finish(result, json_target, show)


def diagnose(
    captures: CapturesArgument,
    bench: BenchOption,
    validate: ValidateOption = None,
    model: Annotated[
        Path | None, typer.Option("--model", help="Base model instead of the default one")
    ] = None,
    base: Annotated[
        list[str] | None,
        typer.Option(
            "--base",
            help="Effect of the base model (repeatable) instead of coulomb and viscous, e.g. "
            "--base viscous",
        ),
    ] = None,
    report: ReportOption = None,
    effects: EffectsOption = None,
    json_target: JsonOption = "",
) -> None:
    """Find where simulation and measurement disagree and name the missing effect.

    Without --validate part of the captures is held back for judging. With --json FILE the grown
    model is stored beside it as FILE.model.json.
    """
    from pmac_comp.workflow.model.diagnosis import diagnose_files
    from pmac_comp.workflow.motion.commands import capture_paths

    progress = ProgressLines()
    outcome = diagnose_files(
        capture_paths(captures),
        capture_paths(validate or ()),
        bench,
        model=model,
        base=tuple(base or ()),
        effects=effects,
        model_out=None
        if json_target in {"", "-"}
        else Path(json_target).with_suffix(".model.json"),
        progress=progress,
    )
    progress.close()
    if report is not None:
        from pmac_comp.report.diagnosis import write_diagnosis_report

        write_diagnosis_report(outcome, output.checked_target(report))

    output.finish_with_report(outcome.as_result(), outcome.lines, json_target, report)


def compare(
    captures: CapturesArgument,
    bench: BenchOption,
    validate: ValidateOption = None,
    report: ReportOption = None,
    json_target: JsonOption = "",
) -> None:
    """Fit rival models to the same captures and show what each leaves uncorrected.

    Beside them what one would do otherwise (scale feedback, notch, friction feedforward, learning),
    simulated on the identified model. On a bench without a scale friction models are compared on
    the motor of one record: closed loop lap by lap, and one step ahead.
    """
    from pmac_comp.workflow.model.comparison import compare_files
    from pmac_comp.workflow.motion.commands import capture_paths

    progress = ProgressLines()
    result = compare_files(
        capture_paths(captures), capture_paths(validate or ()), bench, progress=progress
    )
    progress.close()
    if report is not None:
        from pmac_comp.report.comparison import write_comparison_report

        write_comparison_report(result, output.checked_target(report))

    def show() -> None:
        if "laps" in result:
            _show_rigid(result)
            return
        output.table(
            "what each model leaves uncorrected (rms, captures not used for fitting)",
            ("model", "left um", "of um", "parameters", "source"),
            [
                (r["name"], r["left_rms_um"], r["error_rms_um"], r["n_parameters"], r["source"])
                for r in result["models"]
            ],
        )
        output.echo_all(result["remarks"])
        ways = result["alternatives"]
        if ways["rows"]:
            output.echo()
            output.table(
                f"what one would do otherwise, um rms ({ways['basis']})",
                ("way", "total", "table - motor", "... + correction", "how"),
                [
                    (
                        r["name"],
                        r["total_rms_um"],
                        r["mechanical_rms_um"],
                        r["residual_rms_um"],
                        r["how"],
                    )
                    for r in ways["rows"]
                ],
            )
        if report is not None:
            output.echo(f"report: {report}")

    output.finish(result, json_target, show)


def _show_rigid(result: Mapping[str, Any]) -> None:
    from pmac_comp.workflow.model.comparison import floor_lines

    laps = result["laps"]
    output.table(
        f"motor position from the command alone, um rms (fitted: first {laps['fitted']} of "
        f"{laps['all']} laps)",
        ("coulomb + viscous +", "judged laps", "each lap", "one step nm", "parameters"),
        [
            (
                r["name"],
                round(r["left_rms_um"], 2),
                "  ".join(f"{value:.2f}" for value in r["laps_um"]),
                round(r["one_step_nm"], 1),
                r["n_parameters"],
            )
            for r in result["models"]
        ],
    )
    for name, why in result["refused"].items():
        output.echo(f"  {name}: {why}")
    output.echo_all(floor_lines(result))
