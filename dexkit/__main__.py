"""``python -m dexkit``: the same as the ``dexkit`` command."""

from dexkit.cli import main

if __name__ == "__main__":
    main()
