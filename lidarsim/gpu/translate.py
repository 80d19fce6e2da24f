"""The processor's kernels as functions of Warp: what a thread of a GPU computes is written once.

A kernel of `lidarsim.jit` that computes with numbers and with elements of arrays is Python that
Warp reads too, but for a few words, and `translated` puts Warp's in their place. Every sum keeps
its order, so results keep their bits. What it does not know (a slice, a list, a whole number added
to a float), Warp refuses when it compiles the kernel.
"""

import ast
import inspect
import linecache
import math
from functools import cache, reduce
from typing import Any

from lidarsim.gpu.worlds import wp

__all__ = ["translated"]


@cache
def translated(kernel: Any) -> Any:
    """`kernel`, with every kernel that it calls, as a function of Warp for all types of
    arguments."""
    function, dialect = kernel.py_func, _Dialect()
    tree = dialect.visit(ast.parse(inspect.getsource(function)))
    source = ast.unparse(ast.fix_missing_locations(tree))
    file = f"<{function.__module__}.{function.__name__} in Warp>"
    # Warp, too, asks `inspect` for a function's source, which looks here
    linecache.cache[file] = len(source), None, source.splitlines(keepends=True), file
    space = {"wp": wp, "np": wp, "math": wp, "Any": Any, "__name__": function.__module__}
    for name, value in inspect.getclosurevars(function).globals.items():
        if hasattr(value, "py_func"):
            space[name] = translated(value)
        elif not inspect.ismodule(value):
            space[name] = wp.float64(value) if isinstance(value, float) else value
    found: dict[str, Any] = {}
    exec(compile(source, file, "exec"), space | dialect.floats, found)
    return wp.func(found[function.__name__])


class _Dialect(ast.NodeTransformer):
    """Rewrites one function; `floats` are the constants in it, by the names that they get."""

    def __init__(self) -> None:
        self.floats: dict[str, Any] = {}

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        node.decorator_list = []
        for argument in node.args.args:
            argument.annotation = ast.Name("Any")
        return self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> ast.AST:
        return self._float(node.value) if isinstance(node.value, float) else node

    def visit_Attribute(self, node: ast.Attribute) -> ast.AST:
        return self._float(math.inf) if node.attr == "inf" else self.generic_visit(node)

    def _float(self, value: float) -> ast.Name:
        """A name for a number: Warp takes a literal for one of single precision."""
        name = f"float_{len(self.floats)}"
        self.floats[name] = wp.float64(value)
        return ast.Name(name)

    def visit_Compare(self, node: ast.Compare) -> ast.AST:
        """a < b < c as a < b and b < c."""
        self.generic_visit(node)
        sides = [node.left, *node.comparators]
        pairs = zip(sides, node.ops, sides[1:], strict=False)
        return ast.BoolOp(ast.And(), [ast.Compare(one, [op], [two]) for one, op, two in pairs])

    def visit_Call(self, node: ast.Call) -> ast.AST:
        """min and max by pairs; whole numbers from floor and ceil; a matrix for a small array."""
        self.generic_visit(node)
        called = ast.unparse(node.func)
        if called in ("min", "max"):
            return reduce(lambda one, other: ast.Call(node.func, [one, other], []), node.args)
        if called == "float":
            return ast.Call(_code("wp.float64"), node.args, [])
        if called in ("math.floor", "math.ceil"):
            return _code(f"wp.int32({ast.unparse(node)})")
        if called == "np.empty":
            return _code(f"wp.matrix(shape={ast.unparse(node.args[0])}, dtype=wp.float64)")
        return node

    def visit_Assign(self, node: ast.Assign) -> ast.AST:
        """A vector for a tuple; a copy of what has a name, which a loop may change."""
        self.generic_visit(node)
        value, target = node.value, node.targets[0]
        if isinstance(value, ast.Tuple) and isinstance(target, ast.Name):
            node.value = _code(f"wp.vec3d{ast.unparse(value)}")
        elif isinstance(value, ast.Tuple):
            value.elts = [_copied(one) for one in value.elts]
        elif isinstance(target, ast.Name):
            node.value = _copied(value)
        return node

    def visit_For(self, node: ast.For) -> ast.AST:
        """A loop over two values as one over 0 and 1."""
        self.generic_visit(node)
        if isinstance(node.iter, ast.Tuple):
            one, other = (_row(values) for values in node.iter.elts)
            number = f"number_{node.lineno}"
            chosen = [
                f"{ast.unparse(name)} = {ast.unparse(x)} if {number} == 0 else {ast.unparse(y)}"
                for name, x, y in zip(_row(node.target), one, other, strict=True)
            ]
            node.target, node.iter = _code(number), _code("range(2)")
            node.body = [*ast.parse("\n".join(chosen)).body, *node.body]
        return node


def _row(node: ast.expr) -> list[ast.expr]:
    return node.elts if isinstance(node, ast.Tuple) else [node]


def _copied(node: ast.expr) -> ast.expr:
    if isinstance(node, ast.Constant):
        return _code(f"wp.int32({ast.unparse(node)})")
    return ast.UnaryOp(ast.UAdd(), node) if isinstance(node, ast.Name) else node


def _code(text: str) -> Any:
    """An expression; its text is all that comes of it."""
    return ast.parse(text, mode="eval").body
