"""The processor's kernels as functions of Warp, from one source: what a GPU computes is written
once.

A kernel of `lidarsim.jit` that computes with numbers and with elements of arrays is Python that
Warp reads too, but for a few words: `translated` puts Warp's in their place. The order of every
sum stays, so the bits do. A kernel that makes lists, slices or views, or that adds whole numbers to
floats, is refused by Warp when it compiles.
"""

import ast
import inspect
import linecache
import math
from functools import cache, reduce
from typing import Any

from lidarsim.gpu.device import wp

__all__ = ["translated"]


@cache
def translated(kernel: Any) -> Any:
    """`kernel`, and every kernel that it calls, as a function of Warp for any types of arguments.

    Warp asks for a function's source, which is given to it under a name of its own.
    """
    function = kernel.py_func
    names = inspect.getclosurevars(function).globals
    dialect = _Dialect({name: v for name, v in names.items() if isinstance(v, float)})
    tree = dialect.visit(ast.parse(inspect.getsource(function)))
    source = ast.unparse(ast.fix_missing_locations(tree))
    file = f"<{function.__module__}.{function.__name__} in Warp>"
    linecache.cache[file] = len(source), None, source.splitlines(keepends=True), file
    space = {
        name: translated(value) if hasattr(value, "py_func") else value
        for name, value in names.items()
        if not inspect.ismodule(value)
    }
    space |= {"wp": wp, "np": wp, "math": wp, "Any": Any}
    space |= dialect.floats | {"__name__": function.__module__}
    exec(compile(source, file, "exec"), space)
    return wp.func(space[function.__name__])


class _Dialect(ast.NodeTransformer):
    """Rewrites one function. Constants are visited under the name that `floats` gives them."""

    def __init__(self, constants: dict[str, float]):
        self.constants = constants
        self.floats: dict[str, Any] = {}

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        node.decorator_list = []
        for argument in node.args.args:
            argument.annotation = ast.Name("Any")
        return self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> ast.AST:
        return self._float(node.value) if isinstance(node.value, float) else node

    def visit_Name(self, node: ast.Name) -> ast.AST:
        return self._float(self.constants[node.id]) if node.id in self.constants else node

    def visit_Attribute(self, node: ast.Attribute) -> ast.AST:
        return self._float(math.inf) if node.attr == "inf" else self.generic_visit(node)

    def _float(self, value: float) -> ast.Name:
        """A number of double precision, where Warp would take a literal for one of single."""
        name = f"float_{len(self.floats)}"
        self.floats[name] = wp.float64(value)
        return ast.Name(name)

    def visit_Compare(self, node: ast.Compare) -> ast.AST:
        """a < b < c as a < b and b < c."""
        self.generic_visit(node)
        sides = [node.left, *node.comparators]
        pairs = zip(sides, node.ops, sides[1:], strict=False)
        parts = [ast.Compare(left, [op], [right]) for left, op, right in pairs]
        return parts[0] if len(parts) == 1 else ast.BoolOp(ast.And(), list[ast.expr](parts))

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
