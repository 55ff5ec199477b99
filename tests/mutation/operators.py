"""Small changes of a program's meaning, found in its syntax tree: what a good test suite must notice.

Left alone, because no test of behaviour could or should tell: docstrings, annotations, decorators, imports, the words
of error messages, assertions, and conversions of types (``float(x)``, ``np.asarray(x)``, ``dtype=``: for mypy);
protocols; and how notebooks show things.
"""

from __future__ import annotations

import ast
import copy
from collections.abc import Iterator
from dataclasses import dataclass

COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Pow: ast.Mult,
    ast.Mod: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}
OPPOSITES = [
    ("sin", "cos"),
    ("min", "max"),
    ("minimum", "maximum"),
    ("argmin", "argmax"),
    ("any", "all"),
    ("floor", "ceil"),
    ("zeros", "ones"),
    ("bisect_left", "bisect_right"),
]
OPPOSITE = {**dict(OPPOSITES), **{b: a for a, b in OPPOSITES}}
CONVERSIONS = {"float", "int", "bool", "str", "tuple", "list", "asarray", "array", "ascontiguousarray", "cast", "copy"}
CONVERSIONS |= {"dict", "astype", "tolist"}
UNSWAPPED = {"get", "setdefault", "pop", "getattr", "insort", "bisect_left", "bisect_right", "zip", "einsum", "isin"}
UNSWAPPED |= {"min", "max", "minimum", "maximum", "sum"}
"""Calls that crash with their arguments swapped, or do the same: such mutants would say nothing about the tests."""


@dataclass(frozen=True)
class Mutant:
    """One change: ``old`` and ``new`` are the statement (of a compound one its head) before and after it."""

    function: str
    line: int
    old: str
    new: str
    text: str
    place: int

    @property
    def source(self) -> str:
        """The whole module with the change."""
        tree = ast.parse(self.text)
        for k, (_, _, holder, field, place, new) in enumerate(_changes(tree, "<module>", None)):
            if k == self.place:
                _put(holder, field, place, new)
                return ast.unparse(ast.fix_missing_locations(tree))
        raise LookupError(self.place)


def mutants(text: str) -> list[Mutant]:
    """All changes of a module, in the order of its text."""
    out: list[Mutant] = []
    for k, (scope, statement, holder, field, place, new) in enumerate(_changes(ast.parse(text), "<module>", None)):
        old_text = _head(statement)
        kept = _put(holder, field, place, new)
        # a statement that was replaced itself shows what stands in its place
        new_text = _head(new if kept is statement else statement)
        _put(holder, field, place, kept)
        if new_text != old_text:
            out.append(Mutant(scope, getattr(kept, "lineno", statement.lineno), old_text, new_text, text, k))
    return out


def _put(holder: ast.AST, field: str, place: int | None, new: ast.AST) -> ast.AST:
    """Put a node into a field, or into a place of a list there; returns what stood there."""
    if place is None:
        kept = getattr(holder, field)
        setattr(holder, field, new)
    else:
        kept = getattr(holder, field)[place]
        getattr(holder, field)[place] = new
    return kept


Change = tuple[str, ast.stmt, ast.AST, str, int | None, ast.AST]


def _changes(node: ast.AST, scope: str, statement: ast.stmt | None) -> Iterator[Change]:
    for field, value in ast.iter_fields(node):
        if _left_alone(node, field):
            continue
        children = (
            [(None, value)] if isinstance(value, ast.AST) else list(enumerate(value)) if isinstance(value, list) else []
        )
        for place, child in children:
            if not isinstance(child, ast.AST):
                continue
            owner = child if isinstance(child, ast.stmt) else statement
            inside = scope
            if isinstance(child, ast.FunctionDef) and child.name == "_repr_html_":
                continue
            if isinstance(child, ast.ClassDef) and any(_name(b) == "Protocol" for b in child.bases):
                continue
            if isinstance(child, ast.FunctionDef | ast.ClassDef):
                inside = child.name if scope == "<module>" else f"{scope}.{child.name}"
            if owner is not None and not _is_docstring(child):
                for new in _replacements(child, node, field):
                    yield inside, owner, node, field, place, new
            yield from _changes(child, inside, owner)


def _left_alone(node: ast.AST, field: str) -> bool:
    match node:
        case ast.Import() | ast.ImportFrom() | ast.JoinedStr() | ast.Raise() | ast.Assert() | ast.alias():
            return True
        case ast.arg() | ast.AnnAssign() if field == "annotation":
            return True
        case ast.FunctionDef() if field in ("decorator_list", "returns"):
            return True
        case ast.ClassDef() if field in ("decorator_list", "bases", "keywords"):
            return True
        case ast.If(test=ast.Name(id="TYPE_CHECKING")):
            return True
        case ast.keyword(arg="dtype"):
            return True
        case ast.Call(func=ast.Attribute(attr="reshape")) if field == "args":  # any number below zero is -1
            return True
        case ast.Subscript() if field == "slice" and _name(node.value) in (
            "Literal",
            "tuple",
            "dict",
            "list",
            "NDArray",
        ):
            return True
        case ast.Assign(targets=[ast.Name(id=name)]) if name.startswith("__"):
            return True
    return False


def _is_docstring(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def _name(node: ast.expr) -> str:
    return node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""


def _with(node: ast.AST, **changed: object) -> ast.AST:
    new = copy.copy(node)
    for field, value in changed.items():
        setattr(new, field, value)
    return new


def _replacements(node: ast.AST, holder: ast.AST, field: str) -> Iterator[ast.AST]:
    """What may stand in place of ``node``, which is the ``field`` of ``holder``."""
    match node:
        case ast.Compare():
            for i, op in enumerate(node.ops):
                for other in COMPARISONS[type(op)]:
                    yield _with(node, ops=[*node.ops[:i], other(), *node.ops[i + 1 :]])
        case ast.BinOp(op=op) if type(op) in ARITHMETIC:
            yield _with(node, op=ARITHMETIC[type(op)]())
        case ast.BoolOp():
            yield _with(node, op=ast.Or() if isinstance(node.op, ast.And) else ast.And())
        case ast.UnaryOp():
            yield node.operand
        case ast.Constant(value=bool()):
            yield ast.Constant(not node.value)
        case ast.Constant(value=int(value)) if value > 9:  # a number of things: one more or less says little
            yield from (ast.Constant(v) for v in (value // 2, 2 * value))
        case ast.Constant(value=int(value)):
            yield ast.Constant(value + 1)
            if field in ("lower", "upper") or value > 1:
                yield ast.Constant(value - 1)
        case ast.Constant(value=float()):
            yield from (ast.Constant(v) for v in ((0.5 * node.value, 2.0 * node.value) if node.value else (1.0,)))
        case ast.Attribute(attr="T"):
            yield node.value
        case ast.Call():
            yield from _calls(node)
        case ast.AugAssign():
            yield _with(node, op=ARITHMETIC[type(node.op)]())
            yield ast.Pass()
        case ast.Expr(value=ast.Call()) | ast.Raise() | ast.Continue() | ast.Break() | ast.Return(value=None):
            yield ast.Pass()
        case ast.Assign(targets=[ast.Subscript() | ast.Attribute()]):
            yield ast.Pass()
        case ast.IfExp():
            yield _with(node, body=node.orelse, orelse=node.body)
    if (
        field == "test"
        and isinstance(holder, ast.If | ast.While)
        and isinstance(node, ast.Name | ast.Attribute | ast.Call)
    ):
        yield ast.UnaryOp(ast.Not(), node)
    if field in ("lower", "upper") and isinstance(node, ast.Name | ast.Attribute | ast.BinOp | ast.Call):
        yield ast.BinOp(node, ast.Add(), ast.Constant(1))


def _calls(node: ast.Call) -> Iterator[ast.AST]:
    name = _name(node.func)
    if name in ("cast", "TypeVar", "dataclass", "field"):
        return
    if name in OPPOSITE:
        other = OPPOSITE[name]
        yield _with(node, func=_with(node.func, **{"attr" if isinstance(node.func, ast.Attribute) else "id": other}))
    plain = not any(isinstance(a, ast.Starred) for a in node.args)
    alone = plain and len(node.args) == 1 and not isinstance(node.args[0], ast.GeneratorExp)
    if alone and name not in CONVERSIONS | {"len", "range"} and not name[:1].isupper():
        yield node.args[0]
    if plain and len(node.args) >= 2 and name not in UNSWAPPED:
        yield _with(node, args=[node.args[1], node.args[0], *node.args[2:]])
    for i, keyword in enumerate(node.keywords):
        if keyword.arg not in (None, "dtype", "what", "where"):
            yield _with(node, keywords=[*node.keywords[:i], *node.keywords[i + 1 :]])


def _head(statement: ast.AST) -> str:
    """A statement on one line; of a compound one what stands before the colon."""
    if hasattr(statement, "body") and isinstance(statement.body, list):
        empty = {k: [] for k in ("orelse", "handlers", "finalbody", "decorator_list") if hasattr(statement, k)}
        statement = _with(statement, body=[ast.Pass()], **empty)
        text = ast.unparse(ast.fix_missing_locations(statement)) if not isinstance(statement, ast.Try) else "try:\n"
        return text.rsplit("\n", 1)[0]
    return ast.unparse(ast.fix_missing_locations(statement))
