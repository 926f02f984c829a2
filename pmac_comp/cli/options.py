"""Options and arguments that several commands share, so that they read the same everywhere."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer

from pmac_comp.base.errors import ConfigError
from pmac_comp.cli import output


def is_given(ctx: typer.Context, name: str) -> bool:
    """Whether a person gave a parameter, be it the value that it has by default."""
    source = ctx.get_parameter_source(name)
    # Typer has a copy of click's enumeration of its own: compared by name.
    return source is not None and source.name != "DEFAULT"


def refuse_unused(ctx: typer.Context, names: Iterable[str], why: str, hint: str) -> None:
    """Refuse what was given and would be left aside, rather than leave it without a word.

    Raises
    ------
    ConfigError
        One of the parameters is given; ``why`` says what has no use for it.
    """
    given = [n for n in names if is_given(ctx, n)]
    if given:
        spelled = {p.name: p.opts[0] for p in ctx.command.params}
        listed = " and ".join("a URL" if n == "url" else spelled[n] for n in given)
        raise ConfigError(
            f"{why}, and {listed} {'is' if len(given) == 1 else 'are'} given as well.",
            code="PC-CLI-016",
            hint=f"Leave it out; {hint}",
        )


def _say_default_bench(ctx: typer.Context, param: typer.CallbackParam, bench: str) -> str:
    """Say which bench is assumed where a real controller is spoken to and none was named."""
    url = str(ctx.params.get("url") or "sim://")
    if not is_given(ctx, str(param.name)) and not url.startswith("sim://"):
        output.say(f"bench: {bench} (the default; name the file of this axis with --bench)")
    return bench


UrlArgument = Annotated[
    str,
    typer.Argument(help="sim:// tcp://host:1025 udp://host:1025 serial:///dev/ttyS0 ssh://..."),
]
CapturesArgument = Annotated[
    list[Path], typer.Argument(help="Captures: .h5 .csv .mat, or folders of them")
]
CompensationArgument = Annotated[
    Path, typer.Argument(help="Compensation file written by `compensate`")
]
BenchArgument = Annotated[str, typer.Argument(help="Bench file or the name of a bundled one")]
BenchOption = Annotated[
    str,
    typer.Option(
        "--bench",
        "-b",
        help="Bench file or the name of a bundled one",
        callback=_say_default_bench,
    ),
]
EffectsOption = Annotated[
    Path | None,
    typer.Option(
        "--effects",
        help="Python file with effects of your own, as configs/effect_worn_stretch.py",
    ),
]
ValidateOption = Annotated[
    list[Path] | None,
    typer.Option("--validate", help="Captures or folders for judging, one or several"),
]
JournalOption = Annotated[
    Path, typer.Option("--journal", file_okay=False, help="Folder for backup and journal")
]
PersistOption = Annotated[
    bool, typer.Option("--persist", help="SAVE to flash afterwards and verify (motors killed)")
]
ReportOption = Annotated[Path | None, typer.Option("--report", help="HTML report to write")]
SeedOption = Annotated[int, typer.Option("--seed", help="Draws the verification motions")]
YesOption = Annotated[bool, typer.Option("--yes", "-y", help="Do not ask")]
DryRunOption = Annotated[
    bool, typer.Option("--dry-run", help="Print what would be sent, change nothing")
]
JsonOption = Annotated[
    str,
    typer.Option(
        "--json",
        metavar="[FILE]",
        help="Result as JSON on standard output, or into FILE (a name that ends in .json).",
        show_default=False,
    ),
]
