"""Parameters of a drive model: names, units in SI and in files, bounds, what the bench knows.

Imports ``base`` only.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

from pmac_comp.base.errors import ModelError, NonFinite

Kind = Literal["known", "free"]


@dataclass(frozen=True)
class ParameterSpec:
    """One parameter.

    Parameters
    ----------
    name : str
        ``effect.parameter`` in a model; the bare parameter name within an effect.
    unit : str
        SI unit.
    nominal : float
        Value of the bench file, or a starting value.
    lower, upper : float
        Hard bounds in SI.
    scale : float
        Typical size in SI, for step sizes and scaling.
    kind : str
        ``known`` (bench value with a tolerance) or ``free``.
    tolerance_frac : float or None
        Tolerance of a known value as a fraction.
    file_name, file_unit, file_factor : str, str, float
        Name and unit in files; the value in files is SI value times the factor.
    period : float
        Period of an angle (2 pi), 0 for all others.
    discrete : bool
        Held fixed in a fit and chosen from a list instead (orders per revolution).
    by_root : bool
        Fitted through its square root, because what it does begins like one (a stick zone).
    """

    name: str
    unit: str
    nominal: float
    lower: float
    upper: float
    scale: float
    kind: Kind = "free"
    tolerance_frac: float | None = None
    file_name: str = ""
    file_unit: str = ""
    file_factor: float = 1.0
    description: str = ""
    period: float = 0.0
    discrete: bool = False
    by_root: bool = False

    def to_file(self, value: float) -> float:
        """Value in the unit of files."""
        return value * self.file_factor

    def from_file(self, value: float) -> float:
        """Value in SI."""
        return value / self.file_factor

    def checked(self, value: float) -> float:
        """The value if it is finite and within the bounds.

        Raises
        ------
        NonFinite
            NaN or infinity.
        ModelError
            Outside the bounds.
        """
        number = float(value)
        if not math.isfinite(number):
            raise NonFinite(f"Parameter {self.name} is {number}.", code="PC-MOD-001")
        if not self.lower <= number <= self.upper:
            raise ModelError(
                f"Parameter {self.name} is {number:g} {self.unit}; "
                f"between {self.lower:g} and {self.upper:g} are possible.",
                code="PC-MOD-002",
            )
        return number


def parameter(
    name: str,
    unit: str,
    nominal: float,
    bounds: tuple[float, float],
    *,
    scale: float | None = None,
    file: tuple[str, str, float] | None = None,
    description: str = "",
    discrete: bool = False,
    by_root: bool = False,
) -> ParameterSpec:
    """Free parameter of an effect; ``file`` is (name, unit, factor) where files differ from SI."""
    file_name, file_unit, factor = file or (name, unit, 1.0)
    return ParameterSpec(
        name=name,
        unit=unit,
        nominal=nominal,
        lower=bounds[0],
        upper=bounds[1],
        scale=scale if scale is not None else max(abs(nominal), 1e-12),
        file_name=file_name,
        file_unit=file_unit,
        file_factor=factor,
        description=description,
        discrete=discrete,
        by_root=by_root,
    )


def phase(name: str = "phase_rad") -> ParameterSpec:
    """Phase of a harmonic in rad."""
    return ParameterSpec(
        name=name,
        unit="rad",
        nominal=0.0,
        lower=-1e3,
        upper=1e3,
        scale=1.0,
        file_name=name,
        file_unit="rad",
        period=2.0 * math.pi,
        description="phase of the cosine at angle zero",
    )


def order(nominal: float = 1.0) -> ParameterSpec:
    """Order of a harmonic per screw revolution."""
    return parameter(
        "order_per_rev", "1", nominal, (0.05, 500.0), scale=1e-3, discrete=True,
        description="cycles per screw revolution",
    )  # fmt: skip


def within(effect: str, spec: ParameterSpec) -> ParameterSpec:
    """Spec under its full name ``effect.parameter``."""
    return replace(spec, name=f"{effect}.{spec.name}")


def merged(specs: tuple[ParameterSpec, ...], values: Mapping[str, float]) -> dict[str, float]:
    """Nominal values overridden by ``values``, each checked; unknown names are refused."""
    known = {spec.name: spec for spec in specs}
    unknown = sorted(set(values) - set(known))
    if unknown:
        raise ModelError(
            f"The model has no parameter {', '.join(unknown)}.",
            code="PC-MOD-003",
            hint="It has " + ", ".join(known),
        )
    return {name: spec.checked(values.get(name, spec.nominal)) for name, spec in known.items()}
