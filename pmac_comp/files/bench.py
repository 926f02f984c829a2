"""Bench files: what the user knows of the axis, in TOML with a unit in each key.

What lives here: the pydantic models of the tables of a bench file, their documented defaults and
the SI quantities that follow from them. What may not: identified values (they go to model files).
Imports ``base`` only.
"""

import hashlib
import math
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from pmac_comp.base.errors import ConfigError
from pmac_comp.base.reading import why
from pmac_comp.base.units import (
    CLOCK_CT_PER_MS,
    MM_PER_M,
    MS_PER_S,
    UM_PER_M,
    US_PER_S,
    lead_m_per_rad,
)
from pmac_comp.files.resources import data_folder
from pmac_comp.files.validation import problems

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0.0, lt=1.0)]

# Steel: E = 206 GPa, G = 79.4 GPa, 7850 kg/m3.
SHEAR_OVER_YOUNG = 79.4 / 206.0
STEEL_YOUNG_Pa = 206.0e9
STEEL_DENSITY_kg_per_m3 = 7850.0


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class Screw(_Table):
    """Geometry of the screw."""

    pitch_mm: Positive = Field(description="lead per revolution")
    diameter_mm: Positive = Field(default=25.0, description="nominal diameter")
    root_diameter_mm: Positive | None = Field(
        default=None, description="core diameter, 0.88 of the nominal one if not stated"
    )
    length_mm: Positive = Field(default=1000.0, description="threaded length from the bearing")
    bearing_to_table_zero_mm: NonNegative | None = Field(
        default=None,
        description="fixed bearing to nut when the table reads zero; not stated: the middle of the "
        "travel lies in the middle of the screw",
    )


class Encoder(_Table):
    """Rotary encoder on the motor."""

    counts_per_rev: Positive = Field(description="counts per revolution after decoding")
    extension: Literal["none", "1/T"] = Field(default="none", description="sub-count extension")
    motor_number: int = Field(default=1, ge=1, le=32, description="PMAC motor that closes the loop")


class Scale(_Table):
    """Linear scale at the table."""

    resolution_um: Positive = Field(description="one count")
    motor_number: int = Field(default=2, ge=1, le=32, description="PMAC motor that reads the scale")


class Nominal(_Table):
    """Known quantities of the drive; ``None`` means not known."""

    motor_inertia_kgm2: Positive | None = Field(default=None, description="rotor with coupling")
    screw_inertia_kgm2: Positive | None = Field(default=None, description="screw about its axis")
    table_mass_kg: Positive | None = Field(default=None, description="table with nut")
    torsional_stiffness_Nm_per_rad: Positive | None = Field(
        default=None, description="coupling with journal, without the screw itself"
    )
    axial_stiffness_N_per_um: Positive | None = Field(
        default=None, description="bearing and nut in series, without the screw itself"
    )
    screw_rigidity_N: Positive | None = Field(default=None, description="EA of the screw core")
    efficiency: Annotated[float, Field(gt=0.0, le=1.0)] | None = Field(
        default=None, description="nut efficiency, driving"
    )
    current_bandwidth_Hz: Positive | None = Field(
        default=None, description="current loop of the drive, -3 dB"
    )
    actuator_delay_us: NonNegative | None = Field(
        default=None,
        description="from the controller's output to torque, beside the current loop; not stated: "
        "one servo period (two without current_bandwidth_Hz) with 100 % tolerance",
    )


def _tolerance(fraction: float) -> Any:
    return Field(default=fraction, description="fraction of the nominal value, two std")


class Tolerance(_Table):
    """Tolerances of the nominal quantities as fractions (one half-width)."""

    motor_inertia_kgm2: Fraction = _tolerance(0.05)
    screw_inertia_kgm2: Fraction = _tolerance(0.05)
    table_mass_kg: Fraction = _tolerance(0.05)
    torsional_stiffness_Nm_per_rad: Fraction = _tolerance(0.20)
    axial_stiffness_N_per_um: Fraction = _tolerance(0.20)
    screw_rigidity_N: Fraction = _tolerance(0.05)
    efficiency: Fraction = _tolerance(0.03)
    current_bandwidth_Hz: Fraction = _tolerance(0.20)
    actuator_delay_us: Fraction = _tolerance(0.20)


class Known(_Table):
    """Facts that were measured on the bench."""

    resonance_Hz: Positive | None = Field(
        default=None, description="first resonance of the drive, motor free"
    )
    resonance_at_mm: Finite | None = Field(
        default=None, description="table position at which the resonance was measured"
    )
    bandwidth_Hz: Positive | None = Field(
        default=None, description="position loop from command to motor, -3 dB"
    )
    rated_torque_Nm: Positive | None = Field(default=None, description="of the motor, continuous")
    rated_speed_rpm: Positive | None = Field(default=None, description="of the motor")


class Drive(_Table):
    """Servo drive in torque mode."""

    torque_limit_Nm: Positive = Field(default=1.0e6, description="peak torque at the motor")
    torque_per_dac_Nm: Positive = Field(default=1.0, description="torque of one 16-bit DAC unit")


class SiControl(_Table):
    """PID with feed-forward in SI-like units, e = command - motor.

    u = Kp e + I - Kd v_f + Kvff v_c + Kaff a_c, clipped to the torque limit; I += Ki T e unless u
    is clipped the way of e; v_f += alpha (motor speed - v_f); v_c and a_c are backward differences
    of the command, T the servo period.
    """

    Kp_Nm_per_mm: NonNegative = Field(description="on command - motor")
    Ki_Nm_per_mm_s: NonNegative = Field(default=0.0, description="on its integral")
    Kd_Nm_s_per_mm: NonNegative = Field(default=0.0, description="on filtered motor velocity")
    Kvff_Nm_s_per_mm: Finite = Field(default=0.0, description="on command velocity")
    Kaff_Nm_s2_per_mm: Finite = Field(default=0.0, description="on command acceleration")
    velocity_filter_alpha: Annotated[float, Field(gt=0.0, le=1.0)] = Field(
        default=1.0, description="share of the newest velocity; 1 means no filter"
    )


class CascadeControl(_Table):
    """Position P over velocity P, as EMPS has it: V = kv (kp e - v)."""

    kp_per_s: Positive = Field(description="position loop")
    kv_V_per_m_per_s: Positive = Field(description="velocity loop")
    gain_N_per_V: Positive = Field(description="drive from voltage to force at the table")


class Controller(_Table):
    """Servo controller."""

    kind: Literal["pmac", "si", "cascade"] = Field(description="which of the laws below it runs")
    servo_period_us: Positive | None = Field(
        default=None, description="servo cycle; I10 wins where it is given, needed where it is not"
    )
    cpu_clock_MHz: Positive = Field(default=80.0, description="for the cost of the law")
    dpram: Literal["small", "large", "none"] = Field(
        default="large", description="dual-ported RAM of the card"
    )
    p_block: Annotated[list[int], Field(min_length=2, max_length=2)] = Field(
        default=[7000, 7199], description="first and last P-variable that may be used"
    )
    cam_motor_number: int = Field(
        default=8,
        ge=1,
        le=32,
        description="unused PMAC motor that counts time for the route cam",
    )
    ivariables: dict[str, float] = Field(
        default_factory=dict, description="I-variables by name, for kind pmac"
    )
    si: SiControl | None = Field(default=None, description="PID, for kind si")
    cascade: CascadeControl | None = Field(default=None, description="P over P, for kind cascade")

    @model_validator(mode="after")
    def _law_is_given(self) -> "Controller":
        if self.kind == "si" and self.si is None:
            raise ValueError("kind = 'si' needs the table [controller.si]")
        if self.kind == "cascade" and self.cascade is None:
            raise ValueError("kind = 'cascade' needs the table [controller.cascade]")
        if self.p_block[0] > self.p_block[1] or self.p_block[0] < 0 or self.p_block[1] > 8191:
            raise ValueError("p_block = [first, last] must be ascending within 0..8191")
        if self.servo_period_us is None and self.i10 is None:
            raise ValueError("servo_period_us is missing, and no I10 in [controller.ivariables]")
        for name in self.ivariables:
            if not (name[:1] == "I" and name[1:].isdigit() and int(name[1:]) <= 8191):
                raise ValueError(f"'{name}' in [controller.ivariables] is not an I-variable")
        return self

    @property
    def i10(self) -> float | None:
        """I10 (servo period in 2^-23 ms) where it is given and says something."""
        return (self.ivariables.get("I10") or None) if self.kind == "pmac" else None


class Travel(_Table):
    """Usable table travel in the coordinates of the scale."""

    min_mm: Finite = Field(description="lowest position that may be commanded")
    max_mm: Finite = Field(description="highest position that may be commanded")

    @model_validator(mode="after")
    def _ascending(self) -> "Travel":
        if self.max_mm <= self.min_mm:
            raise ValueError("max_mm must be above min_mm")
        return self


class Safety(_Table):
    """Limits that no correction or motion may pass."""

    max_correction_um: Positive = Field(
        default=60.0, description="of the tables together, and of a law or program beside them"
    )
    max_slope_um_per_mm: Positive = Field(default=50.0, description="of a table along the travel")
    max_enable_step_um: Positive = Field(
        default=5.0, description="of the command when compensation is switched"
    )
    max_speed_mm_per_s: Positive = Field(default=500.0, description="of commanded motions")
    max_acceleration_m_per_s2: Positive = Field(default=12.0, description="of commanded motions")


class Bench(_Table):
    """One bench file, checked once; ``text`` is the source it was read from."""

    config_version: Literal[1] = Field(default=1, description="version of this file's form")
    name: str = Field(default="", description="for reports and errors")
    screw: Screw
    encoder: Encoder
    scale: Scale | None = None
    nominal: Nominal = Nominal()
    tolerance: Tolerance = Tolerance()
    known: Known = Known()
    drive: Drive = Drive()
    controller: Controller
    travel: Travel
    safety: Safety = Safety()
    text: str = Field(default="", repr=False)

    @property
    def digest(self) -> str:
        """SHA-256 of the source text."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    @property
    def servo_period_s(self) -> float:
        """Servo period in s; I10 (2^-23 ms units) wins over the rounded ``servo_period_us``."""
        i10 = self.controller.i10
        if i10 is not None:
            return i10 / CLOCK_CT_PER_MS / MS_PER_S
        return (self.controller.servo_period_us or math.nan) / US_PER_S  # one of both is given

    @property
    def usable_speed_m_per_s(self) -> float:
        """Highest speed in m/s: the safety limit or the rated speed of the motor."""
        limit = self.safety.max_speed_mm_per_s / MM_PER_M
        rpm = self.known.rated_speed_rpm
        return limit if rpm is None else min(limit, rpm / 60.0 * self.pitch_m)

    @property
    def pitch_m(self) -> float:
        """Screw pitch in m per revolution."""
        return self.screw.pitch_mm / MM_PER_M

    @property
    def lead_m_per_rad(self) -> float:
        """Screw lead in m/rad."""
        return lead_m_per_rad(self.pitch_m)

    @property
    def motor_resolution_m(self) -> float:
        """Table travel of one encoder count in m."""
        return self.pitch_m / self.encoder.counts_per_rev

    @property
    def scale_resolution_m(self) -> float | None:
        """One scale count in m, None without a scale."""
        return None if self.scale is None else self.scale.resolution_um / UM_PER_M

    @property
    def root_diameter_m(self) -> float:
        """Core diameter of the screw in m."""
        root_mm = self.screw.root_diameter_mm
        return (0.88 * self.screw.diameter_mm if root_mm is None else root_mm) / MM_PER_M

    @property
    def screw_rigidity_N(self) -> float:
        """Axial rigidity EA of the screw core in N, from the core diameter if not stated."""
        if self.nominal.screw_rigidity_N is not None:
            return self.nominal.screw_rigidity_N
        return STEEL_YOUNG_Pa * math.pi * self.root_diameter_m**2 / 4.0

    @property
    def torsional_rigidity_Nm2(self) -> float:
        """Torsional rigidity GJ of the screw core in N m2: EA (G/E) d^2/8 for a round core."""
        return self.screw_rigidity_N * SHEAR_OVER_YOUNG * self.root_diameter_m**2 / 8.0

    @property
    def axis_facts(self) -> dict[str, float | str]:
        """What a model of this axis is tied to, by key: screw, sensors, output and clock.

        Nominal values are not among them (a model holds its own), nor are gains and limits.
        """
        tables: dict[str, BaseModel | None] = {
            "screw": self.screw,
            "encoder": self.encoder,
            "scale": self.scale,
        }
        facts: dict[str, float | str] = {
            f"{name}.{key}": value
            for name, table in tables.items()
            if table is not None
            for key, value in table.model_dump(exclude_none=True).items()
        }
        facts["drive.torque_per_dac_Nm"] = self.drive.torque_per_dac_Nm
        facts["controller.servo_period_us"] = self.servo_period_s * US_PER_S
        return facts

    @property
    def travel_m(self) -> tuple[float, float]:
        """Lowest and highest position of the travel in m."""
        return self.travel.min_mm / MM_PER_M, self.travel.max_mm / MM_PER_M

    @property
    def mid_travel_m(self) -> float:
        """Middle of the travel in m."""
        return 0.5 * (self.travel.min_mm + self.travel.max_mm) / MM_PER_M

    @property
    def motor_numbers(self) -> tuple[int, ...]:
        """The motor that closes the loop and, with a scale, the one that reads it."""
        scale = (self.scale.motor_number,) if self.scale is not None else ()
        return (self.encoder.motor_number, *scale)

    @property
    def bearing_to_table_zero_m(self) -> float:
        """Fixed bearing to nut in m when the table reads zero."""
        stated = self.screw.bearing_to_table_zero_mm
        if stated is not None:
            return stated / MM_PER_M
        return 0.5 * self.screw.length_mm / MM_PER_M - self.mid_travel_m

    def screw_position_m(self, table_position_m: float) -> float:
        """Distance from the fixed bearing to the nut in m for a table position in m."""
        return table_position_m + self.bearing_to_table_zero_m


def load_bench(path: Path | str) -> Bench:
    """Bench read from a TOML file, or from a bundled one by its name (``paper``).

    Parameters
    ----------
    path : Path or str
        File, or the name of a bundled bench without suffix.

    Raises
    ------
    ConfigError
        Missing file, bad TOML, unknown key (the nearest known one is named) or bad value.
    """
    source = _resolve(path)
    known = "Give the path of a bench file, or the name of a bundled one: " + ", ".join(
        bundled_benches()
    )
    if not source.exists():
        raise ConfigError(f"There is no bench file {source}.", code="PC-CFG-002", hint=known)
    try:
        text = source.read_text(encoding="utf-8-sig")  # some editors put a byte order mark first
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"The bench file {source} cannot be read: {why(error)}.",
            code="PC-CFG-002",
            hint=known,
        ) from error
    return parse_bench(text, name=source.name)


def bundled_benches() -> list[str]:
    """Names of the bench files that come with the installation."""
    return sorted(path.stem for path in data_folder("configs").glob("*.toml"))


def parse_bench(text: str, *, name: str = "bench file") -> Bench:
    """Bench read from TOML text; raises ConfigError as ``load_bench`` does."""
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(
            f"{name} is not valid TOML: {error}.",
            code="PC-CFG-003",
            hint="Compare with `pmac-comp config example`.",
        ) from error
    try:
        return Bench.model_validate({**data, "text": text})
    except ValidationError as error:
        lines = problems(error, Bench)
        what = "a problem" if len(lines) == 1 else f"{len(lines)} problems"
        raise ConfigError(
            f"{name} has {what}:\n" + "\n".join(f"  - {line}" for line in lines),
            code="PC-CFG-004",
            hint="Correct the keys; `pmac-comp config show paper` prints all keys, what they are "
            "and their defaults.",
            context={"problems": lines},
        ) from error


def _resolve(path: Path | str) -> Path:
    source = Path(path)
    if not source.exists() and source.suffix == "" and len(source.parts) == 1:
        bundled = data_folder("configs") / f"{source}.toml"
        if bundled.exists():
            return bundled
    return source
