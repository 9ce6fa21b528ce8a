"""check_drive on EDS and DCF files, as the set-up would read them from the drive."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import canopen
import pytest
from canopen.objectdictionary import ODVariable

from needle_device_driver.check_drive import main
from needle_device_driver.cia402.drive_file import read_device_file

from .drive_bench import DriveBench

Sections = dict[str, dict[str, str]]
Check = Callable[[Sections], tuple[int, str]]

# Index, sub-indices and CiA 306 data types of a complete drive; * can be mapped.
COMPLETE = """
1000:0:7 1006:0:7 1016:1:7 1017:0:6 1029:1:5 1400:12:75 1401:12:75 1600:012:577 1601:01:57
1800:1235:7566 1801:1235:7566 1A00:0123:5777 1A01:012:577 6007:0:3 6040:0:6* 6041:0:6* 605A:0:3
605B:0:3 605C:0:3 605E:0:3 6060:0:2* 6061:0:2* 6064:0:4* 6065:0:7 6066:0:6 607A:0:4* 607C:0:4
607D:12:44 607F:0:7 6081:0:7 6083:0:7 6084:0:7 6085:0:7 6098:0:2 6099:12:77 609A:0:7 60A8:0:7
60A9:0:7 60AA:0:7 60C2:12:52 60F4:0:4* 60FD:0:7* 6502:0:7
"""
VALUES = {"1000": "0x00020192", "6502": "0xA1", "60A8": "0xB50000", "60A9": "0xB50300"}
VALUES |= {"60AA": "0xB55700", "1801sub1": "$NODEID+0x40000280"}


def complete() -> Sections:
    sections: Sections = {"DeviceInfo": {"ProductName": "A drive"}}
    for text in COMPLETE.split():
        index, subs, types = text.split(":")
        for sub, kind in zip(subs, types.rstrip("*"), strict=True):
            name = index if subs == "0" else f"{index}sub{sub}"
            mapping = str(int(types.endswith("*")))
            sections.setdefault(index, {"ObjectType": "0x8", "ParameterName": index})
            sections[name] = {"ParameterName": name, "ObjectType": "0x7", "AccessType": "rw"}
            sections[name] |= {"DataType": f"0x000{kind}", "PDOMapping": mapping}
            if name in VALUES:
                sections[name]["DefaultValue"] = VALUES[name]
    return sections


def write(sections: Sections, file: Path) -> Path:
    text = "".join(
        f"[{name}]\n" + "".join(f"{key}={value}\n" for key, value in values.items()) + "\n"
        for name, values in sections.items()
    )
    file.write_text(text, "latin-1")
    return file


@pytest.fixture
def check(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Check:
    """Run check_drive on a file with these sections; return exit code and output."""

    def run(sections: Sections) -> tuple[int, str]:
        code = main(["--eds", str(write(sections, tmp_path / "drive.eds"))])
        captured = capsys.readouterr()
        return code, captured.out + captured.err

    return run


# One object of each kind: communication, PDO, stop, mode, place, limit, ramp, unit, input.
INDICES = ["1016", "1400", "1A00", "605A", "6060", "6064", "607D", "6085", "60A9", "60FD"]


@pytest.mark.parametrize("index", INDICES)
def test_missing_object_has_the_same_effect_in_a_file_and_in_a_drive(
    index: str, check: Check
) -> None:
    sections = {name: rows for name, rows in complete().items() if not name.startswith(index)}
    code, output = check(sections)
    bench = DriveBench()
    bench.insertion.missing_objects = {int(index, 16)}
    bench.insertion.refuses = lambda at, sub, value: (
        NOT_MAPPABLE * (at & 0xFE00 in (0x1600, 0x1A00) and value[2:].hex() == mapped)
    )
    mapped = int(index, 16).to_bytes(2, "little").hex()
    bench.run(bench.drives.probe())
    if bench.run(bench.supervisor.configure(bench.now)).success:
        bench.home()
        bench.wait(30)
    assert code == (bench.state == "FAULT"), output
    assert ("NOT usable" in output) == (code == 1)
    assert FATAL in output if code else OPTIONAL in output


NOT_MAPPABLE = 0x0604_0041
READ_ONLY = {"AccessType": "ro", "DefaultValue": "2"}
FATAL, OPTIONAL = "NOT USABLE: ", "optional: "


@pytest.mark.parametrize(
    ("name", "change", "code", "text"),
    [
        ("605A", READ_ONLY, 1, FATAL + "fixed at 2"),
        ("1016sub1", READ_ONLY, 1, "drive_watchdog"),
        ("1016sub1", {"DataType": "0x1B"}, 1, FATAL + "has 8 bytes"),
        ("605A", READ_ONLY | {"ParameterValue": "0x6"}, 0, "ok"),
        ("605A", {"AccessType": "const"}, 0, "unknown: read-only"),
        ("605B", READ_ONLY, 0, OPTIONAL + "fixed at 2"),
        ("60C2sub2", {"LowLimit": "-0x2"}, 1, FATAL + "-3 is outside [-2, None]"),
        ("60C2sub2", {"LowLimit": "0xFD"}, 0, "ok"),
        ("605A", {"DataType": "0x2"}, 0, "ok"),
        ("605A", {"DataType": "word"}, 2, "quick stop option: 0 bytes, expected 2"),
        ("6085", {"HighLimit": "0x7FFFFFFF"}, 0, "ok"),
        ("6085", {"HighLimit": "1000"}, 1, FATAL + "10000000 is outside [None, 1000]"),
        ("607A", {"PDOMapping": "0"}, 1, FATAL + "0x1601:1 0x607A cannot be mapped"),
        ("60A9", {"DefaultValue": "0x10300"}, 1, "the drive measures speeds in m/s"),
        ("60A9", {"DefaultValue": "0xB44700"}, 0, "set *_counts_per_turn"),
        ("60A9", {"DefaultValue": ""}, 0, "assumed: counts/s (0x60A9);"),
        ("6502", {"DefaultValue": ""}, 0, "does not list its cyclic synchronous position mode"),
        ("1000", {"DefaultValue": "401"}, 2, "node 1 has device profile 401, expected 402"),
        ("1000", {"DefaultValue": ""}, 0, "\nusable"),
    ],
)
def test_restricted_object(
    name: str, change: dict[str, str], code: int, text: str, check: Check
) -> None:
    sections = complete()
    sections[name] |= change
    got, output = check(sections)
    assert (got, text in output) == (code, True), output


@pytest.mark.parametrize("text", ["", "\x00\x01", "[1000", "[DeviceInfo]\n", "x = 1\n"])
def test_other_files_are_rejected(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "drive.eds"
    file.write_text(text, "latin-1")
    assert main(["--eds", str(file)]) == main(["--eds", str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("\n") == 2


def test_objects_are_those_that_canopen_reads(tmp_path: Path) -> None:
    sections = complete()
    sections["DeviceInfo"]["ProductName"] = "Müller 5/7"
    sections["1800sub1"] |= {"DefaultValue": "$NODEID+0x180", "ParameterValue": "0x190"}
    sections["60C2sub2"] |= {"AccessType": "rww", "LowLimit": "0x80", "HighLimit": "63"}
    sections["6064"] |= {"LowLimit": "0xFFFFFF38", "HighLimit": "0xC8"}
    # Boolean and 64 bits.
    for name, kind in (("2000", "0x1"), ("2001", "0x15"), ("2002", "0x1B")):
        sections[name] = sections["6064"] | {"DataType": kind}
    sections["1003"] = {"ParameterName": "Errors", "ObjectType": "0x8", "CompactSubObj": "3"}
    sections["1003"] |= {"DataType": "0x6", "AccessType": "ro", "DefaultValue": "7"}
    file = write(sections, tmp_path / "drive.dcf")
    product, objects = read_device_file(file, 5)
    stream = io.StringIO(file.read_text("latin-1"))
    stream.name = "drive.dcf"
    oracle: Any = canopen.import_od(stream, 5)
    assert product == "Müller 5/7"
    for (index, sub), found in objects.items():
        entry = oracle[index]
        variable = entry if isinstance(entry, ODVariable) else entry[sub]
        assert (found.lower, found.upper) == (variable.min, variable.max)
        assert (8 * abs(found.size), found.writable) == (len(variable), variable.writable)
        assert found.mappable == variable.pdo_mappable
        assert found.value == (variable.value if variable.value is not None else variable.default)
    assert objects[0x1003, 3].value == 7
    assert objects[0x1800, 1].value == 0x190
