"""``python -m dexkit``: the same as the ``dexkit`` command."""

import os

from dexkit.cli import main
from dexkit.processes import END_WITH_PARENT, end_with_parent

if __name__ == "__main__":
    if os.environ.get(END_WITH_PARENT):
        end_with_parent()
    main()
