"""``python -m dexkit``: the same as the ``dexkit`` command."""

import os

from dexkit.child_processes import END_WITH_PARENT, end_with_parent
from dexkit.cli import main

__all__ = ["start"]


def start() -> None:
    """Run the command line; end with the parent process, if that was asked for."""
    if os.environ.get(END_WITH_PARENT):
        end_with_parent()
    main()


if __name__ == "__main__":
    start()
