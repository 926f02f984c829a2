"""The default bench is said where a real controller would be spoken to."""

import pytest

from pmac_comp.cli.app import main

_NOBODY = "tcp://127.0.0.1:9"  # the discard port: nothing answers


@pytest.mark.parametrize(
    ("words", "is_said"),
    [
        ([_NOBODY], True),
        ([_NOBODY, "--bench", "paper"], False),
        (["sim://"], False),
    ],
)
def test_an_assumed_bench_is_said(
    words: list[str],
    is_said: bool,  # noqa: FBT001
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit):
        main(["status", *words])
    assert ("bench: paper (the default" in capsys.readouterr().err) == is_said
