"""The compensation: law, lead map, correction of a motion, and its file, one JSON for every route.

What lives here: what is uploaded as data, and the tables that follow from it. What may not: how it
is computed (``computing``) and put on a controller (``deploy``).
"""

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
from pmac_comp.files.bench import Bench, load_bench
from pmac_comp.machine.controller.contents.comp_table import BacklashTable, CompTable
from pmac_comp.physics.compensate.exact import Aim
from pmac_comp.physics.compensate.law import CompensationLaw
from pmac_comp.physics.compensate.lead import LeadMap
from pmac_comp.workflow.law.backlash import backlash_table, forward_part
from pmac_comp.workflow.law.rendering import RenderedTable, lead_table

EXACT = "exact"  # in the provenance of a law: what its motion's correction was computed with
_VERSION = 1
_MOTION = ("motion_time_s", "motion_position_m", "motion_correction_m")
ROUTES = ("table", "law", "servo", "cam", "program")
DIGEST_MARK, ROUTE_MARK = "compensation_digest", "compensation_route"  # of runs with it


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
        return {DIGEST_MARK: self.digest, ROUTE_MARK: self.route}

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
    """All of a compensation as JSON takes it, without its digest."""
    arrays = {name: _numbers(getattr(compensation, name)) for name in _MOTION}
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
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
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


def _from_mapping(data: dict[str, Any]) -> Compensation:
    """Compensation from the JSON of a file; ValueError, KeyError or TypeError where it is none."""
    if not isinstance(data["law"].get("provenance", {}), dict):
        raise TypeError("the provenance of the law is no object")
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
