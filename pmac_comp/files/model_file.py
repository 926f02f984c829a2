"""Model files: JSON with every parameter, its unit and its interval, readable by a person.

Imports ``base`` and ``bench``. Nothing in a model file is ever executed, no path in it followed.
"""

import json
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from pmac_comp.base.atomic import atomic_write_text
from pmac_comp.base.errors import ModelError
from pmac_comp.base.reading import why
from pmac_comp.files.bench import Bench
from pmac_comp.files.validation import problems

_MOST_SHOWN = 5
Finite = Annotated[float, Field(allow_inf_nan=False)]


class _Frozen(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class ModelParameter(_Frozen):
    """One parameter: estimate with its interval, in the unit named."""

    value: Finite
    unit: str
    std: Finite | None = None
    lower95: Finite | None = None
    upper95: Finite | None = None
    fixed: bool = False
    nominal: Finite | None = Field(default=None, description="value of the bench file")
    tolerance: Finite | None = Field(default=None, description="its tolerance as a fraction")


class Correlation(_Frozen):
    """Correlation matrix of the estimated parameters."""

    names: list[str] = []
    matrix: list[list[Finite]] = []


class Noise(_Frozen):
    """Standard deviation of what the model leaves, per channel."""

    motor_um: Finite | None = None
    table_um: Finite | None = None
    torque_Nm: Finite | None = None


class DataSource(_Frozen):
    """A capture that the model was fitted to."""

    name: str
    sha256: str = ""


class ModelFile(_Frozen):
    """Contents of a model file."""

    model_version: Literal[1] = 1
    bench_name: str = ""
    bench_digest: str = ""
    axis: dict[str, float | str] = Field(
        default={}, description="keys of the bench file that the model is tied to"
    )
    effects: list[str] = []
    parameters: dict[str, ModelParameter]
    correlation: Correlation = Correlation()
    noise: Noise = Noise()
    data: list[DataSource] = []
    created_utc: str = ""
    notes: list[str] = []


def written_for(bench: Bench) -> dict[str, Any]:
    """Fields of a model file that say which bench file and axis it belongs to."""
    return {
        "bench_name": bench.name,
        "bench_digest": bench.digest,
        "axis": bench.axis_facts,
    }


def read_model(path: Path | str) -> ModelFile:
    """Model read from a JSON file.

    Raises
    ------
    ModelError
        Missing file, bad JSON, unknown key or a value that is not finite.
    """
    source = Path(path)
    try:
        return ModelFile.model_validate_json(source.read_text(encoding="utf-8"))
    except OSError as error:
        raise ModelError(
            f"The model file {source} cannot be read: {why(error)}.",
            code="PC-MFL-001",
            hint="`pmac-comp identify` writes model files.",
        ) from error
    except (ValidationError, UnicodeDecodeError) as error:
        raise ModelError(
            f"{source.name} is not a model file:\n"
            + "\n".join(f"  - {line}" for line in _problems(error)),
            code="PC-MFL-002",
            hint="Give the file that `pmac-comp identify --out` wrote, or identify again.",
        ) from error


def _problems(error: ValidationError | UnicodeDecodeError) -> list[str]:
    if isinstance(error, UnicodeDecodeError):
        return [why(error)]
    found = problems(error, ModelFile)
    more = [f"and {len(found) - _MOST_SHOWN} more"] if len(found) > _MOST_SHOWN else []
    return [*found[:_MOST_SHOWN], *more]


def write_model(path: Path | str, model: ModelFile) -> None:
    """Write a model file; the target is replaced whole or not at all."""
    text = json.dumps(model.model_dump(mode="json"), indent=2) + "\n"
    atomic_write_text(Path(path), text)
