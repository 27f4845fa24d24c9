"""Where the requirements come from, in words that a reader outside the project understands.

The catalogue's ``source`` names vendor documents and code, and cites the project's collected facts
by section ("facts/unitree-dex B.1") and the specifications that were given by number ("seed 002").
:func:`told` says the same with names that mean something, and leads to docs/sources.md, which lists
each document, where it can be had, and what was measured how.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

__all__ = ["DOCUMENTS", "PAGE", "SECTIONS", "Section", "anchor", "cited", "linked", "told"]

PAGE = "docs/sources.md"


@dataclass(frozen=True)
class Section:
    """A section of the collected facts.

    :param title: what it is about.
    :param names: the documents and code that say so.
    """

    title: str
    names: str


DOCUMENTS: Mapping[str, str] = {
    "000": "the gripper's DDS interface specification",
    "002": "Dex3-1 user manual",
    "003": "note on predictive state",
    "004": "notes on H1 LowCmd/LowState",
}
"""The specifications that the project was given, by number."""

_SDK = "unitree_sdk2, unitree_sdk2_python"
_MANUAL = "Dex3-1 user manual"
_USB = "the Dex3-1 on USB: "
SECTIONS: Mapping[str, Section] = {
    "A.1": Section("topics and types", f"xr_teleoperate, dex1_1_service, {_SDK}"),
    "A.2": Section("layout of the messages", f"IDL of {_SDK}"),
    "A.4": Section("bytes on the wire", "measured with unitree_sdk2_python"),
    "A.5": Section("QoS in use", "measured by discovery on both vendor SDKs"),
    "A.6": Section("domains, interfaces, discovery", f"{_SDK}, xr_teleoperate"),
    "A.7": Section("checksum of LowCmd_ and LowState_", f"{_SDK}, measured"),
    "A.8": Section("joints of the H1 and G1 bodies", "unitree_sdk2 examples, Unitree's URDFs"),
    "B.1": Section(
        "rates, gains and start-up of each client", "xr_teleoperate, unitree_sdk2 examples"
    ),
    "B.2": Section("what the vendor's gripper service does", "dex1_1_service main.cpp"),
    "B.3": Section("geometry and direction of the Dex1-1", "xr_teleoperate, Unitree's URDF"),
    "B.4": Section("joints, limits and mode byte of the Dex3-1", f"{_MANUAL}, Unitree's URDF"),
    "B.5": Section("the Dex5-1", "xr_teleoperate, Dex5_1_Controller (pull request 321)"),
    "B.6": Section("error bits of the motors", f"Unitree's developer pages, {_MANUAL}"),
    "B.7": Section(
        "how the genuine client behaves on the wire", "recordings of xr_teleoperate's controllers"
    ),
    "C.1": Section(_USB + "device and endpoints", _MANUAL),
    "C.2": Section(_USB + "motor command", _MANUAL),
    "C.3": Section(_USB + "motor state", _MANUAL),
    "C.4": Section(_USB + "sensor state", _MANUAL),
    "C.5": Section(_USB + "command frame and its size", _MANUAL),
    "C.6": Section(_USB + "state frame", _MANUAL),
    "C.7": Section(_USB + "which motor is on which bus", "assumed"),
    "C.9": Section(_USB + "units", f"{_MANUAL}, derived"),
    "G": Section("motor library of the Dex1-1", "measured on the vendor's library"),
    "D 1": Section("which type is on rt/dex1", "the sources disagree"),
    "D 2": Section("full range of the Dex1-1", "the sources disagree"),
    "D 3": Section("zero of the Dex1-1", "the sources disagree"),
    "D 4": Section("sign of the Dex1-1's torque", "the sources disagree"),
    "D 5": Section("which motor id is which side", "the sources disagree"),
    "D 7": Section("rate of the state", "the sources disagree"),
    "D 8": Section("reliability", "the sources disagree"),
    "D 10": Section("gains of the Dex1-1's commands", "the sources disagree"),
    "D 11": Section("mode of the Dex1-1's commands", "the sources disagree"),
    "D 12": Section("which members of the Dex1-1's state are filled", "the sources disagree"),
    "D 13": Section("order of the Dex3-1's fingers", "the sources disagree"),
    "D 17": Section("limits of the Dex3-1's thumb_1", "the sources disagree"),
    "D 19": Section("type of the motor's temperature", "the sources disagree"),
    "D 20": Section("number of pressure packets", "the sources disagree"),
    "D 26": Section("what the mode byte means", "the sources disagree"),
    "E 1": Section("a client that waits for ever", "xr_teleoperate issue 100"),
}
"""By the codes that the catalogue cites; each is a heading of the page."""

_CODE = re.compile(r"\b(?:[A-C]\.\d+|[DE] \d+|G(?=[),;]|$))")
_CITED = re.compile(r"facts/unitree-dex (" + _CODE.pattern + ")")
_SEED = re.compile(r"\bseed (\d{3})\b")


def told(source: str) -> str:
    """``source`` with names for numbers: what a citation alone leads to is named beside it."""

    def section(match: re.Match[str]) -> str:
        before = source[: match.start()]
        code = match.group(1)
        # in brackets, behind what it is about; of a result file, perhaps one that is not known here
        if before.count("(") > before.count(")") or code not in SECTIONS:
            return f"{PAGE} {code}"
        return f"{SECTIONS[code].names}, {PAGE} {code}"

    text = _CITED.sub(section, source)
    return _SEED.sub(lambda m: DOCUMENTS.get(m.group(1), m.group()), text)


def cited(source: str) -> tuple[str, ...]:
    """The codes that a source cites, each once."""
    return tuple(dict.fromkeys(_CODE.findall(source)))


def linked(text: str, link: Callable[[str, Section], str]) -> str:
    """What :func:`told` says, with every code replaced by ``link(code, section)``."""

    def one(match: re.Match[str]) -> str:
        code = match.group()
        return link(code, SECTIONS[code]) if code in SECTIONS else code

    return _CODE.sub(one, text)


def anchor(code: str) -> str:
    """Where a section is on the page: ``a1`` for A.1."""
    return re.sub(r"[^a-z0-9]", "", code.lower())
