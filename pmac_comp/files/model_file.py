"""Model files: JSON with every parameter, its unit and its interval, readable by a person.

Imports ``base`` only. Nothing in a model file is ever executed, and no path in it is followed.
"""

import json
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from pmac_comp.base.atomic import atomic_write_text
from pmac_comp.base.errors import ModelError

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
    bench_digest: str = ""
    effects: list[str] = []
    parameters: dict[str, ModelParameter]
    correlation: Correlation = Correlation()
    noise: Noise = Noise()
    data: list[DataSource] = []
    created_utc: str = ""
    notes: list[str] = []


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
            f"The model file {source} cannot be read: {error}.",
            code="PC-MFL-001",
            hint="`pmac-comp identify` writes model files.",
        ) from error
    except (ValidationError, UnicodeDecodeError) as error:
        raise ModelError(
            f"{source.name} is not a model file: {error}",
            code="PC-MFL-002",
            hint="Identify again, or correct the keys named above.",
        ) from error


def write_model(path: Path | str, model: ModelFile) -> None:
    """Write a model file; the target is replaced whole or not at all."""
    text = json.dumps(model.model_dump(mode="json"), indent=2) + "\n"
    atomic_write_text(Path(path), text)
