"""Which layouts the messages of a checkout of unitree_ros2 have: the table of docs/ros2.md.

    git clone https://github.com/unitreerobotics/unitree_ros2
    python -m tools.ros2_layouts unitree_ros2 v0.1.0 v0.2.0 v0.3.0 HEAD

Prints a row for each message that dexkit has, and a digest of all definitions of a revision that
are the present ones. Two definitions are the same if they have the same types and names in the same
order: comments, blank lines and the package's own name do not count.
"""

from __future__ import annotations

import hashlib
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from dexkit.messages.earlier import EARLIER
from dexkit.messages.layout import ALL, Struct
from dexkit.messages.schemas import ros2msg

__all__ = ["definitions", "digest", "layout_names", "own_members"]

_FOLDER = "cyclonedds_ws/src/unitree"


def members(text: str, package: str) -> str:
    """A definition without what does not count."""
    lines = (line.partition("#")[0].split() for line in text.splitlines())
    kept = (" ".join(words).replace(f"{package}/", "") for words in lines if words)
    return "".join(f"{line}\n" for line in kept)


def own_members(kind: Struct) -> str:
    """The same of a layout of dexkit's."""
    return members(ros2msg(kind).split("=" * 80)[0], kind.scope[0])


def definitions(checkout: Path, revision: str) -> dict[str, str]:
    """The members of every message of a revision that dexkit has, by DDS name.

    :raises subprocess.CalledProcessError: no checkout, or no such revision.
    """
    git = ["git", "-C", str(checkout)]
    listed = subprocess.run(
        [*git, "ls-tree", "-r", "--name-only", revision, "--", _FOLDER],
        check=True,
        capture_output=True,
        text=True,
    ).stdout.split()
    found = {}
    for name, kind in ALL.items():
        path = f"{_FOLDER}/{kind.ros_name}.msg"
        if path in listed:
            shown = subprocess.run(
                [*git, "show", f"{revision}:{path}"], check=True, capture_output=True, text=True
            )
            found[name] = members(shown.stdout, kind.scope[0])
    return found


def layout_names(found: Mapping[str, str]) -> dict[str, str]:
    """Which layout each message has: ``present``, the month of an earlier one, or ``other``.

    ``same bytes`` has int8 where dexkit and unitree_sdk2 have uint8. A type that only an earlier
    one of another type contains is named after that one.
    """
    named = {}
    for name, kind in ALL.items():
        known = {own_members(kind): "present"}
        for layouts in EARLIER.values():
            for layout in layouts:
                for part in (*layout.struct.depends(), layout.struct):
                    if part.dds_name == name:
                        known.setdefault(own_members(part), layout.when)
        text = found.get(name)
        if text is None:
            named[name] = "absent"
        elif text.replace("uint8", "int8") == own_members(kind).replace("uint8", "int8"):
            named[name] = known.get(text, "same bytes")
        else:
            named[name] = known.get(text, "other")
    return named


def digest(found: Mapping[str, str]) -> str:
    """SHA-256 of all members, by name."""
    text = "".join(f"{name}\n{found[name]}\n" for name in sorted(found))
    return hashlib.sha256(text.encode()).hexdigest()


def main(arguments: Sequence[str]) -> int:
    """Print the table; see the module."""
    if len(arguments) < 2 or not re.fullmatch(r"[^-].*", arguments[0]):
        print(__doc__, file=sys.stderr)
        return 2
    revisions = arguments[1:]
    found = [definitions(Path(arguments[0]), revision) for revision in revisions]
    named = [layout_names(one) for one in found]
    print("| message |", " | ".join(revisions), "|")
    print("|---|" + "---|" * len(revisions))
    for name, kind in ALL.items():
        print(f"| `{kind.ros_name}` |", " | ".join(one[name] for one in named), "|")
    print("| digest |", " | ".join(digest(one)[:16] for one in found), "|")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
