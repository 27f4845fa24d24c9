"""The top-level packages, their links in dexkit/, and which may import which."""

from __future__ import annotations

import ast
import os
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from tests.each import each

ROOT = Path(__file__).parent.parent
PACKAGES = ("drivers", "emulators", "conformance", "traces")
# what a package may import besides itself and the core
MAY_IMPORT = {
    "drivers": set(),
    "emulators": set(),
    "traces": set(),
    "conformance": {"traces"},
}

_OF_INTEREST = re.compile(
    rf"^\s*(from|import) +(\.|dexkit import|(dexkit\.)?({'|'.join(PACKAGES)}|cyclonedds)\b)",
    re.MULTILINE,
)


def modules(folder: Path) -> Iterator[Path]:
    """Python files below ``folder``, not through the packages' links."""
    for base, folders, files in os.walk(folder):
        folders[:] = [f for f in folders if not (Path(base) / f).is_symlink()]
        yield from (Path(base) / f for f in files if f.endswith(".py"))


@cache
def imported(path: Path) -> frozenset[str]:
    """Modules that a file imports, at the top or inside a function, as absolute names.

    None if it imports neither a package nor CycloneDDS. What is imported for type checking only
    is left out: a program never loads it.
    """
    text = path.read_text(encoding="utf-8")
    if not _OF_INTEREST.search(text):  # parsing every file takes seconds
        return frozenset()
    names = set()
    tree = ast.parse(text, str(path))
    for node in statements(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: imports are absolute here"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return frozenset(names)


def statements(block: ast.AST) -> Iterator[ast.stmt]:
    """Every statement, but for those of type checking; expressions import nothing."""
    for node in ast.iter_child_nodes(block):
        if not isinstance(node, ast.stmt | ast.excepthandler | ast.match_case):
            continue
        if isinstance(node, ast.stmt):
            yield node
        if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING":
            for other in node.orelse:
                yield other
                yield from statements(other)
        else:
            yield from statements(node)


def packages_imported(path: Path) -> set[str]:
    return {
        name.split(".")[1]
        for name in imported(path)
        if name.startswith("dexkit.") and name.split(".")[1] in PACKAGES
    }


def files(folder: str) -> list[Path]:
    found = sorted(modules(ROOT / folder))
    assert found, f"no modules in {folder}"
    return found


@each("package", PACKAGES)
def test_each_package_is_linked_into_dexkit(package: str) -> None:
    link = ROOT / "dexkit" / package
    assert link.is_symlink()
    assert os.readlink(link) == f"../{package}"
    assert (link / "__init__.py").is_file()


@each("package", PACKAGES)
def test_packages_do_not_import_each_other(package: str) -> None:
    for path in files(package):
        others = packages_imported(path) - {package} - MAY_IMPORT[package]
        assert not others, f"{path.relative_to(ROOT)} imports {', '.join(others)}"


def test_core_does_not_import_the_linked_packages() -> None:
    for path in files("dexkit"):
        if ROOT / "dexkit" / "cli" not in path.parents:
            assert not packages_imported(path), (
                f"{path.relative_to(ROOT)}: {packages_imported(path)}"
            )


@each("folder", ["dexkit", "tests", "benchmarks", *PACKAGES])
def test_nothing_imports_a_package_by_its_bare_name(folder: str) -> None:
    for path in files(folder):
        bare = {name for name in imported(path) if name.split(".")[0] in PACKAGES}
        assert not bare, f"{path.relative_to(ROOT)} imports {', '.join(bare)}: say dexkit.…"


@each("folder", ["dexkit", "benchmarks", *PACKAGES])
def test_only_the_dds_module_touches_cyclonedds(folder: str) -> None:
    for path in files(folder):
        touches = any(name.split(".")[0] == "cyclonedds" for name in imported(path))
        assert not touches or path == ROOT / "dexkit" / "dds.py", path.relative_to(ROOT)


def test_help_imports_neither_packages_nor_dds() -> None:
    """``dexkit --help`` is quick, and works where parts are missing."""
    for path in (ROOT / "dexkit" / "cli" / "__init__.py", ROOT / "dexkit" / "__init__.py"):
        tree = ast.parse(path.read_text())
        top = [n for n in tree.body if isinstance(n, (ast.Import, ast.ImportFrom))]
        names = {getattr(n, "module", None) or n.names[0].name for n in top}
        assert not any(name.startswith(("dexkit.dds", *(f"dexkit.{r}" for r in PACKAGES)))
                       for name in names)  # fmt: skip
