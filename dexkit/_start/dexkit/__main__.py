"""Start dexkit as a child process: ``python .../dexkit/_start/dexkit ARGUMENTS``.

``python -m dexkit`` puts the working folder in front of the import path, and a ``click.py`` that
lies there would be run. A folder that is run is in front itself, and nothing else is in this one
(what ``-P`` does from Python 3.11 on). :func:`dexkit.child_processes.command_line` makes the
command.
"""

import sys
from pathlib import Path

_ROOT = str(Path(__file__).resolve().parents[3])
if _ROOT not in sys.path:
    sys.path.append(_ROOT)  # behind everything: it is a checkout that is not installed

from dexkit.__main__ import start  # noqa: E402

if __name__ == "__main__":
    start()
