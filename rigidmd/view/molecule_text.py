"""Molecular models as text: a table of all, or one with its geometry, parameters and source."""

import re
import textwrap
from collections import Counter
from itertools import combinations

import numpy as np

from rigidmd.io.formats.bonds import _distance, bonds
from rigidmd.scene.models import GROUPS, Molecule
from rigidmd.units import BOLTZMANN, KJ_PER_MOL

WIDTH = 100


def models_table(molecules: list[Molecule]) -> str:
    """A line for each model, by groups, at most WIDTH columns wide."""
    lines = []
    for group in GROUPS:
        members = [m for m in molecules if m.group == group]
        if members:
            lines += ["" if lines else None, f"{group:<20}sites   mass u dipole D  {'charges e':<22}source"]
        lines += [_row(m) for m in members]
    return "\n".join(line for line in lines if line is not None)


def _row(m: Molecule) -> str:
    dipole = f"{m.dipole_debye:.3f}" if m.charges.any() and m.radius > 0 else ""
    charges = textwrap.shorten(" ".join(dict.fromkeys(f"{q:+.4g}" for q in m.charges if q)), 21, placeholder=" ...")
    return f"  {m.name:<19}{len(m.masses):>4}{m.mass:>9.4g}{dipole:>9}  {charges:<22}{short_source(m)}".rstrip()


def short_source(m: Molecule) -> str:
    """Authors and year."""
    found = re.match(r".*?\b(?:19|20)\d\d\b", m.source)
    authors, year = (found[0][:-4].strip(), found[0][-4:]) if found else (m.source, "")
    names = re.split(r", | & ", authors)
    return f"{names[0]} et al. {year}" if len(names) > 2 else f"{authors} {year}"


def molecule_text(m: Molecule) -> str:
    """One model in full: kind, sites in the principal frame, geometry, source."""
    moments = " ".join(f"{x:.5g}" for x in m.inertia)
    lines = [
        f"{m.name}: {m.title}" if m.title else m.name,
        f"  {m.description}",
        f"  {m.degrees_of_freedom} degrees of freedom",
    ]
    lines.append(f"  principal moments {moments} u Å²")
    if m.kind == "linear" and m.charges.any() and not m.charge:
        lines.append(f"  quadrupole along the axis {m.quadrupole_debye_A[0, 0]:+.4f} D Å")
    lines += ["", *_sites(m), "", *_geometry(m)]
    details = [("mixing", m.mixing), ("note", m.note), ("source", m.source)]
    for name, text in details:
        if text:
            lines += textwrap.wrap(text, WIDTH, initial_indent=f"  {name:<8}", subsequent_indent=" " * 10)
    if m.residue_names:
        lines.append(f"  {'called':<8}{' '.join(m.residue_names)} in structure files")
    return "\n".join(lines)


def _sites(m: Molecule) -> list[str]:
    lines = ["  site   element    mass u       x Å       y Å       z Å   charge e   sigma Å  epsilon kJ/mol        K"]
    for i, name in enumerate(m.site_names):
        x, y, z = np.round(m.positions_body[i], 5) + 0.0
        charge = f"{m.charges[i]:+.6g}" if m.charges[i] else ""
        element = m.elements[i] if m.elements[i] != "X" else ""
        well = ""
        if m.epsilon[i] > 0:
            well = f"{m.sigma[i]:>10.6g}{m.epsilon[i] / KJ_PER_MOL:>16.6g}{m.epsilon[i] / BOLTZMANN:>9.5g}"
        line = f"  {name:<7}{element:<7}{m.masses[i]:>10.4f}{x:>10.5f}{y:>10.5f}{z:>10.5f}{charge:>11}{well}"
        lines.append(line.rstrip())
    return lines


def _geometry(m: Molecule) -> list[str]:
    """Lengths and angles of the links; equal ones are counted."""
    stems = [re.sub(r"(?<=\D)\d+$", "", name) for name in m.site_names]
    kind = [stem if stems.count(stem) > 1 else name for stem, name in zip(stems, m.site_names, strict=True)]
    # charges that represent a multipole are left out: the table of sites shows them
    few = (m.masses == 0).sum() <= 2
    links = [(i, j) for i, j in bonds(m) if m.masses[j] > 0 or few]
    lengths = Counter(f"{kind[i]}-{kind[j]} {_distance(m, i, j):.4f} Å" for i, j in links)
    angles = Counter()
    for one, other in combinations(links, 2):
        if len(ends := {*one} ^ {*other}) == 2:
            (corner,) = {*one} & {*other}
            a, b = sorted(ends, key=lambda s: kind[s])
            # an angle between two massless sites on an atom is listed; a site on a bisector is defined by its length
            ears = kind[a] == kind[b] and abs(_distance(m, a, corner) / _distance(m, b, corner) - 1) < 1e-6
            if ears or m.masses[a] > 0 < m.masses[b]:
                angles[f"{kind[a]}-{kind[corner]}-{kind[b]} {_angle(m, a, corner, b):.2f}°"] += 1
    lines = []
    for name, found in (("lengths", lengths), ("angles", angles)):
        if found:
            text = ", ".join(what if count == 1 else f"{what} ({count})" for what, count in found.items())
            lines += textwrap.wrap(text, WIDTH, initial_indent=f"  {name:<8}", subsequent_indent=" " * 10)
    return lines


def _angle(m: Molecule, i: int, corner: int, j: int) -> float:
    a, b = (m.positions_body[[i, j]] - m.positions_body[corner]) / [
        [_distance(m, i, corner)],
        [_distance(m, j, corner)],
    ]
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))
