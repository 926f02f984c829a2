"""Public functions of the physics say the shapes of their arrays, packages name their modules."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

import pmac_comp
from pmac_comp import machine, simulator
from pmac_comp.physics import compensate
from pmac_comp.workflow import capture, compensation, controller, law

PHYSICS = Path(pmac_comp.__file__).parent / "physics"
ARRAYS = re.compile(r"\b(FloatArray|BoolArray|IntArray|ComplexArray|ndarray|NDArray)\b")
# Compiled code names its arrays by their places in ``slots``; its callers are documented.
COMPILED = "kernel"


def public_functions(path: Path) -> Iterator[tuple[str, ast.FunctionDef]]:
    """Functions and methods of a file that others may call, by place and name."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        inside = node.body if isinstance(node, ast.ClassDef) else [node]
        owner = f"{node.name}." if isinstance(node, ast.ClassDef) else ""
        for function in inside:
            named = owner + getattr(function, "name", "_")
            if isinstance(function, ast.FunctionDef) and not re.search(r"(^|\.)_", named):
                yield f"{path.relative_to(PHYSICS).as_posix()} {named}", function


def has_arrays(function: ast.FunctionDef) -> bool:
    """Whether it takes or returns an array, alone or among others."""
    arguments = function.args.posonlyargs + function.args.args + function.args.kwonlyargs
    noted = [argument.annotation for argument in arguments] + [function.returns]
    return any(note is not None and ARRAYS.search(ast.unparse(note)) for note in noted)


def test_functions_with_arrays_tell_their_shapes() -> None:
    paths = [p for p in sorted(PHYSICS.rglob("*.py")) if not p.name.startswith(COMPILED)]
    found = [pair for path in paths for pair in public_functions(path)]
    with_arrays = {name: function for name, function in found if has_arrays(function)}
    assert len(with_arrays) > 150
    silent = {
        name
        for name, function in with_arrays.items()
        if not re.search(r"\bshapes?\b", ast.get_docstring(function) or "")
    }
    assert silent == set(), "say which shape the arrays have"


PACKAGES = (machine.controller, simulator, pmac_comp.workflow)
STEPS = (capture, law, compensation, controller)


@pytest.mark.parametrize("package", [*PACKAGES, *STEPS, compensate])
def test_the_map_of_a_package_holds_each_of_its_modules_once(package: ModuleType) -> None:
    rows = [line[19:].split() for line in str(package.__doc__).splitlines() if line[:4] == "    "]
    named = [name for row in rows for name in row]
    folder = Path(str(package.__file__)).parent
    modules = [p.stem for p in folder.glob("*.py")]
    modules += [p.parent.name for p in folder.glob("*/__init__.py")]
    assert sorted(named) == sorted(set(modules) - {"__init__"})
