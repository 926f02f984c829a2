"""Model files: round trip and refusal of what is not one."""

import pytest

from pmac_comp.base.errors import ModelError
from pmac_comp.files.bench import load_bench
from pmac_comp.files.model_file import (
    ModelFile,
    ModelParameter,
    read_model,
    write_model,
    written_for,
)


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


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{ no json", "Invalid JSON"),
        ('{"parameters": {}, "effect": []}', "unknown key 'effect'; the nearest known key is"),
        ('{"effects": []}', "missing key 'parameters'"),
        ('{"parameters": {"a": {"value": "3", "unit": "N"}}}', "'parameters.a.value'"),
    ],
)
def test_what_is_wrong_with_a_model_file_is_said_in_words(tmp_path, text, words):
    (tmp_path / "m.json").write_text(text)
    with pytest.raises(ModelError) as caught:
        read_model(tmp_path / "m.json")
    assert words in str(caught.value)
    assert "pydantic" not in str(caught.value)


def test_a_model_file_says_which_axis_it_is_for():
    bench = load_bench("paper")
    stored = ModelFile(parameters={}, **written_for(bench))
    assert stored.bench_name == bench.name
    assert stored.axis["screw.pitch_mm"] == bench.screw.pitch_mm
    assert stored.axis["controller.servo_period_us"] == pytest.approx(1e6 * bench.servo_period_s)
    # What a model holds itself, gains and limits may change under it.
    assert not any(key.startswith(("nominal", "safety", "travel")) for key in stored.axis)
