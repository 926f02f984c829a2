"""The compensation as a file: law, lead map and provenance, one JSON for every route."""

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from pmac_comp.base.arrays import FloatArray, finite_array
from pmac_comp.base.atomic import atomic_write_text
from pmac_comp.base.errors import ConfigError, PmacCompError
from pmac_comp.base.reading import why
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.files.capture import Capture
from pmac_comp.machine.controller.comp_table import BacklashTable, CompTable
from pmac_comp.physics.compensate.exact import Aim
from pmac_comp.physics.compensate.law import CompensationLaw, evaluate_law
from pmac_comp.physics.compensate.lead import LeadMap
from pmac_comp.workflow.backlash import backlash_table, forward_part
from pmac_comp.workflow.rendering import RenderedTable, lead_table
from pmac_comp.workflow.routes import MOTION_ROUTES, TORQUE_ROUTES

EXACT = "exact"  # in the provenance of a law: what its motion's correction was computed with
_VERSION = 1
_MOTION = ("motion_time_s", "motion_position_m", "motion_correction_m")
ROUTES = ("table", "law", "servo", "cam", "program")
_NOTHING_m = 1e-8  # desired and commanded position are the same: far below a count
_CLEAR_um = 1.0  # a correction that a run shows
_DIGEST, _ROUTE = "compensation_digest", "compensation_route"  # attributes of runs with it


@dataclass(frozen=True)
class Compensation:
    """What is uploaded by a route.

    Parameters
    ----------
    route : str
        One of ``table law servo cam program``.
    law : CompensationLaw
        The dynamic law; for ``table`` it is only what was removed from the lead runs.
    lead : LeadMap or None
        Static part, None if it was not measured.
    backlash : bool
        Whether the difference of both directions goes into a backlash table.
    motion_time_s, motion_position_m : ndarray or None
        The one motion of ``cam`` and ``program``.
    motion_correction_m : ndarray or None
        Its exact correction from the model.
    edited : bool
        Whether the file held another digest than its values have.
    """

    route: str
    law: CompensationLaw
    lead: LeadMap | None = None
    motion_time_s: FloatArray | None = None
    motion_position_m: FloatArray | None = None
    motion_correction_m: FloatArray | None = None
    backlash: bool = False
    edited: bool = field(default=False, compare=False)

    def __post_init__(self) -> None:
        check_route(self.route)

    @property
    def digest(self) -> str:
        """SHA-256 of all that acts, as hex text; origin and promise do not act."""
        document = _document(self)
        law = {name: value for name, value in document["law"].items() if name != "provenance"}
        acting = json.dumps({**document, "law": law}, sort_keys=True)
        return hashlib.sha256(acting.encode()).hexdigest()

    @property
    def exact(self) -> Mapping[str, Any]:
        """What is noted of the one motion's correction: aim, room, errors by pass; else empty."""
        noted: Mapping[str, Any] = self.law.provenance.get(EXACT, {})
        return noted

    @property
    def aim(self) -> Aim:
        """Which error the correction of the one motion takes away."""
        told = self.exact.get("aim")
        return Aim.MECHANICAL if told == Aim.MECHANICAL.value else Aim.TOTAL

    @property
    def learned(self) -> tuple[Mapping[str, Any], ...]:
        """Each learning from runs that its correction went through; empty for the model's own."""
        return tuple(self.exact.get("learned", ()))

    @property
    def marks(self) -> dict[str, str]:
        """Attributes by which a run with it tells later which compensation acted."""
        return {_DIGEST: self.digest, _ROUTE: self.route}

    def table(self, bench: Bench) -> RenderedTable[CompTable] | None:
        """Compensation table of the static part, None without one."""
        if self.lead is None:
            return None
        return lead_table(forward_part(self.lead) if self.backlash else self.lead, bench)

    def backlash_table(self, bench: Bench) -> RenderedTable[BacklashTable] | None:
        """Backlash table of the direction-dependent part, None without one."""
        return None if self.lead is None or not self.backlash else backlash_table(self.lead, bench)

    def table_correction(self, bench: Bench) -> Callable[[FloatArray], FloatArray] | None:
        """Correction in m that the tables add at a position in m, mean of both directions."""
        rendered, back = self.table(bench), self.backlash_table(bench)
        if rendered is None:
            return None
        table, count_m = rendered.table, bench.motor_resolution_m
        if back is None:
            return lambda position_m: table.correction_ct(position_m / count_m) * count_m
        backlash = back.table

        def both(position_m: FloatArray) -> FloatArray:
            at = position_m / count_m
            return (table.correction_ct(at) - 0.5 * backlash.backlash_ct(at)) * count_m

        return both


def check_route(route: str) -> str:
    """The route itself; ConfigError for an unknown one."""
    if route not in ROUTES:
        raise ConfigError(
            f"'{route}' is not a route.", code="PC-DEP-001", hint="Use one of " + ", ".join(ROUTES)
        )
    return route


def write_compensation(path: Path, compensation: Compensation) -> None:
    """Write a compensation file, whole or not at all."""
    document = {**_document(compensation), "digest": compensation.digest}
    atomic_write_text(path, json.dumps(document, indent=1) + "\n")


def _document(compensation: Compensation) -> dict[str, Any]:
    arrays = {
        name: _numbers(getattr(compensation, name))
        for name in ("motion_time_s", "motion_position_m", "motion_correction_m")
    }
    lead = compensation.lead
    return {
        "compensation_version": _VERSION,
        "route": compensation.route,
        "law": compensation.law.as_mapping(),
        "lead": None
        if lead is None
        else {
            "position_m": lead.position_m.tolist(),
            "error_m": lead.error_m.tolist(),
            "reversal_m": lead.reversal_m.tolist(),
            "noise_m": lead.noise_m,
        },
        "backlash": compensation.backlash,
        **arrays,
    }


def named_compensation(path: Path | None) -> Compensation:
    """Compensation that a verification switches; ConfigError if none is named."""
    if path is None:
        raise ConfigError(
            "The compensation to verify is not named.",
            code="PC-VER-003",
            hint="Give the uploaded file with --compensation FILE, or stored runs with "
            "--before and --after.",
        )
    return read_compensation(path)


def read_compensation(path: Path) -> Compensation:
    """Compensation read from a file.

    Raises
    ------
    ConfigError
        Not a compensation file, or a value that is not finite.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise _bad(path, why(error)) from error
    except RecursionError as error:
        raise _bad(path, "its values are nested without end") from error
    if not isinstance(data, dict) or data.get("compensation_version") != _VERSION:
        raise _bad(path, "it has no compensation_version 1")
    try:
        found = _from_mapping(data)
        return replace(found, edited=data.get("digest", found.digest) != found.digest)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise _bad(path, f"{type(error).__name__}: {error}") from error
    except ConfigError:
        raise
    except PmacCompError as error:
        raise _bad(path, error.message) from error


def edited_remarks(compensation: Compensation) -> list[str]:
    """That a file was changed by hand, for people; its values are taken as they stand."""
    if not compensation.edited:
        return []
    return [
        "the compensation file was changed after `pmac-comp compensate` wrote it: what it says of "
        "its range, its errors and its cost holds for what was computed, not for what it holds now"
    ]


def check_bench(path: Path, bench: str) -> None:
    """Refuse a compensation that was computed for another bench file.

    Counts per revolution, scale and clock come from the bench file: with another one, metres would
    become the wrong counts.

    Raises
    ------
    ConfigError
        The digests differ. A compensation without a digest passes.
    """
    computed_for = read_compensation(path).law.provenance.get("bench_digest", "")
    loaded = load_bench(bench)
    if computed_for and computed_for != loaded.digest:
        raise ConfigError(
            f"{path} was computed for another bench file than {bench}.",
            code="PC-DEP-003",
            hint="Name its bench file with --bench, or run `pmac-comp compensate` again with this "
            "one. Nothing was changed.",
        )


def check_acted(
    runs: Mapping[str, Capture], expected: Compensation | None, file: str, bench: Bench
) -> tuple[str, ...]:
    """Refuse stored runs with another compensation than the one that is named.

    Parameters
    ----------
    runs : Mapping of str to Capture
        The runs with it, by their names; those that `verify` made tell what acted.
    expected : Compensation or None
        Whose promise they are held against; None for none.
    file : str
        Where it was read from.
    bench : Bench
        Counts of its tables, servo period of its law.

    Returns
    -------
    tuple of str
        What a person should know: runs that do not tell, or that had several without a file.

    Raises
    ------
    ConfigError
        A run tells of another compensation, or shows that none acted.
    """
    acted = {name: str(run.attributes.get(_DIGEST, "")) for name, run in runs.items()}
    if expected is None:
        several = len(set(filter(None, acted.values())))
        told = f"the runs with compensation were made with {several} different ones"
        return (told,) * (several > 1)
    other = [name for name, digest in acted.items() if digest not in {"", expected.digest}]
    if other:
        routes = sorted({str(runs[name].attributes.get(_ROUTE, "")) for name in other})
        raise ConfigError(
            f"{', '.join(other)}: made with another compensation (route {', '.join(routes)}) than "
            f"that of {file} (route {expected.route}).",
            code="PC-VER-007",
            hint="Name with --compensation the file that stood on the controller, or leave it out: "
            "the errors are compared then without its promise and lead.",
        )
    silent = [name for name, digest in acted.items() if not digest]
    if not silent:
        return ()
    for name in silent:
        _require_corrected(name, runs[name], expected, file, bench)
    return (
        f"{len(silent)} of {len(runs)} runs with it do not tell which compensation acted: that it "
        f"was {file} is taken as said",
    )


def _require_corrected(
    name: str, run: Capture, expected: Compensation, file: str, bench: Bench
) -> None:
    """Refuse a run whose desired position is its command though a compensation corrects there."""
    r_m, desired_m = run.commanded_position_m, run.desired_position_m
    if desired_m is None or expected.route in MOTION_ROUTES:
        return  # such a one corrects its own motion only, a program in the command itself
    if float(np.max(np.abs((desired_m - r_m)[run.mask]), initial=0.0)) > _NOTHING_m:
        return
    table, meant_m = expected.table_correction(bench), np.zeros(r_m.size)
    if expected.route in TORQUE_ROUTES:
        meant_m = evaluate_law(expected.law, r_m, run.sample_period_s).correction_m
    if table is not None:
        meant_m = meant_m + table(r_m)
    most_um = float(np.max(np.abs(meant_m[run.mask]), initial=0.0)) * UM_PER_M
    if most_um > _CLEAR_um:
        raise ConfigError(
            f"{name}: no compensation acted in it, its desired position is the commanded one; "
            f"{file} corrects by up to {most_um:.1f} um there.",
            code="PC-WRK-007",
            hint="Give runs that were made with it under --after; `pmac-comp verify URL "
            "--compensation FILE` makes both sides.",
        )


def _from_mapping(data: dict[str, Any]) -> Compensation:
    known = {f.name for f in fields(CompensationLaw)}
    unknown = set(data["law"]) - known
    if unknown:
        raise ValueError(f"unknown law coefficient(s) {sorted(unknown)}")
    lead = data.get("lead")
    motion = [_array(data, name) for name in _MOTION]
    given = zip(_MOTION, motion, strict=True)
    _same_size({name: values for name, values in given if values is not None})
    return Compensation(
        route=str(data["route"]),
        law=CompensationLaw(**data["law"]),
        lead=None if lead is None else _lead(lead),
        motion_time_s=motion[0],
        motion_position_m=motion[1],
        motion_correction_m=motion[2],
        backlash=data.get("backlash", False) is True,
    )


def _lead(data: dict[str, Any]) -> LeadMap:
    position_m, error_m, reversal_m = (
        finite_array(f"lead {name.removesuffix('_m')}", data[name], min_size=2)
        for name in ("position_m", "error_m", "reversal_m")
    )
    _same_size({"position_m": position_m, "error_m": error_m, "reversal_m": reversal_m})
    _rising("lead position_m", position_m)
    return LeadMap(position_m, error_m, reversal_m, _finite(data["noise_m"]))


def _same_size(arrays: Mapping[str, FloatArray]) -> None:
    if len({values.size for values in arrays.values()}) > 1:
        sizes = ", ".join(f"{name} {values.size}" for name, values in arrays.items())
        raise ValueError(f"values that belong together differ in number ({sizes})")


def _rising(name: str, values: FloatArray) -> None:
    steps = np.diff(values)
    if np.any(steps <= 0.0):
        where = int(np.argmax(steps <= 0.0)) + 1
        raise ValueError(f"{name} does not rise at index {where} ({values[where]:.9g})")


def _array(data: dict[str, Any], name: str) -> FloatArray | None:
    values = data.get(name)
    return None if values is None else finite_array(name, values, min_size=2)


def _finite(value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError("a value is not finite")
    return number


def _numbers(values: FloatArray | None) -> list[float] | None:
    return None if values is None else [float(v) for v in np.asarray(values)]


def _bad(path: Path, reason: str) -> ConfigError:
    return ConfigError(
        f"{path} is not a compensation file: {reason}.",
        code="PC-DEP-002",
        hint="`pmac-comp compensate` writes compensation files; one that another version wrote is "
        "computed again.",
    )
