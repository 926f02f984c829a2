"""F15, F01: an upload that failed and was taken back leaves the one before it to be taken back."""

from collections.abc import Callable
from pathlib import Path

import pytest

from pmac_comp.base.errors import ConfigError, ControllerState, PmacCompError
from pmac_comp.machine.controller.whole import recovery, rollback
from pmac_comp.machine.transport.tap import Way
from tests.faults.change_bench import Standing, cut, difference, standing
from tests.faults.test_f01_f29_every_kind import cam_route, thinned, whole_route, with_table
from tests.faults.test_f15_f22_controller import LineFault
from tests.faults.upload_bench import Left
from tests.unit.machine_controller.card_bench import CardBench, make_plc_bench

pytestmark = pytest.mark.faults
Count = Callable[[int], None]


class Upload:
    """A card on which an upload stands, put back before each of the failures that follow."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        self.bench = make_plc_bench(folder)
        with_table(self.bench.link, self.bench.context)
        self.before: Standing = standing(self.bench)
        whole_route(self.bench.link, self.bench.context)
        self.upload: Standing = standing(self.bench)
        self.left = Left(self.bench)

    def again(self) -> CardBench:
        self.left.put_back()
        return self.connected()

    def connected(self) -> CardBench:
        self.bench.reconnect()
        self.bench.tap.sent = self.bench.tap.received = 0
        return self.bench

    def change(self) -> PmacCompError | None:
        try:
            cam_route(self.bench.link, self.bench.context)
        except PmacCompError as error:
            return error
        return None

    def require_taken_back(self) -> None:
        """What stood before the upload that stands comes back, once."""
        assert standing(self.bench) == self.upload
        rollback.rollback_last(self.bench.link, self.bench.context)
        found = standing(self.bench)
        assert found == self.before, difference(found, self.before)
        with pytest.raises(ConfigError, match="taken back already"):
            rollback.rollback_last(self.bench.link, self.bench.context)


@pytest.fixture
def upload(tmp_path: Path) -> Upload:
    return Upload(tmp_path / "store")


def test_f15_upload_before_a_refused_one_is_taken_back(
    *, upload: Upload, exhaustive: bool, count_runs: Count
) -> None:
    counter = LineFault(upload.again(), -1, "none")
    assert upload.change() is None
    lines = thinned(range(counter.seen), 6, exhaustive=exhaustive)
    refused = 0
    for k in lines:
        LineFault(upload.again(), k, "refuse")
        error = upload.change()
        if error is None:
            continue  # a line that was asked again
        assert error.left is ControllerState.OLD, k
        upload.connected()
        upload.require_taken_back()
        refused += 1
    assert refused > 3
    count_runs(len(lines))


def test_f01_upload_before_a_cut_one_is_taken_back(
    *, upload: Upload, exhaustive: bool, count_runs: Count
) -> None:
    upload.again()
    assert upload.change() is None
    whole = upload.bench.tap.sent
    places = thinned(range(1, whole - 100, 97), 6, exhaustive=exhaustive)
    for n in places:
        upload.again().tap.schedule(list(cut(Way.SEND, n)))
        assert upload.change() is not None
        bench = upload.connected()
        recovery.recover(bench.link, bench.context, resume=False)
        upload.require_taken_back()
    count_runs(len(places))
