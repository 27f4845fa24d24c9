"""Is the cyclonedds that is installed beside dexkit self-contained?

Exit code 0 if a process that imports it has loaded the library of the wheel and no other, a message
goes to another process and back, and the licences of binding and library are installed. Run it in
an environment without dexkit's build tools: ``python check_wheel.py``.
"""

from __future__ import annotations

import os
import subprocess
import sys
from importlib import metadata
from pathlib import Path, PurePosixPath

from dexkit.setup_dds import execute, probe
from dexkit.setup_dds.pinned_wheel import LIBRARY_FOLDER


def main() -> str:
    """Check; returns the line that is printed.

    :raises SystemExit: it is not.
    """
    command = probe.command(sys.executable, send=True)
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    found = execute.check(probe.result_of(done.returncode, done.stdout + done.stderr), "")
    files = [PurePosixPath(str(f)) for f in metadata.files("cyclonedds") or ()]
    own = {
        os.path.realpath(metadata.distribution("cyclonedds").locate_file(str(f)))
        for f in files
        if f.parent.name == LIBRARY_FOLDER
    }
    if set(map(os.path.realpath, found.libraries)) != own or len(own) != 1:
        sys.exit(f"it loads {' and '.join(found.libraries)}, not only its own {own}")
    licences = [f for f in files if f.parts[0].endswith(".dist-info")]
    library = [f for f in licences if f.parent.name == "cyclonedds"]
    if {f.name for f in library} != {"LICENSE", "NOTICE.md"}:
        sys.exit(f"the licence files of the library are missing: {library}")
    if not any(f.name == "LICENSE" for f in licences if f not in library):
        sys.exit("the licence file of the binding is missing")
    return f"cyclonedds {found.version} loads {Path(own.pop()).name} of the wheel alone"


if __name__ == "__main__":
    print(main())
