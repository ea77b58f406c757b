"""Molecular models as pictures: atoms as spheres, Lennard-Jones diameters, charges, massless
sites, principal axes."""

from itertools import product
from pathlib import Path

import numpy as np

from rigidmd.assemble.model_text import short_source
from rigidmd.features.view.figures.space import View, camera
from rigidmd.features.view.figures.style import COOL, FAINT, INK, new_figure, save_files
from rigidmd.formats.bonds import COVALENT, bonds
from rigidmd.io.write import check_target
from rigidmd.scene.models import Molecule

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
#: Direction of the eye of bodies that are not flat.
EYE = np.array([-0.4, 0.34, 0.85])
INCHES, FONT = 7.0, 9.0
#: Gaps between a sphere and its label in half widths, and steps of 22.5° from outward, by
#: preference.
GAPS = (0.02, 0.08, 0.16, 0.26, 0.38, 0.52)
STEPS = sorted(range(-7, 9), key=abs)


def color_of(element: str) -> np.ndarray:
    """Red, green and blue of an element, 0 to 1."""
    digits = COLOURS.get(element, OTHER)
    return np.array([int(digits[k : k + 2], 16) for k in (1, 3, 5)]) / 255


def write_molecule_figure(path: Path, m: Molecule, *, force: bool = False) -> None:
    """Draw a molecule into a file, whose extension sets the format. Raises OutputError."""
    from matplotlib.patches import Circle

    check_target(path, EXTENSIONS, force=force, what="figure")
    is_flat = m.planar or m.kind in ("point", "linear")
    matrix = np.eye(3) if is_flat else camera(EYE, np.array([0.0, 1.0, 0.0]))
    covalent = np.array([COVALENT.get(element, 0.0) for element in m.elements])
    radius = np.where(covalent > 0, OF_COVALENT * covalent, OF_DIAMETER * m.sigma)
    radius = np.where(m.masses > 0, np.maximum(LEAST, radius), LEAST / 2)
    reach = np.maximum(radius, np.where(m.epsilon > 0, m.sigma / 2, 0.0))
    flat = m.positions_body @ matrix[:2].T
    half = float(1.12 * (np.abs(flat).max(axis=1) + reach).max())
    figure = new_figure(INCHES, INCHES * 1.12, layout=None)
    view = View(figure.add_axes((0.02, 0.02, 0.96, 0.96 / 1.12)), matrix, half)
    for i in np.flatnonzero(m.epsilon > 0).tolist():
        color = color_of(m.elements[i] if m.elements[i] != "H" else "")
        disc = {"xy": flat[i], "radius": m.sigma[i] / 2, "zorder": 1}
        view.axis.add_patch(Circle(**disc, fc=color, alpha=0.07, lw=0))
        view.axis.add_patch(
            Circle(**disc, fill=False, ec=color, alpha=0.45, lw=0.8, ls=(0, (4, 3)))
        )
    taken = [*_axes(view, m), *_bonds(view, m, radius)]
    for i, order in enumerate(_order(view, m.positions_body)):
        if m.masses[i] > 0:
            color = color_of(m.elements[i])
            view.spheres(m.positions_body[i : i + 1], radius[i : i + 1], color[None], order)
        else:
            view.axis.plot(*flat[i], "D", ms=6, mfc="white", mec=COOL, mew=1.5, zorder=6.5)
    _labels(view, m, radius, taken)
    length = 1.0 if half > 1.6 else 0.5
    view.scale(length, f"{length:g} Å")
    title = m.title or m.name
    plain = {"color": INK, "va": "top", "parse_math": False}
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


def _order(view: View, points: np.ndarray) -> np.ndarray:
    """Drawing order within the layer of the molecule: nearer things later."""
    return 5.0 + np.tanh(view.depth(points) / 5.0)


def _bonds(view: View, m: Molecule, radius: np.ndarray) -> list[np.ndarray]:
    """Draw bonds between the surfaces of spheres. Returns points that labels must not cover."""
    taken = []
    for i, j in bonds(m):
        ends = m.positions_body[[i, j]]
        order = _order(view, ends.mean(axis=0))
        if m.masses[j] == 0:
            view.axis.plot(*view.flat(ends).T, color=FAINT, lw=1.0, zorder=order - 0.01)
            continue
        along = 0.9 * (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        flat = view.flat(ends + np.outer([radius[i], -radius[j]], along))
        for color, width in (("#8f949b", 7.0), ("#c9cdd2", 4.0)):
            view.axis.plot(*flat.T, color=color, lw=width, solid_capstyle="butt", zorder=order)
        taken += [*np.linspace(flat[0], flat[1], 12)]
    return taken


def _axes(view: View, m: Molecule) -> list[np.ndarray]:
    """Draw the principal axes as arrows, a ring for one towards the viewer. Returns points that
    labels must not cover."""
    taken = []
    count = 0 if m.radius == 0 else 1 if m.kind == "linear" else 3
    for k, tip in enumerate(0.9 * view.half.max() * np.eye(3)[:count]):
        name = view.arrow(np.zeros(3), tip, INK, str(k + 1), lw=0.9, fontsize=FONT, zorder=3)
        if name is None:
            view.axis.plot(0, 0, "o", ms=9, mfc="none", mec=INK, zorder=7)
            view.axis.plot(0, 0, ".", ms=4, color=INK, zorder=7)
        else:
            taken += [*np.linspace(np.zeros(2), name, 30)]
    return taken


def _labels(view: View, m: Molecule, radius: np.ndarray, taken: list[np.ndarray]) -> None:
    """Draw names and charges at the first free position, from outward on."""
    centres = view.flat(m.positions_body)
    half = view.half.max()
    height = FONT * 1.25 / 72 * 2 * half / (INCHES * 0.96)
    points = np.array(taken).reshape(-1, 2)
    inner = 0.8 * radius[:, None]
    lows = np.vstack([points, centres - inner])
    highs = np.vstack([points, centres + inner])
    for i in np.lexsort((-np.linalg.norm(centres, axis=1), m.masses > 0)):
        text = f"{m.site_names[i]} {m.charges[i]:+.5g}" if m.charges[i] else m.site_names[i]
        size = np.array([0.56 * height * len(text), height])
        x, y = centres[i]
        outward = np.arctan2(y, x) if np.hypot(x, y) > 1e-6 * half else -np.pi / 2
        gap, step = np.array([*product(GAPS, STEPS)]).T[..., None]
        way = np.hstack([np.cos(outward + step * np.pi / 8), np.sin(outward + step * np.pi / 8)])
        middle = centres[i] + way * (radius[i] + gap * half + size / 2)
        low, high = middle - size / 2, middle + size / 2
        covers = (low[:, None] < highs) & (lows < high[:, None])
        outside = np.abs([low, high]).max(axis=(0, 2)) > 0.99 * half
        best = (covers.all(axis=2).sum(axis=1) + 10 * outside).argmin()
        lows, highs = np.vstack([lows, low[best]]), np.vstack([highs, high[best]])
        if gap[best] > GAPS[0]:
            line = [centres[i], np.clip(centres[i], low[best], high[best])]
            view.axis.plot(*np.array(line).T, color=FAINT, lw=0.7, zorder=6.4)
        view.axis.text(
            middle[best, 0],
            middle[best, 1],
            text,
            color=INK,
            fontsize=FONT,
            ha="center",
            va="center",
            parse_math=False,
            zorder=9,
        )
