"""Molecular models as text: a table of all, or one in full."""

import re
from collections import Counter
from itertools import combinations
from textwrap import wrap

import numpy as np

from rigidmd.formats.bonds import bonds, distance
from rigidmd.scene.models import GROUPS, Molecule
from rigidmd.units import BOLTZMANN, KJ_PER_MOL

WIDTH = 100
MOST_CHARGES = 3  # in a line of the table


def models_table(molecules: list[Molecule]) -> str:
    """A line for each model, by groups, at most WIDTH columns wide."""
    groups = []
    for group in GROUPS:
        lines = [f"{group:<20}sites   mass u dipole D  {'charges, e':<24}source"]
        for m in [m for m in molecules if m.group == group]:
            dipole = f"{m.dipole_debye:.3f}" if m.charges.any() and m.radius > 0 else ""
            charges = [*dict.fromkeys(f"{q:<+8.4g}" for q in m.charges if q)]
            if len(charges) > MOST_CHARGES:
                charges[MOST_CHARGES - 1 :] = ["..."]
            line = f"  {m.name:<19}{len(m.masses):>4}{m.mass:>9.4g}{dipole:>9}  "
            lines.append(f"{line}{''.join(charges):<24}{short_source(m)}".rstrip())
        if len(lines) > 1:
            groups.append("\n".join(lines))
    return "\n\n".join(groups)


def short_source(m: Molecule) -> str:
    """Authors and year."""
    year_match = re.match(r".*?\b(?:19|20)\d\d\b", m.source)
    authors, year = (
        (year_match[0][:-4].strip(), year_match[0][-4:]) if year_match else (m.source, "")
    )
    names = re.split(r", | & ", authors)
    return f"{names[0]} et al. {year}" if len(names) > 2 else f"{authors} {year}"


def molecule_text(m: Molecule) -> str:
    """One model in full: kind, sites in the principal frame, geometry, source."""
    lines = [f"{m.name}: {m.title}" if m.title else m.name, f"  {m.description}"]
    lines.append(f"  {m.degrees_of_freedom} degrees of freedom")
    lines.append(f"  principal moments {' '.join(f'{x:.5g}' for x in m.inertia)} u Å²")
    if m.kind == "linear" and m.charges.any() and not m.charge:
        lines.append(f"  quadrupole along the axis {m.quadrupole_debye_A[0, 0]:+.4f} D Å")
    columns = (
        "  site   element    mass u       x Å       y Å       z Å   charge e   sigma Å  epsilon"
        " kJ/mol        K"
    )
    lines += ["", columns]
    for i, name in enumerate(m.site_names):
        x, y, z = np.round(m.positions_body[i], 5) + 0.0
        charge = f"{m.charges[i]:+.6g}" if m.charges[i] else ""
        element = m.elements[i] if m.elements[i] != "X" else ""
        well = ""
        if m.epsilon[i] > 0:
            in_kj, in_kelvin = m.epsilon[i] / KJ_PER_MOL, m.epsilon[i] / BOLTZMANN
            well = f"{m.sigma[i]:>10.6g}{in_kj:>16.6g}{in_kelvin:>9.5g}"
        position = f"{x:>10.5f}{y:>10.5f}{z:>10.5f}"
        line = f"  {name:<7}{element:<7}{m.masses[i]:>10.4f}{position}{charge:>11}{well}"
        lines.append(line.rstrip())
    lines.append("")
    lengths, angles = _geometry(m)
    for name, text in (
        ("lengths", lengths),
        ("angles", angles),
        ("mixing", m.mixing),
        ("note", m.note),
        ("source", m.source),
    ):
        if text:
            lines += wrap(text, WIDTH, initial_indent=f"  {name:<8}", subsequent_indent=" " * 10)
    if m.residue_names:
        lines.append(f"  {'called':<8}{' '.join(m.residue_names)} in structure files")
    return "\n".join(lines)


def _geometry(m: Molecule) -> list[str]:
    """Lengths and angles of the links. Equal ones are counted."""
    stems = [re.sub(r"(?<=\D)\d+$", "", name) for name in m.site_names]
    kind = [
        stem if stems.count(stem) > 1 else name
        for stem, name in zip(stems, m.site_names, strict=True)
    ]
    # charges that represent a multipole are left out: the table of sites shows them
    few = (m.masses == 0).sum() <= 2
    links = [(i, j) for i, j in bonds(m) if m.masses[j] > 0 or few]
    lengths = Counter(f"{kind[i]}-{kind[j]} {distance(m, i, j):.4f} Å" for i, j in links)
    angles = Counter()
    for one, other in combinations(links, 2):
        if len(ends := {*one} ^ {*other}) == 2:
            (corner,) = {*one} & {*other}
            a, b = sorted(ends, key=lambda s: kind[s])
            to_a, to_b = distance(m, a, corner), distance(m, b, corner)
            # an angle between two massless sites on an atom is listed; a site on a bisector is
            # defined by its length
            ears = kind[a] == kind[b] and abs(to_a / to_b - 1) < 1e-6
            if ears or m.masses[a] > 0 < m.masses[b]:
                u, v = (m.positions_body[[a, b]] - m.positions_body[corner]) / [[to_a], [to_b]]
                angle = np.degrees(np.arctan2(np.linalg.norm(np.cross(u, v)), u @ v))
                angles[f"{kind[a]}-{kind[corner]}-{kind[b]} {angle:.2f}°"] += 1
    return [
        ", ".join(w if n == 1 else f"{w} ({n})" for w, n in counts.items())
        for counts in (lengths, angles)
    ]
