"""What a physical effect is, and the library that collects them.

An effect is a file with one ``EFFECT``; ``effects/`` holds ours and ``load_effects`` reads a
user's own. Imports ``base``, ``files.bench`` and the kernel layout.
"""

import hashlib
import importlib
import importlib.util
import pkgutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from pmac_comp.base.arrays import FloatArray
from pmac_comp.base.errors import USER_CODE_ERRORS, ConfigError
from pmac_comp.base.reading import why
from pmac_comp.files.bench import Bench
from pmac_comp.physics.model.parameters import ParameterSpec
from pmac_comp.physics.model.terms import TableTerm

Values = Mapping[str, float]
Apply = Callable[[FloatArray, Values, Bench, str], None]
MakeTerms = Callable[[Values, Bench], tuple[TableTerm, ...]]


@dataclass(frozen=True)
class Effect:
    """One physical effect that a model may contain.

    Parameters
    ----------
    name : str
        Name in results and files.
    parameters : tuple of ParameterSpec
        Bare parameter names, SI; the first is the one that is scored.
    apply : callable
        ``apply(vector, values, bench, place)`` sets the effect's slots of the kernel vector.
    terms : callable or None
        ``terms(values, bench)`` gives table terms instead of, or beside, slots.
    where : str
        Where it acts.
    source, signature, separating_experiment : str
        Where the form comes from, what it leaves in a residual, which run tells it apart.
    look_alikes : tuple of str
        Effects that can leave the same trace.
    places : tuple of str
        Variants, the first is the default; a model names another one as ``effect@place``.
    joint_places : tuple of str
        Variants that join several places: a model may name them, a search for a single cause does
        not try them.
    place_terms : Mapping of str to callable
        Table terms of the variants that have others than ``terms``.
    starts : tuple of mappings
        Starting values for a search, SI; empty means the nominal ones.
    hides_behind : tuple of str
        Base parameters that can absorb it in a refit.
    min_substeps : int
        Substeps per servo period that its time scale asks for.
    rigid : bool
        Whether it exists on one-mass benches too.
    needs_scale : bool
        Whether it only shows in the table reading.
    """

    name: str
    parameters: tuple[ParameterSpec, ...]
    apply: Apply
    where: str
    source: str
    signature: str
    separating_experiment: str
    look_alikes: tuple[str, ...] = ()
    places: tuple[str, ...] = ()
    terms: MakeTerms | None = None
    starts: tuple[Mapping[str, float], ...] = ()
    hides_behind: tuple[str, ...] = ()
    min_substeps: int = 1
    rigid: bool = True
    needs_scale: bool = False
    place_parameters: Mapping[str, tuple[ParameterSpec, ...]] = field(default_factory=dict)
    joint_places: tuple[str, ...] = ()
    place_terms: Mapping[str, MakeTerms] = field(default_factory=dict)

    def specs(self, place: str) -> tuple[ParameterSpec, ...]:
        """Parameters of a variant."""
        return self.place_parameters.get(place, self.parameters)


def no_slots(vector: FloatArray, values: Values, bench: Bench, place: str) -> None:
    """``apply`` of an effect of table terms alone: a vector of shape (N_SLOTS,) as it was."""


def split_name(name: str) -> tuple[str, str]:
    """Effect and place of ``effect`` or ``effect@place``."""
    effect, _, place = name.partition("@")
    return effect, place


@cache
def effect_library() -> Mapping[str, Effect]:
    """All built-in effects by name, in alphabetic order."""
    from pmac_comp.physics.model import effects as package

    found = {}
    for module in sorted(pkgutil.iter_modules(package.__path__), key=lambda item: item.name):
        effect = importlib.import_module(f"{package.__name__}.{module.name}").EFFECT
        found[effect.name] = effect
    return found


def load_effects(path: Path | str) -> Mapping[str, Effect]:
    """Effects of a user's own Python file, which defines ``EFFECT`` or ``EFFECTS``.

    The file is executed: it must be one that the person at the keyboard has named. A worked example
    is ``configs/effect_worn_stretch.py``.

    Raises
    ------
    ConfigError
        The file cannot be loaded, defines no effect or takes a built-in name.
    """
    source = Path(path)
    module = _executed(source)
    given = getattr(module, "EFFECTS", None) or [getattr(module, "EFFECT", None)]
    effects = {item.name: item for item in given if isinstance(item, Effect)}
    taken = sorted(set(effects) & set(effect_library()))
    if not effects or taken:
        raise ConfigError(
            f"{source} takes the built-in name {', '.join(taken)}."
            if taken
            else f"{source} defines neither EFFECT nor EFFECTS.",
            code="PC-MOD-006",
            hint="Define EFFECT = Effect(...) with a name of its own.",
        )
    return effects


def _executed(source: Path) -> object:
    try:
        key = hashlib.sha256(str(source.resolve()).encode()).hexdigest()[:12]
        spec = importlib.util.spec_from_file_location(f"pmac_comp_user_effects_{key}", source)
        if spec is None or spec.loader is None:
            raise ConfigError(
                f"{source} is not a Python file.",
                code="PC-MOD-005",
                hint="Give a .py file with one EFFECT, as configs/effect_worn_stretch.py.",
            )
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    except USER_CODE_ERRORS as error:
        what = f"{type(error).__name__}: {error}"
        if isinstance(error, OSError):
            what = why(error)
        raise ConfigError(
            f"The effects file {source} cannot be loaded: {what}.",
            code="PC-MOD-005",
            hint="Correct it; configs/effect_worn_stretch.py is a worked example.",
        ) from error
    return module
