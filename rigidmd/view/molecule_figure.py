"""Molecular models as text, a table of all or one in full, and as a picture: atoms as spheres,
Lennard-Jones diameters, charges, massless sites, principal axes."""

import re
from collections import Counter
from itertools import combinations
from pathlib import Path
from textwrap import shorten, wrap
from typing import Any

import numpy as np

from rigidmd.figures.style import COOL, FAINT, INK, draw_scale, new_figure, save_files
from rigidmd.formats.bonds import COVALENT, bonds, distance
from rigidmd.io.write import check_target
from rigidmd.scene.models import GROUPS, Molecule
from rigidmd.units import BOLTZMANN, KJ_PER_MOL

WIDTH = 100


def models_table(molecules: list[Molecule]) -> str:
    """A line for each model, by groups, at most WIDTH columns wide."""
    groups = []
    for group in GROUPS:
        lines = [f"{group:<20}sites   mass u dipole D  {'charges e':<22}source"]
        for m in [m for m in molecules if m.group == group]:
            dipole = f"{m.dipole_debye:.3f}" if m.charges.any() and m.radius > 0 else ""
            charges = " ".join(dict.fromkeys(f"{q:+.4g}" for q in m.charges if q))
            line = f"  {m.name:<19}{len(m.masses):>4}{m.mass:>9.4g}{dipole:>9}  "
            lines.append(
                f"{line}{shorten(charges, 21, placeholder=' ...'):<22}{short_source(m)}".rstrip()
            )
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
    """Lengths and angles of the links; equal ones are counted."""
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


EXTENSIONS = (".png", ".svg", ".pdf")
#: Colours of the elements, after Corey, Pauling and Koltun, and of all others.
COLOURS = {
    "H": "#f0f0f0",
    "C": "#5a5f66",
    "N": "#3f63d6",
    "O": "#d8392f",
    "F": "#7cc95a",
    "S": "#e3bf2b",
    "Cl": "#3fa34d",
    "Li": "#a374d5",
    "Na": "#8a4fc9",
    "K": "#7440b5",
    "Rb": "#60309c",
    "Cs": "#4d2384",
    "Br": "#9c4a2f",
    "I": "#7a3f8f",
    "Ne": "#8fd3e0",
    "Ar": "#6fc1d3",
    "Kr": "#56a9c0",
    "Xe": "#3f8fa8",
}
OTHER = "#b0b4ba"
#: Radius of a sphere as a fraction of the covalent radius, or else of the Lennard-Jones diameter.
OF_COVALENT, OF_DIAMETER, LEAST = 0.62, 0.2, 0.22
#: View of bodies that are not flat: degrees about the vertical, then towards the viewer.
AZIMUTH, LIFT = 25.0, 20.0
INCHES, FONT = 7.0, 9.0


def write_molecule_figure(path: Path, m: Molecule, force: bool = False) -> None:
    """Draw a molecule into a file, whose extension sets the format. Raises OutputError."""
    from matplotlib.patches import Circle

    check_target(path, EXTENSIONS, force, "figure")
    view = _view(m)
    projected: Any = m.positions_body @ view.T  # right, up, towards the viewer
    covalent = np.array([COVALENT.get(element, 0.0) for element in m.elements])
    radius: Any = np.maximum(
        LEAST, np.where(covalent > 0, OF_COVALENT * covalent, OF_DIAMETER * m.sigma)
    )
    radius[m.masses == 0] = LEAST / 2
    reach = np.maximum(radius, np.where(m.epsilon > 0, m.sigma / 2, 0.0))
    half = float(1.12 * (np.abs(projected[:, :2]).max(axis=1) + reach).max())
    figure = new_figure(INCHES, INCHES * 1.12, layout=None)
    axes = figure.add_axes(
        (0.02, 0.02, 0.96, 0.96 / 1.12), aspect="equal", xlim=(-half, half), ylim=(-half, half)
    )
    axes.set_axis_off()
    for i in np.flatnonzero(m.epsilon > 0).tolist():
        colour = COLOURS.get(m.elements[i], OTHER) if m.elements[i] != "H" else OTHER
        dashed = {"lw": 0.8, "ls": (0, (4, 3)), "zorder": 1}
        axes.add_patch(
            Circle(projected[i, :2], m.sigma[i] / 2, fc=colour, alpha=0.07, lw=0, zorder=1)
        )
        axes.add_patch(
            Circle(projected[i, :2], m.sigma[i] / 2, fill=False, ec=colour, alpha=0.45, **dashed)
        )
    bonded = _links(axes, m, projected, radius)
    for i in np.argsort(projected[:, 2], kind="stable"):
        _sphere(axes, m, i, projected[i], radius[i])
    _labels(axes, m, projected[:, :2], radius, half, _principal_axes(axes, m, view, half) + bonded)
    length = 1.0 if half > 1.6 else 0.5
    draw_scale(axes, length - 0.96 * half, -0.95 * half, length, f"{length:g} Å", FONT)
    title, plain = m.title or m.name, {"color": INK, "va": "top", "parse_math": False}
    figure.text(0.03, 0.975, title, fontsize=min(13.0, 780 / len(title)), weight="bold", **plain)
    lines = [f"{m.name}: {m.description}"]
    if m.radius > 0:
        lines.append(f"principal moments {' '.join(f'{x:.5g}' for x in m.inertia)} u Å²")
    legend = [
        (short_source(m), bool(m.source)),
        ("charges in e", m.charges.any()),
        ("discs: Lennard-Jones diameters", (m.epsilon > 0).any()),
        ("diamonds: massless sites", (m.masses == 0).any()),
    ]
    lines.append("; ".join(text for text, is_drawn in legend if is_drawn))
    figure.text(0.03, 0.942, "\n".join(lines), fontsize=FONT, linespacing=1.35, **plain)
    save_files(figure, path.with_suffix(""), [path.suffix[1:]])


def _view(m: Molecule) -> np.ndarray:
    """Rotation (3, 3) from the principal frame to right, up and towards the viewer; flat bodies
    face the viewer."""
    if m.planar or m.kind in ("point", "linear"):
        return np.eye(3)
    a, b = np.radians([AZIMUTH, LIFT])
    about_up = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    return np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]]) @ about_up


def _links(axes, m: Molecule, projected: np.ndarray, radius: np.ndarray) -> list[tuple]:
    """Draw bonds between the surfaces of spheres. Returns points that labels must not cover."""
    taken = []
    for i, j in bonds(m):
        if m.masses[j] == 0:
            axes.plot(
                *projected[[i, j], :2].T, color=FAINT, lw=1.0, zorder=_order(projected[j, 2]) - 0.01
            )
            continue
        along = (projected[j] - projected[i]) / np.linalg.norm(projected[j] - projected[i])
        ends = np.array(
            [projected[i] + 0.9 * radius[i] * along, projected[j] - 0.9 * radius[j] * along]
        )
        for colour, width in (("#8f949b", 7.0), ("#c9cdd2", 4.0)):
            axes.plot(
                *ends[:, :2].T,
                color=colour,
                lw=width,
                solid_capstyle="butt",
                zorder=_order(ends[:, 2].mean()),
            )
        taken += [(*x, *x) for x in np.linspace(ends[0, :2], ends[1, :2], 12)]
    return taken


def _order(depth: float) -> float:
    """Drawing order within the layer of the molecule: nearer things later."""
    return 5.0 + np.tanh(depth / 5.0)


def _sphere(axes, m: Molecule, i: int, projected: Any, radius: float) -> None:
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Circle, RegularPolygon

    if m.masses[i] == 0:
        axes.add_patch(
            RegularPolygon(projected[:2], 4, radius=radius, fc="white", ec=COOL, lw=1.5, zorder=6.5)
        )
        return
    base, steps, order = (
        np.array(to_rgb(COLOURS.get(m.elements[i], OTHER))),
        24,
        _order(projected[2]),
    )
    for k in range(steps):
        fraction = k / (steps - 1)  # from the dark rim to the light spot
        colour = np.clip(
            base * (0.72 + 0.33 * fraction) + 0.55 * max(0.0, fraction - 0.45) ** 2, 0, 1
        )
        x, y = projected[:2] + fraction * np.array([-0.32 * radius, 0.36 * radius])
        axes.add_patch(
            Circle((x, y), radius * (1 - 0.93 * fraction), fc=colour, lw=0, zorder=order)
        )
    axes.add_patch(Circle(projected[:2], radius, fill=False, ec=0.55 * base, lw=0.8, zorder=order))


def _principal_axes(axes, m: Molecule, view: np.ndarray, half: float) -> list[tuple]:
    """Draw arrows along the axes, a ring for one towards the viewer. Returns boxes that labels must
    not cover."""
    if m.radius == 0:
        return []
    taken = []
    for k in range(3):
        if m.kind == "linear" and k > 0:
            break
        tip = 0.9 * half * view[:, k]
        if np.linalg.norm(tip[:2]) < 0.1 * half:
            axes.plot(0, 0, marker="o", ms=9, mfc="none", mec=INK, mew=1.0, zorder=7)
            axes.plot(0, 0, marker=".", ms=4, color=INK, zorder=7)
            continue
        style = {
            "arrowstyle": "-|>",
            "color": INK,
            "lw": 0.9,
            "alpha": 0.75,
            "shrinkA": 0,
            "shrinkB": 0,
        }
        axes.annotate("", tip[:2], (0, 0), arrowprops=style, zorder=3)
        at = tip[:2] + 0.04 * half * tip[:2] / np.linalg.norm(tip[:2])
        axes.text(
            *at,
            str(k + 1),
            color=INK,
            fontsize=FONT,
            ha="center",
            va="center",
            style="italic",
            zorder=8,
        )
        taken.append((*(at - 0.03 * half), *(at + 0.03 * half)))
        taken += [(*x, *x) for x in np.linspace(0, 1, 30)[:, None] * tip[:2]]
    return taken


def _labels(
    axes, m: Molecule, centres: np.ndarray, radius: np.ndarray, half: float, taken: list[tuple]
) -> None:
    """Draw names and charges in the first free direction, from outward on."""
    height = FONT * 1.25 / 72 * 2 * half / (INCHES * 0.96)
    for i in sorted(
        range(len(radius)), key=lambda i: (m.masses[i] > 0, -np.linalg.norm(centres[i]))
    ):
        text = f"{m.site_names[i]} {m.charges[i]:+.5g}" if m.charges[i] else m.site_names[i]
        size = np.array([0.56 * height * len(text), height])
        x, y = centres[i]
        outward = np.arctan2(y, x) if np.hypot(x, y) > 1e-6 * half else -np.pi / 2
        boxes = np.array(taken).reshape(-1, 4)  # left, bottom, right, top
        best = None
        for gap in (0.02, 0.08, 0.16, 0.26, 0.38, 0.52):
            for step in (0, 1, -1, 2, -2, 3, -3, 4, -4, 5, -5, 6, -6, 7, -7, 8):
                angle = outward + step * np.pi / 8
                way = np.array([np.cos(angle), np.sin(angle)])
                centre = centres[i] + way * (radius[i] + gap * half) + way * size / 2
                low, high = centre - size / 2, centre + size / 2
                cost = ((low < boxes[:, 2:]) & (boxes[:, :2] < high)).all(axis=1).sum()
                cost += (
                    np.linalg.norm(np.clip(centres, low, high) - centres, axis=1) < radius
                ).sum()
                cost += 10 * (np.abs([low, high]).max() > 0.99 * half)
                if best is None or cost < best[0]:
                    best = (cost, centre, low, high, gap)
            if best[0] == 0:
                break
        _, centre, low, high, gap = best
        taken.append((*low, *high))
        if gap > 0.02:
            near = np.clip(centres[i], low, high)
            axes.plot(*np.array([centres[i], near]).T, color=FAINT, lw=0.7, zorder=6.4)
        style = {
            "color": INK,
            "fontsize": FONT,
            "ha": "center",
            "va": "center",
            "parse_math": False,
        }
        axes.text(*centre, text, zorder=9, **style)
