"""Equations in TeX as MathML, with the spacing of TeX."""

import html
from itertools import pairwise
from xml.etree.ElementTree import Element, tostring

FUNCTIONS = ("ln", "exp", "sin", "cos", "tan", "min", "max", "det")
PRIMES = "′″‴"
#: Characters that Markdown would read as markup.
MARKUP = str.maketrans({mark: f"&#{ord(mark)};" for mark in "\\`*_[]{}|!~^$"})


def mathml(tex: str, display: str) -> str:
    """An equation for a page in Markdown. `display` is block or inline."""
    from latex2mathml.converter import convert_to_element  # the tests do without it

    equation = convert_to_element(tex.strip(), display=display)
    for element in equation.iter():
        element.text = html.unescape(element.text or "")
    return tostring(typeset(equation), encoding="unicode").translate(MARKUP)


def typeset(equation: Element) -> Element:
    """Primes next to their letter, capital Greek letters upright, space around functions, none
    around slashes and after signs."""
    for element in list(equation.iter()):
        if element.tag in ("msup", "msubsup") and "".join(element[-1].itertext()) in PRIMES:
            _set_prime(element)
        elif element.tag == "mi" and element.text and "Α" <= element.text <= "Ω":
            element.set("mathvariant", "normal")
        elif element.tag == "mo" and element.text == "/":
            element.attrib |= {"lspace": "0", "rspace": "0"}
        elif element.tag in ("math", "mrow", "mtd"):
            _space(element)
    return equation


def _set_prime(element: Element) -> None:
    """The glyph of a prime is raised already: it stands next to the letter, not in an exponent."""
    prime = Element("mo", lspace="0", rspace="0")
    prime.text = "".join(element[-1].itertext())
    base = element[:-1]
    if element.tag == "msubsup":
        base = [Element("msub")]
        base[0].extend(element[:-1])
    element[:] = [*base, prime]
    element.tag = "mrow"


def _space(row: Element) -> None:
    terms: list[Element] = []
    for left, right in pairwise([None, *row]):
        is_first = left is None or (left.tag == "mo" and left.text in ("(", "[", "{", "=", ","))
        if right.text in ("−", "+", "±", "∓") and is_first:
            right.set("form", "prefix")  # a sign, not an operation
        if left is not None and _is_function_beside(left, right):
            terms.append(Element("mspace", width=".17em"))
        terms.append(right)
    row[:] = terms


def _is_function_beside(left: Element, right: Element) -> bool:
    names = [each[0] if each.tag in ("msub", "msup") else each for each in (left, right)]
    has_space = not {left.tag, right.tag}.isdisjoint(("mo", "mspace"))
    return not has_space and any(name.text in FUNCTIONS for name in names)
