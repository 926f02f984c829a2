"""What doctor says of this installation."""

from pathlib import Path

from pmac_comp.workflow.doctor import examine


def test_an_installed_package_says_where_its_files_lie() -> None:
    said = {finding.check: finding.found for finding in examine("", "paper")}
    for check, name in (("configs", "effect_worn_stretch.py"), ("firmware_plc", "homing.plc")):
        assert (Path(said[check].split(" files in ")[1]) / name).is_file()
