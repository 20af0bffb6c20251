"""Reads configuration dataclasses from their source, without importing them.

LeRobot's import takes 10 s or more. The names of its options, their defaults and their docstrings are in its
source, and so are those of this package's own configurations.
"""

from __future__ import annotations

import ast
import importlib.util
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

_NO_FIELDS = {"object", "ABC", "HubMixin", "Protocol", "Generic", "Enum", "PluginRegistry"}
"""Bases that add no field."""
_CHOICES = {"ChoiceRegistry", "PluginRegistry"}
"""Bases of configurations of which one is chosen by `type`."""
_REGISTERED = re.compile(r"(\w+)\.register_subclass\((?:name=)?(?:'([^']+)'|([A-Z_]+))")
"""In a decorator as `ast.unparse` writes it."""


@dataclass(frozen=True)
class SourceField:
    """A field of a dataclass, as its source has it."""

    name: str
    kind: str
    """Annotation, e.g. `int | None`."""
    default: str
    """Expression; empty where there is none."""
    doc: str
    """Docstring below it, else the comment above it or behind it; as one line."""
    module: str
    """Where it is declared: what its annotation's names are looked up in."""


@dataclass(frozen=True)
class SourceClass:
    """A dataclass with the fields of its bases."""

    module: str
    name: str
    fields: Mapping[str, SourceField] = field(default_factory=dict)
    complete: bool = True
    """Whether the source of every base was found."""
    choice: bool = False
    """One of several that are chosen by `type`, each with fields of its own."""


def read_class(module: str, name: str) -> SourceClass | None:
    """Returns a class, with the fields of its bases; None where its source is not found.

    Args:
        module: dotted name.
        name: of the class, in that module or imported there.
    """
    found = _find(module, name)
    if found is None:
        return None
    module, node = found
    fields: dict[str, SourceField] = {}
    complete, choice = True, False
    for base in reversed(node.bases):
        text = ast.unparse(base).partition("[")[0].rpartition(".")[2]
        choice = choice or text in _CHOICES
        if text in _NO_FIELDS | _CHOICES:
            continue
        inherited = read_class(module, text)
        if inherited is None:
            complete = False
            continue
        complete, choice = complete and inherited.complete, choice or inherited.choice
        fields |= inherited.fields
    return SourceClass(module, node.name, fields | _own_fields(module, node), complete, choice)


def nested_class(one: SourceField) -> SourceClass | None:
    """Returns the dataclass that is a field's type; None where it is something else."""
    name = re.sub(r"\s*\|\s*None$", "", one.kind)
    if not re.fullmatch(r"[\w.]+", name) or name.rpartition(".")[2] == "Path":
        return None
    return read_class(one.module, name.rpartition(".")[2])


@cache
def registered_classes(package: str, registry: str) -> Mapping[str, tuple[str, str]]:
    """Returns the choices that a package's files `configuration_*.py` register: (module, class) by name.

    Args:
        package: dotted name.
        registry: class that they are registered with.
    """
    file = source_file(package)
    found: dict[str, tuple[str, str]] = {}
    for path in sorted(file.parent.glob("**/configuration_*.py")) if file is not None else ():
        if f"{registry}.register_subclass(" in path.read_text(encoding="utf-8"):
            parts = path.relative_to(file.parent).with_suffix("").parts if file is not None else ()
            module = ".".join((package, *parts))
            found |= {name: (module, cls) for name, cls in registrations(module, registry).items()}
    return found


def registrations(module: str, registry: str) -> dict[str, str]:
    """Returns the classes that a module registers, by the name that they are chosen by.

    Args:
        module: dotted name.
        registry: class that they are registered with.
    """
    source, found = _source(module), {}
    for node in source.classes.values() if source is not None else ():
        for decorator in node.decorator_list:
            match = _REGISTERED.fullmatch(ast.unparse(decorator).rstrip(")"))
            if match is not None and match[1] == registry:
                name = match[2] or _constant(module, match[3])
                if name:
                    found[name] = node.name
    return found


def _constant(module: str, name: str) -> str:
    """Returns the text that a module's name stands for; empty where it is none."""
    source = _source(module)
    if source is None:
        return ""
    for node in source.tree.body:
        if isinstance(node, ast.Assign) and any(ast.unparse(t) == name for t in node.targets):
            return str(node.value.value) if isinstance(node.value, ast.Constant) else ""
    if name in source.imports:
        return _constant(*source.imports[name])
    return ""


@dataclass(frozen=True)
class _Source:
    tree: ast.Module
    lines: list[str]
    classes: Mapping[str, ast.ClassDef]
    imports: Mapping[str, tuple[str, str]]
    """By name in the module: module and name there."""


@cache
def _source(module: str) -> _Source | None:
    file = source_file(module)
    if file is None:
        return None
    text = file.read_text(encoding="utf-8")
    tree = ast.parse(text)
    nodes = list(ast.walk(tree))
    classes = {node.name: node for node in nodes if isinstance(node, ast.ClassDef)}
    package = module if file.name == "__init__.py" else module.rpartition(".")[0]
    imports = {}
    for node in nodes:
        if isinstance(node, ast.ImportFrom):
            parts = package.split(".")
            head = ".".join(parts[: len(parts) - node.level + 1]) if node.level else ""
            origin = ".".join(part for part in (head, node.module) if part)
            imports |= {one.asname or one.name: (origin, one.name) for one in node.names}
    return _Source(tree, text.splitlines(), classes, imports)


def source_file(module: str) -> Path | None:
    """Returns a module's source file; None where there is none. Imports nothing."""
    top, *rest = module.split(".")
    try:
        spec = importlib.util.find_spec(top)
    except (ImportError, ValueError):
        return None
    if spec is None or spec.origin is None:
        return None
    if not spec.submodule_search_locations:
        return None if rest else Path(spec.origin)
    for folder in spec.submodule_search_locations:
        path = Path(folder).joinpath(*rest)
        for file in (path / "__init__.py", path.with_suffix(".py")):
            if file.is_file():
                return file
    return None


def _find(module: str, name: str, depth: int = 0) -> tuple[str, ast.ClassDef] | None:
    """Finds a class's own module, through the imports of others."""
    source = _source(module)
    if source is None or depth > 8:
        return None
    if name in source.classes:
        return module, source.classes[name]
    if name not in source.imports:
        return None
    return _find(*source.imports[name], depth + 1)


def _own_fields(module: str, node: ast.ClassDef) -> dict[str, SourceField]:
    source = _source(module)
    assert source is not None
    found = {}
    for statement, after in zip(node.body, [*node.body[1:], None], strict=True):
        if not isinstance(statement, ast.AnnAssign) or not isinstance(statement.target, ast.Name):
            continue
        kind = ast.unparse(statement.annotation)
        if kind.startswith(("ClassVar", "typing.ClassVar")):
            continue
        doc = _docstring(after) or _comment(source.lines, statement)
        default = "" if statement.value is None else ast.unparse(statement.value)
        name = statement.target.id
        found[name] = SourceField(name, kind, default, doc, module)
    return found


def _docstring(node: ast.stmt | None) -> str:
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return " ".join(str(node.value.value).split("\n\n")[0].split())
    return ""


def _comment(lines: list[str], node: ast.AnnAssign) -> str:
    """The comment above a statement, or the one behind it."""
    above = []
    number = node.lineno - 2
    while number >= 0 and lines[number].strip().startswith("#"):
        above.append(lines[number].strip().lstrip("#").strip())
        number -= 1
    _, mark, behind = lines[(node.end_lineno or node.lineno) - 1].partition("  # ")
    words = " ".join(reversed(above)) or (behind if mark else "")
    return "" if words.startswith(("type:", "noqa", "TODO")) else " ".join(words.split())
