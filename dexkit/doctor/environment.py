"""The Python that dexkit runs in, and CycloneDDS's configuration variable."""

from __future__ import annotations

import os
import platform
import re
import subprocess
from importlib import metadata
from pathlib import Path
from urllib.parse import unquote, urlsplit
from xml.etree.ElementTree import ParseError

from defusedxml.ElementTree import fromstring

from dexkit.child_processes import code_line
from dexkit.doctor.observations import Environment
from dexkit.documents import read_text
from dexkit.errors import UsageError
from dexkit.redaction import redact

__all__ = ["environment", "shown_uri", "uri_problem"]

_PATIENCE = 20.0  # seconds for an import
_SDK = ("unitree-sdk2", "unitree-sdk2py", "unitree_sdk2py")


def environment() -> Environment:
    """Look at this Python; libraries are imported in a process of their own, if installed."""
    cyclonedds = _version("cyclonedds")
    sdk = next((v for name in _SDK if (v := _version(name))), "")
    uri = os.environ.get("CYCLONEDDS_URI", "")
    return Environment(
        python=platform.python_version(),
        machine=platform.machine(),
        cyclonedds=cyclonedds,
        cyclonedds_error=_import_problem("cyclonedds.core") if cyclonedds else "",
        sdk=sdk,
        sdk_error=_import_problem("unitree_sdk2py") if sdk else "",
        uri=shown_uri(uri),
        uri_error=redact(uri_problem(uri)),
    )


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return ""


def _import_problem(module: str) -> str:
    """Why a module does not import, or empty. A crash of it is not ours."""
    code = f"import {module}"
    try:
        done = subprocess.run(
            code_line(code),
            capture_output=True,
            text=True,
            timeout=_PATIENCE,
            stdin=subprocess.DEVNULL,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"'{code}' does not end"
    if done.returncode == 0:
        return ""
    if done.returncode < 0:
        return f"'{code}' dies of signal {-done.returncode}"
    lines = done.stderr.strip().splitlines()
    # the path at the end has no more information
    return re.sub(r" \(/[^()]*\)$", "", lines[-1]) if lines else f"'{code}' fails"


def shown_uri(uri: str) -> str:
    """A CYCLONEDDS_URI as it may be shown. Of XML that is the names of its elements: their contents
    may be the password and the key of DDS Security.
    """
    return " ".join(re.findall(r"<\w+", uri)) if "<" in uri else redact(uri)


def uri_problem(uri: str) -> str:
    """Why a CYCLONEDDS_URI cannot be used, or empty: each of its parts is XML or a file of it."""
    for part in _parts(uri):
        text = part
        if not part.startswith("<"):
            try:
                path = Path(unquote(urlsplit(part).path) if part.startswith("file:") else part)
                text = read_text(path)
            except UsageError as error:
                return str(error)
            except ValueError:
                return f"{part} cannot be read: that is no name of a file"
        try:
            # a configuration may be several elements in a row
            root = fromstring(f"<all>{_without_declaration(text)}</all>")
        except (ParseError, ValueError) as error:  # ValueError: entities, or lone surrogates
            return f"it is not XML: {error}"
        if not len(root):
            return "it holds no configuration"
    return ""


def _without_declaration(text: str) -> str:
    text = text.strip()
    return text.partition("?>")[2] if text.startswith("<?xml") else text


def _parts(uri: str) -> list[str]:
    """CycloneDDS takes a list with commas; inside XML they mean nothing."""
    uri = uri.strip()
    return [uri] if uri.startswith("<") else [p.strip() for p in uri.split(",") if p.strip()]
