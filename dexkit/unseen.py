"""How long a hand may be without states before it is not known what it did meanwhile."""

from __future__ import annotations

__all__ = ["UNSEEN_S"]

UNSEEN_S = 0.03
"""Seconds without a state. A hand may pause for longer (RATE-03 judges that): what it does in a
pause is left out of measures and checks."""
