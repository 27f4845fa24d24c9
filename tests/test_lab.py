"""The parts of the lab that need no guest: its archive, the order of modules, its report."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from dexkit.errors import UsageError
from tools.lab.devices import Record
from tools.lab.initramfs import archive, in_order
from tools.lab.report import Case, markdown


def _module(folder: Path, name: str, depends: str = "") -> None:
    (folder / f"{name}.ko").write_bytes(
        b"\x7fELF\0license=GPL\0depends=" + depends.encode() + b"\0"
    )


def test_modules_come_behind_those_that_they_need(tmp_path: Path) -> None:
    _module(tmp_path, "vhci-hcd", "usbip-core,usbcore")
    _module(tmp_path, "usbip-core", "usbcore")
    _module(tmp_path, "usbcore")
    (tmp_path / "modules.builtin").write_text("kernel/drivers/char/hw_random/virtio-rng.ko\n")
    ordered = in_order(tmp_path, ["vhci_hcd", "virtio_rng", "usbcore"])
    assert [path.stem for path in ordered] == ["usbcore", "usbip-core", "vhci-hcd"]
    with pytest.raises(UsageError, match="no module ftdi_sio"):
        in_order(tmp_path, ["ftdi_sio"])


def test_the_archive_has_the_kernels_format(tmp_path: Path) -> None:
    entries = [("bin", 0o40755, b""), ("bin/a", 0o100755, b"hello"), ("b", 0o100644, bytes(7))]
    data = archive(entries)
    at, found = 0, []
    while True:
        assert data[at : at + 6] == b"070701"
        fields = [int(data[at + 6 + 8 * i : at + 14 + 8 * i], 16) for i in range(13)]
        mode, size, length = fields[1], fields[6], fields[11]
        name = data[at + 110 : at + 110 + length - 1].decode()
        begin = (at + 110 + length + 3) // 4 * 4
        if name == "TRAILER!!!":
            break
        found.append((name, mode, data[begin : begin + size]))
        at = (begin + size + 3) // 4 * 4
    assert found == entries
    if shutil.which("cpio"):
        listed = subprocess.run(["cpio", "-t", "--quiet"], input=data, capture_output=True)
        assert listed.stdout.decode().split() == ["bin", "bin/a", "b"]


def test_the_report_says_what_failed_and_what_was_skipped() -> None:
    cases = [
        Case("dex3", "works", "passed", "91 exchanges/s", 1.5),
        Case("dex3", "fails", "failed", "moved | by 0.1\nrad"),
        Case("dex1", "not tried", "skipped", "no compiler"),
    ]
    page = markdown(cases, {"kernel": "6.1"})
    assert "| fails | failed | 0.0 | moved \\| by 0.1" in page
    assert page.index("## dex3") < page.index("## dex1")
    assert "What is not: the devices" in page


def test_a_record_counts_only_set_points_that_change_and_drive() -> None:
    place = [0.0]
    record = Record(lambda: place)
    start = record.now()["t"]
    record.setpoint(0, 1.0)
    record.setpoint(0, 1.0)
    record.note_positions()
    place[0] = 0.5
    assert record.since(start) == {
        "low": [0.0],
        "high": [0.5],
        "q": [0.5],
        "setpoints": 1,
        "last": "[(1.0,)]",
    }
    again = record.now()["t"]
    record.rests(0)
    assert record.since(again)["setpoints"] == 0
    record.setpoint(0, 1.0)
    assert record.since(again)["setpoints"] == 1


def test_a_record_says_when_the_joints_stood_still_and_no_motor_was_driven() -> None:
    place = [0.0]
    record = Record(lambda: place)
    record.setpoint(0, 1.0)
    record.setpoint(1, 1.0)
    start = record.now()["t"]
    record.note_positions()
    place[0] = 0.5
    record.rests(0)
    assert record.stopped(start)["released"] is None
    record.rests(1)
    stopped = record.stopped(start)
    assert stopped["still"] is not None
    assert stopped["released"] is not None
    assert 0 < stopped["still"] < stopped["released"] < record.now()["t"] - start
    later = record.now()["t"]
    record.rests(1)
    assert record.stopped(later) == {"still": 0.0, "released": 0.0}
