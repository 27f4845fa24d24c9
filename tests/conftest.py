"""What holds for every test."""

from __future__ import annotations

from hypothesis import HealthCheck, settings

# A machine that is busy with something else makes examples slow, not wrong.
settings.register_profile("dexkit", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("dexkit")
