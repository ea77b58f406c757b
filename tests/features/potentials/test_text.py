"""Formulas in text: code, derivative, errors; their values at the cutoff."""

import math
import random
import re
import sys
from collections import Counter
from types import SimpleNamespace

import pytest
from support.common import small_scene
from support.potentials import at_distance

from rigidmd.assemble.build import build
from rigidmd.features.potentials.expressions import slopes
from rigidmd.features.potentials.expressions.text import FormulaError
from rigidmd.features.potentials.sites.custom import CustomOneKind
from rigidmd.features.potentials.sites.formulas import formula_of_text
from rigidmd.forces.potentials.truncation import Unmodified
from rigidmd.units import KJ_PER_MOL

# --- formulas -------------------------------------------------------------------------------------


FORMULAS = {
    "A*exp(-B*r) - C/r**6": {"A": 1e5, "B": 3.5, "C": 1e3},
    "D*(1 - exp(-a*(r - r0)))**2": {"D": 2.0, "a": 1.2, "r0": 3.4},
    "eps*((sig/r)**n - (sig/r)**m)": {"eps": 1.5, "sig": 3.1, "n": 13.5, "m": 6.0},
    "k*cos(r)**2/r + log(r)*sin(2*r) + sqrt(r)": {"k": 3.0},
    "q/r*exp(-r/l)": {"q": -4.0, "l": 2.5},
}


@pytest.mark.parametrize("energy", FORMULAS)
def test_the_code_of_a_formula_has_the_energy_and_its_derivative(energy):
    given = FORMULAS[energy]
    formula = formula_of_text(energy)
    assert formula.parameters == tuple(sorted(given))
    own = formula.kind(*formula.numbers(given))
    end = (0.0, 0.0, 0.0, 0.0)
    potential, radial = CustomOneKind(20.0, Unmodified(20.0), own, (), end), formula.radial(given)
    names = {"exp": math.exp, "log": math.log, "sin": math.sin, "cos": math.cos, "sqrt": math.sqrt}
    for r in (2.1, 3.7, 8.5):
        u, w = at_distance(potential, own, end, r * r)
        assert u / KJ_PER_MOL == pytest.approx(eval(energy, names | given | {"r": r}), rel=1e-13)
        v, force, slope = radial(r)
        assert (v, force) == pytest.approx((u, w * r), rel=1e-12)
        step = 1e-5
        assert force == pytest.approx(
            (radial(r - step)[0] - radial(r + step)[0]) / (2 * step), rel=1e-7, abs=1e-3
        )
        assert slope == pytest.approx(
            (radial(r + step)[1] - radial(r - step)[1]) / (2 * step), rel=1e-7, abs=1e-3
        )


def test_constants_become_numbers_of_the_formula_and_whole_powers_products():
    formula = formula_of_text("c*eps*((sig/r)**n - (sig/r)**m)", {"n": 14.0, "m": 6.0, "c": 2.0})
    assert formula.parameters == ("eps", "sig")
    assert not formula.kind.uses_root  # even powers of r: no square root
    assert formula_of_text("A/r**7").kind.uses_root


@pytest.mark.parametrize(
    "energy, word",
    [
        ("A*exp(-B*r", "is not a formula"),
        ("A^2/r", "powers are written"),
        ("__import__('os').getcwd()*r", "not allowed in a formula"),
        ("[r for r in (1,)]", "not allowed in a formula"),
        ("r.real", "not allowed in a formula"),
        ("tan(r)", "not a function of one number"),
        ("A + B", "does not depend on the distance"),
        ("r**9**9**9", "9 ** 9 ** 9 is not a finite real number"),
        ("r/0", "divides by 0"),
        ("1e999*r", "not a real number"),
        ("((((9**200)**200)**200)**200)/r", "(9 ** 200) ** 200 is not a finite real number"),
        ("sin((1e8**200)**200)/r", "100000000.0 ** 200 is not a finite real number"),
        ("((9**200*r)**200)**200", "has numbers of more than 300 digits"),
        ("((r**200)**200)**200", "beyond 200"),
        ("sin(exp(exp(exp(9))))/r", "exp(exp(9)) is not a finite real number"),
        ("(-8)**(1/3)*r", "not a real number"),
        ("r*log(0)", "not a finite real number"),
        ("9" * 4500 + "*r", "characters"),
        ("9" * 400 + "*r", "not a finite real number"),
        ("log(" * 21 + "r" + ")" * 21, "more than 20 functions"),
        ("1/(r+" * 11 + "r" + ")" * 11, "more than 20 functions"),
        ("+".join(["r"] * 2000), "characters"),
        ("(" * 150 + "r" + ")" * 150 + "**", "not a formula"),
        ("*".join(f"(r+{k})" for k in range(100)), "more than 200"),
    ],
)
def test_a_text_that_is_not_a_formula_is_reported(energy, word):
    with pytest.raises(FormulaError, match=re.escape(word)):
        formula_of_text(energy)


@pytest.mark.parametrize(
    ("energy", "given", "r"),
    [
        ("(r - 20)**0.5", {}, 3.3),
        ("log(r - 20)", {}, 3.3),
        ("sqrt(eps)/r", {"eps": -1.0}, 3.3),
        ("eps**0.5/r", {"eps": -1.0}, 3.3),
        ("exp(r**3)", {}, 20.0),
        ("1/(r - 2)", {}, 2.0),
    ],
)
def test_an_energy_that_is_not_real_is_refused_where_it_is_requested(energy, given, r):
    with pytest.raises(FormulaError, match=f"no finite real value at r = {r:g}"):
        formula_of_text(energy).radial(given)(r)


NUMBERS = (
    "0",
    "1",
    "2",
    "0.5",
    "1/3",
    "9",
    "200",
    "199",
    "1e8",
    "1e-8",
    "1e200",
    "999999999",
    "1" * 20,
    "1e-300",
    "pi",
    "-1",
    "-7.5",
    "1e308",
    "9" * 300,
)
#: Calls of Python that reading and differentiating a text may take: two seconds or so.
MOST_CALLS = 5_000_000


def a_text(chosen: random.Random, depth: int) -> str:
    """A text that may be a formula, with numbers and nesting that hurt."""
    if depth <= 0 or chosen.random() < 0.1:
        return chosen.choice(NUMBERS if chosen.random() < 0.4 else ("r", "r", "r", "A", "sig"))
    first = a_text(chosen, depth - 1)
    match chosen.randrange(9):
        case 0 | 1 | 2:
            return f"{chosen.choice(('exp', 'log', 'sqrt', 'sin', 'cos'))}({first})"
        case 3 | 4:
            return f"({first})**({chosen.choice(NUMBERS) if chosen.random() < 0.7 else a_text(chosen, depth // 3)})"
        case 5:
            return f"1/(r + {first})"
    return f"({first}){chosen.choice('+-*/')}({a_text(chosen, chosen.choice((depth - 1, depth // 3, 1)))})"


def test_any_text_is_read_or_refused_soon(monkeypatch):
    found, calls = Counter(), 0

    def module(source, name):  # nothing is kept
        compile(source, name, "exec")
        return SimpleNamespace(Formula=tuple)

    def count(frame, event, argument):
        nonlocal calls
        calls += event == "call"
        if calls > MOST_CALLS:
            raise TimeoutError

    monkeypatch.setattr(slopes, "module_of", module)
    for seed in range(150):
        chosen = random.Random(seed)
        text, calls = a_text(chosen, chosen.choice((3, 6, 10, 14, 19))), 0
        sys.setprofile(count)
        try:
            formula = formula_of_text(text)
            for r in (0.3, 3.0, 30.0):
                values = [*formula.radial(dict.fromkeys(formula.parameters, 1.5))(r)]
                values += formula.numbers(dict.fromkeys(formula.parameters, -1.5))
                assert all(type(value) is float for value in values)
            found["read"] += 1
        except FormulaError:
            found["refused"] += 1
        finally:
            sys.setprofile(None)
    assert min(found.values()) > 15


# --- what is lost at a cutoff, and tables that state too little -------------------------------------


UMBRELLA = {"name": "umbrella", "energy": "0.5*k*(r - r0)**2", "sites": ["AR"]}


def with_potential(truncation="plain", cutoff=9.0, temperature=298.0, **potential):
    forces = {"cutoff_A": cutoff, "custom": [{"truncation": truncation} | potential]}
    stages = [{"ensemble": "nvt", "temperature_K": temperature, "duration_ps": 0.004}]
    return small_scene({"argon": 4}, 20.0, forces=forces, stages=stages)


@pytest.mark.parametrize(
    ("scene", "words"),
    [
        (
            with_potential(**UMBRELLA, parameters={"k": 8.0, "r0": 3.5}),
            "umbrella is 121 kJ/mol (49 kT at 298 K) at its cutoff",
        ),
        (
            with_potential(**UMBRELLA, parameters={"k": 8.0, "r0": 3.5}, temperature=596.0),
            "(24 kT at 596 K)",
        ),
        (
            with_potential("shift", **UMBRELLA, parameters={"k": 8.0, "r0": 3.5}),
            "its force is -44 kJ/mol/Å",
        ),
        (
            with_potential("smooth_switch", **UMBRELLA, parameters={"k": 8.0, "r0": 3.5}),
            "with truncation = smooth_switch",
        ),
        (
            with_potential(**UMBRELLA, parameters={"k": 8.0, "r0": 9.0}),
            "where it would change by 1.3e+02 kT",
        ),
        (
            with_potential(name="charge", energy="q*q*1389/r", sites=["AR"], parameters={"q": 0.4}),
            "charge is 24.7 kJ/mol",
        ),
        (
            with_potential(
                name="lj", energy="4*e*((s/r)**12 - (s/r)**6)", parameters={"e": 1.0, "s": 3.4}
            ),
            None,
        ),
        (
            with_potential(
                name="lj",
                energy="4*e*((s/r)**12 - (s/r)**6)",
                parameters={"e": 1.0, "s": 3.4},
                cutoff=5.0,
                temperature=87.0,
            ),
            "lj is -0.356 kJ/mol (-0.49 kT at 87 K)",
        ),
        (with_potential(name="wca", energy="e*(s/r)**12", parameters={"e": 1.0, "s": 3.4}), None),
    ],
)
def test_what_a_potential_has_at_its_cutoff_is_reported(scene, words):
    warnings = build(scene).warnings
    assert (warnings == []) == (words is None)
    assert words is None or words in warnings[0]
