"""The layers of judging: each is complete, and cheap to import."""

from __future__ import annotations

import subprocess
import sys

from dexkit.conformance.checks import REGISTRY, check_of
from dexkit.conformance.kit.requirements import catalogue
from dexkit.conformance.layers import LAYERS, layer


def test_every_layer_is_complete() -> None:
    for name in LAYERS:
        found = layer(name)
        assert found.name == name
        assert found.plots, name
        assert callable(found.context.load()), name
        for model in {r.model for r in catalogue(None, name)}:
            assert found.reference(model).fault_sides, (name, model)
            if name != "client":  # which the kit plays nothing to
                assert found.script(model).run, (name, model)


def test_each_check_is_in_a_module_of_its_layer() -> None:
    for name in LAYERS:
        for requirement in catalogue(None, name):
            assert check_of(requirement).__module__ in layer(name).checks, requirement.id
    modules = {module for name in LAYERS for module in layer(name).checks}
    assert modules == {check.__module__ for check in REGISTRY.values()}


def test_requirements_are_read_without_checks() -> None:
    """What lists requirements starts without decoders, checks, scripts and references."""
    text = (
        "import sys\n"
        "from dexkit.conformance.kit.requirements import catalogue\n"
        "assert catalogue(None, None)\n"
        "print(*(m for m in sys.modules if m.startswith('dexkit.conformance.')))\n"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", text], check=True, capture_output=True, text=True
    ).stdout.split()
    parts = ("checks", "recording", "stimuli", "virtual", "faults", "usb")
    unwanted = [m for m in loaded if m.split(".")[2] in parts]
    assert not unwanted
