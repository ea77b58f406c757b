"""A picture of a model: atoms as spheres, Lennard-Jones diameters, charges, massless sites, principal axes."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from rigidmd.core.files import atomic_file
from rigidmd.figures.style import COOL, FAINT, INK, draw_scale, new_figure, save_figure, settings
from rigidmd.io.formats.bonds import COVALENT, bonds
from rigidmd.io.write import check_target
from rigidmd.scene.models import Molecule
from rigidmd.view.molecule_text import short_source

EXTENSIONS = (".png", ".svg", ".pdf")
#: Colours of the elements, after Corey, Pauling and Koltun, and of all others.
COLOURS = {
    "H": "#f0f0f0", "C": "#5a5f66", "N": "#3f63d6", "O": "#d8392f", "F": "#7cc95a", "S": "#e3bf2b", "Cl": "#3fa34d",
    "Li": "#a374d5", "Na": "#8a4fc9", "K": "#7440b5", "Rb": "#60309c", "Cs": "#4d2384", "Br": "#9c4a2f", "I": "#7a3f8f",
    "Ne": "#8fd3e0", "Ar": "#6fc1d3", "Kr": "#56a9c0", "Xe": "#3f8fa8",
}  # fmt: skip
OTHER = "#b0b4ba"
#: Radius of a sphere as a fraction of the covalent radius, or else of the Lennard-Jones diameter.
OF_COVALENT, OF_DIAMETER, LEAST = 0.62, 0.2, 0.22
#: View of bodies that are not flat: degrees about the vertical, then towards the viewer.
AZIMUTH, LIFT = 25.0, 20.0
INCHES, FONT = 7.0, 9.0


class _Sphere(NamedTuple):
    centre: tuple[float, float]  # Å
    depth: float  # Å, towards the viewer
    radius: float  # Å


def write_molecule_figure(path: Path, m: Molecule, force: bool = False) -> None:
    """Draw a molecule into a file, whose extension sets the format. Raises OutputError."""
    check_target(path, EXTENSIONS, force, "figure")
    view = _view(m)
    seen = m.positions_body @ view.T  # right, up, towards the viewer
    spheres = [_Sphere((x, y), depth, _radius(m, i)) for i, (x, y, depth) in enumerate(seen.tolist())]
    reach = [max(s.radius, m.sigma[i] / 2 if m.epsilon[i] > 0 else 0.0) for i, s in enumerate(spheres)]
    half = 1.12 * max(np.abs(s.centre).max() + r for s, r in zip(spheres, reach, strict=True))
    figure = new_figure(INCHES, INCHES * 1.12, layout=None)
    axes = figure.add_axes((0.02, 0.02, 0.96, 0.96 / 1.12), aspect="equal", xlim=(-half, half), ylim=(-half, half))
    axes.set_axis_off()
    _diameters(axes, m, spheres)
    bonded = _links(axes, m, seen, spheres)
    for i in np.argsort(seen[:, 2], kind="stable"):
        _sphere(axes, m, i, spheres[i])
    taken = _principal_axes(axes, m, view, half)
    _labels(axes, m, spheres, half, taken + bonded)
    length = 1.0 if half > 1.6 else 0.5
    draw_scale(axes, length - 0.96 * half, -0.95 * half, length, f"{length:g} Å", FONT)
    title, plain = m.title or m.name, {"color": INK, "va": "top", "parse_math": False}
    figure.text(0.03, 0.975, title, fontsize=min(13.0, 780 / len(title)), weight="bold", **plain)
    lines = [f"{m.name}: {m.description}"]
    if m.radius > 0:
        lines.append(f"principal moments {' '.join(f'{x:.5g}' for x in m.inertia)} u Å²")
    legend = [
        (short_source(m), bool(m.source)), ("charges in e", m.charges.any()),
        ("discs: Lennard-Jones diameters", (m.epsilon > 0).any()), ("diamonds: massless sites", (m.masses == 0).any()),
    ]  # fmt: skip
    lines.append("; ".join(text for text, there in legend if there))
    figure.text(0.03, 0.942, "\n".join(lines), fontsize=FONT, linespacing=1.35, **plain)
    with settings({"svg.hashsalt": m.name}), atomic_file(path) as temporary:
        metadata = {"Date": None} if path.suffix == ".svg" else None
        save_figure(figure, temporary, dpi=150, metadata=metadata)


def _view(m: Molecule) -> np.ndarray:
    """Rotation (3, 3) from the principal frame to right, up and towards the viewer; flat bodies face the viewer."""
    if m.planar or m.kind in ("point", "linear"):
        return np.eye(3)
    a, b = np.radians([AZIMUTH, LIFT])
    about_up = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    forward = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    return forward @ about_up


def _radius(m: Molecule, i: int) -> float:
    if m.masses[i] == 0:
        return LEAST / 2
    covalent = COVALENT.get(m.elements[i])
    return max(LEAST, OF_COVALENT * covalent if covalent else OF_DIAMETER * m.sigma[i])


def _colour(m: Molecule, i: int) -> str:
    return COLOURS.get(m.elements[i], OTHER)


def _diameters(axes, m: Molecule, spheres: list[_Sphere]) -> None:
    from matplotlib.patches import Circle

    for i in np.flatnonzero(m.epsilon > 0).tolist():
        colour = _colour(m, i) if m.elements[i] != "H" else OTHER
        axes.add_patch(Circle(spheres[i].centre, m.sigma[i] / 2, fc=colour, alpha=0.07, lw=0, zorder=1))
        axes.add_patch(
            Circle(
                spheres[i].centre, m.sigma[i] / 2, fill=False, ec=colour, alpha=0.45, lw=0.8, ls=(0, (4, 3)), zorder=1
            )
        )


def _links(axes, m: Molecule, seen: np.ndarray, spheres: list[_Sphere]) -> list[tuple]:
    """Draw bonds between the surfaces of spheres. Returns points that labels must not cover."""
    taken = []
    for i, j in bonds(m):
        if m.masses[j] == 0:
            axes.plot(*seen[[i, j], :2].T, color=FAINT, lw=1.0, zorder=_order(seen[j, 2]) - 0.01)
            continue
        along = (seen[j] - seen[i]) / np.linalg.norm(seen[j] - seen[i])
        ends = np.array([seen[i] + 0.9 * spheres[i].radius * along, seen[j] - 0.9 * spheres[j].radius * along])
        for colour, width in (("#8f949b", 7.0), ("#c9cdd2", 4.0)):
            axes.plot(*ends[:, :2].T, color=colour, lw=width, solid_capstyle="butt", zorder=_order(ends[:, 2].mean()))
        taken += [(*x, *x) for x in np.linspace(ends[0, :2], ends[1, :2], 12)]
    return taken


def _order(depth: float) -> float:
    """Drawing order within the layer of the molecule: nearer things later."""
    return 5.0 + np.tanh(depth / 5.0)


def _sphere(axes, m: Molecule, i: int, sphere: _Sphere) -> None:
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Circle, RegularPolygon

    order = _order(sphere.depth)
    if m.masses[i] == 0:
        style = {"fc": "white", "ec": COOL, "lw": 1.5, "zorder": 6.5}
        axes.add_patch(RegularPolygon(sphere.centre, 4, radius=sphere.radius, **style))
        return
    base, steps = np.array(to_rgb(_colour(m, i))), 24
    (x, y), towards_light = sphere.centre, (-0.32 * sphere.radius, 0.36 * sphere.radius)
    for k in range(steps):
        fraction = k / (steps - 1)  # from the dark rim to the light spot
        colour = np.clip(base * (0.72 + 0.33 * fraction) + 0.55 * max(0.0, fraction - 0.45) ** 2, 0, 1)
        centre = x + fraction * towards_light[0], y + fraction * towards_light[1]
        spot = Circle(centre, sphere.radius * (1 - 0.93 * fraction), fc=colour, lw=0)
        spot.set_zorder(order)
        axes.add_patch(spot)
    axes.add_patch(Circle(sphere.centre, sphere.radius, fill=False, ec=0.55 * base, lw=0.8, zorder=order))


def _principal_axes(axes, m: Molecule, view: np.ndarray, half: float) -> list[tuple]:
    """Draw arrows along the axes, a ring for one towards the viewer. Returns boxes that labels must not cover."""
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
        style = {"arrowstyle": "-|>", "color": INK, "lw": 0.9, "alpha": 0.75, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", tip[:2], (0, 0), arrowprops=style, zorder=3)
        at = tip[:2] + 0.04 * half * tip[:2] / np.linalg.norm(tip[:2])
        axes.text(*at, str(k + 1), color=INK, fontsize=FONT, ha="center", va="center", style="italic", zorder=8)
        taken.append((*(at - 0.03 * half), *(at + 0.03 * half)))
        taken += [(*x, *x) for x in np.linspace(0, 1, 30)[:, None] * tip[:2]]
    return taken


def _labels(axes, m: Molecule, spheres: list[_Sphere], half: float, taken: list[tuple]) -> None:
    """Draw names and charges in the first free direction, from outward on."""
    height = FONT * 1.25 / 72 * 2 * half / (INCHES * 0.96)
    for i in sorted(range(len(spheres)), key=lambda i: (m.masses[i] > 0, -np.linalg.norm(spheres[i].centre))):
        text = f"{m.site_names[i]} {m.charges[i]:+.5g}" if m.charges[i] else m.site_names[i]
        size = np.array([0.56 * height * len(text), height])
        x, y = spheres[i].centre
        outward = np.arctan2(y, x) if np.hypot(x, y) > 1e-6 * half else -np.pi / 2
        best = None
        for gap in (0.02, 0.08, 0.16, 0.26, 0.38, 0.52):
            for step in (0, 1, -1, 2, -2, 3, -3, 4, -4, 5, -5, 6, -6, 7, -7, 8):
                angle = outward + step * np.pi / 8
                way = np.array([np.cos(angle), np.sin(angle)])
                centre = spheres[i].centre + way * (spheres[i].radius + gap * half) + way * size / 2
                box = (*(centre - size / 2), *(centre + size / 2))
                cost = sum(_overlap(box, other) for other in taken) + sum(_covers(box, s) for s in spheres)
                cost += 10 * (np.abs(np.array(box)).max() > 0.99 * half)
                if best is None or cost < best[0]:
                    best = (cost, centre, box, gap)
            if best[0] == 0:
                break
        _, centre, box, gap = best
        taken.append(box)
        if gap > 0.02:
            near = np.clip(spheres[i].centre, box[:2], box[2:])
            axes.plot(*np.array([spheres[i].centre, near]).T, color=FAINT, lw=0.7, zorder=6.4)
        style = {"color": INK, "fontsize": FONT, "ha": "center", "va": "center", "parse_math": False}
        axes.text(*centre, text, zorder=9, **style)


def _overlap(one: tuple, other: tuple) -> bool:
    """Whether two boxes (left, bottom, right, top) overlap."""
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def _covers(box: tuple, sphere: _Sphere) -> bool:
    nearest = np.clip(sphere.centre, box[:2], box[2:])
    return bool(np.linalg.norm(nearest - sphere.centre) < sphere.radius)
