"""What GROMACS can express, and its input files for a system: coordinates, topology, settings of
each stage, and a script that runs them.

GROMACS constrains the distance of two points, or those of three by SETTLE, which is analytic. So
linear molecules, and molecules whose mass is in a plane, are possible, with all other sites
virtual. Its units are nm, ps, u, e, kJ/mol.
"""

from math import inf
from pathlib import Path
from shlex import quote

import numpy as np
from scipy.special import erfc

from rigidmd.core.files import write_text
from rigidmd.core.plain_text import as_identifier, as_word, distinct, in_comment
from rigidmd.core.state import State
from rigidmd.features.external.engines import SPLIT, Key, Limit, Missing, Translations, moves
from rigidmd.features.external.force_field import ForceFieldView
from rigidmd.features.external.rigid_bodies import (
    SAME,
    MassPoints,
    Points,
    RigidBodies,
    mass_points,
)
from rigidmd.forces.ewald.pme import Pme
from rigidmd.forces.parts import gather_per_molecule
from rigidmd.forces.potentials.coulomb import ReactionField
from rigidmd.forces.potentials.screened_coulomb import ScreenedCoulomb
from rigidmd.scene.models import Molecule
from rigidmd.scene.stage import Stage
from rigidmd.units import KJ_PER_MOL

NM = 0.1
COORDINATES, TOPOLOGY, SCRIPT = "conf.gro", "topol.top", "run.sh"
#: Decimals of coordinates in nm. A .gro may have any number of them.
DECIMALS = 9
#: Atom type of a mass point without a site.
POINT = "MP"
SEEDS = 2**31 - 1


def gromacs_points(molecule: Molecule) -> MassPoints:
    """The mass points of a molecule. The first of three is the apex of an isosceles triangle, as
    SETTLE needs it."""
    body = mass_points(molecule)
    if len(body.mass) != 3 or (body.site < 0).all():
        return body
    d = {(i, j): distance for i, j, distance in body.distances}
    fits = d[0, 1] == d[0, 2] and abs(body.mass[1] - body.mass[2]) <= SAME * body.mass[1]
    return body if fits and (np.diff(body.site) == 1).all() else mass_points(molecule, sites=False)


#: Thermostat -> integrator and tcoupl.
THERMOSTATS: dict[str | None, tuple[str, str]] = {
    None: ("md-vv", "no"),
    "nose_hoover": ("md-vv", "nose-hoover"),
    "langevin": ("sd", "no"),
    "velocity_rescaling": ("md", "v-rescale"),
}
_INTEGRATOR, *_LIMITS = moves("GROMACS", "molecules")
#: What GROMACS can express, and how.
TRANSLATIONS = Translations(
    "GROMACS",
    scene=(
        Key(
            "forces.truncation",
            {  # vdw-modifier
                "plain": "None",
                "shift": "Potential-shift",
                "force_switch": "Force-switch",
                "switch": "Potential-switch",
            },
            matters=lambda view: view.lennard_jones,
        ),
        Key("forces.dispersion", {"cutoff": ""}),
        Key(
            "forces.electrostatics",
            {"none": "Cut-off", "reaction_field": "Reaction-Field", "pme": "PME"},
            matters=lambda view: view.coulomb,
        ),
        Key(
            "forces.reaction_field_truncation",
            {None: "", "plain": "None", "shift": "Potential-shift"},
        ),
        Key("forces.ewald_truncation", {None: "", "plain": "None", "shift": "Potential-shift"}),
    ),
    stage=(
        Key(
            "ensemble",
            {"nve": "", "nvt": "", "npt": "", "nph": Missing("the export to GROMACS has only npt")},
        ),
        Key(
            "thermostat",
            {
                **{name: coupling for name, (_, coupling) in THERMOSTATS.items()},
                "andersen": Missing("GROMACS' Andersen thermostat does not act on whole molecules"),
            },
        ),
        Key("barostat", {None: "no", "cell_rescaling": "C-rescale"}),
        Key(
            "pressure_coupling",
            {"isotropic": "isotropic", "semi_isotropic": "semiisotropic"},
            "GROMACS' cell_rescaling has isotropic and semi_isotropic",
        ),
        _INTEGRATOR,
        Key("rotor", SPLIT, "GROMACS rotates molecules by constrained distances"),
    ),
    limits=(
        Limit(
            "no box or no cutoff: GROMACS computes pairs within a cutoff in a periodic box",
            lambda view: not view.is_periodic or view.system.cutoff == inf,
        ),
        Limit(
            "frozen molecules: GROMACS would compute forces between them",
            lambda view: view.frozen.any(),
        ),
        Limit(
            "{}: GROMACS has no rigid bodies whose mass is neither on a line nor in a plane",
            lambda view: ", ".join(
                m.name for m in view.system.species if len(gromacs_points(m).mass) > 3
            ),
        ),
        Limit(
            "several kinds of planar molecules: GROMACS' SETTLE has one kind of triangle",
            lambda view: sum(len(gromacs_points(m).mass) == 3 for m in view.system.species) > 1,
        ),
    ),
    stage_limits=(
        *_LIMITS,
        Limit(
            "thermostat = 'nose_hoover' with a barostat: GROMACS has no cell_rescaling with"
            " velocity Verlet",
            lambda stage: stage.has_barostat and stage.thermostat_kind == "nose_hoover",
        ),
        Limit(
            "pressure_bar changes over the stage: GROMACS keeps it constant",
            lambda stage: stage.has_barostat and stage.pressures[0] != stage.pressures[1],
        ),
    ),
)


def write_gromacs(folder: Path, view: ForceFieldView, state: State) -> list[str]:
    """Write the files for a system that starts at a state, and return their names. Raises
    OutputError."""
    bodies = [gromacs_points(m) for m in view.system.species]
    stages = [
        (k, stage) for k, stage in enumerate(view.system.scene.stages) if not stage.is_minimisation
    ]
    names = distinct(
        [as_identifier(f"{n}_{stage.label}") for n, (_, stage) in enumerate(stages, 1)]
    )
    script = [
        "#!/bin/sh",
        "# Written by rigidmd: runs the stages with GROMACS, one after the other.",
        "set -e",
    ]
    before = f"-c {COORDINATES}"
    for name in map(quote, names):
        script += [
            f"gmx grompp -f {name}.mdp {before} -p {TOPOLOGY} -po {name}_all.mdp -o {name}.tpr",
            f'gmx mdrun -deffnm {name} "$@"',
        ]
        before = f"-c {name}.gro -t {name}.cpt"
    text = {
        COORDINATES: _coordinates(view, bodies, state),
        TOPOLOGY: _topology(view, bodies),
        **{f"{name}.mdp": _settings(view, k) for name, (k, _) in zip(names, stages, strict=True)},
        SCRIPT: "\n".join([*script, ""]),
    }
    for name, content in text.items():
        write_text(folder / name, content)
    (folder / SCRIPT).chmod(0o755)
    return list(text)


def _coordinates(view: ForceFieldView, bodies: list[MassPoints], state: State) -> str:
    """The .gro file, with velocities."""
    system = view.system
    species = system.model.species
    at, velocity = system.site_positions(state), system.site_velocities(state)
    extra = Points(
        np.repeat(np.arange(len(species)), [bodies[k].extra for k in species]),
        gather_per_molecule([body.position_body[body.site < 0] for body in bodies], species),
        gather_per_molecule([body.mass[body.site < 0] for body in bodies], species),
    )
    extra_positions, extra_velocities = (
        RigidBodies(system, extra).points(state) if len(extra.mass) else np.zeros((2, 0, 3))
    )
    width = DECIMALS + 5
    rows = []
    s = e = 0
    for n, k in enumerate(species):
        m = system.species[k]
        added = bodies[k].extra
        count = len(m.masses)
        names = [*map(as_word, m.site_names), *(f"P{j + 1}" for j in range(added))]
        positions = np.concatenate([at[s : s + count], extra_positions[e : e + added]])
        velocities = np.concatenate([velocity[s : s + count], extra_velocities[e : e + added]])
        for name, x, v in zip(names, positions, velocities, strict=True):
            residue = f"{(n + 1) % 100000:5d}{as_word(m.residue_names[0]):<5}"
            head = f"{residue}{name:>5}{(len(rows) + 1) % 100000:5d}"
            where = "".join(f"{value * NM:{width}.{DECIMALS}f}" for value in x)
            rows.append(
                head + where + "".join(f"{value * NM:{width}.{DECIMALS + 1}f}" for value in v)
            )
        s, e = s + count, e + added
    a, b, c = state.cell * NM
    is_tilted = state.cell[np.tril_indices(3, -1)].any()
    box = [a[0], b[1], c[2]] + ([a[1], a[2], b[0], b[2], c[0], c[1]] if is_tilted else [])
    last = " ".join(f"{value:.{DECIMALS}f}" for value in box)
    return (
        "\n".join([f"{system.scene.name}, written by rigidmd", str(len(rows)), *rows, last]) + "\n"
    )


def _topology(view: ForceFieldView, bodies: list[MassPoints]) -> str:
    """The .top file: kinds of sites, all parameters between them, molecules."""
    system, kinds = view.system, view.kinds
    lines = [f"; {in_comment(system.scene.in_short)}", "; Written by rigidmd.", ""]
    lines += ["[ defaults ]", "; nbfunc comb-rule gen-pairs", "1 2 no", ""]
    lines += ["[ atomtypes ]", "; name mass charge ptype sigma_nm epsilon_kJ_mol"]
    sigma = view.sigma * NM
    epsilon = view.epsilon / KJ_PER_MOL
    for k, kind in enumerate(kinds):
        parameters = f"{kind.mass:.10g} 0 A {sigma[k, k]:.12g} {epsilon[k, k]:.12g}"
        lines.append(f"K{k + 1} {parameters} ; {in_comment(kind.name)}")
    if any(body.extra for body in bodies):
        lines += [f"{POINT} 0 0 A 0 0 ; a point with mass alone"]
    lines += ["", "[ nonbond_params ]", "; i j func sigma_nm epsilon_kJ_mol"]
    pairs = [(i, j) for i in range(len(kinds)) for j in range(i, len(kinds))]
    lines += [f"K{i + 1} K{j + 1} 1 {sigma[i, j]:.12g} {epsilon[i, j]:.12g}" for i, j in pairs]
    index = system.model.species
    names = distinct([as_identifier(m.name) for m in system.species])
    for k in sorted(set(index.tolist())):
        start = int(np.searchsorted(system.sites.molecule, int(np.flatnonzero(index == k)[0])))
        kind = view.kind[start : start + len(system.species[k].masses)]
        lines += ["", *_molecule(view, system.species[k], bodies[k], kind, names[k])]
    lines += ["", "[ system ]", f"{system.scene.name}", "", "[ molecules ]"]
    ends = np.flatnonzero(np.diff(index, append=-1)) + 1
    for begin, end in zip([0, *ends[:-1].tolist()], ends.tolist(), strict=True):
        lines.append(f"{names[index[begin]]} {end - begin}")
    return "\n".join(lines) + "\n"


def _molecule(
    view: ForceFieldView, m: Molecule, body: MassPoints, kind: np.ndarray, name: str
) -> list[str]:
    where, mass = body.particles(len(m.masses))
    charges = np.zeros(len(mass))
    charges[: len(m.charges)] = m.charges if view.coulomb is not None else 0.0
    types = [*(f"K{k + 1}" for k in kind), *[POINT] * body.extra]
    names = [*map(as_word, m.site_names), *(f"P{j + 1}" for j in range(body.extra))]
    lines = ["[ moleculetype ]", "; name nrexcl", f"{name} 1", "", "[ atoms ]"]
    residue = as_word(m.residue_names[0])
    for i, (kind_name, atom, charge, of_atom) in enumerate(
        zip(types, names, charges, mass, strict=True), 1
    ):
        lines.append(f"{i} {kind_name} 1 {residue} {atom} 1 {charge:.12g} {of_atom:.12g}")
    at = [int(p) + 1 for p in where]
    if len(at) == 3:
        d = {(i, j): distance * NM for i, j, distance in body.distances}
        lines += ["", "[ settles ]", f"{at[0]} 1 {d[0, 1]:.12g} {d[1, 2]:.12g}"]
    elif len(at) == 2:
        lines += ["", "[ constraints ]", f"{at[0]} {at[1]} 1 {body.distances[0][2] * NM:.12g}"]
    if body.virtual_sites:
        lines += ["", f"[ virtual_sites{len(at)} ]"]
    points = " ".join(map(str, at))
    for k, site in body.virtual_sites.items():
        weights = " ".join(f"{weight:.12g}" for weight in site.weight[1:])
        out = f"4 {weights} {site.cross / NM:.12g}" if site.cross else f"1 {weights}"
        lines.append(f"{k + 1} {points} {out}")
    if len(mass) > 1:
        lines += ["", "[ exclusions ]"]
        lines += [
            " ".join(str(j + 1) for j in [i, *range(i + 1, len(mass))])
            for i in range(len(mass) - 1)
        ]
    return lines


def _settings(view: ForceFieldView, k: int) -> str:
    system = view.system
    scene = system.scene
    stage = system.scene.stages[k]
    cutoff = system.cutoff * NM

    keeps = system.freedom_in(k).translation < 3 * len(system.model.species)
    interval = system.removes_momentum_every
    integrator, _ = THERMOSTATS[stage.thermostat]
    settings: dict[str, object] = {
        "integrator": integrator,
        "dt": f"{stage.step:.12g}",
        "nsteps": stage.steps,
        "comm-mode": "Linear" if keeps else "None",
        "nstcomm": stage.steps_of(interval) if interval else 100,
        "nstlog": stage.steps_of(scene.output.log_interval_ps),
        "nstenergy": stage.steps_of(scene.output.log_interval_ps),
        "nstxout-compressed": (
            stage.steps_of(scene.output.trajectory_interval_ps) if scene.output.trajectory else 0
        ),
        "continuation": "yes",
        "gen-vel": "no",
        "cutoff-scheme": "Verlet",
        "pbc": "xyz",
        "rlist": f"{cutoff:.12g}",
        "rvdw": f"{cutoff:.12g}",
        "rcoulomb": f"{cutoff:.12g}",
        "vdwtype": "Cut-off",
        "constraint-algorithm": "lincs",
        "lincs-order": 8,
        "lincs-iter": 4,
        "DispCorr": "AllEnerPres" if system.tail is not None else "no",
        "ld-seed": (scene.seed * 1000 + k) % SEEDS,
    }
    if view.lennard_jones is not None:
        settings["vdw-modifier"] = TRANSLATIONS.of("forces.truncation")[view.truncation]
        if "switch" in view.truncation:
            settings["rvdw-switch"] = f"{(scene.forces.switch_start_A or 0.0) * NM:.12g}"
    return "".join(
        f"{key:<24} = {value}\n"
        for key, value in (settings | _coulomb(view) | _couplings(stage)).items()
    )


def _coulomb(view: ForceFieldView) -> dict[str, object]:
    potential = view.coulomb
    mesh = view.system.terms.get("coulomb_reciprocal")
    settings: dict[str, object] = {
        "coulombtype": TRANSLATIONS.of("forces.electrostatics")[view.electrostatics]
    }
    if isinstance(potential, ScreenedCoulomb) and isinstance(mesh, Pme):
        settings["coulomb-modifier"] = "Potential-shift" if potential.shift else "None"
        # GROMACS needs one cutoff; rtol is that of alpha there
        settings["ewald-rtol"] = f"{float(erfc(potential.alpha * view.system.cutoff)):.12g}"
        settings |= {f"fourier-n{axis}": n for axis, n in zip("xyz", mesh.grid, strict=True)}
        settings["pme-order"] = mesh.order
    elif isinstance(potential, ReactionField):
        permittivity = view.system.scene.forces.reaction_field_permittivity
        settings["epsilon-rf"] = 0 if permittivity == inf else f"{permittivity:.12g}"
    return settings


def _couplings(stage: Stage) -> dict[str, object]:
    if not stage.has_thermostat:
        return {"tcoupl": "no", "pcoupl": "no"}
    first, last = stage.temperatures
    settings: dict[str, object] = {
        "tcoupl": TRANSLATIONS.of("thermostat")[stage.thermostat],
        "pcoupl": "no",
        "tc-grps": "System",
        "ref-t": f"{first:.12g}",
        "tau-t": f"{stage.thermostat_time:.12g}",
    }
    if stage.thermostat_kind == "nose_hoover":
        settings["nh-chain-length"] = stage.thermostat_values["nose_hoover_links"]
    if first != last:
        settings |= {
            "annealing": "single",
            "annealing-npoints": 2,
            "annealing-time": f"0 {stage.duration:.12g}",
            "annealing-temp": f"{first:.12g} {last:.12g}",
        }
    if stage.has_barostat:
        pressure = stage.pressures[0]
        count = 1 if stage.pressure_coupling == "isotropic" else 2
        settings |= {
            "pcoupl": TRANSLATIONS.of("barostat")[stage.barostat],
            "pcoupltype": TRANSLATIONS.of("pressure_coupling")[stage.pressure_coupling],
            "tau-p": f"{stage.barostat_time:.12g}",
            "ref-p": " ".join(f"{value:.12g}" for value in (pressure[0], pressure[2])[:count]),
            "compressibility": " ".join([f"{stage.compressibility:.12g}"] * count),
        }
    return settings
