"""Corrections of Ewald sums: constants of frozen molecules, shifts of energies at the cutoff."""

from itertools import product

import numpy as np
import pytest
from scipy.special import erfc
from support.common import observe, small_scene
from support.ewald import (
    EDGES,
    SALT,
    TIGHT_EWALD,
    TIGHT_PME,
    charged_sites,
    coulomb,
    oracle_of,
    salty,
)
from support.reference import KE, Oracle

from rigidmd.assemble.build import build
from rigidmd.units import BAR


@pytest.mark.parametrize(
    ("truncation", "ewald"),
    [
        ("shift", "plain"),
        *(
            pytest.param(truncation, ewald, marks=pytest.mark.soak)
            for truncation, ewald in product(["plain", "shift"], ["plain", "shift", None])
            if (truncation, ewald) != ("shift", "plain")
        ),
    ],
)
def test_lennard_jones_and_real_space_end_at_different_distances(truncation, ewald):
    """RASPA's sums have the one shifted and the other plain."""
    cutoff, alpha = 6.0, 0.3
    forces = {
        "cutoff_A": cutoff,
        "electrostatics": "ewald",
        "ewald_alpha_per_A": alpha,
        "truncation": truncation,
    }
    forces |= {"ewald_truncation": ewald} if ewald else {}
    system, engine, state = salty(forces)
    oracle = oracle_of(system, state, alpha, cutoff)
    found = observe(system, engine, state)
    shift = erfc(alpha * cutoff) / cutoff if (ewald or truncation) == "shift" else 0.0
    pairs = sum(
        oracle.q[i] * oracle.q[j] for i, j, r, same in oracle.pairs() if not same and r < cutoff
    )
    net = np.bincount(oracle.owner, oracle.q)
    assert found.components["coulomb_real"] == pytest.approx(oracle.real - shift * pairs, rel=1e-10)
    assert found.components["coulomb_self"] == pytest.approx(
        oracle.self - 0.5 * shift * net @ net, rel=1e-11
    )
    # without its charges the oracle of potentials that end is one of Lennard-Jones
    potentials = Oracle(system)
    potentials.charge = np.zeros_like(potentials.charge)
    lj = potentials.energy(state.position, state.rotation)[0]
    assert found.components["lennard_jones"] == pytest.approx(lj, rel=1e-10)


def test_only_the_energy_is_shifted_where_real_space_ends():
    cutoff, alpha = 6.0, 0.4
    found = {}
    for truncation in ("plain", "shift"):
        forces = {
            "cutoff_A": cutoff,
            "electrostatics": "ewald",
            "ewald_alpha_per_A": alpha,
            "truncation": truncation,
        }
        system, engine, state = salty(forces)
        found[truncation] = observe(system, engine, state)
    assert found["shift"].load.force == pytest.approx(found["plain"].load.force, rel=1e-11)
    x, q, owner = charged_sites(system, state)
    step = x[:, None] - x
    step -= np.round(step / EDGES) * EDGES
    near = (np.linalg.norm(step, axis=2) < cutoff) & (owner[:, None] > owner)
    shift = KE * erfc(alpha * cutoff) / cutoff
    changes = {
        name: found["shift"].components[name] - found["plain"].components[name]
        for name in found["plain"].components
    }
    assert changes["coulomb_real"] == pytest.approx(
        -shift * (np.outer(q, q) * near).sum(), rel=1e-9
    )
    net = np.bincount(owner, q)
    assert changes["coulomb_self"] == pytest.approx(-0.5 * shift * (net**2).sum(), rel=1e-9)
    assert net.any() and all(changes[name] == 0 for name in changes if name.startswith("coulomb_i"))


def test_frozen_molecules_do_not_act_on_one_another():
    """The energy is the value of the whole box less the value of the frozen molecules alone."""
    molecules = [{**SALT[0], "frozen": True}, {**SALT[1], "count": 6}]
    pressures = {}
    for method in (TIGHT_EWALD, TIGHT_PME):
        box = {"lengths_A": EDGES}
        system = build(small_scene({}, None, molecules=molecules, box=box, forces=method))
        whole = oracle_of(system, system.state, 1.0, 6.4)
        alone = oracle_of(system, system.state, 1.0, 6.4, chosen=whole.owner < 6)
        seen = observe(system, system.engine(), system.state)
        # of the sums that cancel, as good as the grid is; see
        # test_total_does_not_depend_on_how_it_is_split
        error = 3e-6 if method is TIGHT_PME else 1e-10
        assert coulomb(seen.components) == pytest.approx(
            whole.total - alone.total, abs=error * abs(whole.self)
        )
        pressures[method["electrostatics"]] = (
            seen.pressure_tensor.trace() * BAR * system.space.volume
        )
        assert abs(system.constants["coulomb_frozen"]) > abs(coulomb(seen.components))
    # what the grid leaves in the energy changes with the volume to a power of twice the order of
    # the splines
    assert pressures["pme"] == pytest.approx(pressures["ewald"], abs=16 * 3e-6 * abs(whole.self))


def test_frozen_molecules_do_not_press_on_one_another():
    """For what sums over k-vectors and a surface have, with the virial of molecules of several sites."""
    frozen = {"model": "spce", "name": "ice", "count": 5, "frozen": True}
    forces = TIGHT_EWALD | {"ewald_surface_permittivity": 3.0}
    system, other = (
        build(small_scene({}, 15.0, molecules=molecules, forces=forces))
        for molecules in ([{"model": "spce", "count": 4}, frozen], [{"model": "spce", "count": 5}])
    )
    alone = other.state._replace(
        position=system.state.position[4:], rotation=system.state.rotation[4:]
    )
    _, tallies = other.engine().evaluate(alone)
    virial = tallies["coulomb_reciprocal"].virial + tallies["coulomb_surface"].virial
    assert system.constant_pressure == pytest.approx(-virial.trace() / (3 * 15.0**3), rel=1e-9)
