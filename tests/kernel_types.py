"""Looks into compiled kernels: which variables did numba type as float64, and who calls whom?"""

from __future__ import annotations

import ast
import importlib
import pkgutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from numba import njit, types
from numba.core import ir
from numba.core.dispatcher import Dispatcher

PACKAGES = ("gaussians", "lod_cloud", "arch", "rtl_ref", "nebula")


# ---------------------------------------------------------------- types


def float64_variables(kernel: Any) -> dict[str, str]:
    """Variables of a kernel that hold float64 in any signature it was called with: name -> type.

    Temporaries are named after the line they stand in, for example ``line 12: x * 0.5``. The
    kernel is compiled once more without the disk cache, because a cached one carries no types.
    Functions it calls are kernels of their own, unless they are inlined. A constant that only
    stands inside ``np.float32(...)`` does not count.
    """
    assert kernel.signatures, f"{kernel.py_func.__name__} has not been called yet"
    found: dict[str, str] = {}
    for signature in kernel.signatures:
        fresh = njit(error_model="numpy")(kernel.py_func)
        fresh.compile(signature)
        compiled: Any = fresh.overloads[signature]
        annotation = compiled.type_annotation
        lines = _lines_of_temporaries(annotation.blocks)
        rounded = _rounded_constants(annotation)
        for name, kind in annotation.typemap.items():
            if name not in rounded and _holds_float64(kind):
                plain = name.removeprefix("arg.").split(".")[0]
                found[lines.get(name, plain) if name.startswith("$") else plain] = str(kind)
    return found


def _holds_float64(kind: Any) -> bool:
    """True for float64 itself and for arrays, optionals and tuples of it."""
    if isinstance(kind, types.NumberClass):  # the class, not a value
        return False
    if isinstance(kind, types.BaseTuple):
        return any(_holds_float64(item) for item in iter(kind))  # type: ignore[call-overload] # numba
    inner = getattr(kind, "dtype", None) or getattr(kind, "type", None) or kind
    return bool(inner == types.float64)


def _rounded_constants(annotation: Any) -> set[str]:
    """Constants whose every use is the argument of ``np.float32(...)``."""
    statements = [s for block in annotation.blocks.values() for s in block.body]
    assigned = [s for s in statements if isinstance(s, ir.Assign)]
    constants = {s.target.name for s in assigned if isinstance(s.value, ir.Const)}
    float32 = types.NumberClass(types.float32)
    for statement in statements:
        value: Any = getattr(statement, "value", None)
        call = isinstance(value, ir.Expr) and value.op == "call"
        if call and annotation.typemap.get(value.func.name) == float32:
            continue
        used = {v.name for v in statement.list_vars()}
        if isinstance(statement, ir.Assign):
            used -= {statement.target.name}
        constants -= used
    return constants


def _lines_of_temporaries(blocks: dict[int, Any]) -> dict[str, str]:
    lines = {}
    for block in blocks.values():
        for statement in block.body:
            if isinstance(statement, ir.Assign):
                lines[statement.target.name] = f"line {statement.loc.line}: {statement.value}"
    return lines


# ---------------------------------------------------------------- calls


def foreign_calls(root: Path, allowed: Iterable[str]) -> Iterator[str]:
    """Calls from one kernel to another that stands in a different file that is not allowed.

    numba's disk cache does not notice a change behind such a call. ``allowed`` holds paths
    relative to ``root``. Yields lines such as ``arch/a.py:12 calls gaussians.b.c``.
    """
    files = [path for package in PACKAGES for path in sorted((root / package).rglob("*.py"))]
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in files}
    kernels = {
        f"{_module(path, root)}.{function.name}"
        for path, tree in trees.items()
        if str(path.relative_to(root)) not in set(allowed)
        for function in _kernels(tree)
    }
    for path, tree in trees.items():
        names = dict(_imported_names(tree))
        for function in _kernels(tree):
            for node in ast.walk(function):
                if not isinstance(node, (ast.Name, ast.Attribute)):
                    continue
                first, *rest = ast.unparse(node).split(".")
                called = ".".join([names.get(first, first), *rest])
                if called in kernels:
                    yield f"{path.relative_to(root)}:{node.lineno} calls {called}"


def _module(path: Path, root: Path) -> str:
    parts = path.relative_to(root).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _kernels(tree: ast.Module) -> Iterator[ast.FunctionDef]:
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            decorators = (ast.unparse(d).split("(")[0].split(".")[-1] for d in node.decorator_list)
            if {"njit", "jit", "vectorize", "guvectorize"} & set(decorators):
                yield node


def _imported_names(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """(name in this file, full dotted name) of everything imported from the project."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in PACKAGES:
            for alias in node.names:
                yield alias.asname or alias.name, f"{node.module}.{alias.name}"
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if alias.asname and alias.name.split(".")[0] in PACKAGES:
                    yield alias.asname, alias.name


# ---------------------------------------------------------------- all of them


def project_kernels() -> dict[str, Any]:
    """Every kernel of the project by its full name, for example ``gaussians.sorting._order``."""
    found = {}
    for package in PACKAGES:
        root = importlib.import_module(package)
        names = [m.name for m in pkgutil.walk_packages(root.__path__, f"{package}.")]
        for name in names:
            if name.endswith("__main__"):
                continue
            for value in vars(importlib.import_module(name)).values():
                if isinstance(value, Dispatcher) and value.py_func.__module__ == name:
                    found[f"{name}.{value.py_func.__name__}"] = value
    return found


def is_inlined(kernel: Any) -> bool:
    """True for a kernel whose body becomes part of its callers, where its types are seen."""
    return bool(kernel.targetoptions.get("inline") == "always")
