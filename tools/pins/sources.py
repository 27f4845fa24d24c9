"""Which code a result can depend on, found by reading the sources, and a digest of it.

Code is reached from code that names it: by an import, or by a name at the top level of a module.
Most modules count as one piece, with everything that they import. Modules of many independent parts
(checks, wrong hands) are *split*: a definition counts with what it names, and not with the others
beside it; statements of such a module that define nothing count with each of its definitions.

What is reached without a name is not found: a ``Lazy`` reference, a module that is imported by a
text. Whoever asks has to name such places, and the tests watch real runs for code outside of what
was found (``tests/test_pins.py``). Comments, docstrings and the layout of the text do not count.
"""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

__all__ = ["WHOLE", "Place", "Sources"]

WHOLE = "*"
"""In a place: all of the module."""
Place = tuple[str, str]
"""A module's name, and a name at its top level."""
_LOOSE = ""
"""In a place: the statements of a split module that define nothing."""


@dataclass
class _Part:
    """A piece of code: the texts of its statements, and the places that they name."""

    texts: list[str] = field(default_factory=list)
    uses: set[Place] = field(default_factory=set)


class Sources:
    """The sources of packages in a folder.

    :param root: holds the packages.
    :param packages: their names; what is imported from others is not followed.
    :param split: modules, and packages, that are split.
    :param ignored: calls of these names are left out, as decorators and as statements: they
        register something, and what they register is known by value.
    """

    def __init__(
        self,
        root: Path,
        packages: Collection[str],
        split: Collection[str] = (),
        ignored: Collection[str] = (),
    ) -> None:
        self.root = root
        self._packages = frozenset(packages)
        self._split = tuple(split)
        self._ignored = frozenset(ignored)
        self._modules: dict[str, _Module | None] = {}
        self._digests: dict[Place, str] = {}
        self._reached: dict[tuple[frozenset[Place], frozenset[str]], frozenset[Place]] = {}

    def is_split(self, module: str) -> bool:
        """Whether the definitions of a module count one by one."""
        return any(module == name or module.startswith(f"{name}.") for name in self._split)

    def place(self, module: str, name: str) -> Place:
        """The place of a definition, by the module and qualified name that it has at run time."""
        top = name.partition(".")[0]
        found = self._module(module)
        return (module, top if found and self.is_split(module) and top in found.parts else WHOLE)

    def reached(self, places: Iterable[Place], without: Collection[str] = ()) -> frozenset[Place]:
        """These places, and all that is reached from them.

        :param without: modules, and definitions as ``module:name``, that are not entered.
        """
        key = frozenset(places), frozenset(without)
        if key not in self._reached:
            self._reached[key] = frozenset(self._walk(*key))
        return self._reached[key]

    def digest(self, places: Iterable[Place], without: Collection[str] = ()) -> str:
        """Digest of all code that is reached from these places."""
        found = hashlib.sha256()
        for place in sorted(self.reached(places, without)):
            found.update(f"{place[0]} {place[1]} {self._digest_of(place)}\n".encode())
        return found.hexdigest()

    def _digest_of(self, place: Place) -> str:
        if place not in self._digests:
            part = self._part(place)
            text = "\n".join(part.texts) if part else ""
            self._digests[place] = hashlib.sha256(text.encode()).hexdigest()
        return self._digests[place]

    def lines(
        self, places: Iterable[Place], without: Collection[str] = ()
    ) -> Mapping[Path, set[int] | None]:
        """Where the code that is reached is: by file, its lines, or None for all of the file."""
        found: dict[Path, set[int] | None] = {}
        for name, part in self.reached(places, without):
            module = self._module(name)
            assert module is not None, name
            if part == WHOLE:
                found[module.path] = None
            elif found.setdefault(module.path, set()) is not None:
                lines = found[module.path]
                assert lines is not None
                lines |= module.lines.get(part, set())
        return found

    def _walk(self, places: frozenset[Place], without: frozenset[str]) -> set[Place]:
        found: set[Place] = set()
        todo = list(places)
        while todo:
            place = todo.pop()
            if place in found or not without.isdisjoint((place[0], ":".join(place))):
                continue
            part = self._part(place)
            if part is None:
                continue
            found.add(place)
            todo += part.uses
        return found

    def _part(self, place: Place) -> _Part | None:
        module = self._module(place[0])
        if module is None:
            return None
        if place[1] == WHOLE:
            return module.whole
        return module.parts[place[1]]

    def _module(self, name: str) -> _Module | None:
        """A module of the packages; None if there is none of that name."""
        if name not in self._modules:
            path = self._file(name)
            self._modules[name] = None if path is None else _Module(self, name, path)
        return self._modules[name]

    def _file(self, name: str) -> Path | None:
        steps = name.split(".")
        if steps[0] not in self._packages:
            return None
        base = self.root.joinpath(*steps)
        for path in (base / "__init__.py", base.with_suffix(".py")):
            if path.is_file():
                return path
        return None

    def target(self, module: str, name: str) -> Place | None:
        """What ``from module import name`` names; None if it is not of these packages."""
        if self._file(f"{module}.{name}") is not None:
            return (f"{module}.{name}", WHOLE)
        found = self._module(module)
        if found is None:
            return None
        if not self.is_split(module):
            return (module, WHOLE)
        return (module, name if name in found.parts else WHOLE)

    def parents(self, module: str) -> Iterator[Place]:
        """The packages that are imported before a module; split ones do not count."""
        steps = module.split(".")
        for end in range(1, len(steps)):
            parent = ".".join(steps[:end])
            if not self.is_split(parent) and self._file(parent) is not None:
                yield (parent, WHOLE)

    def text(self, path: Path) -> str:
        """A file's text."""
        return path.read_text(encoding="utf-8")

    def parse(self, path: Path) -> ast.Module:
        """A file's code, without what does not count."""
        tree = ast.parse(self.text(path), str(path))
        _Cleaner(self._ignored).visit(tree)
        return tree


class _Module:
    """One module, parsed when it is asked for."""

    def __init__(self, sources: Sources, name: str, path: Path) -> None:
        self._sources = sources
        self._name = name
        self.path = path

    @cached_property
    def _tree(self) -> ast.Module:
        return self._sources.parse(self.path)

    @cached_property
    def whole(self) -> _Part:
        """All of it, with everything that it imports."""
        uses = {place for _, place in self._imports(self._tree)}
        return _Part([ast.dump(self._tree)], uses | set(self._sources.parents(self._name)))

    @cached_property
    def lines(self) -> Mapping[str, set[int]]:
        """The lines of each part."""
        found: dict[str, set[int]] = {}
        for node in self._tree.body:
            # decorators stand above the line of a definition
            above = getattr(node, "decorator_list", ())
            begin = min([node.lineno, *(d.lineno for d in above)])
            for name in self._names_of(node):
                found.setdefault(name, set()).update(range(begin, (node.end_lineno or begin) + 1))
        return found

    @cached_property
    def parts(self) -> Mapping[str, _Part]:
        """Its definitions, by name."""
        found: dict[str, _Part] = {_LOOSE: _Part()}
        bound: dict[str, Place] = {}
        statements = [(node, self._names_of(node)) for node in self._tree.body]
        for node, names in statements:
            bound.update((name, place) for name, place in self._imports(node) if name)
            for name in names:
                found.setdefault(name, _Part())
        parents = set(self._sources.parents(self._name))
        for node, names in statements:
            if isinstance(node, ast.Import | ast.ImportFrom):
                for name in names:  # each by itself
                    found[name].texts.append(_text_of_import(node, name))
                    found[name].uses |= {bound[name]} if name in bound else set()
                continue
            uses = {place for _, place in self._imports(node)}
            uses |= _Uses(self._sources, self._name, bound, found).of(node)
            for name in names:
                part = found[name]
                part.texts.append(ast.dump(node))
                part.uses |= uses | parents | {(self._name, _LOOSE)}
        return found

    def _names_of(self, node: ast.stmt) -> Collection[str]:
        """The parts that a statement belongs to."""
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            return [node.name]
        if isinstance(node, ast.Import | ast.ImportFrom):
            return [alias.asname or alias.name.partition(".")[0] for alias in node.names]
        if isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = {
                name.id
                for target in targets
                for name in ast.walk(target)
                if isinstance(name, ast.Name) and isinstance(name.ctx, ast.Store)
            }
            if names:
                return names
        # what runs whenever the module is imported, and all that it may define
        stored = {
            name.id
            for name in ast.walk(node)
            if isinstance(name, ast.Name) and isinstance(name.ctx, ast.Store)
        }
        kinds = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
        stored |= {inner.name for inner in ast.walk(node) if isinstance(inner, kinds)}
        for inner in ast.walk(node):
            if isinstance(inner, ast.Import | ast.ImportFrom):
                stored.update(self._names_of(inner))
        return {_LOOSE, *stored}

    def _imports(self, tree: ast.AST) -> Iterator[tuple[str, Place]]:
        """Names that imports anywhere in it bind, with what they name."""
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                for alias in node.names:
                    if self._sources._file(alias.name) is not None:
                        name = alias.asname or alias.name.partition(".")[0]
                        yield name, (alias.name, WHOLE)
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{self.path}: a relative import"
                for alias in node.names:
                    target = self._sources.target(node.module or "", alias.name)
                    if target is None:
                        continue
                    yield alias.asname or alias.name, target
                    if not self._sources.is_split(node.module or ""):
                        yield "", (node.module or "", WHOLE)
            if isinstance(node, ast.Import | ast.ImportFrom):
                for alias in node.names:
                    module = node.module if isinstance(node, ast.ImportFrom) else alias.name
                    for parent in self._sources.parents(f"{module}."):
                        yield "", parent


def _text_of_import(node: ast.Import | ast.ImportFrom, name: str) -> str:
    module = node.module if isinstance(node, ast.ImportFrom) else ""
    names = [a for a in node.names if name in (a.asname, a.name.partition(".")[0])]
    return f"{module}: {' '.join(map(ast.dump, names))}"


class _Uses(ast.NodeVisitor):
    """The places that a statement names."""

    def __init__(
        self,
        sources: Sources,
        module: str,
        bound: Mapping[str, Place],
        parts: Mapping[str, _Part],
    ) -> None:
        self._sources = sources
        self._module = module
        self._bound = bound
        self._parts = parts
        self._found: set[Place] = set()

    def of(self, node: ast.AST) -> set[Place]:
        """Those that ``node`` names."""
        if not isinstance(node, ast.Import | ast.ImportFrom):
            self.visit(node)
        return self._found

    def visit_Attribute(self, node: ast.Attribute) -> None:
        """One definition of a split module, where the module is named before the dot."""
        if isinstance(node.value, ast.Name) and node.value.id in self._bound:
            module, name = self._bound[node.value.id]
            if name == WHOLE and self._sources.is_split(module):
                target = self._sources.target(module, node.attr)
                if target is not None:
                    self._found.add(target)
                    return
        self.generic_visit(node)

    def visit_Name(self, node: ast.Name) -> None:
        """A name of the top level, or a local one that is called the same."""
        if node.id in self._bound:
            self._found.add(self._bound[node.id])
        if node.id in self._parts:
            self._found.add((self._module, node.id))


class _Cleaner(ast.NodeTransformer):
    """Removes docstrings, imports for types alone, ``__all__`` and calls that are ignored."""

    def __init__(self, ignored: Collection[str]) -> None:
        self._ignored = ignored

    def visit(self, node: ast.AST) -> ast.AST:
        """Clean a node and all under it."""
        self.generic_visit(node)
        for name in ("body", "orelse"):
            statements = getattr(node, name, None)
            if isinstance(statements, list):
                kept = [kept for one in statements for kept in self._kept(one)]
                if name == "body" and not kept and not isinstance(node, ast.Module):
                    kept = [ast.Pass(lineno=0, col_offset=0)]
                setattr(node, name, kept)
        if hasattr(node, "decorator_list"):
            node.decorator_list = [d for d in node.decorator_list if not self._is_ignored(d)]
        return node

    def _kept(self, node: ast.stmt) -> list[ast.stmt]:
        if isinstance(node, ast.Expr):
            if isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
                return []
            return [] if self._is_ignored(node.value) else [node]
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name):
            return node.orelse if node.test.id == "TYPE_CHECKING" else [node]
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            return [] if node.targets[0].id == "__all__" else [node]
        return [node]

    def _is_ignored(self, node: ast.expr) -> bool:
        while isinstance(node, ast.Call):
            node = node.func
        return isinstance(node, ast.Name) and node.id in self._ignored
