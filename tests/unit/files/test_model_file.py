"""Model files: round trip and refusal of what is not one."""

import pytest

from pmac_comp.base.errors import ModelError
from pmac_comp.files.model_file import ModelFile, ModelParameter, read_model, write_model


def test_round_trip(tmp_path):
    model = ModelFile(
        effects=["backlash"],
        parameters={"backlash.gap_um": ModelParameter(value=3.0, unit="um", std=0.1)},
    )
    write_model(tmp_path / "m.json", model)
    assert read_model(tmp_path / "m.json") == model


@pytest.mark.parametrize(
    "text",
    ["", "{}", '{"parameters": {"a": {"value": NaN, "unit": "N"}}}', '{"parameters": {}, "x": 1}'],
)
def test_what_is_not_a_model_is_refused(tmp_path, text):
    (tmp_path / "m.json").write_text(text)
    with pytest.raises(ModelError):
        read_model(tmp_path / "m.json")
