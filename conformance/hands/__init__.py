"""The models that the kit judges: those of dexkit, each in a module beside this one, and those of
other packages.

A package that has a hand model of its own (:mod:`dexkit.models`) adds what the kit needs to judge
it, under the model's name::

    [project.entry-points."dexkit.conformance_hands"]
    my-hand = "my_package.under_test:MY_HAND"
"""

from __future__ import annotations

from dexkit.conformance.hands import brainco, dex1, dex3, dex5, inspire, robots
from dexkit.conformance.hands.record import JointRoles, ModelUnderTest
from dexkit.errors import UsageError
from dexkit.models import registered_record

__all__ = [
    "BUILT_IN",
    "GROUP",
    "JointRoles",
    "ModelUnderTest",
    "under_test",
]

GROUP = "dexkit.conformance_hands"
BUILT_IN = (
    dex1.DEX1_1,
    dex3.DEX3_1,
    dex5.DEX5_1,
    brainco.BRAINCO_REVO2,
    inspire.INSPIRE_DFX,
    inspire.INSPIRE_FTP,
    robots.H1,
    robots.G1,
)
"""The models of dexkit itself: hands, then robots."""
_BY_NAME = {each.model.name: each for each in BUILT_IN}


def under_test(name: str) -> ModelUnderTest:
    """How the kit judges the model of that name.

    :raises UsageError: it cannot: no package registers that.
    :raises ModelBroken: what another package registers cannot be used.
    """
    found = _BY_NAME.get(name) or registered_record(GROUP, name, ModelUnderTest)
    if found is None:
        raise UsageError(
            f"there are no requirements for {name}",
            hint=f"its package has to register them under {GROUP} (docs/other-hands.md)",
        )
    return found
