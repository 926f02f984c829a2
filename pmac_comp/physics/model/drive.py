"""The drive model as a value, and its closed-loop simulation.

What lives here: ``DriveModel`` (bench, effects, parameters), ``simulate`` and ``simulate_many``.
What may not: equations (they are in ``kernel``) and fitting. Imports ``files.bench``, ``base``,
``signals``.
"""

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np

from pmac_comp.base.arrays import FloatArray, finite_array
from pmac_comp.base.errors import ModelError
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model import slots as s
from pmac_comp.physics.model.chain import (
    USUAL_SHARES,
    Shares,
    apply_chain,
    apply_quantisation,
    chain_specs,
    is_rigid,
)
from pmac_comp.physics.model.effect import Effect, effect_library, split_name
from pmac_comp.physics.model.loop import run_loop
from pmac_comp.physics.model.parameters import ParameterSpec, merged, within
from pmac_comp.physics.model.start import RELAXED, Start
from pmac_comp.physics.model.terms import TableTerm, packed
from pmac_comp.physics.signals.trajectory import Trajectory

BASE_EFFECTS = ("coulomb", "viscous")
# Four per servo period of 442 us: table positions within 1 nm of the converged ones, but for steps
# of torque (tools/bench model).
_SUBSTEP_s = 1.15e-4


@dataclass(frozen=True)
class DriveModel:
    """A drive: what the bench file states, the effects it contains and their parameters.

    Parameters
    ----------
    bench : Bench
        Geometry, controller and nominal values.
    effects : tuple of str
        Effects in the order they were added, ``effect`` or ``effect@place``.
    parameters : Mapping of str to float
        SI values under ``effect.parameter``; what is missing is nominal.
    library : Mapping of str to Effect or None
        Further effects (a user's own).
    clocks : Mapping of int to float
        Per run, by its number, the time in s at which it began for the effects that depend on time,
        where a fit found it; others begin at their own time. No property of the drive: not filed.
    shares : Shares
        How the drive divides what its bench file states as one figure. Not known: not filed either.

    Raises
    ------
    ModelError
        Unknown effect, place or parameter, or a value outside its bounds.
    NonFinite
        A value is NaN or infinite.
    """

    bench: Bench
    effects: tuple[str, ...] = BASE_EFFECTS
    parameters: Mapping[str, float] = field(default_factory=dict)
    library: Mapping[str, Effect] = field(default_factory=dict)
    clocks: Mapping[int, float] = field(default_factory=dict)
    shares: Shares = USUAL_SHARES

    def __post_init__(self) -> None:
        object.__setattr__(self, "effects", tuple(self.effects))
        names = [split_name(name)[0] for name in self.effects]
        if len(set(names)) != len(names):
            raise ModelError(
                f"An effect is named twice in {', '.join(self.effects)}.",
                code="PC-MOD-008",
                hint="Name each effect once; presliding at all its places is presliding@all.",
            )
        values = merged(self.specs, self.parameters)
        object.__setattr__(self, "parameters", MappingProxyType(values))

    def __getstate__(self) -> dict[str, Any]:
        return {
            "bench": self.bench,
            "effects": self.effects,
            "parameters": dict(self.parameters),
            "library": dict(self.library),
            "clocks": dict(self.clocks),
            "shares": self.shares,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        for name, value in state.items():
            object.__setattr__(self, name, value)
        object.__setattr__(self, "parameters", MappingProxyType(state["parameters"]))

    @classmethod
    def base(cls, bench: Bench, parameters: Mapping[str, float] | None = None) -> "DriveModel":
        """Elastic chain of the bench with Coulomb and viscous friction, loop and sensors."""
        return cls(bench, BASE_EFFECTS, parameters or {})

    @property
    def is_rigid(self) -> bool:
        """Whether the bench is one mass."""
        return is_rigid(self.bench)

    @cached_property
    def specs(self) -> tuple[ParameterSpec, ...]:
        """All parameters of the model in a fixed order, under their full names."""
        found = list(chain_specs(self.bench))
        for name in self.effects:
            effect, place = self.effect(name)
            found += [within(effect.name, spec) for spec in effect.specs(place)]
        return tuple(found)

    def spec(self, name: str) -> ParameterSpec:
        """Specification of one parameter by its full name."""
        for spec in self.specs:
            if spec.name == name:
                return spec
        raise ModelError(
            f"The model has no parameter {name}.",
            code="PC-MOD-003",
            hint="It has " + ", ".join(spec.name for spec in self.specs),
        )

    def effect(self, name: str) -> tuple[Effect, str]:
        """Effect and place of a name in ``effects``."""
        bare, place = split_name(name)
        effect = self.library.get(bare) or effect_library().get(bare)
        if effect is None:
            raise ModelError(
                f"There is no effect '{bare}'.",
                code="PC-MOD-009",
                hint="Known: " + ", ".join([*effect_library(), *self.library]),
            )
        known = (*effect.places, *effect.joint_places)
        if place and place not in known:
            raise ModelError(
                f"Effect '{bare}' has no place '{place}'.",
                code="PC-MOD-018",
                hint="It has " + (", ".join(known) or "none"),
            )
        if self.is_rigid and "rigid" in effect.place_parameters:
            return effect, "rigid"
        return effect, place or (effect.places[0] if effect.places else "")

    def with_effect(
        self,
        name: str,
        values: Mapping[str, float] | None = None,
        *,
        library: Mapping[str, Effect] | None = None,
    ) -> "DriveModel":
        """Copy with an effect added; ``values`` are SI under bare or full parameter names."""
        bare = split_name(name)[0]
        given = {
            key if "." in key else f"{bare}.{key}": value for key, value in (values or {}).items()
        }
        return DriveModel(
            self.bench,
            (*self.effects, name),
            {**self.parameters, **given},
            {**self.library, **(library or {})},
            self.clocks,
            self.shares,
        )

    def without_effect(self, name: str) -> "DriveModel":
        """Copy without an effect and its parameters."""
        bare = split_name(name)[0]
        kept = tuple(item for item in self.effects if split_name(item)[0] != bare)
        if len(kept) == len(self.effects):
            raise ModelError(
                f"The model has no effect '{name}'.",
                code="PC-MOD-019",
                hint="It has " + ", ".join(self.effects),
            )
        values = {
            key: value for key, value in self.parameters.items() if not key.startswith(f"{bare}.")
        }
        return DriveModel(self.bench, kept, values, self.library, self.clocks, self.shares)

    def with_parameters(self, values: Mapping[str, float]) -> "DriveModel":
        """Copy with some parameters (full names, SI) changed."""
        return replace(self, parameters={**self.parameters, **values})

    def with_clocks(self, clocks: Mapping[int, float]) -> "DriveModel":
        """Copy in which runs began at other times."""
        return replace(self, clocks=dict(clocks))

    def values_of(self, effect: str) -> dict[str, float]:
        """Parameters of one effect under bare names, SI."""
        prefix = f"{split_name(effect)[0]}."
        return {
            key.removeprefix(prefix): value
            for key, value in self.parameters.items()
            if key.startswith(prefix)
        }

    def kernel_vector(self, *, quantise: bool = False) -> FloatArray:
        """Parameters in the layout of the kernel, shape (N_SLOTS,)."""
        vector = s.neutral_vector()
        apply_chain(vector, self.values_of("chain"), self.bench, self.shares)
        # Levels and masses first: break distances and harmonics refer to them.
        ordered = sorted(self.effects, key=lambda name: split_name(name)[0] not in _FIRST)
        for name in ordered:
            effect, place = self.effect(name)
            effect.apply(vector, self.values_of(name), self.bench, place)
        if quantise:
            apply_quantisation(vector, self.bench)
        return vector

    def terms(self) -> tuple[TableTerm, ...]:
        """Table terms of all effects."""
        found: list[TableTerm] = []
        for name in self.effects:
            effect, place = self.effect(name)
            make = effect.place_terms.get(place, effect.terms)
            if make is not None:
                found += make(self.values_of(name), self.bench)
        return tuple(found)

    @property
    def substeps(self) -> int:
        """Substeps per servo period that the model asks for."""
        usual = math.ceil(self.bench.servo_period_s / _SUBSTEP_s)
        return max(4, usual, self._least_substeps)

    def coarser_substeps(self, factor: int) -> int:
        """So many times fewer substeps, where the effects allow it: for comparisons of runs."""
        return max(math.ceil(self.substeps / factor), self._least_substeps)

    @property
    def _least_substeps(self) -> int:
        return max((self.effect(name)[0].min_substeps for name in self.effects), default=1)


_FIRST = ("coulomb", "viscous", "payload")


@dataclass(frozen=True)
class Response:
    """What a simulated run gives, all shapes (n,).

    Parameters
    ----------
    time_s, commanded_position_m, desired_position_m : ndarray
        Grid and the two inputs.
    motor_position_m, table_position_m : ndarray
        Readings of encoder (expressed at the table) and scale.
    torque_command_Nm : ndarray
        Controller output.
    motor_torque_Nm, joint_force_N : ndarray
        Torque at the shaft and elastic force in the nut.
    true_motor_position_m, true_table_position_m : ndarray
        The readings before the sensors round them; the same without ``quantise``.
    """

    time_s: FloatArray
    commanded_position_m: FloatArray
    desired_position_m: FloatArray
    motor_position_m: FloatArray
    table_position_m: FloatArray
    torque_command_Nm: FloatArray
    motor_torque_Nm: FloatArray
    joint_force_N: FloatArray
    true_motor_position_m: FloatArray
    true_table_position_m: FloatArray

    @property
    def mechanical_error_m(self) -> FloatArray:
        """Table minus motor in m, shape (n,)."""
        return self.table_position_m - self.motor_position_m

    @property
    def control_error_m(self) -> FloatArray:
        """Motor minus desired position in m, shape (n,)."""
        return self.motor_position_m - self.desired_position_m


def simulate(
    model: DriveModel,
    commanded_position_m: FloatArray | Trajectory,
    *,
    desired_position_m: FloatArray | None = None,
    torque_feedforward_Nm: FloatArray | None = None,
    external_force_N: FloatArray | None = None,
    time_origin_s: float = 0.0,
    substeps: int | None = None,
    quantise: bool = False,
    extra_terms: Sequence[TableTerm] = (),
    start: Start = RELAXED,
) -> Response:
    """Response of the closed loop to a command sampled at the servo period.

    Parameters
    ----------
    model : DriveModel
        The drive.
    commanded_position_m : ndarray, shape (n,), or Trajectory
        Trajectory r in m, one sample per servo period.
    desired_position_m : ndarray, shape (n,), or None
        r plus correction, what the controller follows; None means no correction.
    torque_feedforward_Nm : ndarray, shape (n,), or None
        Added to the controller's output.
    external_force_N : ndarray, shape (n,), or None
        Force on the table, positive pushes against positive motion.
    time_origin_s : float
        Time of the first sample, for effects that depend on time.
    substeps : int or None
        Substeps per servo period; None takes what the model asks for.
    quantise : bool
        Round what encoder, scale and output resolve, inside the loop.
    extra_terms : sequence of TableTerm
        Further forces or readings, e.g. a flexible competitor.
    start : Start
        State in which the run begins: at rest and relaxed on the first desired position, unless
        a torque is held, an error is left or the axis moves already.

    Returns
    -------
    Response
        Readings and torque, shape (n,) each.

    Raises
    ------
    NonFinite
        An input is not finite, or the loop became unstable.
    ModelError
        Lengths differ, or the delay is longer than 250 servo periods.

    Source
    ------
    Lagrange's equations of motor, screw end, screw and table; method in ``kernel_chain``.
    """
    if isinstance(commanded_position_m, Trajectory):
        _check_grid(model, commanded_position_m)
        commanded_position_m = commanded_position_m.position_m
    commanded = finite_array("commanded_position_m", commanded_position_m, min_size=2)
    desired = _like(commanded, "desired_position_m", desired_position_m, commanded)
    zeros = np.zeros(commanded.size)
    torque = _like(commanded, "torque_feedforward_Nm", torque_feedforward_Nm, zeros)
    force = _like(commanded, "external_force_N", external_force_N, zeros)
    origin = float(finite_array("time_origin_s", [time_origin_s])[0])
    vector = model.kernel_vector(quantise=quantise)
    begun = [start.torque_Nm, start.error_m, start.speed_m_per_s]
    vector[s.START] = finite_array("start", begun)
    n_sub = model.substeps if substeps is None else substeps
    rows, values = packed([*model.terms(), *extra_terms])
    out = run_loop(vector, n_sub, desired, torque, force, rows, values, origin)
    cycles: FloatArray = np.arange(commanded.size, dtype=np.float64)
    return Response(
        time_s=origin + cycles * model.bench.servo_period_s,
        commanded_position_m=commanded,
        desired_position_m=desired,
        motor_position_m=out[0],
        table_position_m=out[1],
        torque_command_Nm=out[2],
        motor_torque_Nm=out[3],
        joint_force_N=out[4],
        true_motor_position_m=out[5],
        true_table_position_m=out[6],
    )


def simulate_many(
    models: Sequence[DriveModel],
    commands: Sequence[FloatArray | Trajectory],
    *,
    executor: Executor | None = None,
    options: Sequence[Mapping[str, Any]] | Mapping[str, Any] | None = None,
    workers: int = 2,
) -> list[Response]:
    """Responses of ``models[i]`` to ``commands[i]`` on all cores.

    Parameters
    ----------
    models, commands : sequences of equal length; a single command serves all models.
        What to simulate; commands in m, shape (n,) each, may differ in length.
    executor : concurrent.futures.Executor or None
        Where to run; None uses threads (the kernel releases the interpreter lock).
    options : mapping, sequence of mappings or None
        Keyword arguments of ``simulate`` for all, or for each.
    workers : int
        Threads if no executor is given.

    Raises
    ------
    ModelError
        Lengths differ; further as ``simulate``.
    """
    n = len(models)
    all_commands = list(commands) * n if len(commands) == 1 else list(commands)
    each = [options or {}] * n if options is None or isinstance(options, Mapping) else list(options)
    if len(all_commands) != n or len(each) != n:
        raise ModelError(
            f"{n} models, {len(commands)} commands and {len(each)} options do not belong together.",
            code="PC-MOD-012",
        )
    jobs = list(zip(models, all_commands, each, strict=True))
    if executor is not None:
        return list(executor.map(_simulate_job, jobs))
    if n < 2:
        return [_simulate_job(job) for job in jobs]
    with ThreadPoolExecutor(max_workers=max(1, workers)) as pool:
        return list(pool.map(_simulate_job, jobs))


def _simulate_job(
    job: tuple[DriveModel, FloatArray | Trajectory, Mapping[str, Any]],
) -> Response:
    model, command, options = job
    return simulate(model, command, **options)


def _check_grid(model: DriveModel, trajectory: Trajectory) -> None:
    period = model.bench.servo_period_s
    if abs(trajectory.sample_period_s / period - 1.0) > 1e-4:
        raise ModelError(
            f"The trajectory is sampled at {trajectory.sample_period_s:g} s, "
            f"the servo period is {period:g} s.",
            code="PC-MOD-013",
            hint="Sample the command once per servo period.",
        )


def _like(
    reference: FloatArray, name: str, value: FloatArray | None, default: FloatArray
) -> FloatArray:
    if value is None:
        return default
    array = finite_array(name, value)
    if array.size != reference.size:
        raise ModelError(
            f"{name} has {array.size} samples, the command {reference.size}.", code="PC-MOD-014"
        )
    return array
