"""Identifications as model files, and model files as drive models.

File names and units come from the parameter specs. Imports ``physics.model``, ``files``, ``base``.
"""

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime

from pmac_comp.base.errors import ModelError
from pmac_comp.base.units import UM_PER_M
from pmac_comp.files.bench import Bench
from pmac_comp.files.model_file import (
    Correlation,
    DataSource,
    ModelFile,
    ModelParameter,
    Noise,
    written_for,
)
from pmac_comp.physics.identify.result import Identification, ParameterEstimate
from pmac_comp.physics.model.drive import DriveModel
from pmac_comp.physics.model.effect import Effect, effect_library, split_name
from pmac_comp.physics.model.parameters import ParameterSpec

# On one-mass benches the bias is the published "offset", a force that the drive must add.
_OFFSET = ("bias_force.force_N", "offset_N")


def file_key(spec: ParameterSpec, *, rigid: bool) -> str:
    """Name of a parameter in files."""
    effect = spec.name.partition(".")[0]
    if rigid and spec.name == _OFFSET[0]:
        return _OFFSET[1]
    if effect == "chain" or (rigid and effect in {"coulomb", "viscous"}):
        return spec.file_name
    return f"{effect}.{spec.file_name}"


def to_model_file(
    identification: Identification, bench: Bench, *, data: Sequence[tuple[str, str]] = ()
) -> ModelFile:
    """Model file of an identification.

    Parameters
    ----------
    identification : Identification
        Result of ``identify``.
    bench : Bench
        Its bench.
    data : sequence of (name, sha256)
        The captures.
    """
    model = identification.model
    parameters = {}
    keys = {}
    for spec in model.specs:
        keys[spec.name] = file_key(spec, rigid=model.is_rigid)
        found = identification.parameters.get(spec.name)
        parameters[keys[spec.name]] = (
            _estimated(spec, found, keys[spec.name]) if found else _fixed(spec, model)
        )
    noise = identification.noise
    return ModelFile(
        **written_for(bench),
        effects=list(model.effects),
        parameters=parameters,
        correlation=Correlation(
            names=[keys[name] for name in identification.correlation_names],
            matrix=[[float(value) for value in row] for row in identification.correlation],
        ),
        noise=Noise(
            motor_um=None if noise.motor_m is None else noise.motor_m * UM_PER_M,
            table_um=None if noise.table_m is None else noise.table_m * UM_PER_M,
            torque_Nm=noise.torque_Nm,
        ),
        data=[DataSource(name=name, sha256=digest) for name, digest in data],
        created_utc=datetime.now(UTC).isoformat(timespec="seconds"),
        notes=[identification.method, *identification.statements],
    )


def model_from_file(
    stored: ModelFile, bench: Bench, *, library: Mapping[str, Effect] | None = None
) -> DriveModel:
    """Drive model of a model file.

    Raises
    ------
    ModelError
        An effect or parameter is not known, or in another unit; user effects are handed in as
        ``library``.
    """
    known_effects = {**effect_library(), **(library or {})}
    missing = [name for name in stored.effects if split_name(name)[0] not in known_effects]
    if missing:
        raise ModelError(
            f"The model contains {', '.join(missing)}, which is no built-in effect"
            + (" and not in the file of effects." if library else "."),
            code="PC-IDN-032",
            hint="Name the file with the effects of your own that it was identified with: "
            "--effects FILE.",
        )
    empty = DriveModel(bench, tuple(stored.effects), {}, dict(library or {}))
    known = {file_key(spec, rigid=empty.is_rigid): spec for spec in empty.specs}
    unknown = sorted(set(stored.parameters) - set(known))
    if unknown:
        raise ModelError(
            f"The model file holds {', '.join(unknown)}, which this bench and its effects lack.",
            code="PC-IDN-031",
            hint="Use the bench file the model was identified with"
            + (" and the same --effects file." if library is None else "."),
        )
    _require_units(stored, known)
    values = {
        known[key].name: known[key].from_file(entry.value)
        for key, entry in stored.parameters.items()
    }
    return empty.with_parameters(values)


def _require_units(stored: ModelFile, known: Mapping[str, ParameterSpec]) -> None:
    """Values are taken in the unit of their name; one that states another was changed by hand."""
    wrong = [
        f"{key} in {entry.unit} ({known[key].file_unit} is meant)"
        for key, entry in stored.parameters.items()
        if entry.unit != known[key].file_unit
    ]
    if wrong:
        raise ModelError(
            f"The model file states {', '.join(wrong)}.",
            code="PC-IDN-050",
            hint="Give these values in the unit that is meant, or identify again.",
        )


def _estimated(spec: ParameterSpec, found: ParameterEstimate, key: str) -> ModelParameter:
    ends = sorted(spec.to_file(end) for end in (found.lower95, found.upper95))
    known = spec.kind == "known"
    return ModelParameter(
        value=spec.to_file(found.value),
        unit=spec.file_unit,
        std=abs(spec.file_factor) * found.std,
        lower95=ends[0],
        upper95=ends[1],
        fixed=found.fixed,
        nominal=spec.to_file(spec.nominal) if known else None,
        tolerance=spec.tolerance_frac if known else None,
    )


def _fixed(spec: ParameterSpec, model: DriveModel) -> ModelParameter:
    return ModelParameter(
        value=spec.to_file(model.parameters[spec.name]), unit=spec.file_unit, fixed=True
    )
