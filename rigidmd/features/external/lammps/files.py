"""What LAMMPS can express, and its input files (units real) for a system: atoms, settings, and the
stages of a run."""

from collections.abc import Mapping
from itertools import combinations_with_replacement
from math import inf, pi, sqrt
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple, SupportsFloat, cast

import numpy as np

from rigidmd.core.files import write_text
from rigidmd.core.plain_text import in_comment
from rigidmd.core.state import State
from rigidmd.features.external.engines import SPLIT, Key, Limit, Translations, is_langevin, moves
from rigidmd.features.external.force_field import (
    ForceFieldView,
    coulomb_formula,
    lennard_jones_formula,
    table,
)
from rigidmd.features.external.lammps.ellipsoids import atoms, ellipsoids, limits, orientations
from rigidmd.features.external.rigid_bodies import RigidBodies
from rigidmd.features.potentials.extra import body_pairs_of
from rigidmd.features.potentials.poses.gay_berne import GayBerne
from rigidmd.features.potentials.poses.pairs import BodyPairs
from rigidmd.forces.potentials.screened_coulomb import DampedShiftedForce, ScreenedCoulomb
from rigidmd.forces.potentials.truncation import TRUNCATIONS, Unmodified
from rigidmd.scene.stage import Stage
from rigidmd.scene.validation import not_none
from rigidmd.units import BAR, COULOMB, ENERGY_UNITS, KJ_PER_MOL

KCAL = ENERGY_UNITS["kcal/mol"]
#: LAMMPS' constant of Coulomb's law, kcal Å/mol.
COULOMB_REAL = 332.06371
ATMOSPHERE = 1.01325 * BAR
#: Mass of a massless site, u, because LAMMPS needs one. It is less than rounding of the mass of a
#: molecule.
NO_MASS = 1e-18
#: Cutoff of a potential without cutoff, Å.
FARTHEST = 1e4
#: Entries of a table, even in r², and its first r, Å. Above 1 Å, splines of a table up to 9 Å are
#: accurate to 1e-9.
ENTRIES, INNERMOST = 8000, 0.3
#: One more than the largest seed.
SEEDS = 900_000_000

DATA = "data.lammps"
SETTINGS = "settings.lammps"
INPUT = "in.lammps"
TABLES = "tables.lammps"
#: Names of groups, and of the fixes that move the first two.
BODIES = "bodies"
POINTS = "points"
FROZEN = "frozen"
SITES = "sites"


def ranks_without_molecules(view: ForceFieldView) -> str:
    """How many ranks a scene has for how many molecules, if for too few of them."""
    ranks = view.scene.engine.options.get("ranks", 1)
    molecules = len(view.system.model.species)
    return f"{ranks} ranks for {molecules} molecules" if ranks > molecules else ""


_INTEGRATOR, *_LIMITS = moves("LAMMPS", "rigid bodies")
#: What LAMMPS can express, and how.
TRANSLATIONS = Translations(
    "LAMMPS",
    scene=(
        Key(
            "forces.truncation",
            {  # pair style of Lennard-Jones forces
                "plain": "lj/cut",
                "shift": "lj/cut",
                "force_shift": "lj/smooth/linear",
                "force_switch": "lj/gromacs",
                "switch": "lj/mdf",
                "smooth_switch": "table",
            },
            matters=lambda view: view.is_truncated,
        ),
        Key("forces.dispersion", {"cutoff": ""}),
        Key("forces.reaction_field_truncation", dict.fromkeys((None, *TRUNCATIONS), "table")),
        Key(
            "forces.electrostatics",
            {  # kspace style
                **dict.fromkeys(("none", "coulomb", "reaction_field", "damped_shifted_force"), ""),
                "ewald": "ewald",
                "pme": "pppm",
            },
            matters=lambda view: view.coulomb,
        ),
        Key(
            "forces.ewald_truncation",
            {None: "", "plain": ""},
            "LAMMPS has no shift of the real-space energy. Take 'plain'",
            lambda view: view.has_ewald_sum,
        ),
        Key(
            "run.remove_momentum_interval_ps",
            {None: "", False: ""},
            "LAMMPS removes no momentum of rigid bodies. Leave it out",
        ),
    ),
    stage=(
        Key("ensemble", {"nve": "nve", "nvt": "nvt", "npt": "npt", "nph": "nph"}),
        Key(
            "thermostat",
            {None: "", "nose_hoover": "", "langevin": ""},
            "LAMMPS has nose_hoover and langevin for rigid bodies",
        ),
        Key("barostat", {None: ""}, "LAMMPS has its own for rigid bodies. Leave barostat out"),
        Key(
            "pressure_coupling",
            {"isotropic": "iso", "semi_isotropic": "couple xy", "anisotropic": "couple none"},
            "LAMMPS' barostat for rigid bodies keeps the angles of the box",
        ),
        _INTEGRATOR,
        Key("rotor", SPLIT, "LAMMPS' rotation is split"),
    ),
    limits=(
        Limit(
            "forces.tail_correction with a barostat: LAMMPS' barostat for rigid bodies does not"
            " know its pressure",
            lambda view: view.has_barostat and view.system.tail is not None,
        ),
        Limit(
            "a barostat for bodies and points together: LAMMPS' fix rigid/npt moves the box for one"
            " of them",
            lambda view: (
                view.has_barostat and view.is_body.any() and (~view.is_body & ~view.frozen).any()
            ),
        ),
        Limit(
            "engine.ranks: {}, some would have nothing to move. Use fewer",
            ranks_without_molecules,
        ),
    ),
    stage_limits=(
        *_LIMITS,
        Limit(
            "ensemble = 'npt': LAMMPS' barostat for rigid bodies works with nose_hoover only",
            lambda stage: is_langevin(stage) and stage.has_barostat,
        ),
    ),
    body_pairs={GayBerne: limits},
)


class PairStyle(NamedTuple):
    name: str
    arguments: str
    coefficients: dict[tuple[int, int], str]  # kinds from 0, the smaller one first
    formulas: Mapping[tuple[int, int], str] = MappingProxyType({})  # energy in kcal/mol, for tables
    modify: str = ""


def write_data(path: Path, view: ForceFieldView, state: State) -> None:
    """Write the data file: box, masses, atoms with images, velocities. Site k of the system is atom
    k + 1, and ellipsoids follow."""
    system = view.system
    added = ellipsoids(view)
    points = atoms(view)
    position, velocity = RigidBodies(system, points).points(state)
    image = np.zeros(position.shape, int)
    # the first line may name the units of velocities for readers; those of LAMMPS are chosen by its
    # script
    lines = [f"LAMMPS data file, units = real, of {system.scene.name}, written by rigidmd", ""]
    lines += [f"{len(position)} atoms", f"{len(view.kinds) + len(added)} atom types"]
    lines += [f"{len(position) - system.site_count} ellipsoids"] if added else []
    low = position.min(axis=0) - 1
    high = position.max(axis=0) + 1
    tilt = ()
    if view.is_periodic:
        image = np.floor(position @ np.linalg.inv(state.cell)).astype(int)
        position = position - image @ state.cell
        low, high = np.zeros(3), state.cell.diagonal()
        tilt = (state.cell[1, 0], state.cell[2, 0], state.cell[2, 1])
    lines += [""]
    lines += [
        f"{_num(a)} {_num(b)} {axis}lo {axis}hi"
        for a, b, axis in zip(low, high, "xyz", strict=True)
    ]
    lines += [f"{' '.join(map(_num, tilt))} xy xz yz"] if any(tilt) else []
    if added:  # atoms have masses of their own
        lines += ["", "Atoms # hybrid", ""]
    else:
        lines += ["", "Masses", ""]
        lines += [
            f"{k + 1} {_num(kind.mass or NO_MASS)} # {in_comment(kind.name)}"
            for k, kind in enumerate(view.kinds)
        ]
        lines += ["", "Atoms # full", ""]
    of_added = [np.full(len(e.molecule), k) for k, e in enumerate(added, len(view.kinds) + 1)]
    kinds = np.concatenate([view.kind + 1, *of_added])
    charge = np.append(view.charge, np.zeros(len(position) - system.site_count))
    rows = zip(points.molecule + 1, kinds, charge, points.mass, position, image, strict=True)
    for i, (molecule, kind, q, mass, (x, y, z), (nx, ny, nz)) in enumerate(rows, 1):
        at = f"{_num(x)} {_num(y)} {_num(z)}"
        images = f"{nx} {ny} {nz}"
        if added:  # whether it is an ellipsoid, then its density, or the mass of a point
            flag = int(i > system.site_count)
            of_atom = f"{molecule} {_num(q)} {flag} {_num(mass or NO_MASS)}"
            lines.append(f"{i} {kind} {at} {of_atom} {images}")
        else:
            lines.append(f"{i} {molecule} {kind} {_num(q)} {at} {images}")
    if added:
        lines += ["", "Ellipsoids", ""]
        diameters = np.concatenate([np.tile(e.diameters, (len(e.molecule), 1)) for e in added])
        numbers = np.hstack([diameters, orientations(view, state)])
        lines += [
            f"{i} {' '.join(map(_num, row))}"
            for i, row in enumerate(numbers, system.site_count + 1)
        ]
    per_fs = velocity * 1e-3  # Å/ps to Å/fs
    spin = " 0 0 0" if added else ""  # angular momentum
    lines += ["", "Velocities", ""]
    lines += [f"{i} {_num(x)} {_num(y)} {_num(z)}{spin}" for i, (x, y, z) in enumerate(per_fs, 1)]
    write_text(path, "\n".join(lines) + "\n")


def _num(number: SupportsFloat) -> str:
    """The shortest decimal form of a number that is read back exactly."""
    return repr(float(number))


def settings(view: ForceFieldView, data: str = DATA) -> list[str]:
    """The commands that define the system and its forces, without fixes that move it."""
    system = view.system
    forces = system.scene.forces
    boundary = "p p p" if view.is_periodic else "s s s"
    styles = pair_styles(view)
    names = (
        " ".join(f"{style.name} {style.arguments}" for style in styles)
        or f"zero {_cutoff(system.cutoff):g}"
    )
    kinds = len(view.kinds) + len(ellipsoids(view))
    atom_style = "hybrid full ellipsoid" if kinds > len(view.kinds) else "full"
    lines = ["units real", f"atom_style {atom_style}", f"boundary {boundary}"]
    lines += [f"pair_style {'hybrid/overlay ' if styles else ''}{names}", f"read_data {data}"]
    for n, style in enumerate(styles):
        which = style_name(styles, n)
        lines += [
            f"pair_coeff {i + 1} {j + 1} {which} {text}"
            for (i, j), text in style.coefficients.items()
        ]
    touched = {pair for style in styles for pair in style.coefficients}
    pairs = [(i, j) for i in range(kinds) for j in range(i, kinds)]
    if styles:
        lines += [f"pair_coeff {i + 1} {j + 1} none" for i, j in pairs if (i, j) not in touched]
    else:
        lines += ["pair_coeff * *"]
    lines += [style.modify for style in styles if style.modify]
    if view.has_ewald_sum:
        style = TRANSLATIONS.of("forces.electrostatics")[forces.electrostatics]
        # LAMMPS' accuracy is the rms error of the force on a site over the force of two charges e
        # at 1 Å
        accuracy = float(system.force_error or 0.0) / COULOMB
        lines += [
            f"kspace_style {style} {accuracy:.3g}",
            f"kspace_modify gewald {_num(not_none(forces.ewald_alpha_per_A))}",
        ]
    lines += [
        f"neighbor 2.0 {'bin' if view.is_periodic else 'nsq'}",
        "neigh_modify every 1 delay 0 check yes",
        "neigh_modify exclude molecule/intra all",
    ]
    for name, members in (
        (BODIES, view.is_body),
        (POINTS, ~view.is_body & ~view.frozen),
        (FROZEN, view.frozen),
    ):
        if members.any():
            numbers = np.flatnonzero(members) + 1
            runs = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)  # as 1:5 7 9:12
            ranges = " ".join(
                f"{run[0]}:{run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs
            )
            lines += [f"group {name} molecule {ranges}"]
    if ellipsoids(view):
        lines += [f"group {SITES} id 1:{system.site_count}"]
    if view.frozen.any():
        lines += [f"neigh_modify exclude group {FROZEN} {FROZEN}"]
    return lines


def _cutoff(cutoff: float) -> float:
    return FARTHEST if cutoff == inf else cutoff


def pair_styles(view: ForceFieldView) -> list[PairStyle]:
    styles = [style for style in (_lennard_jones(view), _coulomb(view)) if style is not None]
    return [_gay_berne(view, name) for name in body_pairs_of(view.system)] + styles


def _lennard_jones(view: ForceFieldView) -> PairStyle | None:
    potential = view.lennard_jones
    if potential is None or not view.epsilon.any():
        return None
    name = (
        TRANSLATIONS.of("forces.truncation")[view.truncation]
        if potential.cutoff < inf
        else "lj/cut"
    )
    pairs = [(i, j) for i, j in np.argwhere(view.epsilon > 0) if i <= j]
    cutoff = _num(_cutoff(potential.cutoff))
    if name == "table":
        formulas = {}
        for i, j in pairs:
            six = float(view.sigma[i, j]) ** 6
            c6 = 4 * float(view.epsilon[i, j]) * six
            formulas[(i, j)] = lennard_jones_formula(potential, c6 * six, c6, KCAL)
        return _tables("lj", formulas, cutoff)
    arguments = cutoff
    if name in ("lj/gromacs", "lj/mdf") and not isinstance(potential.truncation, Unmodified):
        arguments = f"{_num(potential.truncation.start)} {cutoff}"
    coefficients = {
        (i, j): f"{_num(view.epsilon[i, j] / KCAL)} {_num(view.sigma[i, j])}" for i, j in pairs
    }
    is_shifted = view.truncation == "shift" and potential.cutoff < inf
    modify = f"pair_modify pair {name} shift yes" if is_shifted else ""
    return PairStyle(name, arguments, coefficients, modify=modify)


def _coulomb(view: ForceFieldView) -> PairStyle | None:
    potential = view.coulomb
    if potential is None:
        return None
    charge = [kind.charge for kind in view.kinds]
    charged = [k for k, q in enumerate(charge) if q != 0]
    pairs = [(i, j) for i in charged for j in charged if i <= j]
    cutoff = _num(_cutoff(potential.cutoff))
    plain = dict.fromkeys(pairs, "")
    if isinstance(potential, ScreenedCoulomb):
        return PairStyle("coul/long", cutoff, plain, modify="pair_modify pair coul/long table 0")
    if potential.cutoff == inf:
        return PairStyle("coul/cut", cutoff, plain)
    if isinstance(potential, DampedShiftedForce):
        return PairStyle("coul/dsf", f"{_num(potential.alpha)} {cutoff}", plain)
    of_pairs = {
        (i, j): coulomb_formula(potential, COULOMB_REAL * charge[i] * charge[j]) for i, j in pairs
    }
    return _tables("coulomb", of_pairs, cutoff)


def _gay_berne(view: ForceFieldView, name: str) -> PairStyle:
    potential = body_pairs_of(view.system)[name]
    coefficients = {}
    kinds = enumerate(ellipsoids(view), len(view.kinds))
    members = [(k, kind) for k, kind in kinds if kind.potential == name]
    for (i, one), (j, other) in combinations_with_replacement(members, 2):
        p, q = potential.parameters_of(one.species, other.species)
        epsilon = sqrt(p["epsilon_kJ_mol"] * q["epsilon_kJ_mol"]) * KJ_PER_MOL / KCAL
        numbers = [epsilon, (p["width_A"] + q["width_A"]) / 2, *one.wells, *other.wells]
        coefficients[(i, j)] = " ".join(map(_num, numbers))
    gamma, upsilon, mu = (getattr(potential.function, x) for x in ("gamma", "upsilon", "mu"))
    term = cast(BodyPairs, view.system.terms[name])
    arguments = (gamma, upsilon, mu, _cutoff(term.cutoff))
    return PairStyle("gayberne", " ".join(map(_num, arguments)), coefficients)


def _tables(what: str, formulas: dict[tuple[int, int], str], cutoff: str) -> PairStyle:
    """A pair style with tables in the file TABLES. Pairs with the same formula use the same
    table."""
    names = {formula: f"{what}_{n}" for n, formula in enumerate(dict.fromkeys(formulas.values()))}
    coefficients = {
        pair: f"{TABLES} {names[formula]} {cutoff}" for pair, formula in formulas.items()
    }
    return PairStyle("table", f"spline {ENTRIES}", coefficients, formulas)


def style_name(styles: list[PairStyle], n: int) -> str:
    """LAMMPS' name of style n, with its number if several styles have that name."""
    names = [style.name for style in styles]
    return (
        names[n] if names.count(names[n]) == 1 else f"{names[n]} {names[: n + 1].count(names[n])}"
    )


def write_tables(path: Path, view: ForceFieldView) -> bool:
    """Write the tables of the potentials for which LAMMPS has no style. Returns whether there are
    any."""
    parts = []
    for style in pair_styles(view):
        for pair, formula in style.formulas.items():
            name, cutoff = style.coefficients[pair].split()[1:]
            if f"\n{name}\n" not in "".join(parts):
                parts.append(
                    f"# {formula}\n\n{name}\n{table(formula, INNERMOST, float(cutoff), ENTRIES)}\n"
                )
    if parts:
        write_text(path, "".join(parts))
    return bool(parts)


def fixes(view: ForceFieldView, k: int) -> list[str]:
    """The fixes that move the molecules in stage k."""
    stage = view.system.scene.stages[k]
    seed = (view.system.scene.seed * 1000 + k) % (SEEDS - 1) + 1
    kind = "nve" if stage.is_minimisation else stage.ensemble
    at = " ".join(map(_num, stage.temperatures))
    langevin = []
    if stage.thermostat_kind == "langevin":
        friction = stage.thermostat_values["friction_translation_per_ps"]
        damping = f"{at} {_num(1e3 / friction)}"
        of_bodies = f"rigid/small molecule langevin {damping} {seed}"
        of_points = "nve"
        langevin = [f"fix {POINTS}_bath {POINTS} langevin {damping} {seed + 1} tally yes"]
    else:
        of_bodies = f"rigid/{kind}/small molecule"
        of_points = kind
        # LAMMPS has the inverse of an angular frequency, a scene its period
        if stage.has_thermostat:
            chain = f" temp {at} {_num(1e3 * stage.thermostat_time / (2 * pi))}"
            of_bodies, of_points = of_bodies + chain, of_points + chain
        if stage.has_barostat:
            box = f" {_barostat(view, stage)}"
            of_bodies, of_points = of_bodies + box, of_points + box
        if stage.has_thermostat:
            links = stage.thermostat_values["nose_hoover_links"]
            of_bodies += f" tparam {links} 1 5" + (f" pchain {links}" if stage.has_barostat else "")
            of_points += "" if stage.has_barostat else f" tchain {links}"
    lines = [f"fix {BODIES} {BODIES} {of_bodies}"] if view.is_body.any() else []
    if (~view.is_body & ~view.frozen).any():
        lines += [f"fix {POINTS} {POINTS} {of_points}", *langevin]
    return lines


def _barostat(view: ForceFieldView, stage: Stage) -> str:
    """Pressures, atm, without the tail correction, which the forces lack, and damping time, fs."""
    tail = view.system.tail
    volume = view.system.state.volume
    tail_pressure = 0.0 if tail is None else tail.pressure(volume)
    first, last = (
        [(bar * BAR - tail_pressure) / ATMOSPHERE for bar in at[:3]] for at in stage.pressures
    )
    damping = _num(1e3 * stage.barostat_time)
    if stage.pressure_coupling == "isotropic":
        return f"iso {_num(np.mean(first))} {_num(np.mean(last))} {damping}"
    axes = " ".join(
        f"{axis} {_num(a)} {_num(b)} {damping}"
        for axis, a, b in zip("xyz", first, last, strict=True)
    )
    return f"{axes} couple {'xy' if stage.pressure_coupling == 'semi_isotropic' else 'none'}"


def input_script(view: ForceFieldView) -> str:
    """The input script of the whole run: settings, and all stages except minimisations."""
    system = view.system
    output = system.scene.output
    hint = (
        "# Written by rigidmd. Run it here:  lmp -in in.lammps   or   mpirun -n 4 lmp -in in.lammps"
    )
    lines = [f"# {in_comment(system.scene.in_short)}", hint, "", f"include {SETTINGS}", ""]
    columns = "step time temp pe ke etotal press vol density"
    added = []
    if (constant := system.constants.get("coulomb_intramolecular")) is not None:
        what = (
            "pairs within molecules in reciprocal space, constant for rigid molecules; potential"
            " does not"
        )
        lines, added = [*lines, f"# pe includes {what}"], [f"({_num(constant / KCAL)})"]
    if system.tail is not None:
        lines += ["# potential includes Lennard-Jones beyond the cutoff, pe and press do not"]
        added += [
            f"({_num(system.tail.energy_volume / KCAL)})/vol",
            f"({_num(system.tail.constant / KCAL)})",
        ]
    if added:
        lines += [f"variable potential equal {'+'.join(['pe', *added])}"]
        columns += " v_potential"
    lines += [f"thermo_style custom {columns}", "thermo_modify format float %.10g flush yes"]
    for k, stage in enumerate(system.scene.stages):
        if stage.is_minimisation:
            continue
        every = stage.steps_of(output.log_interval_ps)
        frames = stage.steps_of(output.trajectory_interval_ps)
        stage_fixes = fixes(view, k)
        lines += [
            "",
            f"# {in_comment(stage.label)}: {stage.duration:g} ps",
            f"timestep {_num(stage.step_fs)}",
            *stage_fixes,
            f"thermo {every}",
        ]
        if output.trajectory:
            lines += [
                f"dump frames {SITES if ellipsoids(view) else 'all'} custom {frames}"
                f" trajectory_{k}.lammpstrj id mol type xu yu zu vx vy vz"
            ]
            lines += ["dump_modify frames sort id"]
        lines += [f"run {stage.steps}"]
        lines += [f"unfix {fix.split()[1]}" for fix in stage_fixes] + (
            ["undump frames"] if output.trajectory else []
        )
    return "\n".join([*lines, "", "write_data final.lammps", ""])


def write_lammps(folder: Path, view: ForceFieldView, state: State) -> list[str]:
    """Write all files of a run to a folder, and return their names. Raises OutputError."""
    write_data(folder / DATA, view, state)
    for name, text in ((SETTINGS, "\n".join([*settings(view), ""])), (INPUT, input_script(view))):
        write_text(folder / name, text)
    return [INPUT, SETTINGS, DATA, *([TABLES] if write_tables(folder / TABLES, view) else [])]
