"""What a comparison says for people."""

from pmac_comp.workflow.model.comparison import floor_lines


def test_laps_are_told_beside_the_best_model_and_not_where_the_command_does_not_repeat() -> None:
    rows = [{"left_rms_um": 3.0}, {"left_rms_um": 2.0}]
    (told,) = floor_lines({"floor_um": 1.25, "models": rows, "lattice_nm": 50.0})
    assert "1.25 um rms" in told
    assert "the best leaves 2.00 um" in told
    assert "lattice is 50 nm" in told
    assert "leaves nan um" in floor_lines({"floor_um": 1.0, "models": [], "lattice_nm": 50.0})[0]
    assert floor_lines({"floor_um": None, "models": rows, "lattice_nm": 50.0}) == []
