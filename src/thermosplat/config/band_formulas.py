"""Layers that are worked out of bands, such as vegetation indices: a name and a formula, which is data and never code.

    ndvi = (b4 - b3) / (b4 + b3)

A formula has bands b1, b2, ..., numbers, + - * /, and parentheses.
"""

import ast
import operator
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from thermosplat.config.values import shown
from thermosplat.errors import UserError

_OPERATIONS: dict[type[ast.AST], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
}
_LONGEST = 500
"""Characters of a formula: one that is deeper than Python can follow is longer."""


@dataclass(frozen=True)
class BandFormula:
    """A formula that was read."""

    name: str
    """What it gives."""
    tree: ast.expr
    """Nodes of the kinds that ``parsed`` lets through."""

    def value(self, band: Callable[[int], Any]) -> Any:
        """What it gives.

        Args:
            band: Arrays or tensors by their place, from 0 on.
        """
        return _value(self.tree, band)


def parsed(text: str, channels: int, called: str) -> BandFormula:
    """Read "name = formula".

    Raises:
        UserError: It has another form, another sign, or a band that does not exist.
    """
    name, equals, formula = (part.strip() for part in text.partition("="))
    hint = 'For example: derived: ["ndvi = (b4 - b3) / (b4 + b3)"], of bands b1, b2, ..., numbers, + - * / and ( ).'
    if not equals or not re.fullmatch("[a-z][a-z0-9_]*", name) or len(formula) > _LONGEST:
        raise UserError(f"{called} must be a name in small letters, = and a formula, found {shown(text)}.", hint)
    try:
        tree = ast.parse(formula, mode="eval").body
        wrong = next(_wrong(tree, channels), None)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        wrong = "no formula"
    if wrong is not None:
        raise UserError(f"{called}: {shown(text)} has {wrong}.", hint)
    return BandFormula(name, tree)


def _wrong(node: ast.expr, channels: int) -> Iterator[str]:
    """What of a formula is none, in words."""
    if isinstance(node, ast.BinOp) and type(node.op) in _OPERATIONS:
        yield from _wrong(node.left, channels)
        yield from _wrong(node.right, channels)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        yield from _wrong(node.operand, channels)
    elif isinstance(node, ast.Name):
        place = re.fullmatch("b([1-9][0-9]{0,5})", node.id)
        if place is None or int(place[1]) > channels:
            yield f"{shown(node.id)}, and the bands are b1 to b{channels}"
    elif not isinstance(node, ast.Constant) or type(node.value) not in (int, float):
        yield f"{shown(ast.unparse(node))}, which is no part of a formula"


def _value(node: ast.expr, band: Callable[[int], Any]) -> Any:
    if isinstance(node, ast.BinOp):
        return _OPERATIONS[type(node.op)](_value(node.left, band), _value(node.right, band))
    if isinstance(node, ast.UnaryOp):
        return -_value(node.operand, band)
    if isinstance(node, ast.Name):
        return band(int(node.id[1:]) - 1)
    assert isinstance(node, ast.Constant)  # noqa: S101  nothing else was let through
    return float(node.value)  # type: ignore[arg-type]
