"""JSON schemas of the files that dexkit writes, made of their types."""

from __future__ import annotations

import json

from dexkit.conformance.kit.result_file import ResultFile
from dexkit.conformance.selftest.result_file import SelfTestFile
from dexkit.records import json_schema

__all__ = ["files"]

_FORMS = {"result.schema.json": ResultFile, "selftest.schema.json": SelfTestFile}


def files() -> dict[str, str]:
    """The schemas by their names on the site."""
    return {name: json.dumps(json_schema(form), indent=2) + "\n" for name, form in _FORMS.items()}
