"""Ways to change a model: its own parameters, and every effect of the library from several starts.

What lives here: directions of the joint refit. Effects with memory, dead zones, orders or phases
have local minima, so each is tried from several starts and in each of its places. No statistics.
May import ``physics.model``.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pmac_comp.files.bench import Bench
from pmac_comp.physics.diagnose.clocks import clock_directions, merged_clocks
from pmac_comp.physics.diagnose.spectra import Peaks
from pmac_comp.physics.diagnose.workbench import Direction
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.effect import Effect, split_name
from pmac_comp.physics.model.parameters import ParameterSpec

STEP_FRAC = 0.02
# A tolerance counts as two standard deviations.
_SIGMAS = 2.0
_EDGE = 1.02
# Motor and nut friction act on one shaft; only its wind-up, a few hundredths of a micrometre, tells
# them apart. Their sum is what data shows, their shares stay near the typical ones.
_ROTARY = (
    ("coulomb.nut_Nm", "coulomb.motor_Nm"),
    ("viscous.nut_Nms_per_rad", "viscous.motor_Nms_per_rad"),
)
_SPLIT: Mapping[str, str] = dict([*_ROTARY, *((b, a) for a, b in _ROTARY)])
SPLIT_FRAC = 0.15
# Effects that add to a known parameter: data cannot tell the two apart, so once such an effect is
# named it carries the whole difference from the bench file, and the tolerance widens its interval.
ADDITIONS: Mapping[str, str] = {
    "payload": "chain.table_mass_kg",
    "chain_damping": "chain.damping_time_s",
}


@dataclass(frozen=True)
class Start:
    """One start of one candidate.

    Parameters
    ----------
    effect : str
        Name of the effect.
    key : str
        Name in a model, ``effect`` or ``effect@place``.
    values : Mapping[str, float]
        Starting values, SI, bare names.
    directions : tuple of Direction
        One column, or two when a phase is free (cosine and sine).
    linear : bool
        Whether the effect vanishes with its size; others replace a value of the model.
    clocks : Mapping of int to float
        When runs began, where that is found along with the effect.
    """

    effect: str
    key: str
    values: Mapping[str, float]
    directions: tuple[Direction, ...]
    linear: bool = True
    clocks: Mapping[int, float] = field(default_factory=dict)


def _bare(name: str) -> str:
    return split_name(name)[0]


def relieved(model: DriveModel, effect: str) -> DriveModel:
    """The model with the bench's value of what an effect adds to; the effect takes the rest."""
    name = ADDITIONS.get(effect)
    if name is None or name not in model.parameters:
        return model
    nominal = model.spec(name).nominal
    first = next(spec for spec in model.specs if spec.name.startswith(f"{effect}."))
    value = model.parameters[first.name] + model.parameters[name] - nominal
    return model.with_parameters(
        {name: nominal, first.name: float(np.clip(value, first.lower, first.upper))}
    )


def own_directions(model: DriveModel, *, step_frac: float = STEP_FRAC) -> list[Direction]:
    """Directions along the model's own parameters, known ones within their tolerance.

    ``step_frac`` is the size of a difference as a share of the parameter.
    """
    directions = []
    doubled = {ADDITIONS[name] for name in map(_bare, model.effects) if name in ADDITIONS}
    for spec in model.specs:
        if spec.discrete or spec.name in doubled:
            continue
        direction = _own_direction(model, spec, step_frac)
        if direction is not None:
            directions.append(direction)
    return directions + clock_directions(model, step_frac / STEP_FRAC)


def _own_direction(model: DriveModel, spec: ParameterSpec, step_frac: float) -> Direction | None:
    value = model.parameters[spec.name]
    lower, upper, centre, sigma = spec.lower, spec.upper, value, math.inf
    if spec.kind == "known":
        width = abs(spec.nominal) * (spec.tolerance_frac or 0.0)
        if width <= 0.0:
            return None
        lower = max(lower, spec.nominal - _EDGE * width)
        upper = min(upper, spec.nominal + _EDGE * width)
        centre, sigma = spec.nominal, width / _SIGMAS
    if spec.name in _SPLIT:
        lower, upper = _shared(model, spec, lower, upper)
    step = _step(spec, value, lower, upper, step_frac)
    if step == 0.0:
        return None
    unit = abs(step)
    moved = model.with_parameters({spec.name: value + step})
    return Direction(
        owner="",
        label=spec.name,
        model=moved,
        step=step / unit,
        lower=(lower - value) / unit,
        upper=(upper - value) / unit,
        centre=(centre - value) / unit,
        sigma=sigma / unit,
        unit=unit,
    )


def _shared(
    model: DriveModel, spec: ParameterSpec, lower: float, upper: float
) -> tuple[float, float]:
    """Bounds of a friction that only its sum with another one is known of."""
    other = _SPLIT[spec.name]
    if other not in model.parameters:
        return lower, upper
    total = model.parameters[spec.name] + model.parameters[other]
    nominal = spec.nominal + model.spec(other).nominal
    if total <= 0.0 or nominal <= 0.0:
        return lower, upper
    share = spec.nominal / nominal
    low, high = max(0.0, share - SPLIT_FRAC), min(1.0, share + SPLIT_FRAC)
    return max(lower, low * total), min(upper, high * total)


def _step(spec: ParameterSpec, value: float, lower: float, upper: float, step_frac: float) -> float:
    """Finite step that stays inside the hard bounds; 0 where there is no room."""
    size = step_frac * max(abs(value), spec.scale)
    if spec.kind == "known":
        size = min(size, 10.0 * step_frac * (upper - lower))
    if spec.period:
        size = 0.05 * step_frac / STEP_FRAC
    if value + size <= spec.upper:
        return size
    return -size if value - size >= spec.lower else 0.0


def starts_of(effect: Effect, model: DriveModel, bench: Bench, peaks: Peaks) -> list[Start]:
    """Starts of an effect at a model, leaving out those that the model cannot hold.

    Parameters
    ----------
    effect : Effect
        Candidate.
    model : DriveModel
        Working point.
    bench : Bench
        Tells rigid benches and benches without a scale.
    peaks : Peaks
        Orders and frequencies to try where the effect has one.

    Returns
    -------
    list of Start
    """
    if (model.is_rigid and not effect.rigid) or (effect.needs_scale and bench.scale is None):
        return []
    present = {split_name(name)[0] for name in model.effects}
    if effect.name in present:
        return []
    found = []
    # A rigid bench is one mass: its friction has one place.
    for place in (effect.places[:1] if model.is_rigid else effect.places) or ("",):
        key = f"{effect.name}@{place}" if place else effect.name
        library = {effect.name: effect}
        specs = _specs(model.with_effect(key, library=library), effect.name)
        for values in _start_values(effect, specs, peaks, model):
            found += [
                _start(effect, key, specs, values, model, clocks)
                for clocks in peaks.clocks_for(effect.name, values)
            ]
    return [start for start in found if start.directions]


def _specs(model: DriveModel, effect: str) -> tuple[ParameterSpec, ...]:
    """Parameters of one effect of a model under bare names."""
    prefix = f"{effect}."
    return tuple(
        replace(spec, name=spec.name.removeprefix(prefix))
        for spec in model.specs
        if spec.name.startswith(prefix)
    )


# Effects that replace a value of the model: where to try, as multiples of it.
_FACTORS: Mapping[str, tuple[str, tuple[float, ...]]] = {
    "actuator_delay": ("chain.actuator_delay_s", (0.6, 1.25, 1.6, 2.1, 2.8)),
    "current_bandwidth": ("chain.current_bandwidth_Hz", (0.12, 0.2, 0.35, 0.6, 1.8)),
}

# A torque limit shows only below the largest torque asked for: where to try, as shares of it.
_LIMIT_SHARES = (0.995, 0.98, 0.95, 0.92, 0.89, 0.86, 0.83, 0.8, 0.75, 0.65, 0.45)
_TRIED_AS_THEY_ARE = (*_FACTORS, "torque_saturation")

# Which trace shows the order or frequency of an effect; others try all orders found.
_TRACES = {
    "cogging": "torque",
    "friction_per_rev": "friction",
    "torque_ripple": "ripple",
    "lead_cyclic": "reading",
    "encoder_eccentricity": "reading",
}


# Of the usual orders and frequencies of an effect, those tried whatever peaks: once and twice per
# turn are what couplings, leads and encoders do.
_USUAL = {"order_per_rev": 2, "frequency_Hz": 1}


def _start_values(
    effect: Effect, specs: Sequence[ParameterSpec], peaks: Peaks, model: DriveModel
) -> Iterable[dict[str, float]]:
    """Starting values: those of the effect, or the orders and frequencies that the data shows."""
    names = {spec.name: spec for spec in specs}
    listed: list[dict[str, float]] = []
    for start in effect.starts or ({},):
        values = {spec.name: float(start.get(spec.name, spec.nominal)) for spec in specs}
        # The refit finds the sign of a size by itself.
        mirrored = {k: (-v if k == specs[0].name else v) for k, v in values.items()}
        if values not in listed and mirrored not in listed:
            listed.append(values)
    if effect.name in _FACTORS:
        # Nothing can be learned at the value that the model already has, nor far beyond it.
        name, factors = _FACTORS[effect.name]
        present = model.parameters.get(name) or specs[0].nominal
        inside = [float(np.clip(f * present, specs[0].lower, specs[0].upper)) for f in factors]
        return [{**listed[0], specs[0].name: value} for value in inside]
    if effect.name == "torque_saturation" and peaks.largest_torque_Nm > 0.0:
        tried = [share * peaks.largest_torque_Nm for share in _LIMIT_SHARES]
        return [{**listed[0], specs[0].name: max(specs[0].lower, limit)} for limit in tried]
    orders = getattr(peaks, _TRACES.get(effect.name, "torque"))
    for name, grid in (("order_per_rev", orders), ("frequency_Hz", peaks.frequencies_Hz)):
        if name not in names or not grid or effect.name == "base_mode":
            continue
        spec = names[name]
        usual = [values[name] for values in listed[: _USUAL[name]]]
        wanted = dict.fromkeys([*usual, *(g for g in grid if spec.lower <= g <= spec.upper)])
        listed = [{**listed[0], name: value} for value in wanted]
    return listed


# The parameter that is zero when the effect is absent, where it is not the first.
_AMPLITUDES = {"base_mode": "mass_ratio"}


def amplitude_of(effect: str, specs: Sequence[ParameterSpec]) -> ParameterSpec:
    """The parameter that makes an effect vanish, or the first one."""
    name = _AMPLITUDES.get(effect, specs[0].name)
    return next(spec for spec in specs if spec.name == name)


def _start(
    effect: Effect,
    key: str,
    specs: Sequence[ParameterSpec],
    values: dict[str, float],
    model: DriveModel,
    clocks: Mapping[int, float],
) -> Start:
    clocks = merged_clocks(model, effect.name, values, clocks)
    size = amplitude_of(effect.name, specs)
    library = {effect.name: effect}
    angle = next((spec.name for spec in specs if spec.period), None)
    if values[size.name] == 0.0:
        values = {**values, size.name: min(size.scale, size.upper)}
    turns = [values] if angle is None else [{**values, angle: 0.0}, {**values, angle: math.pi / 2}]
    linear = vanishes(key, size, values, model, library)
    # Near the edge of stability nothing is linear: the value itself is judged, not a step to it.
    exact = effect.name in _TRIED_AS_THEY_ARE
    free_sign = linear and (angle is not None or size.lower < 0.0)
    directions = tuple(
        Direction(
            owner=effect.name,
            label=f"{key} {i}",
            model=model.with_effect(key, turned, library=library).with_clocks(clocks),
            step=1.0,
            lower=-math.inf if free_sign else float(exact),
            upper=math.inf if linear else (1.0 if exact else 3.0),
        )
        for i, turned in enumerate(turns)
    )
    return Start(effect.name, key, values, directions, linear, clocks)


def vanishes(
    key: str,
    size: ParameterSpec,
    values: Mapping[str, float],
    model: DriveModel,
    library: Mapping[str, Effect],
) -> bool:
    """Whether the effect is absent at size zero; others replace a value of the model."""
    if not size.lower <= 0.0 <= size.upper:
        return False
    off = model.with_effect(key, {**values, size.name: 0.0}, library=library)
    if len(off.terms()) != len(model.terms()):
        return True
    changed = off.kernel_vector() - model.kernel_vector()
    on = model.with_effect(key, values, library=library).kernel_vector() - model.kernel_vector()
    # Periods, speeds and centres may differ: they act through the size alone.
    same = np.isclose(changed, on, rtol=1e-12, atol=0.0)
    return bool(np.all((changed == 0.0) | same))


def started(
    start: Start, step: Sequence[float], specs: Sequence[ParameterSpec]
) -> dict[str, float]:
    """Values of an effect after a linearised refit moved it by ``step`` from nothing.

    Parameters
    ----------
    start : Start
        Where the columns were taken.
    step : sequence of float
        Move along each direction, as multiples of the start's size.
    specs : sequence of ParameterSpec
        Of the effect, bare names.

    Returns
    -------
    dict
        Starting values of the nonlinear refit, SI.
    """
    values = dict(start.values)
    size = amplitude_of(start.effect, specs)
    angle = next((spec.name for spec in specs if spec.period), None)
    share = float(step[0])
    if angle is not None:
        # a cos(w) + b cos(w + pi/2) = r cos(w + phi)
        values[angle] = math.atan2(step[1], step[0])
        share = math.hypot(step[0], step[1])
    if start.linear:
        share = share if abs(share) > 0.05 else math.copysign(0.05, share)
        values[size.name] = float(np.clip(values[size.name] * share, size.lower, 0.98 * size.upper))
    return values
