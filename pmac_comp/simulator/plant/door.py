"""The plug-in door: what a plant must offer, and how a user's file is loaded.

What lives here: the protocol and the loader of ``--plant FILE[:FACTORY]``. What may not: any plant.
Python is executed only from a path that a person typed. Imports ``files`` and ``base``.
"""

import importlib.util
import math
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import USER_CODE_ERRORS, ConfigError, ModelError, NonFinite
from pmac_comp.files.bench import Bench
from pmac_comp.simulator.plant.ballscrew import BallscrewPlant

_DEFAULT_FACTORY = "make_plant"
_TRIAL_STEPS = 3


@runtime_checkable
class Plant(Protocol):
    """One ``step`` is one servo period: torque held over [k, k+1), readings latched at k+1.

    ``set_external_force(force_N)`` is optional; positive pushes against positive motion.
    """

    def reset(self, table_position_m: float = 0.0) -> None:
        """Put the drive at rest at a table position in m."""

    def step(self, torque_command_Nm: float) -> tuple[float, float]:
        """Motor angle in rad and table position in m after one period of this torque."""


class GuardedPlant:
    """A user's plant with what the card needs around it: finite values, a record of the truth.

    Parameters
    ----------
    plant : Plant
        The user's plant.
    lead_m_per_rad : float
        Screw lead, so that the record is in m for both sides.
    name : str
        Where it came from, for error texts.
    """

    def __init__(self, plant: Plant, lead_m_per_rad: float, name: str = "plant") -> None:
        self.plant = plant
        self._lead = lead_m_per_rad
        self._name = name
        self._reading = (0.0, 0.0)
        self._cycle = 0
        self._log: FloatArray = np.zeros((0, 4))
        self._recorded = 0

    def reset(self, table_position_m: float = 0.0) -> None:
        """Put the drive at rest; it reads the motor angle that belongs to the position."""
        try:
            self.plant.reset(table_position_m)
        except USER_CODE_ERRORS as error:
            raise self._failed("reset", error) from error
        self._reading = (table_position_m / self._lead, table_position_m)
        self._cycle = 0

    def reading(self) -> tuple[float, float]:
        """Latest motor angle in rad and table position in m."""
        return self._reading

    def step(self, torque_command_Nm: float) -> tuple[float, float]:
        """One servo period.

        Raises
        ------
        ModelError
            The user's code failed, or did not return two numbers.
        NonFinite
            They are not finite.
        """
        self._cycle += 1
        try:
            result = self.plant.step(torque_command_Nm)
        except USER_CODE_ERRORS as error:
            raise self._failed("step", error) from error
        angle, table = self._pair(result)
        if not (math.isfinite(angle) and math.isfinite(table)):
            raise NonFinite(
                f"{self._name} returned ({angle}, {table}) in servo cycle {self._cycle}.",
                code="PC-PLT-014",
                hint="The plant has diverged; check its integration step and its parameters.",
            )
        self._reading = (angle, table)
        if self._log.shape[0]:
            row = self._recorded % self._log.shape[0]
            self._log[row] = (self._cycle, angle * self._lead, table, torque_command_Nm)
            self._recorded += 1
        return self._reading

    def set_external_force(self, force_N: float) -> None:
        """Force on the table in N, if the user's plant takes one."""
        push = getattr(self.plant, "set_external_force", None)
        if push is None:
            return
        try:
            push(force_N)
        except USER_CODE_ERRORS as error:
            raise self._failed("set_external_force", error) from error

    def _pair(self, result: object) -> tuple[float, float]:
        """Motor angle and table position out of whatever ``step`` returned."""
        if isinstance(result, tuple | list | np.ndarray) and len(result) == len(self._reading):
            try:
                if all(np.ndim(value) == 0 for value in result):
                    return float(result[0]), float(result[1])
            except (TypeError, ValueError):
                pass
        raise ModelError(
            f"{self._name}: step returned {_shown(result)} in servo cycle {self._cycle}.",
            code="PC-PLT-016",
            hint="It returns two numbers: motor angle in rad and table position in m.",
        )

    def _failed(self, what: str, error: BaseException) -> ModelError:
        line = _line_of(error, self._name)
        return ModelError(
            f"{self._name}: {what} failed in servo cycle {self._cycle}{line}: "
            f"{type(error).__name__}: {error}.",
            code="PC-PLT-015",
            hint="The plant file is the user's own; run it with Python by itself first.",
        )

    def record(self, n_cycles: int) -> None:
        """Start a ring of the values before quantisation; 0 stops it."""
        self._log = np.zeros((n_cycles, 4))
        self._recorded = 0

    def recorded(self) -> dict[str, FloatArray]:
        """Values since ``record``, oldest first, as ``BallscrewPlant.recorded`` gives them."""
        capacity = self._log.shape[0]
        first = max(0, self._recorded - capacity)
        rows = np.arange(first, self._recorded) % max(capacity, 1)
        table = self._log[rows] if capacity else np.zeros((0, 4))
        names = ("cycle", "motor_position_m", "table_position_m", "torque_Nm")
        return {name: table[:, i].copy() for i, name in enumerate(names)}


def load_plant(text: str, bench: Bench) -> Plant:
    """Plant made by a user's file.

    Parameters
    ----------
    text : str
        ``FILE`` or ``FILE:FACTORY``; the factory (default ``make_plant``) takes the bench.
    bench : Bench
        The loaded bench file.

    Raises
    ------
    ConfigError
        No such file, no such factory, it fails to import or to run, or its result is not a plant.
    ModelError, NonFinite
        The plant fails in a trial of a few servo periods without torque.

    Returns
    -------
    Plant
        Our own compiled drive as it is, any other one with a guard around it.
    """
    path, factory_name, factory = _factory_of(text)
    try:
        plant = factory(bench)
    except USER_CODE_ERRORS as error:
        raise ConfigError(
            f"{factory_name} of {path} failed{_line_of(error, path.name)}: "
            f"{type(error).__name__}: {error}.",
            code="PC-PLT-015",
            hint="It is called with the loaded bench file, see `pmac_comp.files.bench.Bench`.",
        ) from error
    if not isinstance(plant, Plant):
        raise ConfigError(
            f"{factory_name} of {path} returned {type(plant).__name__}, which is not a plant.",
            code="PC-PLT-013",
            hint="It needs reset(table_position_m=0.0) and step(torque_command_Nm).",
        )
    # A class of the user's own that inherits from the drive keeps its own step.
    if type(plant) is BallscrewPlant:
        plant.reset()
        return plant
    guarded = GuardedPlant(plant, bench.lead_m_per_rad, path.name)
    guarded.reset()
    for _ in range(_TRIAL_STEPS):
        guarded.step(0.0)
    guarded.reset()
    return guarded


def _shown(result: object) -> str:
    text = repr(result)
    return text if len(text) < 80 else f"{type(result).__name__} {text[:60]}..."


def _line_of(error: BaseException, name: str) -> str:
    """Where in the user's file an error came from, as `` (line 12)``, empty if not known."""
    lines = [
        frame.lineno
        for frame in traceback.extract_tb(error.__traceback__)
        if Path(frame.filename).name == name
    ]
    return f" (line {lines[-1]})" if lines else ""


def check_plant(text: str) -> None:
    """Refuse what is no file or defines no such factory; raises ConfigError. Makes no plant."""
    _factory_of(text)


def _factory_of(text: str) -> tuple[Path, str, Callable[[Bench], object]]:
    path, name = _split(text)
    factory = getattr(_module_from(path), name, None)
    if not callable(factory):
        raise ConfigError(
            f"{path} has no factory '{name}'.",
            code="PC-PLT-012",
            hint="Define make_plant(bench), or name the factory: FILE:FACTORY.",
        )
    return path, name, factory


def _split(text: str) -> tuple[Path, str]:
    if Path(text).is_file():
        return Path(text), _DEFAULT_FACTORY
    head, colon, tail = text.rpartition(":")
    if colon and tail.isidentifier() and Path(head).is_file():
        return Path(head), tail
    raise ConfigError(
        f"There is no plant file {text}.",
        code="PC-PLT-010",
        hint="Give FILE or FILE:FACTORY of a Python file.",
    )


def _module_name(path: Path) -> str:
    """Name as which the file's author imports it, where no other module has it.

    Compiled functions that numba keeps on disk are tied to it.
    """
    name = path.stem
    known = sys.modules.get(name)
    if known is not None:
        ours = getattr(known, "__file__", None) == str(path)
    else:
        ours = name.isidentifier() and _is_free(path)
    return name if ours else _other_name(path)


def _is_free(path: Path) -> bool:
    """Whether nothing else would be imported by the name of a file."""
    found = importlib.util.find_spec(path.stem)
    if found is None:
        return True
    origin = Path(found.origin or "")
    return origin.is_file() and origin.samefile(path)


def _other_name(path: Path) -> str:
    return f"pmac_comp_user_plant_{path.stem}"


def _module_from(path: Path) -> object:
    name = _module_name(path)
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ConfigError(
            f"{path} is not a Python file.", code="PC-PLT-011", hint="Give a file ending in .py."
        )
    module = importlib.util.module_from_spec(spec)
    # Compiled functions that were kept when the file had its other name are found as well.
    names = {name, _other_name(path)}
    sys.modules.update(dict.fromkeys(names, module))
    try:
        spec.loader.exec_module(module)
    except USER_CODE_ERRORS as error:
        for each in names:
            del sys.modules[each]
        raise ConfigError(
            f"The plant file {path} cannot be loaded: {error}.",
            code="PC-PLT-011",
            hint="Run it with Python by itself first.",
        ) from error
    return module
