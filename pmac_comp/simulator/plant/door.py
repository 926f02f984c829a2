"""The plug-in door: what a plant must offer, and how a user's file is loaded.

What lives here: the protocol and the loader of ``--plant FILE[:FACTORY]``. What may not: any plant.
Python is executed only from a path that a person typed. Imports ``files`` and ``base``.
"""

import importlib.util
import sys
from pathlib import Path
from typing import Protocol, runtime_checkable

from pmac_comp.base.errors import ConfigError
from pmac_comp.files.bench import Bench

_DEFAULT_FACTORY = "make_plant"


@runtime_checkable
class Plant(Protocol):
    """One ``step`` is one servo period: torque held over [k, k+1), readings latched at k+1.

    ``set_external_force(force_N)`` is optional; positive pushes against positive motion.
    """

    def reset(self, table_position_m: float = 0.0) -> None:
        """Put the drive at rest at a table position in m."""

    def step(self, torque_command_Nm: float) -> tuple[float, float]:
        """Motor angle in rad and table position in m after one period of this torque."""


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
        No such file, no such factory, it fails to import, or its result is not a plant.
    """
    path, factory_name = _split(text)
    module = _module_from(path)
    factory = getattr(module, factory_name, None)
    if not callable(factory):
        raise ConfigError(
            f"{path} has no factory '{factory_name}'.",
            code="PC-PLT-012",
            hint="Define make_plant(bench), or name the factory: FILE:FACTORY.",
        )
    plant = factory(bench)
    if not isinstance(plant, Plant):
        raise ConfigError(
            f"{factory_name} of {path} returned {type(plant).__name__}, which is not a plant.",
            code="PC-PLT-013",
            hint="It needs reset(table_position_m=0.0) and step(torque_command_Nm).",
        )
    plant.reset()
    return plant


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


def _module_from(path: Path) -> object:
    name = f"pmac_comp_user_plant_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ConfigError(
            f"{path} is not a Python file.", code="PC-PLT-011", hint="Give a file ending in .py."
        )
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except (ImportError, SyntaxError, NameError, AttributeError, TypeError, ValueError) as error:
        del sys.modules[name]
        raise ConfigError(
            f"The plant file {path} cannot be loaded: {error}.",
            code="PC-PLT-011",
            hint="Run it with Python by itself first.",
        ) from error
    return module
