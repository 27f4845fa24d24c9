"""Hashes of Unitree's types as described by CycloneDDS 0.10, to detect other descriptions.

A participant announces a hash of each type. A 0.10.x peer that does not know the hash asks for the
type, and what the Python binding sends from 2023 on crashes it (docs/sources/unitree-dex.md#f).
The version alone does not tell: the wheel of cyclonedds 0.10.2 announces 0.11.0, and so do builds
that crash.
"""

from __future__ import annotations

__all__ = ["TYPE_HASHES"]

_GO, _HG = "unitree_go::msg::dds_::", "unitree_hg::msg::dds_::"

TYPE_HASHES: dict[str, str] = {
    _GO + "MotorCmds_": "2ea87a3ac222ec386596036ece43",
    _GO + "MotorStates_": "b90aca9286ab4e3eae7638ef5ca9",
    _GO + "LowCmd_": "52cc8eb0d427d692aa2b20a90540",
    _GO + "LowState_": "08f239c471d3a27e67e7c7723184",
    _GO + "WirelessController_": "e9686fe76f7b08f92cb24943ac72",
    _HG + "HandCmd_": "5c45f9f8b1e1c279a659521332b0",
    _HG + "HandState_": "b9f2806966060fc0f913a47b8ab9",
    _HG + "LowCmd_": "42b0283aa7e1bb592ec898a0dbed",
    _HG + "LowState_": "2be9706c9587e8d8afd8bfc6de7b",
}
"""Hash of the complete type by DDS name, as :attr:`dexkit.doctor.observations.Endpoint.type_hash`;
the same from 0.9.1 to 0.10.5, in Python and in C++."""
