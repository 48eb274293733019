"""Every array that a kernel, a Warp function or a struct has says its shape in a comment on its line."""

import ast
import re
from pathlib import Path

import pytest

KERNELS = Path(__file__).resolve().parents[2] / "warp_kernels"
SHAPE = re.compile(r"#.*\[[^\]]+\]")
"""A comment with a shape in brackets."""

ARRAYS = re.compile(r"\bwp\.array|_type\b|\brows_[ab]\b")
"""Annotations of arrays: Warp's own, and names of types that are made from them."""

DECORATORS = ("wp.kernel", "wp.func", "wp.struct")


def what_warp_compiles(source: str) -> list[ast.FunctionDef | ast.ClassDef]:
    """Functions and structs; functions in C, whose arrays are pointers to one element, are left out."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names = [ast.unparse(one.func if isinstance(one, ast.Call) else one) for one in node.decorator_list]
            if any(name in DECORATORS for name in names):
                found.append(node)
    return found


def without_shape(source: str) -> list[str]:
    """Names of the functions or structs and their arrays that lack the comment."""
    lines = source.splitlines()
    missing = []
    for one in what_warp_compiles(source):
        has = (
            one.args.args if isinstance(one, ast.FunctionDef) else [a for a in one.body if isinstance(a, ast.AnnAssign)]
        )
        for array in has:
            annotation = ast.unparse(array.annotation) if array.annotation is not None else ""
            if ARRAYS.search(annotation) and not SHAPE.search(lines[array.end_lineno - 1]):
                name = array.arg if isinstance(array, ast.arg) else ast.unparse(array.target)
                missing.append(f"{one.name}: {name}")
    return missing


@pytest.mark.parametrize("path", sorted(KERNELS.rglob("*.py")), ids=lambda path: str(path.relative_to(KERNELS)))
def test_arrays_have_shapes(path: Path) -> None:
    """A reader needs no other file to know what an index runs over."""
    assert without_shape(path.read_text(encoding="utf-8")) == []


def test_the_walk_finds_what_lacks_a_shape() -> None:
    """Kernels and functions, with decorators that take arguments and without."""
    source = '''
@wp.kernel(module="unique")
def with_shape(count: int, values: wp.array(dtype=float),  # [count]
    ):
    """[no] shape."""

@wp.func
def lacks_one(
    first: wp.array(dtype=float),  # [N]
    second: wp.array2d(dtype=float),  # of each pixel
): ...

@wp.struct
class Images:
    colors: wp.array2d(dtype=wp.vec3)  # [height, width]
    alphas: wp.array2d(dtype=float)

def no_kernel(values: wp.array): ...
'''
    assert [one.name for one in what_warp_compiles(source)] == ["with_shape", "lacks_one", "Images"]
    assert without_shape(source) == ["lacks_one: second", "Images: alphas"]
