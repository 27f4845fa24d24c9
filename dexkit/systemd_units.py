"""The text of systemd units and udev rules for hands: pure functions; docs/install-service.md.

``dexkit install-service`` writes them; packaging/systemd holds those of two EZGrippers.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from dexkit.errors import UsageError
from dexkit.hand import Side
from dexkit.wire.dex3_usb import PRODUCT_ID, VENDOR_ID

__all__ = ["GROUPS", "device_link", "serial_rule", "unit", "unit_name", "usb_rules"]

GROUPS = ("dialout", "plugdev")
"""Who may use serial ports and USB devices, on Debian and its relatives."""

_PLAIN = re.compile(r"[A-Za-z0-9@%+=:,./_-]+")
_WATCHDOG = 5  # seconds without a state after which systemd restarts the service


def unit_name(side: Side) -> str:
    """File name of the unit of a hand."""
    return f"dexkit-{side}.service"


def device_link(side: Side) -> str:
    """The stable name of a hand's serial adapter, made by :func:`serial_rule`."""
    return f"/dev/dexkit-{side}"


def _plain(text: str) -> str:
    """A text of one line, in which nothing is a specifier (systemd.unit(5), "Specifiers").

    :raises UsageError: it holds a control character, or is not Unicode.
    """
    if any(ord(c) < 32 or "\ud800" <= c <= "\udfff" for c in text):
        raise UsageError(f"{text!r} cannot be written into a systemd unit")
    return text.replace("%", "%%")


def _quoted(word: str) -> str:
    """A word of a list (systemd.syntax(7), "Quoting").

    :raises UsageError: as for :func:`_plain`.
    """
    word = _plain(word)
    if _PLAIN.fullmatch(word):
        return word
    return '"' + word.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _command(words: Sequence[str]) -> str:
    """A command line (systemd.service(5), "Command lines"): variables are not in the program."""
    program, *arguments = words
    return " ".join([_quoted(program), *(_quoted(word.replace("$", "$$")) for word in arguments)])


def _folder(folder: Path) -> str:
    """A folder, which systemd reads to the end of its line, without quotes.

    :raises UsageError: it would read another one.
    """
    text = str(folder)
    if not text.startswith("/") or text != text.strip() or text.endswith("\\"):
        raise UsageError(
            f"the folder {text!r} cannot be written into a systemd unit", hint="rename it"
        )
    return _plain(text)


def unit(
    side: Side,
    command: Sequence[str],
    *,
    user: str,
    what: str,
    groups: Sequence[str] = GROUPS,
    folder: Path | None = None,
    python_path: str = "",
) -> str:
    """The unit of one hand's service.

    :param command: the command line, program first.
    :param user: who runs it.
    :param what: the hand, for its description.
    :param groups: that the service is in beside the user's own. Each has to exist.
    :param folder: working folder, where a plug-in is loaded from; None for systemd's, "/".
    :param python_path: value of PYTHONPATH, or empty.
    :raises UsageError: a word, name or folder cannot be written into a unit.
    """
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_.-]*\$?", user):
        raise UsageError(f"{user!r} is not a user name")
    place = "" if folder is None else f"WorkingDirectory={_folder(folder)}\n"
    if python_path:
        place += f"Environment={_quoted('PYTHONPATH=' + python_path)}\n"
    devices = f"SupplementaryGroups={' '.join(groups)}\n" if groups else ""
    if devices:
        devices = "# serial ports and USB devices of hands\n" + devices
    return f"""\
# Written by dexkit install-service (docs/install-service.md).
[Unit]
Description=dexkit: {side} hand ({_plain(what)})
# the interface may come later still: --wait-for-interface
Wants=network-online.target
After=network-online.target
# retries of a hand have no limit
StartLimitIntervalSec=0

[Service]
Type=notify
NotifyAccess=main
ExecStart={_command(command)}
{place}User={user}
{devices}# ready when the topics are up, which may take until device and network are there
TimeoutStartSec=infinity
# the state loop reports; without a report for {_WATCHDOG} s the service is killed and started again
WatchdogSec={_WATCHDOG}
Restart=always
RestartSec=2
# SIGTERM brakes and releases the hand
KillSignal=SIGTERM
TimeoutStopSec=10
# states on time when other work uses all cores (docs/service.md)
LimitRTPRIO=10
NoNewPrivileges=yes
ProtectSystem=full
PrivateTmp=no

[Install]
WantedBy=multi-user.target
"""


def serial_rule(side: Side, device: Path, sys: Path = Path("/sys")) -> str:
    """The udev rule that gives the serial adapter of a hand a stable name.

    By its serial number, or by its place on the USB where it has none. An FTDI adapter's latency
    timer is set to 1 ms. ModemManager is told to leave the adapter alone.

    :param device: where it is now, e.g. ``/dev/ttyUSB0``.
    :raises UsageError: it is not a serial adapter on USB.
    """
    name = device.resolve().name
    place = sys / "class" / "tty" / name / "device"
    if not place.exists():
        raise UsageError(
            f"{device} is no serial adapter of this machine",
            hint="plug it in and give its path, e.g. /dev/ttyUSB0; 'ls /dev/serial/by-id'",
        )
    above = place.resolve()
    found = next((p for p in (above, *above.parents) if (p / "idVendor").exists()), None)
    if found is None:
        raise UsageError(
            f"{device} is not on USB, so its name stays the same without a rule",
            hint="give --no-udev",
        )
    values = {key: _attribute(found / key) for key in ("idVendor", "idProduct", "serial")}
    match = ", ".join(f'ATTRS{{{key}}}=="{values[key]}"' for key in ("idVendor", "idProduct"))
    if values["serial"]:
        match += f', ATTRS{{serial}}=="{values["serial"]}"'
        note = "by its serial number"
    else:
        match += f', KERNELS=="{found.name}"'
        note = "by its place on the USB (it has no serial number): keep it in that socket"
    return f"""\
# The {side} hand's serial adapter, {note}.
SUBSYSTEM=="tty", {match}, SYMLINK+="{Path(device_link(side)).name}", GROUP="dialout", MODE="0660"
# ModemManager must not send it a modem's commands.
SUBSYSTEM=="tty", {match}, ENV{{ID_MM_DEVICE_IGNORE}}="1", ENV{{ID_MM_PORT_IGNORE}}="1"
ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{{latency_timer}}="1"
"""


def _attribute(path: Path) -> str:
    """An attribute as it is written into a rule; empty when it is not there or odd."""
    try:
        text = path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
    return text if re.fullmatch(r"[A-Za-z0-9 ._:-]+", text) else ""


def usb_rules() -> str:
    """The udev rules of Dex3-1 hands on USB."""
    return "".join(
        f'SUBSYSTEM=="usb", ATTR{{idVendor}}=="{VENDOR_ID:04x}", '
        f'ATTR{{idProduct}}=="{product:04x}", '
        f'MODE="0660", GROUP="plugdev", TAG+="uaccess", SYMLINK+="dexkit-dex3-{side}"\n'
        for side, product in PRODUCT_ID.items()
    )
