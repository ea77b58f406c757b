"""Pair potentials of users in a system: compared with the built-in ones, parameters, truncation."""

import functools
import math
from typing import NamedTuple

import numba
import numpy as np
import pytest
from support.common import built, site, small_scene
from support.potentials import LJ, Pair, at_distance, points

import rigidmd
from rigidmd.assemble.build import build
from rigidmd.errors import SceneError
from rigidmd.features.potentials.sites.custom import CustomOneKind, tail_of_pair
from rigidmd.features.potentials.sites.formulas import (
    FormulaError,
    formula_of_function,
    formula_of_text,
)
from rigidmd.forces.potentials.lennard_jones import energy_and_force as of_built_in
from rigidmd.forces.potentials.lennard_jones import lennard_jones as built_in
from rigidmd.forces.potentials.lennard_jones import tail
from rigidmd.forces.potentials.truncation import TRUNCATIONS, Unmodified, truncation_terms
from rigidmd.run.kind import describe
from rigidmd.units import KJ_PER_MOL

# --- formulas -------------------------------------------------------------------------------------


@numba.njit(error_model="numpy")
def in_numbers(potential, r2):
    return of_built_in(potential, potential.c12, potential.c6, r2)


def lennard_jones(p: Pair, r, inverse):
    six = (p.sig * inverse) ** 6
    return 4 * p.eps * (six * six - six), 24 * p.eps * (2 * six * six - six) * inverse


def test_a_function_needs_to_state_what_its_parameters_are():
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
    sites = [site("D", 40, element="Ar", parameters={"k": 3.0, "other": 1.0})]
    scene = points(
        molecules=[{"name": "dot", "count": 10, "sites": sites}],
        forces={"custom": [{"name": "wall", "energy": "k/r**9"}]},
    )
    assert build(scene).terms["wall"].potential.parameters[0, 0, 0] == pytest.approx(300)
    assert "wall: k/r**9, 10 sites, cutoff 9 Å, shift" in describe(scene)


# --- tables in files ------------------------------------------------------------------------------


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
def test_a_potential_that_makes_no_sense_is_reported_at_once(arguments, word):
    with pytest.raises(ValueError, match=word):
        rigidmd.pair_potential(**arguments)


# --- code in files --------------------------------------------------------------------------------


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


# --- what is lost at a cutoff, and tables that state too little -------------------------------------


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
def test_what_a_function_has_at_its_cutoff_is_reported(function, truncation, words):
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
