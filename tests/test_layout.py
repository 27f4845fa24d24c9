"""The top-level packages, their links in dexkit/, and which may import which."""

from __future__ import annotations

import ast
import os
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
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


def modules(folder: Path) -> Iterator[Path]:
    """Python files below ``folder``, not through the packages' links."""
    for base, folders, files in os.walk(folder):
        folders[:] = [f for f in folders if not (Path(base) / f).is_symlink()]
        yield from (Path(base) / f for f in files if f.endswith(".py"))


@cache
def imports(path: Path) -> tuple[frozenset[str], frozenset[str]]:
    """What a file imports, as absolute names: outside functions, and anywhere in it.

    What is imported for type checking only counts as the rest does.
    """
    outside, anywhere = set(), set()
    for node, in_function in statements(ast.parse(path.read_text(encoding="utf-8"), str(path))):
        if isinstance(node, ast.Import):
            names = {alias.name for alias in node.names}
        else:
            assert node.level == 0, f"{path}:{node.lineno}: imports are absolute here"
            names = {f"{node.module}.{alias.name}" for alias in node.names}
        anywhere |= names
        if not in_function:
            outside |= names
    return frozenset(outside), frozenset(anywhere)


def statements(
    block: ast.AST, in_function: bool = False
) -> Iterator[tuple[ast.Import | ast.ImportFrom, bool]]:
    """Every import, and whether it is in a function; expressions import nothing."""
    for node in ast.iter_child_nodes(block):
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node, in_function
        elif isinstance(node, ast.stmt | ast.excepthandler | ast.match_case):
            function = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
            yield from statements(node, in_function or function)


def imported(path: Path) -> frozenset[str]:
    """Everything that a file imports."""
    return imports(path)[1]


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
def test_only_the_dds_package_touches_cyclonedds(folder: str) -> None:
    for path in files(folder):
        touches = any(name.split(".")[0] == "cyclonedds" for name in imported(path))
        assert not touches or path == ROOT / "dexkit" / "dds" / "cyclone.py", path.relative_to(ROOT)


def module_name(path: Path) -> str:
    """``dexkit.traces.reader`` of ``traces/reader.py``."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    parts = parts if parts[0] == "dexkit" else ("dexkit", *parts)
    return ".".join(parts).removesuffix(".__init__")


def test_no_circle_of_files() -> None:
    """What is imported for type checking included: a part can be read without those above it."""
    paths = {module_name(p): p for folder in ("dexkit", *PACKAGES) for p in files(folder)}
    graph = {}
    for name, path in paths.items():
        found = imports(path)[0]
        graph[name] = {n if n in paths else n.rpartition(".")[0] for n in found} & set(paths)
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        circle = list(reversed(error.args[1]))
        raise AssertionError(" imports ".join(circle)) from None


def test_help_imports_neither_packages_nor_dds() -> None:
    """``dexkit --help`` is quick, and works where parts are missing."""
    for path in (ROOT / "dexkit" / "cli" / "__init__.py", ROOT / "dexkit" / "__init__.py"):
        tree = ast.parse(path.read_text())
        top = [n for n in tree.body if isinstance(n, (ast.Import, ast.ImportFrom))]
        names = {getattr(n, "module", None) or n.names[0].name for n in top}
        assert not any(name.startswith(("dexkit.dds", *(f"dexkit.{r}" for r in PACKAGES)))
                       for name in names)  # fmt: skip
