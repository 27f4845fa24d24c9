"""The run record: with what, on which machine and for which requirements a live run was made.

It is mcap metadata, :data:`RECORD`, beside the stimulus record. With it the recording alone says
how to judge it as the run was judged (dialect, sides, claims), and how to do the run again.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
from collections.abc import Iterable, Mapping
from dataclasses import asdict, is_dataclass
from functools import cache
from importlib import metadata
from pathlib import Path

from dexkit import __version__
from dexkit.conformance.kit.claims import Claims
from dexkit.conformance.kit.requirements import Requirement, catalogue
from dexkit.conformance.layers import LAYERS
from dexkit.errors import DexkitError
from dexkit.hand import ROBOT, Side, Subject
from dexkit.models import DIALECTS
from dexkit.robots import ROBOTS

__all__ = [
    "RECORD",
    "catalogue_digest",
    "recorded_claims",
    "recorded_dialect",
    "recorded_subject",
    "recorded_subjects",
    "run_record",
]

RECORD = "dexkit.run"
VERSION = "1"
_SUBJECT = ("backend", "device", "object")
NO_SEED = "none: the stimulus has no random numbers"
_CPUS = Path("/proc/cpuinfo")


def run_record(
    *,
    subject: Mapping[str, str],
    dialect: str,
    sides: Iterable[Subject],
    phases: Iterable[str],
    rounds: int,
    requirements: Iterable[Requirement],
    claims: Claims,
) -> dict[str, str]:
    """The content of the record of a live run that begins now.

    :param subject: backend, device and object of the run, as in the result's ``subject``.
    :param phases: of the stimulus.
    :param rounds: of the stimulus.
    """
    return {
        "version": VERSION,
        "kind": "live",
        "dexkit": __version__,
        "python": platform.python_version(),
        "numpy": _version("numpy"),
        "cyclonedds": _version("cyclonedds"),
        "kernel": f"{platform.system()} {platform.release()} {platform.machine()}",
        "processor": _processor(),
        "cores": str(os.cpu_count() or 0),
        "seed": NO_SEED,
        "catalogue": catalogue_digest(),
        **{name: subject.get(name, "") for name in _SUBJECT},
        "dialect": dialect,
        "sides": json.dumps([str(side) for side in sides]),
        "phases": json.dumps(sorted(phases)),
        "rounds": str(rounds),
        "requirements": json.dumps([r.id for r in requirements]),
        "claims": json.dumps(
            None
            if claims.units is None
            else {"claims": dict(claims.units), "hand": dict(claims.hand)}
        ),
    }


@cache
def catalogue_digest() -> str:
    """SHA-256, hex, of all requirements of this version of dexkit."""
    every = [
        {k: str(v) if k in ("level", "kind", "plots") else v for k, v in vars(r).items()}
        for layer in sorted(LAYERS)
        for r in catalogue(None, layer)
    ]
    text = json.dumps(every, sort_keys=True, default=_plain)
    return hashlib.sha256(text.encode()).hexdigest()


def _plain(value: object) -> object:
    """What JSON has no form for; without a copy of all that it has one for."""
    return asdict(value) if is_dataclass(value) and not isinstance(value, type) else str(value)


def recorded_dialect(run: Mapping[str, str]) -> str | None:
    """The dialect that the run was judged with; None if the record does not say."""
    name = run.get("dialect")
    return name if name in DIALECTS or name in ROBOTS else None


def recorded_subjects(run: Mapping[str, str]) -> tuple[Subject, ...]:
    """The subjects that the run was about; none if the record does not say."""
    known: dict[str, Subject] = {str(s): s for s in (*Side, ROBOT)}
    names = _parsed(run, "sides")
    names = names if isinstance(names, list) else []
    return tuple(known[n] for n in names if isinstance(n, str) and n in known)


def recorded_subject(run: Mapping[str, str]) -> dict[str, str]:
    """Backend, device and object of the run, for a result's ``subject``.

    None of them where the record does not say whether the device was emulated: an earlier dexkit
    wrote the backend only.
    """
    if "device" not in run:
        return {}
    return {name: run[name] for name in _SUBJECT if run.get(name)}


def recorded_claims(run: Mapping[str, str]) -> Claims:
    """The claims that the run was judged with; none if the record does not say."""
    found = _parsed(run, "claims")
    if not isinstance(found, dict):
        return Claims()
    about = {name: found[name] for name in ("claims", "hand") if name in found}
    try:
        return Claims.of_document(about, "the run record")
    except DexkitError:  # of another dexkit, whose units are not known here
        return Claims()


def _parsed(run: Mapping[str, str], name: str) -> object:
    try:
        found: object = json.loads(run.get(name, "null"))
    except ValueError:
        return None
    return found


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "none"


def _processor() -> str:
    """The processor's name, where the system tells."""
    try:
        for line in _CPUS.read_text(encoding="utf-8", errors="replace").splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name":
                return value.strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
