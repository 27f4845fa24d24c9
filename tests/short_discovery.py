"""A pytest plugin (``-p tests.short_discovery``): the kit waits 0.3 s for a hand instead of 5 s."""

from __future__ import annotations

from dexkit.conformance.kit import live

live.DISCOVERY_TIMEOUT = 0.3
