"""Common mistakes: a function's syntax tree -> the trees of the same function with one mistake.

The operators are those of mutation testing for expressions and statements (arithmetic, relational,
logical, constant, variable and statement replacement; DeMillo, Lipton and Sayward 1978, Offutt et
al. 1996), with what the literature on beginners' programs adds (off-by-one limits, an accumulator
that is not kept, an index for a value, `and` for `or`, a branch that is missing; Soloway and
Spohrer 1989) and what a course on flight and vision adds: degrees for radians, a transposed matrix,
products in the other order, a square or root left out, sine for cosine, another axis, a missing
limit.

A mistake's words name the place by what the line computes, never by its code.
"""

import ast
import copy
import pickle
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

Edit = Callable[[Any], Any]  # a node of a copy -> what replaces it; None: nothing

WORDS = {
    "sin": "sine", "cos": "cosine", "tan": "tangent", "arctan": "arc tangent",
    "atan": "arc tangent", "arctan2": "arc tangent", "atan2": "arc tangent", "arcsin": "arc sine",
    "sqrt": "square root", "abs": "absolute value", "exp": "exponential", "log": "logarithm",
    "linalg.norm": "length", "linalg.inv": "inverse", "linalg.solve": "solution of the equations",
    "mean": "mean", "sum": "sum", "median": "median", "var": "variance", "std": "spread",
    "minimum": "smaller of the two", "maximum": "larger of the two", "min": "least", "max": "most",
    "argmin": "place of the least", "argmax": "place of the most", "cumprod": "running product",
    "cumsum": "running sum", "diff": "differences", "radians": "conversion to radians",
    "degrees": "conversion to degrees", "clip": "limits", "isfinite": "test for missing values",
    "linalg.det": "determinant", "sigmoid": "sigmoid", "logsigmoid": "logarithm of the sigmoid",
    "round": "rounding", "astype": "conversion of the type", "float": "conversion to a number",
}  # fmt: skip
OTHERS = {
    "sin": ("cos", "tan"), "cos": ("sin",), "tan": ("sin", "arctan"), "arctan": ("tan", "arcsin"),
    "atan": ("tan", "asin"), "arcsin": ("arccos", "arctan"), "mean": ("sum", "median"),
    "sum": ("mean",), "median": ("mean", "min", "max"), "min": ("max",), "max": ("min",),
    "argmin": ("argmax",), "argmax": ("argmin",), "minimum": ("maximum",), "maximum": ("minimum",),
    "any": ("all",), "all": ("any",), "cumprod": ("cumsum",), "cumsum": ("cumprod",),
    "var": ("std",), "std": ("var",), "degrees": ("radians",), "radians": ("degrees",),
    "floor": ("ceil", "round"), "round": ("floor",), "zeros": ("ones",), "ones": ("zeros",),
    "hstack": ("vstack",), "exp": ("log", "square"), "log": ("exp", "log10"), "sqrt": ("square",),
    "hypot": ("add",), "column_stack": ("vstack",),
    "stack": ("concatenate",), "isnan": ("isfinite",), "isfinite": ("isnan",), "abs": ("square",),
    "sigmoid": ("tanh",), "inv": ("pinv",), "zeros_like": ("ones_like",), "full": ("zeros",),
}  # fmt: skip
UNITS = ("radians", "degrees", "deg2rad", "rad2deg")
KEEPS = {  # functions of which the first argument, or the object, may be taken as it is
    "sqrt", "abs", "exp", "log", "radians", "degrees", "sin", "cos", "tan", "clip", "maximum",
    "minimum", "where", "round", "mean", "sum", "inv", "norm", "astype", "sorted", "nan_to_num",
    "cumprod", "cumsum", "diff", "max", "min", "transpose", "ravel", "reshape", "float", "int",
    "sigmoid", "logsigmoid", "asarray", "array", "copy", "median", "arctan", "atan", "sinc",
    "isfinite", "argsort", "arcsin", "var",
}  # fmt: skip
HINTS = {
    "sign": "write the equation down once more and follow each sign, with its frame",
    "factor": "compare the factors with the equation, one by one, and their units",
    "term": "count the terms of the equation and those of your line",
    "power": "which power of each quantity does the equation have: a square, a root?",
    "trigonometry": "draw the triangle: which side is opposite, which adjacent?",
    "units": "write each quantity with its unit: degrees or radians, grams or kilograms?",
    "comparison": "try the limit itself and a value on each side by hand",
    "condition": "go through the cases one by one: which of them does your condition let in?",
    "limit": "which values may the result take? Try one far outside",
    "axis": "write the shape beside each array: which axis is summed or joined?",
    "matrix": "write the frames beside each matrix; inner names must meet",
    "index": "try the first and the last element by hand",
    "brackets": "which part of the line does each bracket hold, and each fraction line?",
    "constant": "compare every number with the text",
    "function": "say in words what the function that you call computes",
    "order": "compare the order with that in the docstring",
    "name": "go through the line and say of each quantity which one it is and where it comes from",
    "step": "say in words what each step is for: is one missing?",
    "state": "follow a small example by hand: what is kept from one round to the next?",
}
FIXES = {
    "sign": "turn that sign round",
    "factor": "put the factor right where it is named",
    "term": "put that term in",
    "power": "put the power right that is named",
    "trigonometry": "use the other function of the same angle",
    "units": "convert the unit once, where the quantity enters",
    "comparison": "turn the comparison, or let the limit itself in or out",
    "condition": "mend the condition that is named",
    "limit": "put the limit in",
    "axis": "take the other axis",
    "matrix": "transpose it, or change the order of the product",
    "index": "move the index or limit by one",
    "brackets": "put the bracket round all of it",
    "constant": "take the number of the text",
    "function": "use the function that the text names",
    "order": "exchange the two",
    "name": "take the quantity that the equation has there",
    "step": "put the step in that is named",
    "state": "keep what is named from round to round",
}


@dataclass(frozen=True)
class Mistake:
    """A function with one mistake.

    Attributes:
        name: of the mistake, unique in its function: what is wrong, and where.
        kind: a key of HINTS.
        place: which line of the computation, by what it computes.
        source: of the whole function.
    """

    name: str
    kind: str
    place: str
    source: str


def mistakes_of(function: ast.FunctionDef) -> list[Mistake]:
    """All single mistakes of a function that the operators make, without equal sources.

    Args:
        function: its definition; it is not changed.
    """
    function = _bare(function)
    nodes = list(ast.walk(function))
    stored = pickle.dumps(function)  # loading is a quicker copy
    around = _Around(function)
    found: dict[str, Mistake] = {}
    seen, names = {ast.unparse(function)}, set[str]()
    for numbers, place in _positions(nodes, around):
        for kind, what, edit in _edits(nodes[numbers[0]], around):
            source = _edited(stored, numbers, edit)
            if not source or source in seen:
                continue
            seen.add(source)
            name, count = f"{what}, in {place}", 2
            while name in names:
                name, count = f"{what} ({count}), in {place}", count + 1
            names.add(name)
            found[source] = Mistake(name, kind, place, source)
    return list(found.values())


def _positions(nodes: list[ast.AST], around: "_Around") -> Iterator[tuple[list[int], str]]:
    """Each node, then all nodes with the same expression together."""
    same: dict[str, list[int]] = {}
    for i, node in enumerate(nodes):
        yield [i], around.place(node)
        if isinstance(node, ast.expr) and not isinstance(getattr(node, "ctx", None), ast.Store):
            same.setdefault(ast.dump(node), []).append(i)
    for numbers in same.values():
        if len(numbers) > 1:
            yield numbers, "every line that has it"


def _bare(function: ast.FunctionDef) -> ast.FunctionDef:
    """A copy without docstring and annotations."""
    function = copy.deepcopy(function)
    function.returns = None
    for each in function.args.args:
        each.annotation = None
    first = function.body[0]
    if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant) and function.body[1:]:
        function.body = function.body[1:]
    return function


def _edited(stored: bytes, numbers: list[int], edit: Edit) -> str:
    """Source of the pickled function with the nodes replaced; "" where the edit does not fit."""
    tree: ast.FunctionDef = pickle.loads(stored)
    nodes = list(ast.walk(tree))
    for number in numbers:
        new = edit(nodes[number])
        if new is None or (new is not nodes[number] and not _replace(tree, nodes[number], new)):
            return ""
    return ast.unparse(ast.fix_missing_locations(tree))


def _replace(tree: ast.AST, old: ast.AST, new: ast.AST) -> bool:
    for parent in ast.walk(tree):
        for field, value in ast.iter_fields(parent):
            if value is old:
                setattr(parent, field, new)
                return True
            if isinstance(value, list):
                for i, each in enumerate(value):
                    if each is old:
                        value[i] = new
                        return True
    return False


class _Around:
    """What stands around the nodes of a function: parents, statements, local names."""

    def __init__(self, function: ast.FunctionDef) -> None:
        self.function = function
        self.parents = {
            id(child): parent
            for parent in ast.walk(function)
            for child in ast.iter_child_nodes(parent)
        }
        self.arguments = [each.arg for each in function.args.args]
        self.locals: list[str] = []
        self.groups: list[list[str]] = []
        self.numbers = list(
            dict.fromkeys(
                node.id
                for node in ast.walk(function)
                if isinstance(node, ast.Name) and node.id.isupper()
            )
        )
        for node in ast.walk(function):
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                self.locals += [node.id] if node.id not in self.locals else []
            if isinstance(node, ast.Tuple) and isinstance(node.ctx, ast.Store):
                self.groups.append([each.id for each in node.elts if isinstance(each, ast.Name)])
        self.keys = list(
            dict.fromkeys(
                node.slice.value
                for node in ast.walk(function)
                if isinstance(node, ast.Subscript)
                and isinstance(node.slice, ast.Constant)
                and isinstance(node.slice.value, str)
            )
        )

    def parent(self, node: ast.AST) -> ast.AST | None:
        return self.parents.get(id(node))

    def statement(self, node: ast.AST) -> ast.AST:
        while not isinstance(node, ast.stmt):
            above = self.parent(node)
            if above is None:
                return node
            node = above
        return node

    def place(self, node: ast.AST) -> str:
        """The line of the computation in which a node stands, by what it computes."""
        statement = self.statement(node)
        if isinstance(statement, ast.Assign):
            return f"what gives {_targets(statement.targets[0])}"
        if isinstance(statement, ast.AugAssign):
            return f"what changes {_targets(statement.target)}"
        if isinstance(statement, ast.Return):
            value, below = statement.value, node
            while (above := self.parent(below)) not in (None, value, statement):
                below = above or below
            if isinstance(value, ast.Tuple) and below in value.elts:
                return f"number {value.elts.index(below) + 1} of what is returned"
            return "what is returned"
        if isinstance(statement, ast.If):
            return f"the condition on {_about(statement.test)}"
        if isinstance(statement, ast.While):
            return "the condition of the loop"
        if isinstance(statement, ast.For):
            return f"the loop over {_targets(statement.target)}"
        if isinstance(statement, ast.FunctionDef):
            return f"the helper {statement.name}"
        return f"the step with {_about(statement)}"


def _targets(node: ast.AST) -> str:
    if isinstance(node, ast.Tuple):
        return " and ".join(map(_targets, node.elts))
    if isinstance(node, ast.Subscript):
        key = node.slice.value if isinstance(node.slice, ast.Constant) else None
        return f"{key} of {_targets(node.value)}" if isinstance(key, str) else (
            f"an element of {_targets(node.value)}"
        )  # fmt: skip
    return node.id if isinstance(node, ast.Name) else _about(node)


def _about(node: ast.AST) -> str:
    """What an expression is made of, in words: at most three names."""
    if isinstance(node, ast.Constant):
        return "an empty text" if node.value == "" else str(node.value)
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Call):
        name = _called(node)
        inner = node.args[0] if node.args else node.func
        return f"the {WORDS[name]} of {_about(inner)}" if name in WORDS else _names(node)
    return _names(node)


def _names(node: ast.AST) -> str:
    names: list[str] = []
    for each in ast.walk(node):
        word = ""
        if isinstance(each, ast.Name) and each.id not in ("np", "math", "torch"):
            word = each.id
        elif isinstance(each, ast.Constant) and isinstance(each.value, str) and each.value:
            word = each.value
        if word and word not in names:
            names.append(word)
    shown = [name for name in names if name not in ("COHORT", "lens", "K")] or names
    return ", ".join(shown[:3]) if shown else "a number"


def _called(call: ast.Call) -> str:
    """Name of what is called, without the library's: "linalg.norm", "mean"."""
    parts: list[str] = []
    node: ast.AST = call.func
    while isinstance(node, ast.Attribute):
        parts.append(node.attr)
        node = node.value
    if isinstance(node, ast.Name) and node.id not in ("np", "math", "torch"):
        if not parts:
            return node.id
        return parts[0]
    return ".".join(reversed([part for part in parts if part not in ("nn", "functional")]))


Found = Iterator[tuple[str, str, Edit]]


def _edits(node: ast.AST, around: _Around) -> Found:
    if isinstance(node, ast.BinOp):
        yield from _arithmetic(node)
        yield from _brackets(node)
        yield from _chains(node, around)
        yield from _matrix(node)
    elif isinstance(node, ast.UnaryOp):
        yield from _unary(node)
    elif isinstance(node, ast.Call):
        yield from _calls(node)
    elif isinstance(node, ast.Compare):
        yield from _comparisons(node)
    elif isinstance(node, ast.BoolOp):
        yield from _logic(node)
    elif isinstance(node, ast.Constant):
        yield from _constants(node, around)
    elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
        yield from _variables(node, around)
    elif isinstance(node, ast.Subscript) and isinstance(node.ctx, ast.Load):
        yield from _subscripts(node, around)
    elif isinstance(node, ast.Attribute) and node.attr == "T":
        yield "matrix", f"a transpose is missing of {_about(node.value)}", lambda n: n.value
    elif isinstance(node, ast.Slice):
        yield from _slices(node)
    elif isinstance(node, ast.Tuple | ast.List) and isinstance(node.ctx, ast.Load):
        yield from _rows(node)
    elif isinstance(node, ast.Tuple) and len(node.elts) in (3, 4):
        yield "order", f"the order of {_targets(node)} begins with the last", (
            lambda n: _with(n, elts=[n.elts[-1], *n.elts[:-1]])
        )  # fmt: skip
        yield "order", f"the order of {_targets(node)} begins with the second", (
            lambda n: _with(n, elts=[*n.elts[1:], n.elts[0]])
        )  # fmt: skip
        yield from _rows(node)
    elif isinstance(node, ast.Dict):
        for i in range(len(node.values) - 1):
            yield "order", f"the values of entries {i + 1} and {i + 2} are exchanged", (
                lambda n, i=i: _with(n, values=_exchanged_list(n.values, i))  # type: ignore[misc]
            )  # fmt: skip
    elif isinstance(node, ast.IfExp):
        yield "condition", f"the two cases of {_about(node.test)} are exchanged", _swap_cases
        yield "condition", f"the case of {_about(node.test)} is forgotten", lambda n: n.orelse
        yield "condition", f"the case other than {_about(node.test)} is forgotten", lambda n: n.body
    elif isinstance(node, ast.stmt) and node is not around.function:
        yield from _statements(node, around)
    yield from _negated(node, around)


def _with(node: Any, **changes: object) -> Any:
    for name, value in changes.items():
        setattr(node, name, value)
    return node


def _op(operator: type[ast.operator]) -> Edit:
    return lambda n: _with(n, op=operator())


def _number(value: float) -> Any:
    return ast.Constant(value)


def _call(name: str, *arguments: Any) -> ast.Call:
    function: ast.expr = ast.Name("np", ast.Load())
    for part in name.split("."):
        function = ast.Attribute(function, part, ast.Load())
    return ast.Call(function, list(arguments), [])


def _arithmetic(node: ast.BinOp) -> Found:
    left, right, op = _about(node.left), _about(node.right), node.op
    if isinstance(op, ast.Add | ast.Sub):
        other = ast.Sub if isinstance(op, ast.Add) else ast.Add
        yield "sign", f"the sign of {right} is wrong", _op(other)
        yield "term", f"the term with {right} is missing", lambda n: n.left
        yield (
            "term",
            f"the term with {left} is missing",
            lambda n: n.right if isinstance(n.op, ast.Add) else ast.UnaryOp(ast.USub(), n.right),
        )
        if isinstance(op, ast.Sub):
            yield (
                "sign",
                f"{left} and {right} are subtracted the other way round",
                lambda n: _with(n, left=n.right, right=n.left),
            )
            yield "term", f"only {right} is left, with its sign turned", lambda n: n.right
        yield "factor", f"{left} and {right} are multiplied, not added", _op(ast.Mult)
    elif isinstance(op, ast.Mult):
        yield "factor", f"the factor {right} is missing", lambda n: n.left
        yield "factor", f"the factor {left} is missing", lambda n: n.right
        yield "factor", f"divided by {right} instead of multiplied", _op(ast.Div)
        yield (
            "factor",
            f"{left} divides instead of multiplying",
            lambda n: ast.BinOp(n.right, ast.Div(), n.left),
        )
        yield "factor", f"{left} and {right} are added, not multiplied", _op(ast.Add)
        yield "power", f"the factor {right} is squared", _powered("right", 2)
        yield "power", f"the factor {left} is squared", _powered("left", 2)
        yield "power", f"of the factor {right} its root is taken", _powered("right", 0.5)
    elif isinstance(op, ast.Div | ast.FloorDiv):
        yield "factor", f"the division by {right} is missing", lambda n: n.left
        yield "factor", f"multiplied by {right} instead of divided", _op(ast.Mult)
        yield (
            "factor",
            f"the fraction of {left} and {right} is upside down",
            lambda n: _with(n, left=n.right, right=n.left),
        )
        yield (
            "factor",
            f"one over {right}: the factor {left} is missing",
            lambda n: _with(n, left=_number(1.0)),
        )
        yield "power", f"{right}, below the line, is squared", _powered("right", 2)
        yield "power", f"of {right}, below the line, the root is taken", _powered("right", 0.5)
        if isinstance(op, ast.Div):
            yield "function", f"the division by {right} drops what is left over", _op(ast.FloorDiv)
    elif isinstance(op, ast.Pow):
        yield "power", f"the power of {left} is missing", lambda n: n.left
        yield (
            "power",
            f"the absolute value of {left} for its square",
            lambda n: _call("abs", n.left),
        )
        yield "power", f"{left} times the power instead of to the power", _op(ast.Mult)
        yield "power", f"the power of {left} is one too high", _powered("right", 1, add=True)
        yield "power", f"of {left} the root is taken, not the power", _with_right(0.5)
        yield "sign", f"the power of {left} has the wrong sign", _negative_right
    elif isinstance(op, ast.Mod):
        yield "limit", f"{left} is not wrapped round", lambda n: n.left
    elif isinstance(op, ast.BitAnd | ast.BitOr):
        other_op: type[ast.operator] = ast.BitOr if isinstance(op, ast.BitAnd) else ast.BitAnd
        yield "condition", f"'and' and 'or' are exchanged before {right}", _op(other_op)
        yield "condition", f"the condition on {right} is missing", lambda n: n.left
        yield "condition", f"the condition on {left} is missing", lambda n: n.right


def _brackets(node: ast.BinOp) -> Found:
    """Products over sums, and fractions, as they come out without their brackets."""
    for side, other in (("left", "right"), ("right", "left")):
        inner = getattr(node, side)
        if not isinstance(inner, ast.BinOp):
            continue
        sums = isinstance(inner.op, ast.Add | ast.Sub)
        if sums and isinstance(node.op, ast.Mult | ast.MatMult | ast.Div):
            if isinstance(node.op, ast.Div) and side == "right":
                continue
            words = f"only a part of {_about(inner)} is taken times {_about(getattr(node, other))}"
            if isinstance(node.op, ast.Div):
                words = f"only a part of {_about(inner)} is divided"
            for part in ("left", "right"):
                yield "brackets", words, _opened(side, part)
        if isinstance(node.op, ast.Div) and side == "right" and isinstance(inner.op, ast.Mult):
            yield "brackets", f"{_about(inner.right)} multiplies instead of dividing", (
                lambda n: ast.BinOp(
                    ast.BinOp(n.left, ast.Div(), n.right.left), ast.Mult(), n.right.right
                )
            )  # fmt: skip
        if isinstance(node.op, ast.Pow) and side == "left":
            for part in ("left", "right"):
                yield "brackets", f"the power is taken of a part of {_about(inner)}", (
                    _opened(side, part)
                )  # fmt: skip


def _opened(side: str, part: str) -> Edit:
    """(a + b) * c as a * c + b, for a part of the bracket; matrices keep their order."""

    def edit(n: Any) -> Any:
        inner = getattr(n, side)
        new = ast.BinOp(n.left, n.op, n.right)
        setattr(new, side, getattr(inner, part))
        sides = {part: new, "right" if part == "left" else "left": None}
        rest = inner.right if part == "left" else inner.left
        left = sides["left"] or rest
        return ast.BinOp(left, inner.op, sides["right"] or rest)

    return edit


def _chains(node: ast.BinOp, around: "_Around") -> Found:
    """Two factors of a longer product left out."""
    parent = around.parent(node)
    if isinstance(parent, ast.BinOp) and isinstance(parent.op, ast.Mult | ast.Div):
        return
    factors = _factors(node)
    if not 3 <= len(factors) <= 6:
        return
    for i in range(len(factors)):
        for j in range(i + 1, len(factors)):
            words = f"the factors {_about(factors[i][0])} and {_about(factors[j][0])} are missing"
            yield "factor", words, (
                lambda n, i=i, j=j: _product(  # type: ignore[misc]
                    [f for k, f in enumerate(_factors(n)) if k not in (i, j)]
                )
            )  # fmt: skip


def _factors(node: Any) -> list[tuple[Any, bool]]:
    """Factors of a product, each with whether it divides."""
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult | ast.Div):
        divides = isinstance(node.op, ast.Div)
        return [*_factors(node.left), (node.right, divides)]
    return [(node, False)]


def _product(factors: list[tuple[Any, bool]]) -> Any:
    first, divides = factors[0]
    result = ast.BinOp(_number(1.0), ast.Div(), first) if divides else first
    for factor, below in factors[1:]:
        result = ast.BinOp(result, ast.Div() if below else ast.Mult(), factor)
    return result


def _powered(side: str, power: float, *, add: bool = False) -> Edit:
    def edit(n: Any) -> ast.AST:
        operand = getattr(n, side)
        new = ast.BinOp(operand, ast.Add() if add else ast.Pow(), _number(power))
        return _with(n, **{side: new})

    return edit


def _with_right(value: float) -> Edit:
    return lambda n: _with(n, right=_number(value))


def _negative_right(n: Any) -> ast.AST:
    return _with(n, right=ast.UnaryOp(ast.USub(), n.right))


def _matrix(node: ast.BinOp) -> Found:
    if not isinstance(node.op, ast.MatMult):
        return
    left, right = _about(node.left), _about(node.right)
    swapped: Edit = lambda n: _with(n, left=n.right, right=n.left)  # noqa: E731
    yield "matrix", f"{left} and {right} are multiplied in the other order", swapped
    for side, words in (("left", left), ("right", right)):
        yield "matrix", f"{words} is transposed", _transposed(side)
        yield "matrix", f"of {words} the inverse is taken", _through(side, "linalg.inv")
        yield "matrix", f"of {words} the two last axes are exchanged", _exchanged(side)
    yield "matrix", f"the product with {right} is missing", lambda n: n.left
    yield "matrix", f"the product with {left} is missing", lambda n: n.right
    yield "matrix", f"{left} and {right} are multiplied element by element", _op(ast.Mult)


def _transposed(side: str) -> Edit:
    return lambda n: _with(n, **{side: ast.Attribute(getattr(n, side), "T", ast.Load())})


def _exchanged(side: str) -> Edit:
    def edit(n: Any) -> ast.AST:
        return _with(n, **{side: _call("swapaxes", getattr(n, side), _number(-1), _number(-2))})

    return edit


def _through(side: str, name: str) -> Edit:
    return lambda n: _with(n, **{side: _call(name, getattr(n, side))})


def _unary(node: ast.UnaryOp) -> Found:
    inner = _about(node.operand)
    if isinstance(node.op, ast.USub):
        yield "sign", f"the minus before {inner} is missing", lambda n: n.operand
    elif isinstance(node.op, ast.Not | ast.Invert):
        yield "condition", f"the condition on {inner} is turned round", lambda n: n.operand


def _calls(node: ast.Call) -> Found:
    name = _called(node)
    last = name.split(".")[-1]
    argument = _about(node.args[0]) if node.args else _names(node.func)
    words = WORDS.get(name, WORDS.get(last, last))
    attribute = isinstance(node.func, ast.Attribute)
    for other in OTHERS.get(last, ()):
        kind = "units" if last in UNITS else "trigonometry" if last in OTHERS["cos"] else "function"
        kind = "trigonometry" if last in ("sin", "cos", "tan", "arctan", "atan", "arcsin") else kind
        if attribute:
            yield (
                kind,
                f"{WORDS.get(other, other)} for {words} of {argument}",
                lambda n, other=other: _with(n, func=_with(n.func, attr=other)),  # type: ignore[misc]
            )
        elif last in ("min", "max", "all", "any"):
            yield (
                kind,
                f"{WORDS.get(other, other)} for {words} of {argument}",
                lambda n, other=other: _with(n, func=ast.Name(other, ast.Load())),  # type: ignore[misc]
            )
    method = attribute and not _is_library(node.func)
    if last in KEEPS and not (last in ("min", "max") and len(node.args) > 1):
        kind = {"sqrt": "power", "clip": "limit", "maximum": "limit", "minimum": "limit"}.get(
            last, "units" if last in UNITS else "step"
        )
        if method:
            yield kind, f"the {words} is left out of {argument}", lambda n: n.func.value
        for i, each in enumerate(node.args[: 3 if last in ("clip", "where") else 2]):
            if isinstance(each, ast.expr) and not (method and i):
                what = f"the {words} of {argument} is left out: {_about(each)} stands for it"
                yield kind, what, lambda n, i=i: n.args[i]  # type: ignore[misc]
    if last in ("min", "max") and len(node.args) > 1:
        for i in range(len(node.args)):
            yield "limit", f"the limit by {_about(node.args[1 - i])} is missing", (
                lambda n, i=i: n.args[i]  # type: ignore[misc]
            )  # fmt: skip
        free = _unlimited(node)
        if free is not node.args[0]:
            yield "limit", f"{_about(free)} has no limits", _unlimited
    if last == "clip" and len(node.args) == 3:
        yield (
            "limit",
            f"{argument} has no lower limit",
            lambda n: _call("minimum", n.args[0], n.args[2]),
        )
        yield (
            "limit",
            f"{argument} has no upper limit",
            lambda n: _call("maximum", n.args[0], n.args[1]),
        )
    if last in ("sin", "cos", "tan"):
        yield "units", f"{argument} is converted to radians once too often", _on_first("radians")
        yield "units", f"{argument} is in degrees", _on_first("degrees")
    if last in ("arctan2", "atan2", "arctan", "atan", "arcsin"):
        yield "units", f"the angle from {argument} is in degrees", lambda n: _call("degrees", n)
    if last in ("isin", "isfinite", "isnan", "any", "all", "astype") and not isinstance(
        node, ast.BoolOp
    ):
        yield "condition", f"the test of {argument} is turned round", (
            lambda n: ast.UnaryOp(ast.Invert(), n)
        )  # fmt: skip
    inner = node.args[0] if len(node.args) == 1 else None
    if isinstance(inner, ast.Call) and inner.args:
        below = _called(inner)
        below = WORDS.get(below, below)
        yield (
            "order",
            f"the {words} is taken before the {below} of {_about(inner.args[0])}",
            _inside_out,
        )
    for i in range(len(node.args) - 1):
        first, second = _about(node.args[i]), _about(node.args[i + 1])
        yield "order", f"{first} and {second} are exchanged", _exchange_arguments(i)
    for i, keyword in enumerate(node.keywords):
        if keyword.arg in ("axis", "dim"):
            yield from _axes(i, words, argument, keyword.value)
        elif keyword.arg == "keepdims":
            yield "axis", f"the {words} of {argument} loses its axis", _without_keyword(i)
        elif keyword.arg is not None:
            yield "step", f"the {keyword.arg} of the {words} of {argument} are left out", (
                _without_keyword(i)
            )  # fmt: skip
    if last in ("norm", "hypot"):
        yield (
            "power",
            f"the length of {argument} is squared",
            lambda n: ast.BinOp(n, ast.Pow(), _number(2)),
        )
    if last == "range" and node.args:
        yield "index", f"the loop's end by {_about(node.args[-1])} is one too early", _shift(-1, -1)
        yield "index", f"the loop's end by {_about(node.args[-1])} is one too late", _shift(-1, 1)
    if last == "range" and len(node.args) == 1 and isinstance(node.args[0], ast.Constant):
        for rounds in (1, 2, 3, 5, 10):
            yield "constant", f"the loop has {rounds} rounds", (
                lambda n, rounds=rounds: _with(n, args=[_number(rounds)])  # type: ignore[misc]
            )  # fmt: skip
    if last == "range" and len(node.args) > 1:
        yield "index", "the loop begins one too late", _shift(0, 1)
        yield "index", "the loop begins at zero", lambda n: _with(n, args=[_number(0), *n.args[1:]])


def _inside_out(n: Any) -> ast.AST:
    """f(g(x, ...)) as g(f(x), ...)."""
    inner = n.args[0]
    outer = ast.Call(n.func, [inner.args[0]], n.keywords)
    return ast.Call(inner.func, [outer, *inner.args[1:]], inner.keywords)


def _unlimited(n: Any) -> ast.AST:
    """What stands inside nested limits."""
    while isinstance(n, ast.Call) and _called(n) in ("min", "max", "minimum", "maximum", "clip"):
        n = next((a for a in n.args if isinstance(a, ast.Call)), n.args[0])
    return n


def _is_library(node: ast.AST) -> bool:
    while isinstance(node, ast.Attribute):
        node = node.value
    return isinstance(node, ast.Name) and node.id in ("np", "math", "torch")


def _on_first(name: str) -> Edit:
    return lambda n: _with(n, args=[_call(name, n.args[0]), *n.args[1:]])


def _exchange_arguments(i: int) -> Edit:
    def edit(n: Any) -> ast.AST:
        args = list(n.args)
        args[i], args[i + 1] = args[i + 1], args[i]
        return _with(n, args=args)

    return edit


def _axes(i: int, words: str, argument: str, value: ast.AST) -> Found:
    if isinstance(value, ast.Tuple):
        for keep in range(len(value.elts)):
            yield "axis", f"the {words} of {argument} goes over one axis only ({keep + 1})", (
                lambda n, keep=keep: _axis(n, i, n.keywords[i].value.elts[keep])  # type: ignore[misc]
            )  # fmt: skip
    else:
        for other in (0, 1, -1, 2):
            yield "axis", f"the {words} of {argument} goes over another axis ({other})", (
                lambda n, other=other: _axis(n, i, _number(other))  # type: ignore[misc]
            )  # fmt: skip
    yield "axis", f"the {words} of {argument} goes over everything, without an axis", (
        _without_keyword(i)
    )  # fmt: skip


def _axis(n: Any, i: int, value: ast.AST) -> ast.AST:
    n.keywords[i].value = value
    return n


def _without_keyword(i: int) -> Edit:
    return lambda n: _with(n, keywords=[k for j, k in enumerate(n.keywords) if j != i])


def _shift(i: int, by: int) -> Edit:
    def edit(n: Any) -> ast.AST:
        n.args[i] = ast.BinOp(n.args[i], ast.Add(), _number(by))
        return n

    return edit


_NEXT = {
    ast.Lt: (ast.LtE, ast.Gt), ast.LtE: (ast.Lt, ast.GtE), ast.Gt: (ast.GtE, ast.Lt),
    ast.GtE: (ast.Gt, ast.LtE), ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,), ast.In: (ast.NotIn,), ast.NotIn: (ast.In,),
}  # fmt: skip


def _comparisons(node: ast.Compare) -> Found:
    sides = [node.left, *node.comparators]
    for i, op in enumerate(node.ops):
        left, right = _about(sides[i]), _about(sides[i + 1])
        for j, other in enumerate(_NEXT[type(op)]):
            words = "the limit itself" if len(_NEXT[type(op)]) == 2 and j == 0 else "the other way"
            words = f"{left} is compared with {right} " + (
                "so that equality counts on the other side" if j == 0 and words != "the other way"
                else "the other way round"
            )  # fmt: skip
            yield "comparison", words, (
                lambda n, i=i, other=other: _with(  # type: ignore[misc]
                    n, ops=[other() if j == i else o for j, o in enumerate(n.ops)]
                )
            )  # fmt: skip
    if len(node.ops) == 2:
        yield "condition", f"the upper limit of {_about(sides[1])} is missing", (
            lambda n: _with(n, ops=n.ops[:1], comparators=n.comparators[:1])
        )  # fmt: skip
        yield "condition", f"the lower limit of {_about(sides[1])} is missing", (
            lambda n: ast.Compare(n.comparators[0], n.ops[1:], n.comparators[1:])
        )  # fmt: skip


def _logic(node: ast.BoolOp) -> Found:
    other = ast.Or if isinstance(node.op, ast.And) else ast.And
    what = f"'and' and 'or' are exchanged after {_about(node.values[0])}"
    yield "condition", what, lambda n: _with(n, op=other())
    for i, each in enumerate(node.values):
        yield "condition", f"the condition on {_about(each)} is missing", _without_value(i)


def _without_value(i: int) -> Edit:
    def edit(n: Any) -> ast.AST:
        left = [v for j, v in enumerate(n.values) if j != i]
        return left[0] if len(left) == 1 else _with(n, values=left)

    return edit


def _constants(node: ast.Constant, around: _Around) -> Found:
    value, parent = node.value, around.parent(node)
    if isinstance(value, bool):
        yield "condition", f"{value} for {not value}", lambda n: ast.Constant(not value)
    elif isinstance(value, int | float) and not isinstance(parent, ast.keyword):
        inside = isinstance(parent, ast.Subscript | ast.Slice) or (
            isinstance(parent, ast.Tuple) and isinstance(around.parent(parent), ast.Subscript)
        )
        options: tuple[float, ...] = (value + 1, value - 1)
        if not inside:
            options += (2 * value, value / 2, 0 * value, 1.0, -value, 10 * value, value / 10)
            options += (0.5,) if value == 0 else ()
        for other in options:
            other = int(other) if isinstance(value, int) and other == int(other) else other
            kind = "index" if inside else "constant"
            yield kind, f"the number {value:g} is {other:g}", (
                lambda n, other=other: ast.Constant(other)  # type: ignore[misc]
            )  # fmt: skip
    elif isinstance(value, str) and value:
        for other_key in around.keys:
            yield "name", f"{other_key} stands for {value}", (
                lambda n, other_key=other_key: ast.Constant(other_key)  # type: ignore[misc]
            )  # fmt: skip
        if isinstance(parent, ast.Compare | ast.Assign | ast.Tuple):
            texts = {
                each.value
                for each in ast.walk(around.function)
                if isinstance(each, ast.Constant) and isinstance(each.value, str)
            }
            for text in sorted(texts - {value} - set(around.keys)):
                yield "name", f"{text or 'an empty text'} stands for {value}", (
                    lambda n, text=text: ast.Constant(text)  # type: ignore[misc]
                )  # fmt: skip


def _variables(node: ast.Name, around: _Around) -> Found:
    name, parent = node.id, around.parent(node)
    if name in around.numbers:
        for other in around.numbers:
            yield "name", f"{other} stands for {name}", _renamed(other)
    if name not in around.locals and name not in around.arguments:
        return
    if isinstance(parent, ast.Call) and parent.func is node:
        return
    for value, words in ((0.0, "zero"), (1.0, "one")):
        yield "step", f"{name} is taken as {words}", _taken_as(value)
    yield "step", f"the mean of {name} stands for each of it", (
        lambda n: ast.BinOp(_call("mean", n), ast.Add(), ast.BinOp(_number(0.0), ast.Mult(), n))
    )  # fmt: skip
    for other in dict.fromkeys([*around.arguments, *around.locals]):
        if other != name and other != "_":
            yield "name", f"{other} stands for {name}", _renamed(other)


def _taken_as(value: float) -> Edit:
    """Zero or one in the shape of the value."""
    return lambda n: ast.BinOp(ast.BinOp(_number(0.0), ast.Mult(), n), ast.Add(), _number(value))


def _renamed(other: str) -> Edit:
    return lambda n: ast.Name(other, ast.Load())


def _subscripts(node: ast.Subscript, around: _Around) -> Found:
    if isinstance(node.slice, ast.Constant) and isinstance(node.slice.value, str):
        return
    whole = _about(node.value)
    yield "step", f"all of {whole} is taken, not a part of it", lambda n: n.value
    if isinstance(node.slice, ast.UnaryOp):  # the last one
        yield "index", f"the first of {whole} for the last", lambda n: _with(n, slice=_number(0))
        yield "index", f"the last but one of {whole}", lambda n: _with(n, slice=_number(-2))
    elif isinstance(node.slice, ast.Name | ast.BinOp):
        yield "index", f"the element of {whole} before the right one", _moved(-1)
        yield "index", f"the element of {whole} after the right one", _moved(1)
        yield "index", f"always the last of {whole}", lambda n: _with(n, slice=_number(-1))
        yield "index", f"always the first of {whole}", lambda n: _with(n, slice=_number(0))
    elif isinstance(node.slice, ast.Tuple):
        yield "index", f"row and column of {whole} are exchanged", (
            lambda n: _with(n, slice=ast.Tuple(n.slice.elts[::-1], ast.Load()))
        )  # fmt: skip
        for i, each in enumerate(node.slice.elts):
            if isinstance(each, ast.Slice) and each.lower is None and each.upper is None:
                continue
            yield "index", f"all of axis {i} of {whole} is taken", _whole_axis(i)


def _whole_axis(i: int) -> Edit:
    def edit(n: Any) -> ast.AST:
        n.slice.elts[i] = ast.Slice()
        return n

    return edit


def _moved(by: int) -> Edit:
    return lambda n: _with(n, slice=ast.BinOp(n.slice, ast.Add(), _number(by)))


def _slices(node: ast.Slice) -> Found:
    for side, words in (("lower", "begins"), ("upper", "ends")):
        bound = getattr(node, side)
        if bound is None:
            continue
        about = _about(bound)
        for by, how in ((1, "one too late"), (-1, "one too early")):
            yield "index", f"the part by {about} {words} {how}", _bounded(side, by)
        yield "index", f"the part by {about} has no limit where it {words}", (
            lambda n, side=side: _with(n, **{side: None})  # type: ignore[misc]
        )  # fmt: skip
    if node.step is not None:
        yield "order", "the order is not turned round", lambda n: _with(n, step=None)
    elif node.lower is None and node.upper is None:
        yield "order", "the order is turned round", lambda n: _with(n, step=_number(-1))


def _bounded(side: str, by: int) -> Edit:
    return lambda n: _with(n, **{side: ast.BinOp(getattr(n, side), ast.Add(), _number(by))})


def _rows(node: ast.Tuple | ast.List) -> Found:
    count = len(node.elts)
    if count > 8 or any(isinstance(each, ast.Slice) for each in node.elts):
        return
    for i in range(count):
        for j in range(i + 1, count):
            first, second = _about(node.elts[i]), _about(node.elts[j])
            yield "order", f"{first} and {second} are exchanged (places {i + 1} and {j + 1})", (
                _exchange_elements(i, j)
            )  # fmt: skip


def _exchange_elements(i: int, j: int) -> Edit:
    def edit(n: Any) -> ast.AST:
        elts = list(n.elts)
        elts[i], elts[j] = elts[j], elts[i]
        return _with(n, elts=elts)

    return edit


def _swap_cases(n: Any) -> ast.AST:
    return _with(n, body=n.orelse, orelse=n.body)


def _negated(node: ast.AST, around: _Around) -> Found:
    """A sign before what is assigned, returned, handed over or multiplied; a condition turned."""
    parent = around.parent(node)
    if not isinstance(node, ast.expr) or isinstance(node, ast.Constant | ast.Slice | ast.Starred):
        return
    if isinstance(getattr(node, "ctx", None), ast.Store):
        return
    if isinstance(node, ast.Compare | ast.BoolOp) or _is_test(node, parent):
        yield "condition", f"the condition on {_about(node)} is turned round", (
            lambda n: ast.UnaryOp(ast.Not(), n)
        )  # fmt: skip
        if isinstance(parent, ast.If | ast.IfExp | ast.While):
            yield "condition", f"the condition on {_about(node)} always holds", (
                lambda n: ast.Constant(True)
            )  # fmt: skip
            yield "condition", f"the condition on {_about(node)} never holds", (
                lambda n: ast.Constant(False)
            )  # fmt: skip
        yield "condition", f"the condition on {_about(node)} is turned round, element by element", (
            lambda n: ast.UnaryOp(ast.Invert(), n)
        )  # fmt: skip
        return
    whole = isinstance(parent, ast.Assign | ast.Return | ast.AugAssign | ast.Call | ast.List)
    whole = whole or isinstance(parent, ast.Tuple) or (
        isinstance(parent, ast.BinOp) and isinstance(parent.op, ast.MatMult | ast.Mult)
    )  # fmt: skip
    called = isinstance(parent, ast.Call) and parent.func is node
    if whole and not called and isinstance(node, ast.BinOp | ast.Call | ast.Name | ast.Subscript):
        yield "sign", f"{_about(node)} has the opposite sign", (
            lambda n: ast.UnaryOp(ast.USub(), n)
        )  # fmt: skip
        if isinstance(parent, ast.Assign | ast.Return | ast.Tuple | ast.List):
            for factor, words in ((2.0, "twice"), (0.5, "half"), (1000.0, "1000 times")):
                yield "factor", f"{_about(node)} is {words} as large", (
                    lambda n, factor=factor: ast.BinOp(n, ast.Mult(), _number(factor))  # type: ignore[misc]
                )  # fmt: skip
            yield "power", f"of {_about(node)} the square is taken", (
                lambda n: ast.BinOp(n, ast.Pow(), _number(2))
            )  # fmt: skip
            yield "power", f"of {_about(node)} the root is taken", lambda n: _call("sqrt", n)
            yield "limit", f"{_about(node)} loses its sign", lambda n: _call("abs", n)
            yield "units", f"{_about(node)} is in degrees", lambda n: _call("degrees", n)
            yield "units", f"{_about(node)} is converted to radians", lambda n: _call("radians", n)
            yield "matrix", f"{_about(node)} is transposed", (
                lambda n: ast.Attribute(n, "T", ast.Load())
            )  # fmt: skip
            yield "step", f"{_about(node)} is taken as zero", _taken_as(0.0)
            yield "step", f"{_about(node)} is taken as one", _taken_as(1.0)


def _is_test(node: ast.AST, parent: ast.AST | None) -> bool:
    return isinstance(parent, ast.If | ast.IfExp | ast.While) and parent.test is node


def _statements(node: ast.stmt, around: _Around) -> Found:
    if isinstance(node, ast.AugAssign):
        about = _targets(node.target)
        yield "state", f"{about} is replaced in each round, not added to", _plain_assignment
        yield "sign", f"{about} changes with the wrong sign", (
            lambda n: _with(n, op=ast.Sub() if isinstance(n.op, ast.Add) else ast.Add())
        )  # fmt: skip
        yield "step", f"{about} is never changed", lambda n: ast.Pass()
    elif isinstance(node, ast.Assign):
        target = node.targets[0]
        names = {each.id for each in ast.walk(target) if isinstance(each, ast.Name)}
        used = {each.id for each in ast.walk(node.value) if isinstance(each, ast.Name)}
        if isinstance(target, ast.Subscript) or names & used or _stored_before(node, names, around):
            yield "step", f"the step that changes {_targets(target)} is missing", (
                lambda n: ast.Pass()
            )  # fmt: skip
        else:
            yield "step", (
                f"{_targets(target)} has no value where it is used: "
                "the step that gives it is missing, or comes too late"
            ), lambda n: ast.Pass()  # fmt: skip
        if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
            for i, each in enumerate(target.elts):
                if isinstance(each, ast.Name):
                    yield "step", f"{each.id} is not set anew", _without_target(i)
    elif isinstance(node, ast.If):
        yield "step", f"what the case of {_about(node.test)} needs is missing", _without_branch
        if node.orelse:
            yield "step", f"the choice by {_about(node.test)} is missing, with all its cases", (
                lambda n: ast.Pass()
            )  # fmt: skip
            yield "step", f"what is done unless {_about(node.test)} is missing", (
                lambda n: _with(n, orelse=[])
            )  # fmt: skip
            yield "condition", f"what follows 'else' of {_about(node.test)} is always done", (
                lambda n: _always(n)
            )  # fmt: skip
    elif isinstance(node, ast.Expr):
        yield "step", f"the step with {_about(node.value)} is missing", lambda n: ast.Pass()
    elif isinstance(node, ast.Break | ast.Continue):
        yield "condition", "the loop goes on where it should end", lambda n: ast.Pass()
    if isinstance(node, ast.For):
        yield "step", f"the loop over {_targets(node.target)} is missing", lambda n: ast.Pass()
        yield "state", f"the loop over {_targets(node.target)} ends after its first round", (
            lambda n: _with(n, body=[*n.body, ast.Break()])
        )  # fmt: skip
    for field in ("body", "orelse"):
        block = getattr(node, field, None)
        if isinstance(block, list):
            yield from _orders(block, field)


def _orders(block: list[ast.stmt], field: str) -> Found:
    for i in range(len(block) - 1):
        first, second = block[i], block[i + 1]
        if isinstance(first, ast.Return) or isinstance(second, ast.Return):
            continue
        yield "order", f"two steps are exchanged: {_short(first)} and {_short(second)}", (
            lambda n, i=i: _with(n, **{field: _exchanged_list(getattr(n, field), i)})  # type: ignore[misc]
        )  # fmt: skip


def _short(node: ast.stmt) -> str:
    if isinstance(node, ast.Assign):
        return _targets(node.targets[0])
    return _targets(node.target) if isinstance(node, ast.AugAssign) else _about(node)


def _exchanged_list(block: list[ast.stmt], i: int) -> list[ast.stmt]:
    return [*block[:i], block[i + 1], block[i], *block[i + 2 :]]


def _stored_before(node: ast.Assign, names: set[str], around: _Around) -> bool:
    """Whether a name has a value already where it is assigned: an argument or earlier line."""
    if names & set(around.arguments):
        return True
    return any(
        isinstance(each, ast.Name)
        and isinstance(each.ctx, ast.Store)
        and each.id in names
        and each.lineno < node.lineno
        for each in ast.walk(around.function)
    )


def _plain_assignment(n: Any) -> ast.AST:
    return ast.Assign([n.target], n.value)


def _without_target(i: int) -> Edit:
    def edit(n: Any) -> ast.AST:
        n.targets[0].elts[i] = ast.Name("_", ast.Store())
        return n

    return edit


def _without_branch(n: Any) -> ast.AST:
    return _with(n, body=[ast.Pass()])


def _always(n: Any) -> ast.AST:
    return _with(n, test=ast.Constant(False))
