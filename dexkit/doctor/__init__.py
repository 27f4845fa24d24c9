"""``dexkit doctor``: find out why a client and a hand do not connect.

:mod:`rules` judges :mod:`observations` and is pure; :mod:`dds` (with the sans-IO
:mod:`observer` and :mod:`rtps`), :mod:`network`, :mod:`usb`, :mod:`environment` and
:mod:`processes` gather them; :mod:`catalogue` holds the texts. What takes a driver (asking a servo
who it is) is done by the command line.
"""

from dexkit.doctor.catalogue import DIAGNOSES, Diagnosis, Finding, Severity
from dexkit.doctor.observations import Observations
from dexkit.doctor.rules import Readiness, Scope, Verdict, diagnose, readiness, verdict

__all__ = [
    "DIAGNOSES",
    "Diagnosis",
    "Finding",
    "Observations",
    "Readiness",
    "Scope",
    "Severity",
    "Verdict",
    "diagnose",
    "readiness",
    "verdict",
]
