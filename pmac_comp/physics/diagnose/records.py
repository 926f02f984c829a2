"""Captures made ready for comparison: channels, block means, simulated counterparts.

What lives here: how a capture and a simulation become residuals on a common, coarser grid.
No statistics and no decisions. May import ``files`` and ``physics.model``.

The comparison runs closed loop from the command alone (derivatives and feedback both mislead), in
the channels that carry information: motor position and, where there is a scale, table position.
The torque command is a known function of command and motor position, so it adds no evidence of
its own; its gap is reported.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import cached_property, partial
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from pmac_comp.base.arrays import BoolArray, FloatArray
from pmac_comp.base.errors import NotIdentifiable
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.files.capture import EXTERNAL_FORCE, TORQUE_FEEDFORWARD, Capture
from pmac_comp.physics.diagnose.localise import Coordinates, machine_coordinates
from pmac_comp.physics.identify.derivatives import bridged
from pmac_comp.physics.identify.plausibility import require_positions
from pmac_comp.physics.model.drive import DriveModel, Response, simulate
from pmac_comp.physics.model.resting import first_under_way, forgetting_s, start_of
from pmac_comp.physics.model.start import RELAXED, Start
from pmac_comp.physics.signals.grid import onto_servo_grid

_COARSE_Hz = 450.0
_SHORTEST_s = 0.2
_MOST_RECENT, _MOST_COLUMNS = 2, 3
_DATE = "start_utc"
DATED: Mapping[int, float] = MappingProxyType({-1: 0.0})
"""Start times of runs that are those of their files' dates."""
_OVERLAP = 0.7  # of the time that runs take, more than the last of them


def is_dated(model: DriveModel) -> bool:
    """Whether runs begin for a model at the dates of their files."""
    return not DATED.keys().isdisjoint(model.clocks)


class Recent:
    """The last results of a record for whole models: what was fitted is judged and told next.

    Known by the model itself and not by its values: nothing is compared, and nothing mistaken.
    Threads may lose each other's results, which are made anew then.
    """

    def __init__(self) -> None:
        self._responses: tuple[tuple[DriveModel, bool, Response], ...] = ()
        self._columns: tuple[tuple[DriveModel, float, NDArray[np.float32]], ...] = ()

    def response(self, model: DriveModel, *, quantise: bool) -> Response | None:
        """The response to this model, if it is one of the last."""
        kept = self._responses
        return next((r for m, q, r in kept if m is model and q == quantise), None)

    def keep_response(self, model: DriveModel, response: Response, *, quantise: bool) -> None:
        """Add a response; the oldest goes."""
        self._responses = ((model, quantise, response), *self._responses[: _MOST_RECENT - 1])

    def columns(self, model: DriveModel, step_frac: float) -> NDArray[np.float32] | None:
        """Columns of all own directions of a model at a step, shape (m, channels, k), if kept."""
        return next((c for m, s, c in self._columns if m is model and s == step_frac), None)

    def keep_columns(
        self, model: DriveModel, step_frac: float, columns: NDArray[np.float32]
    ) -> None:
        """Add columns, shape (m, channels, k); the oldest go."""
        self._columns = ((model, step_frac, columns), *self._columns[: _MOST_COLUMNS - 1])


@dataclass(frozen=True)
class Record:
    """One capture on the servo grid with its measured channels.

    Parameters
    ----------
    name : str
        For messages and figures.
    capture : Capture
        Source.
    commanded_m, desired_m : ndarray, shape (n,)
        Command on the servo grid.
    measured_m : ndarray, shape (n, channels)
        Motor position, then table position where there is a scale.
    torque_Nm : ndarray, shape (n,) or None
        Measured torque command.
    feedforward_Nm : ndarray, shape (n,) or None
        Known torque beside the control law's, in ``torque_Nm`` too.
    external_force_N : ndarray, shape (n,) or None
        Known force of the loading screws.
    valid : ndarray of bool, shape (n,)
        Samples that may be compared.
    factor : int
        Servo samples per coarse sample.
    period_s : float
        Servo period.
    start : Start
        What integrator and friction hold when the run begins: a real axis rests anywhere within
        its friction, and off the command.
    number : int
        Place in the order in which the captures were given.
    following_s : float
        When the run began if each followed the one before at once.
    dated_s : float or None
        When it began by the dates of the files; None where one of them has none.
    recent : Recent
        Its last results; ``masked`` copies share them, others begin their own.
    """

    name: str
    capture: Capture
    commanded_m: FloatArray
    desired_m: FloatArray
    measured_m: FloatArray
    torque_Nm: FloatArray | None
    feedforward_Nm: FloatArray | None
    external_force_N: FloatArray | None
    valid: BoolArray
    factor: int
    period_s: float
    start: Start = RELAXED
    number: int = 0
    following_s: float = 0.0
    dated_s: float | None = None
    recent: Recent = field(default_factory=Recent, init=False, repr=False, compare=False)

    def masked(self, valid: BoolArray) -> "Record":
        """The same with other valid samples, shape (n,)."""
        copy = replace(self, valid=valid)
        object.__setattr__(copy, "recent", self.recent)  # what is simulated is the same
        return copy

    @property
    def channels(self) -> int:
        """Number of channels: 1 motor only, 2 with a table."""
        return int(self.measured_m.shape[1])

    @property
    def begun_s(self) -> float:
        """Time at which the run began by its own clock."""
        return float(self.capture.time_s[0])

    @property
    def coarse_period_s(self) -> float:
        """Sample period of the coarse grid in s."""
        return self.factor * self.period_s

    @cached_property
    def coarse_measured_m(self) -> FloatArray:
        """Measured channels on the coarse grid, shape (m, channels)."""
        return self.coarsen(self.measured_m)

    @cached_property
    def usable(self) -> BoolArray:
        """Coarse samples all of whose servo samples are valid, shape (m,)."""
        count = self.valid.size // self.factor
        return np.asarray(self.valid[: count * self.factor].reshape(count, -1).all(axis=1))

    def coarsen(self, values: FloatArray) -> FloatArray:
        """Means over ``factor`` samples along the first axis: shape (n, ...) to (m, ...)."""
        count = values.shape[0] // self.factor
        shape = (count, self.factor, *values.shape[1:])
        return np.asarray(values[: count * self.factor].reshape(shape).mean(axis=1))

    def response(
        self,
        model: DriveModel,
        *,
        probe_torque_Nm: FloatArray | None = None,
        probe_force_N: FloatArray | None = None,
        substeps: int | None = None,
        quantise: bool = False,
    ) -> Response:
        """Closed loop with this record's command on the servo grid; probes of shape (n,)."""
        whole = probe_torque_Nm is None and probe_force_N is None and substeps is None
        known = self.recent.response(model, quantise=quantise) if whole else None
        if known is not None:
            return known
        found = simulate(
            model,
            self.commanded_m,
            desired_position_m=self.desired_m,
            torque_feedforward_Nm=_both(self.feedforward_Nm, probe_torque_Nm),
            external_force_N=_both(self.external_force_N, probe_force_N),
            time_origin_s=self._origin_s(model),
            start=self.start,
            substeps=substeps,
            quantise=quantise,
        )
        if whole:
            self.recent.keep_response(model, found, quantise=quantise)
        return found

    def _origin_s(self, model: DriveModel) -> float:
        own_s = self.begun_s if self.dated_s is None or not is_dated(model) else self.dated_s
        return model.clocks.get(self.number, own_s)

    def channels_of(self, response: Response) -> FloatArray:
        """Simulated channels on the servo grid, shape (n, channels)."""
        if self.channels == 1:
            return response.motor_position_m[:, None]
        return np.column_stack([response.motor_position_m, response.table_position_m])

    def simulated_m(self, model: DriveModel, *, substeps: int | None = None) -> FloatArray:
        """Simulated channels on the coarse grid, shape (m, channels)."""
        return self.coarsen(self.channels_of(self.response(model, substeps=substeps)))

    def coordinates(self, response: Response, lead_m_per_rev: float) -> Coordinates:
        """Machine coordinates on the coarse grid, from a simulation (free of sensor noise)."""
        return machine_coordinates(
            self.capture.time_s[0]
            + self.coarse_period_s * np.arange(self.coarse_measured_m.shape[0]),
            self.coarsen(response.motor_position_m),
            self.coarsen(response.torque_command_Nm),
            lead_m_per_rev,
        )


def prepare(captures: Sequence[Capture], bench: Bench, *, prefix: str) -> tuple[Record, ...]:
    """Records of captures.

    Parameters
    ----------
    captures : sequence of Capture
        Runs, from rest or cut out of a motion.
    bench : Bench
        Gives the servo period and says whether there is a scale.
    prefix : str
        Name of a capture that has none and tells no motion.

    Returns
    -------
    tuple of Record

    Raises
    ------
    NotIdentifiable
        A capture is too short or does not move.
    """
    with_table = all(c.table_position_m is not None for c in captures) and bench.scale is not None
    prepared = [
        _prepare_one(c, bench, f"{prefix} {i + 1}", with_table=with_table)
        for i, c in enumerate(captures)
    ]
    ends = np.cumsum([0.0, *(c.n * c.sample_period_s for c in captures)]).tolist()
    return tuple(
        replace(r, number=i, following_s=t, dated_s=d)
        for i, (r, t, d) in enumerate(zip(prepared, ends[:-1], _dated_s(captures), strict=True))
    )


def _dated_s(captures: Sequence[Capture]) -> list[float | None]:
    """Time of every capture in a session that began with the first, by the dates they carry."""
    try:
        dates = [datetime.fromisoformat(str(c.attributes[_DATE])) for c in captures]
        since = [(date - min(dates)).total_seconds() for date in dates]
    except (KeyError, ValueError, TypeError):
        return [None] * len(captures)
    # Runs do not overlap: such dates are those of the files and not of the runs.
    longest_s = sum(c.n * c.sample_period_s for c in captures)
    if max(since) < _OVERLAP * longest_s:
        return [None] * len(captures)
    return [s + float(c.time_s[0]) for s, c in zip(since, captures, strict=True)]


def _prepare_one(capture: Capture, bench: Bench, name: str, *, with_table: bool) -> Record:
    name = str(capture.attributes.get("name") or capture.attributes.get("motion") or name)
    _refuse_useless(capture, name)
    require_positions(capture, bench, name)
    stretch = max(1, round(capture.sample_period_s / bench.servo_period_s))
    period_s = capture.sample_period_s / stretch
    on_servo_grid = partial(onto_servo_grid, stride=stretch)
    columns = [capture.motor_position_m]
    if with_table and capture.table_position_m is not None:
        columns.append(capture.table_position_m)
    readings = [bridged(c, capture.mask) for c in columns]
    force, forward = (
        None if column is None else bridged(column, capture.mask)
        for column in map(capture.extra.get, (EXTERNAL_FORCE, TORQUE_FEEDFORWARD))
    )
    torque = capture.torque_command_Nm
    cycles = np.arange(stretch * (capture.n - 1) + 1) / stretch
    valid = np.interp(cycles, np.arange(capture.n), capture.mask.astype(np.float64)) > 0.999
    followed = _command(capture.desired_m, capture.mask)
    desired = on_servo_grid(followed)
    given = None if torque is None else bridged(torque, capture.mask)
    start = start_of(bench, followed, readings[0], given, capture.sample_period_s, added_Nm=forward)
    first = first_under_way(bench, desired, start, period_s)
    if given is None and start.speed_m_per_s == 0.0:
        # What an integrator holds nobody knows then, until it has forgotten it.
        first += min(round(forgetting_s(bench) / period_s), desired.size // 3)
    valid[:first] = False
    return Record(
        name=name,
        capture=capture,
        commanded_m=on_servo_grid(_command(capture.commanded_position_m, capture.mask)),
        desired_m=desired,
        measured_m=np.column_stack([on_servo_grid(c) for c in readings]),
        torque_Nm=None if given is None else on_servo_grid(given),
        feedforward_Nm=None if forward is None else on_servo_grid(forward),
        external_force_N=None if force is None else on_servo_grid(force),
        valid=valid,
        factor=max(1, round(1.0 / (_COARSE_Hz * period_s))),
        period_s=period_s,
        start=start,
    )


def _both(known: FloatArray | None, probe: FloatArray | None) -> FloatArray | None:
    """Sum of two inputs either of which may be missing."""
    if known is None or probe is None:
        return probe if known is None else known
    return np.asarray(known + probe)


def _command(values: FloatArray, mask: BoolArray) -> FloatArray:
    """The command with gaps filled; where only readings were lost it is known all the same."""
    known = np.isfinite(values)
    if mask.all() or not known.all():
        return bridged(values, mask & known)
    largest = float(np.abs(np.diff(values))[mask[1:] & mask[:-1]].max(initial=0.0))
    smooth = bool(np.abs(np.diff(values)).max(initial=0.0) <= 1.5 * largest)
    return values if smooth else bridged(values, mask)


def _refuse_useless(capture: Capture, name: str) -> None:
    """A diagnosis from nothing would be a confident wrong answer."""
    enough = capture.n * capture.sample_period_s >= _SHORTEST_s and capture.mask.mean() > 0.2
    moves = enough and float(np.ptp(capture.commanded_position_m[capture.mask])) > 1e-6
    if not moves:
        raise NotIdentifiable(
            f"{name} cannot be diagnosed: it is shorter than {_SHORTEST_s} s, mostly invalid, "
            "or its command does not move.",
            code="PC-DIA-001",
            hint="Capture motions in both directions; `pmac-comp capture` proposes a campaign.",
        )


def simulate_all(
    records: Sequence[Record], models: Sequence[DriveModel], executor: Executor
) -> list[list[FloatArray]]:
    """Coarse channels, ``result[model][record]`` of shape (m, channels), on both cores."""
    futures = [[executor.submit(r.simulated_m, m) for r in records] for m in models]
    return [[f.result() for f in row] for row in futures]


@dataclass(frozen=True)
class Gap:
    """Rms differences of measured and simulated signals over records."""

    position_um: float
    torque_Nm: float | None


def gap(records: Sequence[Record], model: DriveModel, executor: Executor) -> Gap:
    """Gap over records: table (motor without a scale), constant offset per record removed."""
    responses = list(executor.map(lambda r: r.response(model), records))
    squares, torques, count = 0.0, 0.0, 0
    for record, response in zip(records, responses, strict=True):
        good = record.valid
        miss = (record.measured_m - record.channels_of(response))[good, -1]
        # The motor has no free offset: its zero is that of the command.
        squares += float(np.sum((miss - (miss.mean() if record.channels > 1 else 0.0)) ** 2))
        count += int(good.sum())
        if record.torque_Nm is not None:
            torques += float(np.sum((record.torque_Nm - response.torque_command_Nm)[good] ** 2))
    has_torque = all(r.torque_Nm is not None for r in records)
    return Gap(
        UM_PER_M * float(np.sqrt(squares / max(count, 1))),
        float(np.sqrt(torques / max(count, 1))) if has_torque else None,
    )
