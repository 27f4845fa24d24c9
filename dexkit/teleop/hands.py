"""How each hand model is teleoperated: its client, and what its operators do.

A package whose hand has a client unlike :class:`~dexkit.teleop.client.FingerClient` registers a
:class:`TeleopHand` under the model's name::

    [project.entry-points."dexkit.teleop_hands"]
    my-hand = "my_package.teleop:MY_HAND"
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from dexkit.errors import UsageError
from dexkit.hand import Side
from dexkit.models import (
    BRAINCO_REVO2,
    DEX1_1,
    DEX3_1,
    DEX5_1,
    INSPIRE_DFX,
    INSPIRE_FTP,
    MODELS,
    Dialect,
    HandModel,
    dialect,
    model,
    registered_record,
)
from dexkit.teleop.client import (
    Dex1Client,
    EitherHandClient,
    FingerClient,
    Release,
    RightHandClient,
    TeleopClient,
)
from dexkit.teleop.profiles import Profile, finger_profiles, gripper_profiles

__all__ = ["GROUP", "TeleopHand", "client_for", "profile", "profiles_for", "teleop_hand"]

GROUP = "dexkit.teleop_hands"


@dataclass(frozen=True)
class TeleopHand:
    """How a hand is teleoperated.

    :param client: model of the client that drives it.
    :param profiles: makes its operator profiles.
    :param forks: its client sends from a forked process, which a reader that starts later does not
        receive.
    :param note: what a user of its client has to know, or empty.
    :param option: its name in the client's ``--ee``; empty if that is its short name.
    """

    model: HandModel
    client: type[TeleopClient] = FingerClient
    profiles: Callable[[HandModel], tuple[Profile, ...]] = finger_profiles
    forks: bool = False
    note: str = ""
    option: str = ""


_OWN = {
    each.model.name: each
    for each in (
        TeleopHand(DEX1_1, client=Dex1Client, profiles=gripper_profiles),
        TeleopHand(DEX3_1, forks=True),
        TeleopHand(DEX5_1, forks=True, note="--ee=dex5 is not in a release: pull request 321"),
        TeleopHand(BRAINCO_REVO2, forks=True),
        TeleopHand(INSPIRE_DFX, client=RightHandClient, forks=True, option="inspire_dfx"),
        TeleopHand(INSPIRE_FTP, client=EitherHandClient, forks=True, option="inspire_ftp"),
    )
}


def teleop_hand(name: str) -> TeleopHand:
    """How hands of the model of that name are teleoperated.

    :raises UsageError: there is no such model.
    :raises ModelBroken: what another package registers cannot be used.
    """
    own = _OWN.get(name) or registered_record(GROUP, name, TeleopHand)
    return own or TeleopHand(model(name))


def client_for(
    spoken: Dialect | str,
    sides: Sequence[Side] = tuple(Side),
    *,
    release: Release | None = None,
    simulated: bool = False,
) -> TeleopClient:
    """The client that drives hands of this dialect.

    :raises UsageError: no such dialect, or a release or simulation of a client that has none.
    """
    chosen = dialect(spoken) if isinstance(spoken, str) else spoken
    client = teleop_hand(chosen.model).client
    if issubclass(client, Dex1Client):
        return client(chosen, sides, release=release, simulated=simulated)
    if release is not None or simulated:
        raise UsageError(f"the client of a {model(chosen.model).title} is the same in all releases")
    return client(chosen, sides)


def profiles_for(hand_model: str) -> tuple[Profile, ...]:
    """The profiles of a model."""
    found = teleop_hand(hand_model)
    return found.profiles(found.model)


def profile(name: str, hand_model: str) -> Profile:
    """The profile of that name.

    :raises UsageError: that model has none.
    """
    found = [p for p in profiles_for(hand_model) if p.name == name]
    if not found:
        owner = next(
            (m for m in MODELS.values() if name in {p.name for p in profiles_for(m.name)}), None
        )
        its = f"--dialect {owner.dialects[0].name} has it; " if owner else ""
        raise UsageError(
            f"a {model(hand_model).title} has no profile {name!r}",
            hint=f"{its}there are: {', '.join(p.name for p in profiles_for(hand_model))}, or give "
            "a recording: FILE.mcap",
        )
    return found[0]
