"""Slopes of a traced function, and its code.

Slopes follow from the graph by reverse differentiation, as further nodes. `code_of` writes nodes as
lines of Python, which are compiled.
"""

import math
from collections import Counter
from collections.abc import Callable, Container, Mapping, Sequence
from types import ModuleType

import numpy as np

from rigidmd.compile import kernel
from rigidmd.core.user_modules import module_of
from rigidmd.features.potentials.expressions.trace import Number, Traced, choose, computed

#: Kind of a node -> its code.
_CODE = {
    "add": "({} + {})",
    "subtract": "({} - {})",
    "multiply": "({} * {})",
    "divide": "({} / {})",
    "negative": "(-{})",
    "less": "({} < {})",
    "where": "where({}, {}, {})",
}
#: Kind of a node -> its slopes by its parts: a function of the node and of the parts.
SLOPES: dict[str, Callable] = {
    "add": lambda node, x, y: (1.0, 1.0),
    "subtract": lambda node, x, y: (1.0, -1.0),
    "multiply": lambda node, x, y: (y, x),
    "divide": lambda node, x, y: (1 / y, -node / y),
    "negative": lambda node, x: (-1.0,),
    "sqrt": lambda node, x: (0.5 / node,),
    "exp": lambda node, x: (node,),
    "log": lambda node, x: (1 / x,),
    "sin": lambda node, x: (x.cos(),),
    "cos": lambda node, x: (-x.sin(),),
    "tanh": lambda node, x: (1 - node * node,),
    "acos": lambda node, x: (-1 / (1 - x * x).sqrt(),),
    "fabs": lambda node, x: (choose(x < 0.0, -1.0, 1.0),),
    "erfc": lambda node, x: (-2 / math.sqrt(math.pi) * (-x * x).exp(),),
    "power": lambda node, x, *y: (
        node.parts[1] * x ** (node.parts[1] - 1),
        *(node * x.log() for _ in y),
    ),
    "less": lambda node, x, y: (0.0, 0.0),
}


def slopes_of(output: Traced, leaves: Sequence[Traced]) -> list[Number]:
    """The slopes of a node by leaves; 0.0 by one on which it does not depend."""
    slope: dict[int, Number] = {output.index: 1.0}
    for node in reversed(in_order([output])):
        above = slope.get(node.index, 0.0)
        if not node.inner or (isinstance(above, float) and above == 0):
            continue
        if node.kind == "where":
            condition, yes, no = node.parts
            terms = [(yes, choose(condition, above, 0.0)), (no, choose(condition, 0.0, above))]
        else:
            factors = SLOPES[node.kind](node, *node.inner)
            terms = [
                (part, above * factor) for part, factor in zip(node.inner, factors, strict=True)
            ]
        for part, term in terms:
            slope[part.index] = slope.get(part.index, 0.0) + term
    return [slope.get(leaf.index, 0.0) for leaf in leaves]


def in_order(outputs: Sequence[Traced], known: Container[int] = ()) -> list[Traced]:
    """The nodes that the outputs need, each after those that it needs; not what only known nodes
    need."""
    needed: dict[int, Traced] = {}
    waiting = list(outputs)
    while waiting:
        node = waiting.pop()
        if node.index not in needed:
            needed[node.index] = node
            waiting += [] if node.index in known else node.inner
    return [needed[index] for index in sorted(needed)]


def code_of(
    outputs: Sequence[Number], known: Mapping[int, str] | None = None, *, fused: bool = False
) -> tuple[list[str], list[str]]:
    """Lines that compute the nodes, and the text of each output, a node or a number.

    known : text of the nodes that are not computed here; fused : write a product in the expression
    with the sum to which alone it is added, so that vectors have one multiply-add for both
    """
    nodes = [output for output in outputs if isinstance(output, Traced)]
    names: dict[int, str] = dict(known or {})
    lines: list[str] = []
    needed = in_order(nodes, names)
    uses = Counter(part.index for node in needed for part in node.inner)
    uses.update(node.index for node in nodes)
    terms = {
        part.index
        for node in needed
        if fused and node.kind in ("add", "subtract")
        for part in node.inner
        if part.kind == "multiply" and uses[part.index] == 1
    }
    for node in needed:
        if node.index in names:
            continue
        if node.kind == "leaf":
            names[node.index] = node.parts[0]
        elif node.kind == "constant":
            names[node.index] = repr(node.parts[0])
        elif node.index in terms:
            names[node.index] = _expression(node, names)
        else:
            names[node.index] = f"v{node.index}"
            lines.append(f"v{node.index} = {_expression(node, names)}")
    texts = [
        names[output.index] if isinstance(output, Traced) else repr(float(output))
        for output in outputs
    ]
    return lines, texts


def function_of(
    outputs: Sequence[Number],
    arguments: str,
    functions: ModuleType = math,
    known: Mapping[int, str] | None = None,
) -> Callable[..., list]:
    """The outputs as a function of Python: of numbers, or with NumPy of arrays, whose values are
    NaN or inf where they are not finite.

    arguments : names of which the leaves are expressions; known : as for `code_of`
    """
    lines, texts = code_of(outputs, known)
    body = "; ".join([*lines, f"return [{', '.join(texts)}]"])
    scope = {**vars(functions), "erfc": np.vectorize(math.erfc, otypes=[float])}
    exec(f"def values({arguments}): {body}", scope)
    return np.errstate(all="ignore")(scope["values"])


def _expression(node: Traced, names: dict[int, str]) -> str:
    parts = [names[part.index] for part in node.inner]
    exponent = node.parts[1] if node.kind == "power" else None
    if isinstance(exponent, float):
        if exponent == round(exponent) and abs(exponent) <= 64:
            whole = f"{parts[0]} ** {int(abs(exponent))}"
            # a negative power of 0 would raise ZeroDivisionError in compiled code
            return whole if exponent > 0 else f"1.0 / {whole}"
        return f"pow({parts[0]}, {exponent!r})"
    if exponent is not None:
        return f"pow({', '.join(parts)})"
    if node.kind in _CODE:
        return _CODE[node.kind].format(*parts)
    return f"{node.kind}({', '.join(parts)})"


class Hoisted:
    """What depends on parameters alone is computed once for each pair of kinds: it is read from a
    row of numbers in the loop.

    names : of the parameters, which are leaves
    """

    def __init__(self, outputs: Sequence[Number], names: Sequence[str]):
        nodes = in_order([output for output in outputs if isinstance(output, Traced)])
        fixed: set[int] = set()
        for node in nodes:
            if node.kind == "leaf":
                is_fixed = node.parts[0] in names
            else:
                is_fixed = all(part.index in fixed for part in node.inner)
            if is_fixed:
                fixed.add(node.index)
        used = [part for node in nodes if node.index not in fixed for part in node.inner]
        used += [output for output in outputs if isinstance(output, Traced)]
        read = {
            node.index: node for node in used if node.index in fixed and node.kind != "constant"
        }
        self._nodes = list(read.values())
        self.places = {node.index: k for k, node in enumerate(self._nodes)}

    def values(self, parameters: dict[str, float]) -> list[float]:
        """The numbers of a pair of kinds, from its parameters by name. Raises TraceError."""
        known: dict[int, float] = {}
        for node in in_order(self._nodes):
            if node.kind == "leaf":
                known[node.index] = parameters[node.parts[0]]
            elif node.number is not None:
                known[node.index] = node.number
            else:
                parts = [
                    known[part.index] if isinstance(part, Traced) else part for part in node.parts
                ]
                known[node.index] = computed(node.kind, parts)
        return [known[node.index] for node in self._nodes]


def formula_module(
    name: str,
    function: Callable[..., object],
    arguments: str,
    lines: Sequence[str],
    returned: str,
    *,
    inline: bool = False,
    fields: Sequence[str] = ("nothing",),
    uses_root: bool = True,
) -> ModuleType:
    """A module with a NamedTuple class `Formula`, with fields and `uses_root`, and the
    implementation of a function for it.

    arguments, lines, returned : of that function
    """
    body = "\n".join(f"    {line}" for line in lines)
    source = f"""\
# {name}, written by rigidmd
from math import acos, cos, exp, fabs, log, pow, sin, sqrt, tanh
from typing import NamedTuple

from rigidmd.compile import implements
from {__name__} import where
from {function.__module__} import {function.__name__}


class Formula(NamedTuple):
    {"; ".join(f"{field}: float = 0.0" for field in fields)}
    uses_root = {uses_root}


@implements({function.__name__}, Formula, inline={inline})
def _of_formula({arguments}):
{body}
    return {returned}
"""
    return module_of(source.encode(), f"<potential {name}>")


@kernel(inline=True, from_python=True)
def where(condition, x, y):
    """`where` in the code of formulas."""
    return x if condition else y
