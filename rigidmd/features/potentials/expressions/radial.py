"""Functions of one distance r, arranged for a pair loop.

A function is a sum of products c r^n f, with c independent of r: c is computed once for each pair
of kinds of sites, powers of r are products of r² and 1/r², and the derivative of a product reuses
its value. So 4 eps ((sig/r)**12 - (sig/r)**6) is as fast as the built-in Lennard-Jones.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import NamedTuple

from rigidmd.features.potentials.expressions.slopes import SLOPES, code_of, in_order
from rigidmd.features.potentials.expressions.trace import Traced


class Product(NamedTuple):
    """coefficient r^power rest."""

    coefficient: Traced  # independent of r
    power: float
    rest: Traced  # 1, or a function of r that is neither a power of it nor has one as a factor


class Radial:
    """Functions of the leaf r."""

    def __init__(self, r: Traced):
        self.r, self._one = r, r.graph.constant(1.0)
        self.depends_on_r = cache(self._depends_on_r)
        self.product, self.fall = cache(self._product), cache(self._fall)

    def _depends_on_r(self, node: Traced) -> bool:
        return node is self.r or any(map(self.depends_on_r, node.inner))

    def _product(self, node: Traced) -> Product:
        one = self._one
        if not self.depends_on_r(node):
            return Product(node, 0.0, one)
        match node.kind:
            case "leaf":
                return Product(one, 1.0, one)
            case "negative":
                c, n, f = self.product(node.parts[0])
                return Product(-c, n, f)
            case "multiply":
                (a, m, f), (b, n, g) = map(self.product, node.parts)
                return Product(a * b, m + n, f * g)
            case "divide":
                (a, m, f), (b, n, g) = map(self.product, node.parts)
                return Product(a / b, m - n, f * (one / g))
            case "power" if isinstance(k := node.parts[1], float) and k == round(k):
                c, n, f = self.product(node.parts[0])
                return Product(c**k, n * k, f**k)
            case "power":
                base, *exponent = map(self.arranged, node.inner)
                return Product(one, 0.0, base ** (exponent or node.parts[1:])[0])
        return Product(one, 0.0, node.graph.node(node.kind, *map(self.arranged, node.inner)))

    def arranged(self, node: Traced) -> Traced:
        """A node as a product."""
        return self._node(*self.product(node)) if self.depends_on_r(node) else node

    def _node(self, coefficient: Traced, power: float, rest: Traced) -> Traced:
        return coefficient * self.r**power * rest

    def sum_of_products(self, node: Traced, factor: float = 1.0) -> Traced:
        """A node times a factor, with equal products added, and factors of sums that are
        independent of r multiplied out."""
        sums: dict[tuple[float, Traced], Traced] = {}
        zero = node.graph.constant(0.0)
        for c, n, f in self._products(node, node.graph.constant(factor)):
            sums[n, f] = sums.get((n, f), zero) + c
        return sum((self._node(c, n, f) for (n, f), c in sums.items()), zero)

    def _products(self, node: Traced, factor: Traced) -> Iterator[Product]:
        if node.kind in ("add", "subtract"):
            first, second = node.parts
            yield from self._products(first, factor)
            yield from self._products(second, factor if node.kind == "add" else -factor)
            return
        c, n, f = self.product(node)
        if n == 0 and f.kind in ("add", "subtract"):
            yield from self._products(f, factor * c)
        else:
            yield Product(factor * c, n, f)

    def _fall(self, node: Traced) -> Traced | float:
        """-r times the derivative by r."""
        if not self.depends_on_r(node):
            return 0.0
        c, n, f = self.product(node)
        if f is self._one:
            return -n * node
        if f.kind == "exp" and f is not node:
            return node * (self.fall(f.parts[0]) - n)
        if f is not node:
            return self._node(c, n, self._one) * self.fall(f) - n * node
        if node.kind == "divide":  # 1 by a function
            return -node * node * self.fall(node.parts[1])
        if node.kind == "power" and not self.depends_on_r(node.inner[-1]):
            c, n, f = self.product(node.inner[0])
            if f is self._one:
                return node.parts[1] * -n * node
        factors = SLOPES[node.kind](node, *node.inner)
        return sum(x * self.fall(part) for x, part in zip(factors, node.inner, strict=True))

    def code_of(
        self, outputs: Sequence[Traced], known: Mapping[int, str]
    ) -> tuple[list[str], list[str], bool]:
        """Lines that compute the outputs from r2, inverse1 and inverse2, r², 1/r and 1/r²; the text
        of each output; whether they use r or 1/r.

        known : text of the nodes that are not computed here
        """
        names, lines = dict(known), list[str]()
        texts = {1: "r", 2: "r2"}, {1: "inverse1", 2: "inverse2"}
        uses_root = False
        for node in in_order(outputs, known):
            if node.kind == "power" and node.parts[0] is self.r:
                n = node.parts[1]
                if isinstance(n, float) and n == round(n):
                    names[node.index] = _power(int(abs(n)), texts[n < 0], lines)
                    uses_root |= n % 2 == 1
        if uses_root := uses_root or self.r in in_order(outputs, names):
            lines.insert(0, "r = r2 * inverse1")
        more, values = code_of(outputs, names, fused=True)
        return lines + more, values, uses_root


def _power(n: int, texts: dict[int, str], lines: list[str]) -> str:
    """The text of a power, from smaller ones, by lines where it needs them."""
    if n not in texts:
        half = n // 2 if n % 4 == 0 else n - 2 if n % 2 == 0 else n - 1
        first = _power(half, texts, lines)
        second = _power(n - half, texts, lines)
        texts[n] = f"{texts[1]}_{n}"
        lines.append(f"{texts[n]} = {first} * {second}")
    return texts[n]
