"""Reports of a whole run and of a verification."""

from pathlib import Path

from pmac_comp import __version__
from pmac_comp.base.errors import ConfigError
from pmac_comp.base.units import US_PER_S
from pmac_comp.files.bench import Bench, parse_bench
from pmac_comp.files.capture import told_by
from pmac_comp.report.page import Page, Section, Table, write_page
from pmac_comp.report.verification import headline, verification_sections
from pmac_comp.workflow.accuracy.positioning_sheet import begun
from pmac_comp.workflow.compensation.text import describe
from pmac_comp.workflow.demo import RunResult
from pmac_comp.workflow.verification.result import Verification

_SIMULATED = (
    "The controller and the drive behind it are simulated. Figures marked 'measured' are what the "
    "simulated sensors read through the wire protocol, quantised as on the bench; {true}figures "
    "marked 'promised' come from the identified model alone."
)
_TRUE = (
    "figures marked 'true' are the plant's unquantised positions, which no sensor of a real axis "
    "sees; "
)
_MEASURED = "All figures marked 'measured' come from captures; 'promised' ones from the model."


def notice_of(verification: Verification) -> str:
    """What the marks of the figures mean: those of this page."""
    if not verification.simulated:
        return _MEASURED
    has_truth = any(motion.truth is not None for motion in verification.motions)
    return _SIMULATED.format(true=_TRUE if has_truth else "")


def write_run_report(result: RunResult, path: Path) -> Path:
    """Report of a whole job."""
    page = Page(
        title=result.title,
        subtitle=f"{result.bench.name or 'bench'} – {result.controller}",
        notice=notice_of(result.verification),
        headline=headline(result.verification),
        sections=[
            *verification_sections(result.verification),
            _model_section(result),
            _compensation_section(result),
            _time_section(result),
        ],
        facts={
            "pmac-comp": __version__,
            "bench digest": result.bench.digest,
            "servo period us": result.bench.servo_period_s * US_PER_S,
        },
    )
    return write_page(page, path)


def write_verification_report(verification: Verification, path: Path) -> Path:
    """Report of a verification alone."""
    page = Page(
        title="Verification: before and after compensation",
        subtitle=_axis_name(verification)
        + (f"route {verification.route}, " if verification.route else "")
        + f"{len(verification.motions)} motion"
        + "s" * (len(verification.motions) != 1),
        notice=notice_of(verification),
        headline=headline(verification),
        sections=verification_sections(verification),
        facts={
            "pmac-comp": __version__,
            **_where_and_when(verification),
            "steps of the sensors": f"{verification.floor_um:.3f} um rms of table minus motor",
        },
        signed=("Machine, axis, serial number", "Measured by", "Date, signature"),
    )
    return write_page(page, path)


def _axis_name(verification: Verification) -> str:
    """Name in the bench file that the runs carry, for a subtitle; nothing where none does."""
    bench = _bench(verification)
    return "" if bench is None or not bench.name else f"{bench.name} – "


def _bench(verification: Verification) -> Bench | None:
    """Bench file that the runs carry; None for runs without one, or of another version."""
    texts = _told(verification, "bench_text")
    try:
        return parse_bench(texts[0]) if texts else None
    except ConfigError:
        return None


def _where_and_when(verification: Verification) -> dict[str, str]:
    """Controller, bench file, compensation, and when it was run, as far as the runs say it."""
    bench = _bench(verification)
    facts = {} if bench is None else {"digest of the bench file": bench.digest}
    for key, name in (
        ("controller", "fingerprint of the controller"),
        ("compensation_digest", "digest of the compensation"),
    ):
        told = _told(verification, key)
        facts |= {name: ", ".join(told)} if told else {}
    return facts | dict(begun(_told(verification, "start_utc")))


def _told(verification: Verification, key: str) -> list[str]:
    """What the attributes of all runs say under a key, each once, sorted."""
    return sorted(told_by((*verification.before, *verification.after), key))


def _model_section(result: RunResult) -> Section:
    return Section(
        "Identified model",
        text=[
            f"Effects: {', '.join(result.identified.model_file.effects) or 'base'}. The host knew "
            "the bench file only.",
            *result.identified.statements(),
        ],
        tables=[
            Table(
                ("parameter", "value", "unit", "std", "lower 95 %", "upper 95 %", "bench file"),
                result.identified.rows(),
            )
        ],
    )


def _compensation_section(result: RunResult) -> Section:
    parts = [
        (p.route, p.verdict.value, f"{p.crc_old:08x}", f"{p.crc_new:08x}", p.disabled_s)
        for p in result.deployment.parts
    ]
    described = describe(result.bench, result.compensation)
    return Section(
        "Compensation and upload",
        text=[
            f"The upload ended in {result.deployment.verdict.value}.",
            *result.deployment.notes,
            *result.remarks,
        ],
        tables=[
            Table(("item", "value"), list(described.items())),
            Table(("part", "verdict", "old checksum", "new checksum", "off for s"), parts),
        ],
    )


def _time_section(result: RunResult) -> Section:
    tables = [Table(("step", "s"), [(s.name, round(s.seconds, 1)) for s in result.steps])]
    text = []
    if result.plant_notes:
        text = [
            "The simulated drive holds, unknown to the host: " + "; ".join(result.plant_notes) + "."
        ]
    return Section("What ran", text=text, tables=tables, open=False)
