"""Whether captures and models belong together and to a bench: sensors, screw, controller.

What lives here: refusals before any computing. What may not: anything that changes data.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pmac_comp.base.errors import CaptureError, ConfigError
from pmac_comp.base.units import MM_PER_M, US_PER_S
from pmac_comp.files.bench import Bench, parse_bench
from pmac_comp.files.capture import Capture, file_digest, read_capture
from pmac_comp.files.model_file import ModelFile

# What the columns of a capture depend on. Inertias and stiffnesses do not count: they are being
# refined.
_OF_THE_AXIS = (
    "screw.pitch_mm",
    "encoder.counts_per_rev",
    "encoder.motor_number",
    "scale.resolution_um",
    "scale.motor_number",
    "drive.torque_per_dac_Nm",
)
PERIOD_TOLERANCE = 1e-3
_PERIOD = "controller.servo_period_us"
_COARSEST = 200.0  # servo periods per sample: below 12 Hz nothing of a drive is seen
_TRAVELS = 1.5  # a command may reach over a travel that is stated too tightly
_FAR = 10.0  # times the farthest end: a zero that lies elsewhere, and no other unit
_START = "start_utc"
_SAME_SAMPLES = 1e-9  # m or N m: below every resolution, above what the digits of a CSV lose
_SAME_MOTION_FRAC = 0.05  # of the stroke: a run may begin some samples later than another


def captures_of(paths: Sequence[Path], bench: Bench) -> list[Capture]:
    """Captures read from files, each made on the axis of the bench file.

    Raises
    ------
    CaptureError
        A file cannot be read.
    ConfigError
        Another axis, not sampled at the servo period or a multiple of it, or one run twice.
    """
    found = [read_capture(path) for path in paths]
    check_no_copies([str(path) for path in paths], found)
    for path, capture in zip(paths, found, strict=True):
        check_same_axis(capture, bench, path.name)
        check_scales(capture, bench, path.name)
    return found


def check_scales(capture: Capture, bench: Bench, name: str) -> None:
    """Refuse a capture whose time or lengths cannot be those of this axis: units, above all.

    The sample period must be the servo period or a multiple of it, and the command must lie within
    a travel like that of the bench file.

    Raises
    ------
    ConfigError
        They are not.
    """
    ratio = capture.sample_period_s / bench.servo_period_s
    if ratio > _COARSEST:
        raise ConfigError(
            f"{name} is sampled every {capture.sample_period_s:.4g} s, {ratio:.0f} servo periods.",
            code="PC-IDF-008",
            hint="Is its time in milliseconds? time_s is in seconds. Else capture finer.",
        )
    _check_period(ratio, capture, bench, name)
    used_mm = capture.commanded_position_m[capture.mask] * MM_PER_M
    if used_mm.size:
        _check_lengths(float(used_mm.min()), float(used_mm.max()), bench, name)


def _check_lengths(low_mm: float, high_mm: float, bench: Bench, name: str) -> None:
    travel = bench.travel
    farthest_mm = max(abs(travel.min_mm), abs(travel.max_mm))
    too_long = high_mm - low_mm > _TRAVELS * (travel.max_mm - travel.min_mm)
    if too_long or max(-low_mm, high_mm) > _FAR * farthest_mm:
        raise ConfigError(
            f"{name} commands {low_mm:.4g} to {high_mm:.4g} mm, the travel of the bench file is "
            f"{travel.min_mm:g} to {travel.max_mm:g} mm.",
            code="PC-IDF-009",
            hint="Are its positions in um or counts? They are in mm. Else correct [travel].",
        )


def _check_period(ratio: float, capture: Capture, bench: Bench, name: str) -> None:
    if ratio < 1.0 - PERIOD_TOLERANCE or abs(ratio / round(ratio) - 1.0) > PERIOD_TOLERANCE:
        raise ConfigError(
            f"{name} is sampled every {capture.sample_period_s * US_PER_S:.2f} us, the servo "
            f"period of the bench is {bench.servo_period_s * US_PER_S:.2f} us.",
            code="PC-IDF-001",
            hint="Use the bench file of this axis, or capture at the servo rate.",
        )


def check_same_axis(capture: Capture, bench: Bench, name: str) -> None:
    """Refuse a capture whose own bench text tells of another axis.

    Parameters
    ----------
    capture : Capture
        May carry the text of the bench file it was made with.
    bench : Bench
        The bench file that was given.
    name : str
        Of the capture, for the error.

    Raises
    ------
    ConfigError
        Screw, sensors or output differ.
    """
    _refuse_differences(capture, bench, name, _axis_of)


def check_same_loop(capture: Capture, bench: Bench, name: str) -> None:
    """Refuse a capture of another axis or under other gains: its loop is simulated.

    As ``check_same_axis``, with the control law beside the axis.
    """
    _refuse_differences(capture, bench, name, lambda b: {**_axis_of(b), **_law_of(b)})


def _refuse_differences(
    capture: Capture, bench: Bench, name: str, facts: Callable[[Bench], Mapping[str, Any]]
) -> None:
    text = str(capture.attributes.get("bench_text", ""))
    if not text:
        return
    try:
        own = parse_bench(text, name=f"bench text in {name}")
    except ConfigError:
        return  # of an older version; the period is checked in any case
    differences = _differences(facts(own), facts(bench), "capture")
    if differences:
        raise ConfigError(
            f"{name} was captured on another axis or under other gains ({_named(own)}) than the "
            f"bench file states ({_named(bench)}): {'; '.join(differences)}.",
            code="PC-DIA-010",
            hint="Give the bench file of this capture. If its stored text is wrong, take the "
            f"samples without it: `pmac-comp convert {name} {Path(name).stem}.csv`.",
        )


def check_same_drive(stored: ModelFile, bench: Bench, name: str) -> None:
    """Refuse a model of another axis: screw, sensors, output or clock differ.

    Parameters
    ----------
    stored : ModelFile
        Says what it was identified on; one that does not say is taken as it is.
    bench : Bench
        The bench file that was given.
    name : str
        Of the model file, for the error.

    Raises
    ------
    ConfigError
        With the keys that differ.
    """
    if not stored.axis:
        return
    differences = _differences(stored.axis, bench.axis_facts, "model", same=_equal)
    if differences:
        raise ConfigError(
            f"{name} was identified on another axis ({stored.bench_name or 'without a name'}) than "
            f"the bench file states ({_named(bench)}): {'; '.join(differences)}.",
            code="PC-DIA-015",
            hint="Give the bench file that the model was identified with, or identify again with "
            "this one.",
        )


def _equal(key: str, first: Any, second: Any) -> bool:
    """Equal as far as a model file keeps digits; a bench file may round what another has of I10."""
    if isinstance(first, (int, float)) and isinstance(second, (int, float)):
        return math.isclose(first, second, rel_tol=PERIOD_TOLERANCE if key == _PERIOD else 1e-6)
    return bool(first == second)


def _identical(_: str, first: Any, second: Any) -> bool:
    return bool(first == second)


def _named(bench: Bench) -> str:
    return bench.name or "without a name"


def _axis_of(bench: Bench) -> dict[str, Any]:
    facts = bench.axis_facts
    return {key: facts.get(key) for key in _OF_THE_AXIS}


def _law_of(bench: Bench) -> dict[str, Any]:
    law = bench.controller
    found: dict[str, Any] = {"controller.kind": law.kind}
    found |= {f"controller.ivariables.{k}": v for k, v in _gains(bench).items()}
    stated = {"si": law.si, "cascade": law.cascade}.get(law.kind)
    if stated is not None:
        found |= {f"controller.{law.kind}.{k}": v for k, v in stated.model_dump().items()}
    return found


def _gains(bench: Bench) -> Mapping[str, float]:
    """I-variables of the motor's servo law, Ixx30 to Ixx39 and Ixx68."""
    if bench.controller.kind != "pmac":
        return {}
    motor = bench.encoder.motor_number
    names = [f"I{motor * 100 + tail}" for tail in (*range(30, 40), 68)]
    held = bench.controller.ivariables
    return {name: held[name] for name in names if name in held}


def _differences(
    own: Mapping[str, Any],
    given: Mapping[str, Any],
    owner: str,
    *,
    same: Callable[[str, Any, Any], bool] = _identical,
) -> list[str]:
    return [
        f"{key} {_shown(own.get(key))} in the {owner}, {_shown(given.get(key))} in the bench file"
        for key in dict.fromkeys([*own, *given])
        if not same(key, own.get(key), given.get(key))
    ]


def _shown(value: Any) -> str:
    return "not stated" if value is None else f"{value:g}" if isinstance(value, float) else value


def check_one_motion(name: str, runs: Sequence[Capture]) -> None:
    """Refuse runs whose commands are not one motion at one place.

    Parameters
    ----------
    name : str
        Of the comparison, for the error.
    runs : sequence of Capture
        To be compared with each other.

    Raises
    ------
    ConfigError
        With what two of the runs do.
    """
    first, *others = runs
    stroke_m = float(np.ptp(first.commanded_position_m))
    for other in others:
        n = min(first.n, other.n)
        apart_m = first.commanded_position_m[:n] - other.commanded_position_m[:n]
        differs = float(np.sqrt(np.mean(apart_m**2))) > _SAME_MOTION_FRAC * stroke_m
        if differs or n < (1.0 - _SAME_MOTION_FRAC) * max(first.n, other.n):
            raise ConfigError(
                f"{name}: the runs to be compared are of two motions, {_motion_of(first)} and "
                f"{_motion_of(other)}.",
                code="PC-VER-004",
                hint="Give the same motions on both sides, in the same order.",
            )


def _motion_of(capture: Capture) -> str:
    r_mm = capture.commanded_position_m * MM_PER_M
    seconds = capture.n * capture.sample_period_s
    return f"{r_mm.min():.1f} to {r_mm.max():.1f} mm in {seconds:.1f} s"


def check_channels(captures: Mapping[str, Capture], bench: Bench) -> str:
    """Refuse captures of which only some hold the table; gives back a remark where none does.

    Raises
    ------
    CaptureError
        The table is missing in some captures only.
    """
    without = [name for name, c in captures.items() if c.table_position_m is None]
    if bench.scale is None or not without:
        return ""
    if len(without) < len(captures):
        raise CaptureError(
            f"The column table_position_mm is missing in {', '.join(without)}, the others have it.",
            code="PC-DIA-011",
            hint="Leave these captures out, or capture them again with the scale.",
        )
    return (
        "No capture holds table_position_mm although the bench file states a scale: only what the "
        "motor shows is judged."
    )


def check_two_sides(before: Sequence[Path], after: Sequence[Path]) -> None:
    """Refuse a run that is given both without and with compensation; raises ConfigError."""
    digests = {file_digest(path): path for path in before}
    twice = [f"{path} is {digests[d]}" for path in after if (d := file_digest(path)) in digests]
    if twice:
        raise ConfigError(
            f"Given without and with compensation alike: {', '.join(twice)}.",
            code="PC-WRK-006",
            hint="Give runs without it under --before and runs with it under --after.",
        )


def check_no_copies(names: Sequence[str], captures: Sequence[Capture]) -> None:
    """Refuse one run given twice, also as a copy or in another format: it is evidence once.

    Parameters
    ----------
    names, captures : sequence of str, sequence of Capture
        What is to be counted together.

    Raises
    ------
    ConfigError
        With the copies.
    """
    given = list(zip(names, captures, strict=True))
    twice = [
        f"{name} is {first}"
        for i, (name, capture) in enumerate(given)
        for first in [
            next((n for n, other in given[:i] if n == name or _is_copy(capture, other)), "")
        ]
        if first
    ]
    if twice:
        raise ConfigError(
            f"One run is given twice: {', '.join(twice)}.",
            code="PC-WRK-008",
            hint="Give each run once: a copy would count as a second measurement.",
        )


def _is_copy(one: Capture, other: Capture) -> bool:
    """Whether two captures hold the same samples in every column that both have.

    A run at rest is none: a quiet sensor reads the same twice. Nor are two of which neither tells
    when it began, or that began at different times: a simulated drive does the same again.
    """
    if one is other:
        return True
    starts = {capture.attributes.get(_START) for capture in (one, other)}
    if starts == {None} or len(starts - {None}) > 1:
        return False
    if one.n != other.n or not np.ptp(one.commanded_position_m):
        return False
    pairs = (
        (one.commanded_position_m, other.commanded_position_m),
        (one.motor_position_m, other.motor_position_m),
        (one.table_position_m, other.table_position_m),
        (one.torque_command_Nm, other.torque_command_Nm),
    )
    return all(
        np.allclose(a, b, rtol=0.0, atol=_SAME_SAMPLES, equal_nan=True)
        for a, b in pairs
        if a is not None and b is not None
    )


def check_side_marks(before: Mapping[str, Capture], after: Mapping[str, Capture]) -> None:
    """Refuse runs whose header says that they belong to the other side.

    Parameters
    ----------
    before, after : Mapping of str to Capture
        Name to run, without and with compensation.

    Raises
    ------
    ConfigError
        With the runs.
    """
    sides = ((before, "on"), (after, "off"))
    wrong = [
        f"{name} says 'compensation = {other}'"
        for runs, other in sides
        for name, run in runs.items()
        if run.attributes.get("compensation") == other
    ]
    if wrong:
        raise ConfigError(
            f"Runs stand on the wrong side: {', '.join(wrong)}.",
            code="PC-VER-008",
            hint="Give runs without it under --before and runs with it under --after.",
        )


def check_not_twice(fit: Mapping[str, str], judge: Mapping[str, str]) -> None:
    """Refuse a capture that would fit and judge at once.

    Parameters
    ----------
    fit, judge : Mapping of str to str
        Name to digest.

    Raises
    ------
    CaptureError
        The same samples stand on both sides.
    """
    digests = {digest: name for name, digest in fit.items()}
    twice = [f"{name} ({digests[d]})" for name, d in judge.items() if d in digests]
    if twice:
        raise CaptureError(
            f"Given for fitting and for judging alike: {', '.join(twice)}.",
            code="PC-DIA-012",
            hint="A model must be judged on captures it has not seen; leave --validate out to let "
            "some be held back.",
        )
