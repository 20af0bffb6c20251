"""Hashes a callable policy: its source, and everything that the source refers to.

A trial of an earlier run is taken from the log only if everything that can change its result is the same. So
the hash covers source, defaults, closure, attributes of objects, weights, and the global names that a
function uses; of an installed library it covers the version. Where a part cannot be hashed (an open file, an
object of a compiled type), there is no hash, and rows are never reused.
"""

from __future__ import annotations

import enum
import functools
import hashlib
import inspect
import sys
import types
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lerobot_roborecover.policies.identity import content_hash

_PLAIN = (type(None), bool, int, float, complex, str, bytes, enum.Enum, Path, np.generic, np.dtype, type(...))
_MAX_PARTS = 20_000
"""Objects that one policy may refer to."""
_MANAGED = ("__dict__", "__weakref__")
_OBJECT_BYTES, _SLOT_BYTES = object.__basicsize__, 8


class UnhashableError(ValueError):
    """A part of the policy whose content cannot be read."""


def callable_hash(policy: Any) -> str:
    """Returns the SHA-256 of a callable with all that it refers to.

    Raises:
        UnhashableError: names the part that cannot be hashed.
    """
    walk = _Walk()
    try:
        walk.add(policy, "policy")
    except RecursionError:
        raise UnhashableError("it is nested too deeply") from None
    return walk.digest.hexdigest()


class _Walk:
    """Feeds values into one digest, each object once."""

    def __init__(self) -> None:
        self.digest = hashlib.sha256()
        self._seen: dict[int, int] = {}
        self._alive: list[Any] = []
        """Keeps every visited object alive, so that no two share an id."""

    def add(self, value: Any, where: str) -> None:
        """Adds a value; `where` names it in an error."""
        if isinstance(value, _PLAIN):
            self._say(f"{type(value).__qualname__} {value!r}")
            self._add_file(value)
            return
        if id(value) in self._seen:
            self._say(f"again {self._seen[id(value)]}")
            return
        if len(self._seen) >= _MAX_PARTS:
            raise UnhashableError(f"it refers to more than {_MAX_PARTS} objects")
        self._seen[id(value)] = len(self._seen)
        self._alive.append(value)
        self._say(type(value).__qualname__)
        self._add_object(value, where)

    def _add_object(self, value: Any, where: str) -> None:
        if isinstance(value, (np.ndarray, torch.Tensor)) or _is_array(value):
            self._add_array(value, where)
        elif isinstance(value, dict | types.MappingProxyType):
            for key, item in value.items():
                self.add(key, where)
                self.add(item, f"{where}[{key!r:.40}]")
        elif isinstance(value, list | tuple):
            self._say(str(len(value)))
            for index, item in enumerate(value):
                self.add(item, f"{where}[{index}]")
        elif isinstance(value, set | frozenset):
            if not all(isinstance(item, _PLAIN) for item in value):
                raise UnhashableError(f"{where} is a set of objects")
            self._say(" ".join(sorted(map(repr, value))))
        elif isinstance(value, types.ModuleType):
            self._add_module(value, where)
        elif isinstance(value, functools.partial):
            self.add([value.func, value.args, value.keywords], where)
        elif isinstance(value, types.MethodType):
            self.add([value.__func__, value.__self__], where)
        elif isinstance(value, staticmethod | classmethod):
            self.add(value.__func__, where)
        elif isinstance(value, property):
            self.add([value.fget, value.fset], where)
        elif isinstance(value, types.FunctionType):
            self._add_function(value, where)
        elif isinstance(value, type):
            self._add_class(value, where)
        elif isinstance(value, np.random.Generator):
            self.add(value.bit_generator.state, where)
        elif isinstance(value, types.BuiltinFunctionType | np.ufunc):
            self._say(f"{getattr(value, '__module__', '')}.{value.__name__}")
            owner = getattr(value, "__self__", None)
            if owner is not None and not isinstance(owner, types.ModuleType):
                self.add(owner, where)
        elif inspect.unwrap(value) is not value:  # jax.jit, functools.cache
            self.add(inspect.unwrap(value), where)
        else:
            self._add_instance(value, where)

    def _add_array(self, value: Any, where: str) -> None:
        if isinstance(value, torch.Tensor):
            tensor = value.detach().cpu().contiguous()
            self._say(f"{tuple(tensor.shape)} {tensor.dtype}")
            self.digest.update(memoryview(tensor.reshape(-1).view(torch.uint8).numpy()))
            return
        array = np.ascontiguousarray(value)
        if array.dtype.hasobject:
            self.add(array.tolist(), where)
            return
        self._say(f"{array.shape} {array.dtype}")
        self.digest.update(array.tobytes())

    def _add_file(self, value: Any) -> None:
        """Adds the content of a file or checkpoint that a text names by a path with a slash."""
        text = str(value) if isinstance(value, str | Path) else ""
        if "/" in text and len(text) < 4096 and "\0" not in text:
            path = Path(text).expanduser()
            if path.is_file() or (path / "config.json").is_file():
                self._say(content_hash(path))

    def _add_module(self, module: types.ModuleType, where: str, names: Collection[str] = ()) -> None:
        """Adds a module's version, or a user's module: its source, and the members that are used."""
        if library := _library(module.__name__):
            self._say(library)
            return
        file = Path(getattr(module, "__file__", None) or "")
        if not file.is_file():
            raise UnhashableError(f"{where} is the module {module.__name__}, which has no source")
        self._say(f"{module.__name__} {content_hash(file)}")
        for name in sorted(set(names) & vars(module).keys()):
            self._add_named(vars(module)[name], f"{where}.{name}", names)

    def _add_named(self, value: Any, where: str, names: Collection[str]) -> None:
        self._say(where)
        if isinstance(value, types.ModuleType):
            self._add_module(value, where, [n for n in names if n != where.rpartition(".")[2]])
        else:
            self.add(value, where)

    def _add_function(self, function: types.FunctionType, where: str) -> None:
        if library := _library(function.__module__):
            self._say(f"{library} {function.__qualname__}")
            self.add(_cells(function), where)
            return
        self._say(_source(function, where))
        self.add([function.__defaults__, function.__kwdefaults__, _cells(function)], where)
        names, texts = _names_and_texts(function.__code__)
        for text in texts:
            self._add_file(text)
        for name in sorted(names & function.__globals__.keys()):
            self._add_named(function.__globals__[name], name, names)

    def _add_class(self, cls: type, where: str) -> None:
        if library := _library(cls.__module__):
            self._say(f"{library} {cls.__qualname__}")
            return
        with suppress(OSError, TypeError):  # in a notebook only its functions have a source
            self._say(inspect.getsource(cls))
        for base in cls.__bases__:
            self.add(base, f"{where}.{base.__name__}")
        for name, item in sorted(vars(cls).items()):
            if _is_written(cls, name, item):
                self._say(name)
                self.add(item, f"{where}.{name}")

    def _add_instance(self, value: Any, where: str) -> None:
        cls = type(value)
        slots = [n for c in cls.__mro__ for n in _slots(c)]
        plain = cls.__basicsize__ == _OBJECT_BYTES + _SLOT_BYTES * len(slots)
        attributes = getattr(value, "__dict__", None)
        if not plain or (attributes is None and not slots):  # a compiled type, whose state is not seen
            raise UnhashableError(f"{where} is a {cls.__module__}.{cls.__qualname__}")
        self.add(cls, where)
        held = dict(attributes or {}) | {n: getattr(value, n) for n in slots if hasattr(value, n)}
        for name, item in held.items():
            self._say(name)
            self.add(item, f"{where}.{name}")

    def _say(self, text: str) -> None:
        self.digest.update(f"{len(text)} {text}\n".encode(errors="surrogateescape"))


def _library(module: str | None) -> str:
    """Name and version of the installed package that a module belongs to; empty for a user's own module."""
    top = (module or "").partition(".")[0]
    found = sys.modules.get(top)
    if top in sys.builtin_module_names or top in sys.stdlib_module_names - {"__main__"}:
        return f"{module} of Python {sys.version_info[:3]}"
    paths = [*getattr(found, "__path__", []), getattr(found, "__file__", None)]
    inside = any(path and _holds_installed(Path(path).parent) for path in paths[:1])
    if inside or top == "lerobot_roborecover":
        return f"{module} {getattr(found, '__version__', '')}"
    return ""


@functools.cache
def _holds_installed(folder: Path) -> bool:
    """Whether an installer wrote to a folder: `site-packages`, or the target of one."""
    return any(folder.glob("*.dist-info"))


def _source(item: Any, where: str) -> str:
    try:
        return inspect.getsource(item)
    except (OSError, TypeError):
        raise UnhashableError(f"{where} has no source") from None


def _cells(function: types.FunctionType) -> list[Any]:
    found = []
    for cell in function.__closure__ or ():
        try:
            found.append(cell.cell_contents)
        except ValueError:  # empty
            found.append(None)
    return found


def _names_and_texts(code: types.CodeType) -> tuple[set[str], list[str]]:
    """Names that a function, or one within it, looks up, as globals or attributes, and its constant texts."""
    names, texts = set(code.co_names), [c for c in code.co_consts if isinstance(c, str)]
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            inner, more = _names_and_texts(constant)
            names, texts = names | inner, texts + more
    return names, texts


def _is_written(cls: type, name: str, item: Any) -> bool:
    """Whether a member of a class comes from its source, and is looked into for what it refers to."""
    if isinstance(item, types.FunctionType):
        file = inspect.unwrap(item).__code__.co_filename
        return not (hasattr(cls, "__dataclass_fields__") and file.startswith("<"))
    hidden = name.startswith("__") or name == "_abc_impl"
    return not (hidden or isinstance(item, types.MemberDescriptorType | types.GetSetDescriptorType))


def _slots(cls: type) -> tuple[str, ...]:
    slots = cls.__dict__.get("__slots__", ())
    return tuple(n for n in ((slots,) if isinstance(slots, str) else slots) if n not in _MANAGED)


def _is_array(value: Any) -> bool:
    """JAX's and others' arrays."""
    return hasattr(value, "__array__") and hasattr(value, "shape") and hasattr(value, "dtype")
