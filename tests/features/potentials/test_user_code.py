"""User code: forces, pair potentials and thermostats of users, from Python and from scenes; functions of
vectors."""

import functools
import linecache
import math
import random
import re
import runpy
import sys
from collections import Counter
from math import cos, exp, log, sin
from types import SimpleNamespace
from typing import NamedTuple

import numba
import numpy as np
import pytest
from scipy.integrate import quad
from support.common import ROOT, built, shaken, small_scene
from support.scenes import GOOD
from support.stops import same_after_stops

import rigidmd
from rigidmd.assemble.build import build
from rigidmd.assemble.describe import describe
from rigidmd.assemble.user_code.compiled import check_compiled_code, describe_compile_error
from rigidmd.commands.cli import main
from rigidmd.compile import kernel, simd
from rigidmd.compile.cache import CacheIndex
from rigidmd.compile.kernels import CompileError
from rigidmd.core import user_modules
from rigidmd.dynamics.noise import THERMOSTAT, Key, key_of, normals
from rigidmd.errors import SceneError, SimulationError
from rigidmd.forces.potentials import text_formulas
from rigidmd.forces.potentials.custom import CustomOneKind, energy_and_force, tail_of_pair
from rigidmd.forces.potentials.formulas import FormulaError, formula_of_function, formula_of_table
from rigidmd.forces.potentials.lennard_jones import energy_and_force as of_built_in
from rigidmd.forces.potentials.lennard_jones import lennard_jones as built_in
from rigidmd.forces.potentials.lennard_jones import tail
from rigidmd.forces.potentials.text_formulas import formula_of_text
from rigidmd.forces.potentials.truncation import TRUNCATIONS, Unmodified, truncation_terms
from rigidmd.run.checks import explain
from rigidmd.run.failed_check import FailedCheck
from rigidmd.run.force_errors import check_forces
from rigidmd.units import KJ_PER_MOL

SCRIPTS = sorted((ROOT / "systems" / "scripts").glob("*.py"))
LJ = "4*eps*((sig/r)**12 - (sig/r)**6)"
POINTS = {
    "box": {"lengths_A": 24},
    "molecules": [
        {
            "name": "dot",
            "count": 100,
            "sites": [{"name": "D", "element": "Ar", "mass_u": 40, "position_A": [0, 0, 0]}],
        }
    ],
    "start": {"temperature_K": 94},
    "stages": [{"duration_ps": 0.04, "timestep_fs": 4}],
    "output": {"log_interval_ps": 0.02},
}


def points(**sections) -> rigidmd.MolecularScene:
    return rigidmd.Scene.from_dict(POINTS | sections)


# --- functions of vectors -------------------------------------------------------------------------


@kernel(from_python=True)
def every_function(x, y, out):
    for i in range(0, len(x), simd.lanes_of(x)):
        a, b = simd.load(x, i), simd.load(y, i)
        found = (
            exp(a),
            log(a),
            math.pow(a, b),
            sin(b),
            cos(b),
            -(a**3),
            a**-2,
            math.sqrt(a) + abs(b),
        )
        for k in range(8):
            simd.store(out, k * len(x) + i, found[k])


@pytest.mark.parametrize("dtype, error", [(np.float64, 4.5e-16), (np.float32, 2e-7)])
def test_functions_of_vectors_are_right_to_the_last_digits(dtype, error):
    rng = np.random.default_rng(1)
    n = 4096
    x = (10 ** rng.uniform(-2, 1.9, n)).astype(dtype)
    y = rng.uniform(-14, 14, n).astype(dtype)
    out = np.zeros(8 * n, dtype)
    every_function(x, y, out)
    a, b = x.astype(np.longdouble), y.astype(np.longdouble)
    expected = [
        np.exp(a),
        np.log(a),
        a**b,
        np.sin(b),
        np.cos(b),
        -(a**3),
        a**-2,
        np.sqrt(a) + abs(b),
    ]
    for k, values in enumerate(expected):
        off = np.abs(out[k * n : (k + 1) * n] / values - 1)
        assert off[np.abs(values) < np.finfo(dtype).max].max() < error, k


def test_functions_of_vectors_at_the_ends_of_their_range():
    x = np.array([0.0, -1.0, np.inf, np.nan, 800.0, 1e-310, 1.0, 745.0])
    x, y = np.tile(x, 2), np.tile([2.0, 2.0, -3.0, 1.0, 200.0, 1.0, 0.0, 1e14], 2)
    out = np.zeros(8 * 16)
    every_function(x, y, out)
    with np.errstate(all="ignore"):
        assert out[:16] == pytest.approx(np.exp(x), rel=1e-15, nan_ok=True)
        assert out[16:32] == pytest.approx(np.log(x), rel=1e-15, nan_ok=True)
        powers = np.where(x < 0, np.nan, np.abs(x) ** y)  # of a negative number: no number
        assert out[32:48] == pytest.approx(powers, rel=1e-15, nan_ok=True)
    assert np.isnan(
        out[48:80].reshape(2, 16)[:, [7, 15]]
    ).all()  # a sine of 1e14 would state nothing


# --- formulas -------------------------------------------------------------------------------------

FORMULAS = {
    "A*exp(-B*r) - C/r**6": {"A": 1e5, "B": 3.5, "C": 1e3},
    "D*(1 - exp(-a*(r - r0)))**2": {"D": 2.0, "a": 1.2, "r0": 3.4},
    "eps*((sig/r)**n - (sig/r)**m)": {"eps": 1.5, "sig": 3.1, "n": 13.5, "m": 6.0},
    "k*cos(r)**2/r + log(r)*sin(2*r) + sqrt(r)": {"k": 3.0},
    "q/r*exp(-r/l)": {"q": -4.0, "l": 2.5},
}


@numba.njit(error_model="numpy")
def at_distance(potential, formula, end, r2):
    return energy_and_force(potential, formula, end, r2)


@numba.njit(error_model="numpy")
def in_numbers(potential, r2):
    return of_built_in(potential, potential.c12, potential.c6, r2)


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
        ("exp(999999999*log(9*r))", "has numbers of more than 300 digits"),
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
def test_a_text_that_is_no_formula_is_told(energy, word):
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
def test_an_energy_that_is_not_real_is_refused_where_it_is_asked_for(energy, given, r):
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

    formula_of_text(LJ)  # imports SymPy
    monkeypatch.setattr(text_formulas, "module_of", module)
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


def test_a_table_is_as_good_as_it_says():
    r = np.linspace(2.5, 10, 200)
    given = {"eps": 1.0, "sig": 3.4}
    exact = formula_of_text(LJ).radial(given)
    table = formula_of_table(r, [exact(x)[0] / KJ_PER_MOL for x in r], 9.0)
    radial, well = table.radial({"scale": 1.0}), KJ_PER_MOL
    off = max(abs(radial(x)[0] - exact(x)[0]) / well for x in np.linspace(2.9, 9, 3001))
    assert off < 3 * table.error < 1e-3
    for x in (3.0, 5.0, 8.0):
        step = 1e-5
        assert radial(x)[1] == pytest.approx(
            (radial(x - step)[0] - radial(x + step)[0]) / (2 * step), rel=1e-6
        )
    for bad, word in (
        (([1, 2], [1, 2]), "8 distances"),
        ((r, r**2), "does not repel"),
        ((r[::-1], r), "ascending"),
    ):
        with pytest.raises(FormulaError, match=word):
            formula_of_table(*bad, 9.0)
    with pytest.raises(FormulaError, match=r"ends at 10 Å, before the cutoff"):
        formula_of_table(r, 1 / r, 12.0)


class Pair(NamedTuple):
    eps: float
    sig: float


def lennard_jones(p: Pair, r, inverse):
    six = (p.sig * inverse) ** 6
    return 4 * p.eps * (six * six - six), 24 * p.eps * (2 * six * six - six) * inverse


def test_a_function_needs_to_say_what_its_parameters_are():
    def bare(p, r):
        return r, r

    def strange(p: Pair, radius):
        return radius, radius

    def alone(p: Pair, r):
        return r

    assert formula_of_function(lennard_jones).radial({"eps": 1.0, "sig": 3.0})(4.0)[
        0
    ] == pytest.approx(formula_of_text(LJ).radial({"eps": 1.0, "sig": 3.0})(4.0)[0])
    with pytest.raises(FormulaError, match="annotate p with a NamedTuple"):
        formula_of_function(bare)
    with pytest.raises(FormulaError, match="not a function of Python"):
        formula_of_function(functools.partial(lennard_jones))
    with pytest.raises(FormulaError, match="radius"):
        formula_of_function(strange)
    with pytest.raises(FormulaError, match="two numbers"):
        formula_of_function(alone).radial({"eps": 1.0, "sig": 3.0})(4.0)


@pytest.mark.parametrize("name", TRUNCATIONS)
def test_a_potential_ends_as_the_built_in_one(name):
    theirs = built_in(np.zeros(1, np.int32), np.array([3.4]), np.array([100.0]), 9.0, name, 7.5)
    formula, given = formula_of_text(LJ), {"eps": 1.0, "sig": 3.4}
    end = truncation_terms(name, theirs.truncation, formula.radial(given))
    own = CustomOneKind(9.0, theirs.truncation, formula.kind(*formula.numbers(given)), (), end)
    one = theirs.for_slots(8, np.float64)
    for r in (2.9, 7.4, 8.2, 8.99):
        expected = in_numbers(one, r * r)
        assert at_distance(own, own.formula, end, r * r) == pytest.approx(
            expected, rel=1e-11, abs=1e-11
        )


@pytest.mark.parametrize("name", TRUNCATIONS)
def test_the_tail_of_a_potential_is_that_of_the_built_in_one(name):
    theirs = built_in(np.zeros(10, np.int32), np.array([3.4]), np.array([100.0]), 9.0, name, 7.5)
    radial = formula_of_text(LJ).radial({"eps": 1.0, "sig": 3.4})
    found = tail_of_pair(
        radial, np.array(truncation_terms(name, theirs.truncation, radial)), theirs.truncation
    )
    assert 100 * np.array(found) == pytest.approx(np.array(tail(theirs)), rel=1e-8)
    with pytest.raises(ArithmeticError, match="too slowly"):
        tail_of_pair(formula_of_text("1/r**3").radial({}), np.zeros(4), theirs.truncation)


# --- pair potentials in a system ------------------------------------------------------------------------


def same_as_built_in(counts, tolerance=1e-13, potential=None, **forces):
    """A potential equals the built-in Lennard-Jones of the same models, with mixing and truncation."""
    scene = small_scene(counts, 25.0, forces={"electrostatics": "none", **forces})
    system, engine, state = built(
        counts, 25.0, spread=0.0, forces={"electrostatics": "none", **forces}
    )
    expected_load, expected = engine.evaluate(state)
    given = {
        f"{m.name}.{name}": {"eps": m.epsilon[i] / KJ_PER_MOL, "sig": m.sigma[i]}
        for m in system.species
        for i, name in enumerate(m.site_names)
        if m.epsilon[i] > 0
    }
    own = build(scene.with_user_code([(potential or rigidmd.pair_potential)(given)]))
    load, tallies = own.engine_of(
        {name: own.terms[name] for name in own.user_terms}, "double"
    ).evaluate(state)
    (tally,) = tallies.values()
    assert tally.energy == pytest.approx(expected["lennard_jones"].energy, rel=tolerance)
    assert tally.virial == pytest.approx(
        expected["lennard_jones"].virial, rel=tolerance, abs=tolerance * 1e5
    )
    for mine, theirs in zip(load, expected_load, strict=True):
        assert mine == pytest.approx(
            theirs, rel=tolerance, abs=tolerance * np.abs(theirs).max(initial=0.0)
        )


def from_text(given, **more):
    return rigidmd.pair_potential(LJ, given, **more)


@pytest.mark.soak
@pytest.mark.parametrize("truncation", TRUNCATIONS)
def test_a_potential_is_the_built_in_one_in_a_box(truncation):
    same_as_built_in({"argon": 60}, 1e-12, potential=from_text, truncation=truncation)
    same_as_built_in(
        {"argon": 40, "nitrogen": 30}, 1e-12, potential=from_text, truncation=truncation
    )


@pytest.mark.soak
def test_a_potential_from_a_function_or_a_table_is_the_built_in_one():
    def from_function(given):
        return rigidmd.pair_potential(
            lennard_jones, {key: Pair(**own) for key, own in given.items()}
        )

    def from_table(given):
        (own,) = given.values()
        r = np.linspace(2.4, 9.5, 2000)
        return rigidmd.pair_potential(
            table=(r, 4 * own["eps"] * ((own["sig"] / r) ** 12 - (own["sig"] / r) ** 6))
        )

    same_as_built_in({"argon": 40, "nitrogen": 30}, 1e-12, potential=from_function)
    same_as_built_in({"argon": 60}, 1e-6, potential=from_table)


def test_who_interacts_with_which_parameters():
    def numbers(potential, counts={"argon": 3, "krypton": 3}, **forces):  # noqa: B006
        potential = (
            build(small_scene(counts, 25.0, forces=forces).with_user_code([potential]))
            .terms["pair_potential"]
            .potential
        )
        return potential.parameters, potential.interacts

    both = {"Ar": {"k": 1.0}, "Kr": {"k": 4.0}}
    parameters, interacts = numbers(rigidmd.pair_potential("k/r**9", both))
    assert parameters[0] == pytest.approx(100 * np.array([[1.0, 2.0], [2.0, 4.0]]))
    assert interacts.all()
    parameters, _ = numbers(
        rigidmd.pair_potential("k/r**9", both, mixing={"k": "arithmetic"}, pairs={})
    )
    assert parameters[0, 0, 1] == pytest.approx(250)
    parameters, _ = numbers(
        rigidmd.pair_potential("k/r**9", both, pairs={("Kr", "Ar"): {"k": 7.0}})
    )
    assert parameters[0, 0, 1] == parameters[0, 1, 0] == pytest.approx(700)
    parameters, interacts = numbers(
        rigidmd.pair_potential("k/r**9", pairs={("argon.Ar", "Kr"): {"k": 7.0}})
    )
    assert np.array_equal(interacts, [[0, 1], [1, 0]])
    # as in [[forces.pairs]]: a name means sites of that name, and elements only if no site has it
    parameters, interacts = numbers(
        rigidmd.pair_potential("k/r**9", {"AR": {"k": 1.0}, "argon.AR": {"k": 2.0}})
    )
    assert parameters[0] == pytest.approx(200)
    assert interacts.shape == (1, 1)
    one = build(
        small_scene({"argon": 3}, 25.0).with_user_code(
            [rigidmd.pair_potential("k/r**9", {"k": 2.0})]
        )
    ).terms["pair_potential"]
    assert one.potential.interacts.shape == (1, 1)
    with pytest.raises(SceneError, match=r"have no geometric mean"):
        numbers(rigidmd.pair_potential("k/r**9", {"Ar": {"k": 1.0}, "Kr": {"k": -4.0}}))
    with pytest.raises(SceneError, match=r"no site is 'Xe'; there are AR, argon.AR"):
        numbers(rigidmd.pair_potential("k/r**9", {"Xe": {"k": 1.0}}))
    with pytest.raises(SceneError, match=r"(?s)Ar: there is no k.*Ar: l is not a parameter"):
        numbers(rigidmd.pair_potential("k/r**9", {"Ar": {"l": 1.0}}))
    with pytest.raises(SceneError, match="there is no k among its parameters"):
        numbers(rigidmd.pair_potential("k/r**9 + l/r", {"l": 1.0}))
    with pytest.raises(SceneError, match="mixing: q is not a parameter"):
        numbers(rigidmd.pair_potential("k/r**9", both, mixing={"q": "arithmetic"}))
    with pytest.raises(SceneError, match="is given twice"):
        numbers(
            rigidmd.pair_potential(
                "k/r**9", pairs={("AR", "KR"): {"k": 1.0}, ("KR", "AR"): {"k": 2.0}}
            )
        )
    with pytest.raises(SceneError, match="switch_start_A would have no effect"):
        numbers(rigidmd.pair_potential("k/r**9", both, truncation="shift", switch_start_A=7.0))
    with pytest.raises(SceneError, match=r"longer than half"):
        numbers(rigidmd.pair_potential("k/r**9", {"k": 1.0}, cutoff_A=13.0))
    with pytest.raises(SceneError, match="it has no cutoff, and the box is periodic"):
        numbers(rigidmd.pair_potential("k/r**9", {"k": 1.0}, cutoff_A=math.inf))


def test_parameters_may_come_from_the_model():
    sites = [
        {
            "name": "D",
            "element": "Ar",
            "mass_u": 40,
            "position_A": [0, 0, 0],
            "parameters": {"k": 3.0, "other": 1.0},
        }
    ]
    scene = points(
        molecules=[{"name": "dot", "count": 10, "sites": sites}],
        forces={"custom": [{"name": "wall", "energy": "k/r**9"}]},
    )
    assert build(scene).terms["wall"].potential.parameters[0, 0, 0] == pytest.approx(300)
    assert "wall: k/r**9, 10 sites, cutoff 9 Å, shift" in describe(scene)


# --- tables in files ------------------------------------------------------------------------------

ARGON = {
    "sigma": 3.405,
    "epsilon": 119.8 * 8.31446261815324e-3,
}  # of the shipped model, Å and kJ/mol


def argon_energy(r):
    """Energy (kJ/mol) and force (kJ/mol/Å) of two argon atoms."""
    six = (ARGON["sigma"] / r) ** 6
    return 4 * ARGON["epsilon"] * (six**2 - six), 24 * ARGON["epsilon"] * (2 * six**2 - six) / r


def write_argon_table(path, rows=700, first=2.6, with_forces=False):
    r = np.linspace(first, 9.2, rows)
    columns = np.column_stack([r, *argon_energy(r)][: 3 if with_forces else 2])
    head = "r_A, energy_kJ_mol, force_kJ_mol_A" if with_forces else "r_A energy_kJ_mol"
    separator = ", " if with_forces else "  "
    lines = ["# argon", "", head, *(separator.join(f"{x:.12g}" for x in row) for row in columns)]
    path.write_text("\n".join(lines) + "  # the end\n")


def tabulated(folder, count=60, edge=19.0, **entry):
    """Argon with the table argon.csv, or without an entry with the built-in potential."""
    forces = {"cutoff_A": 9.0}
    if entry:
        forces |= {
            "lennard_jones": False,
            "custom": [{"name": "argon", "table": "argon.csv"} | entry],
        }
    return small_scene(
        {"argon": count},
        edge,
        folder,
        forces=forces,
        stages=[{"duration_ps": 0.4, "timestep_fs": 4}],
        start={"temperature_K": 90.0},
        output={"trajectory": False, "figures": False, "log_interval_ps": 0.02},
    )


@pytest.mark.parametrize("with_forces", [False, True])
def test_a_table_in_a_file_is_the_potential_that_it_lists(with_forces, tmp_path):
    write_argon_table(tmp_path / "argon.csv", with_forces=with_forces)
    scene = tabulated(tmp_path, sites=("AR",))
    text = describe(scene)
    assert (
        "argon: argon.csv of 700 energies from 2.6 to 9.2 Å, 60 sites, cutoff 9 Å, switch" in text
    )
    error = float(
        re.search(r"argon: the error of its spline is (\S+) of its deepest energy", text)[1]
    )
    assert 1e-9 < error < 2e-5
    exact, of_table = (rigidmd.Simulation(one).run() for one in (tabulated(tmp_path), scene))
    start = [results["potential"][0] for results in (exact, of_table)]
    depth, pairs = ARGON["epsilon"], 60 * 14
    assert abs(start[0] - start[1]) < 3 * error * depth * pairs
    assert np.abs(exact["conserved"] - of_table["conserved"]).max() < 1e-3
    drift = [np.ptp(results["conserved"]) for results in (exact, of_table)]
    assert drift[1] < 1.1 * drift[0]


def test_a_table_ends_in_a_wall(tmp_path):
    """Nearer than the first row, value and slope are the values of the first row, and the energy rises
    as r⁻¹²."""
    write_argon_table(tmp_path / "argon.csv", first=3.1)
    potential = rigidmd.pair_potential(table=str(tmp_path / "argon.csv"))
    radial = potential.formula(9.0).radial({"scale": 1.0})
    energy, force = argon_energy(3.1)
    below, above = radial(3.1 - 1e-7), radial(3.1 + 1e-7)
    assert below[:2] == pytest.approx(above[:2], rel=1e-5)
    assert below[:2] == pytest.approx((energy * KJ_PER_MOL, force * KJ_PER_MOL), rel=1e-3)
    for r in (3.0, 2.5, 2.0, 1.6):
        wall = energy + 3.1 * force / 12 * ((3.1 / r) ** 12 - 1)
        assert radial(r)[0] == pytest.approx(wall * KJ_PER_MOL, rel=1e-3)
        assert radial(r)[1] == pytest.approx(
            (radial(r - 1e-5)[0] - radial(r + 1e-5)[0]) / 2e-5, rel=1e-5
        )
    scene = tabulated(tmp_path, count=2, edge=30.0, sites=("AR",))
    _, engine, state = shaken(build(scene), 0, 0.0)
    for r in (2.2, 3.05, 4.0):
        state.position[:] = [[5.0, 5.0, 5.0], [5.0 + r, 5.0, 5.0]]
        load, tallies = engine.evaluate(state)
        assert tallies["argon"].energy == pytest.approx(radial(r)[0], rel=1e-12)
        assert load.force[1, 0] == pytest.approx(radial(r)[1], rel=1e-10)


def test_a_run_with_a_table_resumes_with_the_same_bits_and_keeps_a_copy(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_argon_table(tmp_path / "argon.csv")
    data = tabulated(tmp_path, sites=("AR",)).model_dump(exclude_none=True)
    same_after_stops(data, [30, 61], tmp_path)
    again = rigidmd.Scene.read(tmp_path / "whole" / "scene.toml")
    copy = tmp_path / "whole" / again.forces.custom[0].table
    assert copy.read_bytes() == (tmp_path / "argon.csv").read_bytes()
    write_argon_table(tmp_path / "argon.csv", rows=500)
    with pytest.raises(rigidmd.errors.RigidMDError, match=r"forces\.custom\.0\.table"):
        rigidmd.Simulation(rigidmd.Scene.from_dict(data), tmp_path / "parts", resume=True).run()


ROWS = "\n".join(f"{r:.3f} {argon_energy(r)[0]:.6g}" for r in np.arange(3.0, 9.3, 0.05))
WRONG_TABLES = {
    "r_nm energy_kJ_mol\n"
    + ROWS: r"argon.csv: line 1: the columns are r_nm, energy_kJ_mol. They must be r_A \(Å\)",
    ROWS
    + "\n9.4": r"argon.csv: line 128: has 1 numbers, must have the same columns in all lines: r_A",
    ROWS + "\n9.4 nan": r"argon.csv: line 128: 9.4 nan has something else than finite numbers",
    ROWS + "\n9.4 abc": r"argon.csv: line 128: 9.4 abc has something else than finite numbers",
    ROWS
    + "\n9.0 -0.1": r"argon.csv: line 128: r_A = 9 must be above 9.3 Å of the row before. Sort the rows",
    "-1 5\n" + ROWS: r"argon.csv: line 1: r_A = -1 must be above 0",
    "\n".join(ROWS.splitlines()[:7]): r"argon.csv: has 7 rows, needs 8 or more",
    "# nothing": r"argon.csv: has 0 rows",
    "\n".join(ROWS.splitlines()[:60]): r"ends at 5.95 Å, before the cutoff of 9 Å$",
    "\n".join(
        f"{float(row.split()[0]) / 10} {row.split()[1]}" for row in ROWS.splitlines()
    ): r"Is it in nm\?",
    "\n".join(ROWS.splitlines()[20:]): r"begins at 4 Å, where it does not repel",
    "\n".join(
        f"{row} {-argon_energy(float(row.split()[0]))[1]:.6g}" for row in ROWS.splitlines()
    ): r"the forces are not -dE/dr. From 3 to 3.05 Å the energy changes by -\S+ kJ/mol, .*Have they another sign or unit\?",
}


@pytest.mark.parametrize("text", WRONG_TABLES, ids=range(len(WRONG_TABLES)))
def test_a_table_that_is_no_use_is_told(text, tmp_path):
    (tmp_path / "argon.csv").write_text(text + "\n")
    with pytest.raises(SceneError, match=WRONG_TABLES[text]):
        build(tabulated(tmp_path, sites=("AR",)))


def test_a_table_that_overrides_another_may_be_anywhere(tmp_path, monkeypatch):
    write_argon_table(tmp_path / "argon.csv")
    tables = tabulated(tmp_path, sites=("AR",)).model_dump(exclude_unset=True)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene").mkdir()
    with pytest.raises(SceneError, match="there is no such file"):
        rigidmd.Scene.from_dict(tables, "scene")
    scene = rigidmd.Scene.from_dict(tables, "scene", {"forces.custom.0.table": "argon.csv"})
    assert scene.inputs == {"forces.custom.0.table": tmp_path / "argon.csv"}


def test_all_errors_of_a_table_are_told_and_its_file_is_in_the_folder(tmp_path):
    (tmp_path / "argon.csv").write_text("\n".join(["1 x"] * 9) + "\n" + ROWS)
    with pytest.raises(SceneError) as refused:
        build(tabulated(tmp_path, sites=("AR",)))
    assert [re.search(r"argon.csv: line (\d)", fault)[1] for fault in refused.value.errors] == [
        *"123456789"
    ]
    with pytest.raises(
        SceneError, match=r"forces.custom.0.table: '../argon.csv' is outside the scene's folder"
    ):
        tabulated(tmp_path, table="../argon.csv")
    with pytest.raises(SceneError, match="there is no such file"):
        build(tabulated(tmp_path, table="other.csv"))
    with pytest.raises(SceneError, match=r"give a module, .* an energy, .* or a table"):
        tabulated(tmp_path, energy="1/r**9")


@pytest.mark.parametrize(
    "arguments, word",
    [
        ({}, "needs an energy or a table"),
        ({"energy": "1/r", "truncation": "shfit"}, "shift"),
        ({"energy": "1/r", "mixing": {"k": "mean"}}, "geometric"),
        ({"energy": "k/r", "parameters": {"Ar": {"k": math.nan}}}, "finite"),
        ({"energy": "k/r", "parameters": {"Ar": {"k": 1.0}, "k": 1.0}}, "either numbers"),
        ({"energy": "k/r", "parameters": {"Ar": "k"}}, "not a table of numbers"),
        ({"energy": "k/r", "pairs": {"Ar": {"k": 1.0}}}, "pair of names"),
        ({"energy": "1/r", "cutoff_A": -1.0}, "above 0"),
        ({"energy": "1/r", "cutoff_A": True}, "above 0"),
        ({"energy": "k/r", "parameters": {"r": 1.0}}, "is the distance"),
        ({"energy": "k/r", "mixing": "geometric"}, "must be a dictionary"),
        ({"table": "x.dat"}, "x.dat: there is no such file"),
        ({"table": [1.0]}, "must be a file, or lists"),
    ],
)
def test_a_potential_that_makes_no_sense_is_told_at_once(arguments, word):
    with pytest.raises(ValueError, match=word):
        rigidmd.pair_potential(**arguments)


# --- forces in Python -----------------------------------------------------------------------------


class Field(rigidmd.Force):
    """A field along z, on sites."""

    changes_momentum = (False, False, False)
    tied_to_places = False

    def begin(self, system):
        self.charge = system.of_sites(lambda molecule: molecule.charges)

    def on_sites(self, position, state):
        force = self.charge[:, None] * [0, 0, 9.64853321233]
        return -(force * position).sum(), force


class Spring(rigidmd.Force):
    """A spring to the origin."""

    name = "spring"

    def on_molecules(self, state):
        return 0.5 * (state.position**2).sum(), -state.position


def test_a_field_on_sites_is_the_built_in_one():
    forces = {"electrostatics": "none"}
    own = build(
        small_scene({"spce": 20, "argon": 3}, 20.0, forces=forces).with_user_code([Field()])
    )
    theirs = build(
        small_scene(
            {"spce": 20, "argon": 3}, 20.0, forces=forces, fields={"electric_V_per_nm": [0, 0, 1]}
        )
    )
    load, tallies = own.engine_of({"field": own.terms["field"]}, "double").evaluate(own.state)
    expected, told = theirs.engine_of({"e": theirs.terms["electric_field"]}, "double").evaluate(
        own.state
    )
    assert tallies["field"].energy == pytest.approx(told["e"].energy, rel=1e-9)
    assert load.force == pytest.approx(expected.force, abs=1e-9)
    assert load.torque_body == pytest.approx(expected.torque_body, rel=1e-9, abs=1e-6)
    assert own.model.keeps_momentum.all()


def test_a_force_in_python_conserves_energy_and_is_in_the_log(tmp_path):
    results = rigidmd.Simulation(points(), tmp_path / "run", forces=[Spring()]).run()
    assert results["spring"] == pytest.approx(results["potential"])
    assert abs(results["drift"]).max() < 1e-4 * results["kinetic"][0]
    assert results.system.freedom.translation == 300  # the momentum is not conserved
    header = (tmp_path / "run" / "log.csv").read_text().splitlines()[0]
    assert header.endswith('"spring (kJ/mole)"')
    assert results.units["spring"] == "kJ/mol"
    assert results.summary["user_forces"] == {"spring": "Spring, computed by Python"}


def test_a_run_with_forces_from_python_is_repeated_by_python_only(tmp_path, capsys):
    folder = tmp_path / "run"
    whole = rigidmd.Simulation(points(), tmp_path / "whole", forces=[Spring()]).run()
    short = points(stages=[{"duration_ps": 0.02, "timestep_fs": 4}])
    rigidmd.Simulation(short, folder, forces=[Spring()]).run()
    assert main(["resume", str(folder), "--until", "0.04ps"]) == 2
    assert "from_python: this run had spring from Python" in capsys.readouterr().err
    scene = rigidmd.Scene.read(folder / "scene.toml")
    with pytest.raises(SceneError, match="This has field"):
        rigidmd.Simulation(scene, forces=[Field()])
    results = rigidmd.Simulation(scene.with_end(0.04), folder, forces=[Spring()], resume=True).run()
    assert np.array_equal(results.state.position, whole.state.position)
    assert np.array_equal(results["spring"], whole["spring"])
    assert main(["report", str(folder)]) == 0  # what has ended can be observed without the code


class Faulty(rigidmd.Force):
    """Goes wrong in the way that it is given, once some molecule has moved."""

    def __init__(self, way):
        self.way, self.seen = way, None

    def on_molecules(self, state):
        energy, force = 0.5 * (state.position**2).sum(), -state.position
        self.seen = state.position.copy() if self.seen is None else self.seen
        if self.way == "raises":
            raise KeyError("charge")
        if self.way == "shape":
            return energy, force[0]
        if self.way == "energy":
            return "much", force
        if self.way == "text":
            return "5", force
        if self.way == "complex":
            return energy + 1e-3j, force
        if self.way == "text of forces":
            return energy, force.astype(str)
        if self.way == "objects":
            return energy, force.astype(object).astype(str).astype(object)
        if self.way == "virial":
            return energy, force, None, [1.0, 2.0]
        if self.way == "tuple":
            return force
        if state.step[0] > 3:
            force[6, 1] = np.nan
        return energy, force


@pytest.mark.parametrize(
    "way, word",
    [
        (
            "raises",
            r"on_molecules of the force faulty raised KeyError: 'charge', line \d+ of .*test_user_code.py",
        ),
        ("shape", r"the force faulty returned forces of the shape \(3,\), not \(100, 3\)"),
        ("energy", "returned 'much' as its energy"),
        ("text", "returned '5' as its energy, not a real number"),
        ("complex", r"returned .*0\.001j\) as its energy, not a real number"),
        ("text of forces", "as forces, not real numbers"),
        ("objects", "as forces, not real numbers"),
        ("tuple", "returned ndarray. It must return a tuple"),
        ("virial", r"returned \[1.0, 2.0\] as its virial"),
        (
            "nan",
            r"stopped at step \d \(.* ps\): the force faulty returned .*nan.* on molecule 7 \(dot\)",
        ),
    ],
)
def test_a_faulty_force_is_told_with_its_molecule_and_step(way, word):
    with pytest.raises(SimulationError if way == "nan" else SceneError, match=word):
        rigidmd.Simulation(points(), forces=[Faulty(way)]).run()


class Neither(rigidmd.Force):
    pass


class Wrong(rigidmd.Force):
    def on_molecules(self, state):
        return 0.5 * (state.position**2).sum(), +state.position


class Turned(rigidmd.Force):
    def on_molecules(self, state):
        return 0.0, np.zeros_like(state.position), np.ones_like(state.position)


class Unstretched(Spring):
    tied_to_places = False


class Sheared(rigidmd.Force):
    tied_to_places = False

    def on_molecules(self, state):
        return 0.0, np.zeros_like(state.position), None, np.diag([500.0, -500.0, 0.0])


class InPlace(rigidmd.Force):
    def on_sites(self, position, state):
        position %= 20.0
        return 0.0, np.zeros(position.shape)


class Leaving(rigidmd.Force):
    def on_molecules(self, state):
        raise SystemExit(0)


class Halfway(Spring):
    changes_momentum = (True, False)  # type: ignore[assignment]


@pytest.mark.parametrize(
    "force, word",
    [
        (
            Wrong(),
            r"wrong: the force on molecule \d+ \(spce\) is not the derivative of the energy.* falls by -",
        ),
        (Turned(), "turned: the torque on molecule"),
        (
            Unstretched(),
            "spring: the component xx of its molecular virial is 0 kJ/mol.*tied_to_places = True",
        ),
        (Sheared(), "the component xx of its molecular virial is 500"),
        (InPlace(), "read-only"),
        (Leaving(), "SystemExit: 0"),
        (Halfway(), "must be three truth values"),
        (Neither(), "must define one of on_sites and on_molecules"),
        (lambda state: 0.0, "is not a force"),
    ],
)
def test_a_force_that_is_not_what_its_energy_says_stops_the_run_with_the_numbers(force, word):
    scene = small_scene({"spce": 8}, 20.0, forces={"electrostatics": "none"})
    with pytest.raises((SceneError, SimulationError), match=word):
        system = build(scene.with_user_code([force]))
        check_forces(system, system.state)


def test_forces_from_python_exclude_what_they_cannot_go_with():
    stage = {"ensemble": "npt", "temperature_K": 94, "pressure_bar": 1, "duration_ps": 1}
    with pytest.raises(
        SceneError, match="spring depend on absolute positions in it: keep the volume"
    ):
        rigidmd.Simulation(points(stages=[stage]), forces=[Spring()])
    top = rigidmd.Scene.read(ROOT / "systems" / "heavy_top_3.toml")
    with pytest.raises(SceneError, match=r"forces: for molecules. A single body takes applied"):
        rigidmd.Simulation(top, forces=[Spring()])
    with pytest.raises(SceneError, match="energy is a column of the log"):
        rigidmd.Simulation(points(), forces=[rigidmd.pair_potential("1/r**9", name="energy")])
    with pytest.raises(SceneError, match="thermostat: 3 is neither"):
        rigidmd.Simulation(points(), thermostat=3)


# --- code in files --------------------------------------------------------------------------------

MINE = """
from typing import NamedTuple
import rigidmd

class Trap(NamedTuple):
    stiffness: float
    tied_to_places = True

@rigidmd.compiled_force(Trap)
def add(term, state, load, tally):
    for m in range(len(state.position)):
        for k in range(3):
            load.force[m, k] -= term.stiffness * state.position[m, k]
            if tally is not None:
                tally[0] += 0.5 * term.stiffness * state.position[m, k] ** 2

def trap(stiffness_kJ_mol_A2):
    return Trap(100 * stiffness_kJ_mol_A2)

ready = Trap(1.0)
"""


def test_a_file_of_code_runs_only_where_it_is_trusted(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(f"{MINE}\n# {tmp_path}")  # not trusted by an earlier test
    custom = {"module": "mine.py", "name": "trap", "parameters": {"stiffness_kJ_mol_A2": 1.0}}
    import tomli_w

    (tmp_path / "s.toml").write_text(tomli_w.dumps(POINTS | {"forces": {"custom": [custom]}}))
    assert main(["check", "s.toml"]) == 2
    assert "mine.py is Python code, which can do whatever you can" in capsys.readouterr().err
    assert main(["check", "s.toml", "--trust", "nosuch.py"]) == 2
    assert main(["run", "s.toml", "--trust", "mine.py"]) == 0
    capsys.readouterr()
    spring = rigidmd.Simulation(points(), forces=[Spring()]).run()
    assert main(["energy", "s.toml", "--json"]) == 0  # this process trusts it by now
    import json

    assert json.loads(capsys.readouterr().out)["components"]["trap"] == pytest.approx(
        spring["spring"][0], rel=1e-12
    )
    # the file and its digest go with the run, which repeats
    (copy,) = (tmp_path / "runs" / "s").glob("input_*mine.py")
    assert copy.read_bytes() == (tmp_path / "mine.py").read_bytes()
    assert main(["run", "runs/s/scene.toml", "-o", "again", "--trust", str(copy)]) == 0
    assert main(["compare", "runs/s", "again"]) == 0
    # a changed file is another one
    (tmp_path / "mine.py").write_text(MINE.replace("0.5", "0.25"))
    assert main(["check", "s.toml"]) == 2
    assert main(["run", "s.toml", "-o", "third", "--trust", "mine.py"]) == 2
    assert "is not the derivative of the energy" in capsys.readouterr().err


@pytest.mark.parametrize(
    "text, entry, word",
    [
        (
            "import nosuchmodule",
            {"name": "x"},
            "ModuleNotFoundError: No module named 'nosuchmodule'",
        ),
        ("def f(:", {"name": "x"}, "line 1 raised SyntaxError"),
        (MINE, {"name": "tarp"}, "has no tarp; did you mean .*trap"),
        (MINE, {"name": "trap"}, r"trap\(...\) raised TypeError"),
        (MINE, {"name": "ready", "parameters": {"k": 1.0}}, "parameters would have no effect"),
        ("x = 3", {"name": "x"}, "3 is not a force"),
    ],
)
def test_a_file_that_is_no_use_is_told(text, entry, word, tmp_path):
    (tmp_path / "mine.py").write_text(text)
    rigidmd.trust(tmp_path / "mine.py")
    scene = rigidmd.Scene.from_dict(
        POINTS | {"forces": {"custom": [{"module": "mine.py", **entry}]}}, tmp_path
    )
    with pytest.raises(SceneError, match=word):
        build(scene)


@pytest.mark.parametrize(
    "entry, word",
    [
        ({"name": "x"}, "give a module"),
        ({"name": "x", "module": "m.py", "energy": "1/r"}, "give a module"),
        (
            {"name": "x", "module": "m.py", "sites": ["A"]},
            "sites would have no effect with a module",
        ),
        ({"name": "x", "module": "m.txt"}, "must be a Python file"),
        ({"name": "x", "module": "../m.py"}, "outside the scene's folder"),
        ({"name": "x y", "energy": "1/r"}, "name"),
    ],
)
def test_entries_of_custom_forces_are_checked(entry, word):
    with pytest.raises(SceneError, match=word):
        points(forces={"custom": [entry]})


def test_code_for_classes_of_users_has_an_index_of_its_own():
    index = CacheIndex("/nowhere", "f", 0)
    source = b"from typing import NamedTuple\nclass Term(NamedTuple):\n    x: float\n"
    kept = user_modules.module_of(source, "<test>").Term
    assert user_modules.module_of(source, "<test>").Term is kept  # one class for one text
    assert user_modules.module_of(source + b"\n", "<test>").Term is not kept

    def key(value):
        return ((numba.typeof((value, 1.0)),), ())

    common = index._index_for(key(1.0))._index_path
    assert index._index_for(key(2.0))._index_path == common
    assert index._index_for(key(Pair(1.0, 2.0))) is None  # of a module that may change: not kept
    of_file = user_modules.module_of(source, "<test>", user_modules.USER_FILE_PREFIX).Term
    assert index._index_for(key(of_file(1.0))) is None  # it may hold what it has read
    apart = index._index_for(key(kept(1.0)))
    assert apart._index_path not in (common, None)


STRENGTH = 1.0


class One(NamedTuple):
    k: float


def of_strength(p: One, r):
    return STRENGTH * p.k / r, STRENGTH * p.k / r**2


def test_a_potential_of_a_function_sees_what_the_function_uses_when_the_potential_is_made(
    monkeypatch,
):
    made, end = [], (0.0, 0.0, 0.0, 0.0)
    for strength in (1.0, 5.0):
        monkeypatch.setitem(globals(), "STRENGTH", strength)
        own = rigidmd.pair_potential(of_strength, {"D": One(2.0)}).formula(9.0).kind(2.0)
        made.append(
            at_distance(CustomOneKind(20.0, Unmodified(20.0), own, (), end), own, end, 4.0)[0]
        )
    assert made == [pytest.approx(100.0), pytest.approx(500.0)]


# --- thermostats ----------------------------------------------------------------------------------


class Halving(NamedTuple):
    """Halves the kinetic energy in a time."""

    time: float
    halved = False


@rigidmd.compiled_thermostat(Halving)
def halve(bath, model, state, h, draw):
    factor = 0.5 ** (h / bath.time)
    before = 0.0
    for m in range(len(state.velocity)):
        for k in range(3):
            before += 0.5 * model.mass[model.species[m]] * state.velocity[m, k] ** 2
            state.velocity[m, k] *= math.sqrt(factor)
    state.energy_ledger[0] += (factor - 1) * before


def test_a_thermostat_of_ones_own_takes_the_place_of_that_of_the_stage():
    given = {"D": {"A": 1e5, "B": 4.0, "C": 1.0}}
    scene = points(
        forces={"custom": [{"name": "soft", "energy": "A*exp(-B*r) - C/r**6", "parameters": given}]}
    )
    results = rigidmd.Simulation(scene, thermostat=Halving(0.01)).run()
    assert results["kinetic"][-1] == pytest.approx(results["kinetic"][0] / 16, rel=0.02)
    assert results["heat"][-1] == pytest.approx(
        results["energy"][-1] - results["energy"][0], rel=0.02
    )
    assert any("thermostat: halving, from Python" in note for note in results.system.notes)
    assert results.system.scene.from_python == ("thermostat halving",)


def with_error(line: str, name: str = "kick"):
    """A thermostat of one line of code, for each molecule m, from a file of its own so that
    messages can quote it."""

    class Shaky(NamedTuple):
        rate: float
        key: Key

    source = f"def {name}(thermostat, model, state, h, draw):\n    for m in range(len(state.velocity)):\n        {line}\n"
    lines = source.splitlines(keepends=True)
    linecache.cache["shaky.py"] = (len(source), None, lines, "shaky.py")
    names = {"normals": normals, "SCRIPTS": SCRIPTS[0]}
    exec(compile(source, "shaky.py", "exec"), names)
    rigidmd.compiled_thermostat(Shaky)(names[name])
    return Shaky(0.5, key_of(1, THERMOSTAT))


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (
            "normals(draw, 0, m)",
            "line 3 of shaky.py: `normals(draw, 0, m)`): normals(key, draw, molecule, step) is called with",
        ),
        (
            "state.velocity[m] *= model.mass[m]",
            "kick (line 3 of shaky.py: `state.velocity[m] *= model.mass[m]`) has an index",
        ),
        (
            "state.velocity[m, 3] = 0.0",
            "kick (line 3 of shaky.py: `state.velocity[m, 3] = 0.0`) has an index beyond an array",
        ),
        (
            "state.velocities[m, 0] = 0.0",
            "line 3 of shaky.py: `state.velocities[m, 0] = 0.0`): Numba knows no attribute 'velocities'",
        ),
        ("state.velocity[m, 0] = thermostat.time", "Numba knows no attribute 'time' of Shaky"),
        (
            "state.velocity[m, 0] = ramp(h)",
            "kick (line 1 of shaky.py) cannot be compiled: NameError: name 'ramp' is not defined",
        ),
        ("state.velocity[m, 0] = SCRIPTS", "it uses SCRIPTS, which is not compiled"),
        (
            "state.velocity[m, 0] = 0.0 / (h - h)",
            "kick (line 1 of shaky.py) makes momenta that are not finite",
        ),
    ],
)
def test_an_error_in_a_thermostat_names_its_line_and_the_cause(line, message):
    with pytest.raises(SceneError) as error:
        rigidmd.Simulation(points(), thermostat=with_error(line)).run()
    assert message in str(error.value)
    assert "halving" not in str(error.value)


def test_errors_of_numba_have_no_colours():
    error = CompileError("Failed in nopython mode\n\x1b[1m\x1b[31mNameError: no ramp\x1b[0m")
    assert describe_compile_error(error) == ": NameError: no ramp"


def test_an_index_beyond_an_array_in_a_compiled_force_names_its_line():
    class Pull(NamedTuple):
        strength: np.ndarray

    @rigidmd.compiled_force(Pull)
    def pull(term, state, load, tally):
        for m in range(len(state.position)):
            load.force[m, 0] += term.strength[m]

    with pytest.raises(
        SceneError,
        match=r"pull \(line \d+ of test_user_code.py: `load.force.*`\) has an index beyond",
    ):
        rigidmd.Simulation(points(), forces=[Pull(np.ones(3))]).run()


@pytest.mark.parametrize(
    ("line", "note"),
    [
        ("state.velocity[m, 1] *= -1.0", None),
        (
            "state.velocity[m, 1] *= 0.9; "
            + (heat := "state.energy_ledger[0] -= 20.0 * 0.19 / 0.81 * state.velocity[m, 1]**2"),
            None,
        ),
        ("state.velocity[m, 1] *= 0.9", "of it and adds 0 to state.energy_ledger[0]"),
        (f"state.velocity[m, 1] *= 0.9; {heat.replace('-=', '+=')}", "of it and adds 0."),
    ],
)
def test_heat_that_is_not_in_the_ledger_has_a_note(line, note):
    system = build(points().with_user_code([], with_error(line)))
    notes = check_compiled_code(system, system.state)
    assert len(notes) == (note is not None)
    assert note is None or note in notes[0]


def test_a_stop_names_the_code_of_the_user_that_acts_in_each_step():
    rows = [{"name": "two_halves", "order": 2, "steps": [0.5, 0.5], "source": "this test"}]
    stages = [{"duration_ps": 0.04, "timestep_fs": 4, "integrator": "two_halves"}]
    system = build(points(integrators=rows, stages=stages).with_user_code([], Halving(0.01)))
    told = explain(system, FailedCheck("molecule 2 (dot) is lost", 1), [], 0.004, None)
    assert (
        "Likely cause: the thermostat halving, from Python or the integrator two_halves, from the scene"
        in told
    )


# --- examples -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=path.stem, marks=[pytest.mark.soak] if path.stem == "mie" else [])
        for path in SCRIPTS
    ],
)
def test_every_example_of_an_extension_runs_and_is_short(path, monkeypatch):
    from rigidmd.analysis import registry

    monkeypatch.setattr(registry, "KNOWN", dict(registry.KNOWN))
    assert len(path.read_text().splitlines()) <= 50
    assert path.read_text().startswith("# ")
    runpy.run_path(str(path), run_name="__main__")


def test_scripts_are_listed_and_copied(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["examples"]) == 0
    listed = capsys.readouterr().out
    assert all(f"  {path.stem} " in listed for path in SCRIPTS)
    assert main(["new", "mie"]) == 0
    assert "python mie.py" in capsys.readouterr().out
    assert (tmp_path / "mie.py").read_bytes() == (
        ROOT / "systems" / "scripts" / "mie.py"
    ).read_bytes()
    assert main(["new", "mie", "-o", "mine.toml", "--force"]) == 2
    assert "must end in .py" in capsys.readouterr().err


@pytest.mark.soak
def test_langevin_function_of_dipoles_in_a_field_in_python():
    """Free dipoles in a field: the mean of cos is coth x - 1/x with x = mu E/kT."""
    scene = rigidmd.Scene.from_dict(
        {
            "box": {"lengths_A": 60},
            "molecules": [{"model": "spce", "count": 200}],
            "forces": {"electrostatics": "none", "lennard_jones": False},
            "start": {"temperature_K": 300},
            "stages": [
                {
                    "ensemble": "nvt",
                    "temperature_K": 300,
                    "duration_ps": 100,
                    "thermostat": "langevin",
                }
            ],
        }
    )
    results = rigidmd.Simulation(scene, forces=[Field()]).run()
    energy = results["field"][len(results["field"]) // 10 :]
    mu = results.system.species[0].dipole_debye * 0.20819434 * 9.64853321233
    thermal = 8.31446261815324e-3 * 300
    weight = quad(lambda c: math.exp(mu * c / thermal), -1, 1)[0]
    mean = quad(lambda c: c * math.exp(mu * c / thermal), -1, 1)[0] / weight
    assert energy.mean() / 200 == pytest.approx(-mu * mean, rel=0.01)


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
def test_what_a_potential_has_at_its_cutoff_is_told(scene, words):
    warnings = build(scene).warnings
    assert (warnings == []) == (words is None)
    assert words is None or words in warnings[0]


class Well(NamedTuple):
    k: float
    r0: float


def umbrella(p: Well, r):
    return 0.5 * p.k * (r - p.r0) ** 2, p.k * (p.r0 - r)


@pytest.mark.parametrize("function", [umbrella, numba.njit(umbrella)], ids=["python", "numba"])
@pytest.mark.parametrize(
    ("truncation", "words"),
    [("plain", "umbrella is 121 kJ/mol (49 kT at 298 K)"), ("shift", "its force is -44 kJ/mol/Å")],
)
def test_what_a_function_has_at_its_cutoff_is_told(function, truncation, words):
    """A potential from a function is checked like a text; one that vanishes at its cutoff has no
    warning."""
    scene = small_scene(
        {"argon": 4}, 20.0, stages=[{"ensemble": "nvt", "temperature_K": 298, "duration_ps": 0.004}]
    )
    parameters = {"AR": Well(8.0, 3.5)}
    law = rigidmd.pair_potential(function, parameters, truncation=truncation, cutoff_A=9.0)
    (warning,) = build(scene.with_user_code([law])).warnings
    assert words in warning
    ends = rigidmd.pair_potential(lennard_jones, {"AR": Pair(1.0, 3.4)}, cutoff_A=9.0)
    assert build(scene.with_user_code([ends])).warnings == []


def lennard_jones_rows(step=0.02, without=(0.0, 0.0), factor=1.0):
    r = np.arange(2.6, 9.3, step)
    r = r[(r <= without[0]) | (r >= without[1])]
    return r, factor * argon_energy(r)[0], factor * argon_energy(r)[1]


@pytest.mark.parametrize("gap", [(3.96, 6.96), (4.0, 9.0), (3.6, 4.4), (3.6, 5.2), (3.7, 3.8)])
@pytest.mark.parametrize("with_forces", [False, True])
def test_a_gap_in_a_table_is_refused(gap, with_forces):
    rows = lennard_jones_rows(without=gap)[: 3 if with_forces else 2]
    with pytest.raises(
        ValueError, match=r"has a gap from 3\.|has a gap from 4 to 9|forces are not -dE/dr"
    ):
        rigidmd.pair_potential(table=rows).formula(9.0)


@pytest.mark.parametrize(
    ("step", "with_forces"), [(0.02, False), (0.05, True), (0.1, False), (0.1, True), (0.15, True)]
)
def test_the_error_of_a_spline_is_what_it_says(step, with_forces):
    """Compared with the exact energy where it is below ten wells; the estimate is within a factor
    of 6."""
    formula = rigidmd.pair_potential(
        table=lennard_jones_rows(step)[: 3 if with_forces else 2]
    ).formula(9.0)
    radial, r = formula.radial({"scale": 1.0}), np.linspace(2.9, 8.99, 2001)
    r = r[argon_energy(r)[0] < 10 * ARGON["epsilon"]]
    off = (
        max(abs(radial(x)[0] / KJ_PER_MOL - argon_energy(x)[0]) for x in r.tolist())
        / ARGON["epsilon"]
    )
    assert off / 3 < formula.error < 6 * off


def test_a_table_of_two_parts_or_of_growing_intervals_has_no_gap():
    fine, coarse = lennard_jones_rows(0.02), lennard_jones_rows(0.1)
    two = [np.r_[a[fine[0] < 5.0], b[coarse[0] > 5.01]] for a, b in zip(fine, coarse, strict=True)]
    r = np.geomspace(2.6, 9.3, 200)
    for rows in (two, (r, *argon_energy(r))):
        assert rigidmd.pair_potential(table=tuple(rows)).formula(9.0).error < 1e-3


def test_a_spline_that_is_nonsense_is_refused_and_a_poor_one_told(tmp_path):
    r, energy, _ = lennard_jones_rows(0.02)
    wild = energy.copy()
    wild[120] = 1e6
    with pytest.raises(
        ValueError,
        match=r"the error of its spline is .* of its deepest energy, .* must be below 0.1",
    ):
        rigidmd.pair_potential(table=(r, wild)).formula(9.0)
    np.savetxt(tmp_path / "argon.csv", np.column_stack(lennard_jones_rows(0.12)[:2]))
    [told] = build(tabulated(tmp_path, sites=("AR",))).warnings
    assert re.match(
        r"argon the error of its spline is \d\.\de-02 of its deepest energy: use smaller", told
    )


@pytest.mark.parametrize("value", ["1e300", "-1e31", "1e308"])
def test_a_huge_energy_in_a_table_is_told_with_its_line(value, tmp_path):
    lines = [f"{x:g} {y:g}" for x, y in zip(*lennard_jones_rows(0.1)[:2], strict=True)]
    (tmp_path / "t.csv").write_text("\n".join([lines[0], f"2.61 {value}", *lines[1:]]))
    with pytest.raises(ValueError, match=r"t.csv: line 2: 2.61 .* has a number above 1e\+30"):
        rigidmd.pair_potential(table=tmp_path / "t.csv")


@pytest.mark.parametrize("name", ["energy", "time", "tail", "load", "box", "trajectory"])
def test_names_that_a_force_cannot_have_are_refused_by_check(name, tmp_path, capsys):
    entry = f'[[forces.custom]]\nname = "{name}"\nenergy = "1/r**9"\nsites = ["OW"]\n'
    (tmp_path / "s.toml").write_text(f"{GOOD}\n{entry}")
    assert main(["check", str(tmp_path / "s.toml")]) == 2
    assert f"{name} is " in capsys.readouterr().err
