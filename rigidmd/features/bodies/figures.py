"""Figures of a single body: path of its axis, Euler angles, ellipsoids, path in space, errors of
the invariants."""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from rigidmd.features.bodies.motion import Motion, drawn_axis
from rigidmd.features.bodies.system import BodySystem
from rigidmd.features.bodies.translation import InertialFrame
from rigidmd.features.view.figures.panels import Panel, Timeline, draw_rows, stack
from rigidmd.features.view.figures.space import (
    UP,
    View,
    camera,
    circle,
    draw_line,
    globe,
    path_style,
)
from rigidmd.features.view.figures.style import (
    COOL,
    FAINT,
    INK,
    TEXT,
    TITLE,
    WARM,
    new_figure,
    open_axis,
)
from rigidmd.mechanics.free_rotor import SplitRotor

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rigidmd.features.view.figures.picture import Picture

#: Errors of exactly 0 are drawn at this value, whose tick is labelled 0.
FLOOR = 1e-17
#: Names of errors in legends.
LABELS = {"L_lab_error": "L in the lab", "L_size_error": "|L|"}
NOTE = {"loc": "left", "fontsize": TITLE, "color": FAINT}
DASHED = (0, (5, 4))
FIGURES = ("axis", "angles", "ellipsoids", "omega", "path", "invariants")
#: Inches: width and height of pictures, and width of the curves next to them.
SIDE, SERIES = 4.6, 4.4


def body_figures(system: BodySystem, samples: Motion) -> "dict[str, Picture]":
    """The figures of FIGURES that the columns allow, under a title with the name of the run. None
    for two samples."""
    if len(samples) <= 2:
        return {}
    return {stem: figure for stem, figure in _Figures(system, samples).all() if figure is not None}


class _Figures:
    """The figures of one motion."""

    def __init__(self, system: BodySystem, samples: Motion):
        self.system, self.invariants = system, samples.invariants
        self.columns, gravity = dict(samples.columns), system.scene.gravity
        if system.rotates:  # omega along the principal axes, where it lies on ellipsoids
            self.omega = self.stacked(*(f"omega_body_{k}" for k in (1, 2, 3))) @ system.axes
            self.columns |= {f"omega_body_{k + 1}": self.omega[:, k] for k in range(3)}
        self.down = None
        if gravity is not None and np.any(gravity.acceleration_m_s2):
            down = np.array(gravity.acceleration_m_s2)
            self.down = down / np.linalg.norm(down)
        self.times = timeline(self.columns)
        self.panels = body_panels(system, self.columns)

    def stacked(self, *names: str) -> np.ndarray:
        return np.stack([self.columns[name] for name in names], axis=-1)

    def rows(self, panels: list[Panel]) -> list[list[tuple[Timeline, Panel]]]:
        return [[(self.times, panel)] for panel in panels]

    def title(self, text: str) -> str:
        return f"{self.system.scene.name}: {text}"

    def all(self) -> "Iterator[tuple[str, Picture | None]]":
        """The figures by the stems of their files."""
        if "q11" in self.columns:
            yield "axis", self.axis()
        if "angles" in self.panels:
            title = self.title(f"Euler angles (3-1-3){self.doubt()}")
            yield "angles", stack(self.rows(self.panels["angles"]), title)
        if "omega" in self.panels:
            # omega stays on ellipsoids if the inertia is constant, the frame does not rotate, and
            # no torque acts
            body, system = self.system.body, self.system
            steady = isinstance(body.rotor, SplitRotor) and isinstance(body.frame, InertialFrame)
            if steady and "L_size" in self.invariants and np.min(system.inertia) > 0:
                yield "ellipsoids", self.ellipsoids(np.asarray(system.inertia, float))
            else:
                title = self.title("ω in the body frame")
                yield "omega", stack(self.rows(self.panels["omega"]), title, 3.6)
        if self.panels.get("position"):
            yield "path", self.path()
        errors = []
        for key in [f"{key}_error" for key in (*self.invariants, "orthogonality")]:
            error = np.abs(self.columns.get(key, np.nan))
            if np.isfinite(error).any():
                most = np.nanmax(error)
                bound = f"at most {most:.1e}" if most > 0 else "exactly 0"
                errors.append((f"{LABELS.get(key, key.removesuffix('_error'))}: {bound}", error))
        if errors:
            title = self.title("errors of the invariants")
            yield "invariants", stack(self.rows([error_panel(errors)]), title, 4.0)

    def doubt(self) -> str:
        """A note if the Euler angles cannot be followed."""
        if "omega_body_1" in self.columns:
            speed = np.linalg.norm(self.omega, axis=1)
            if (speed[1:] * np.diff(self.times.time)).max() > np.pi:
                return ". The body rotates by more than 180° between samples: not all are counted"
        if np.abs(np.diff(np.unwrap(self.columns["phi"]))).max() > np.pi / 2:
            return "; φ and ψ jump where θ passes 0° or 180°: they are undefined there"
        return ""

    def axis(self) -> "Picture":
        """The body axis on the unit sphere and seen along z, enlarged if it stays in a small part
        of the disc."""
        Q = self.stacked(*(f"q{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))).reshape(-1, 3, 3)
        path = Q @ np.asarray(drawn_axis(self.system), float)
        polar = np.degrees(np.arctan2(np.hypot(path[:, 0], path[:, 1]), path[:, 2]))
        side, word = (1.0, "above") if path[:, 2].mean() > -1e-9 else (-1.0, "below")
        azimuth, lift = np.arctan2(path[0, 1], path[0, 0]) - np.radians(25), side * np.radians(25)
        eye = np.array(
            [np.cos(azimuth) * np.cos(lift), np.sin(azimuth) * np.cos(lift), np.sin(lift)]
        )
        figure = new_figure(9, 4.9, title=self.title("path of the body axis"))
        left, right = figure.subplots(1, 2)
        sphere = View(left, camera(eye), 1.12)
        sphere.ellipsoids(np.ones((1, 3)), [FAINT])
        sphere.curve(globe(), (0.45, 0.12), color=FAINT, lw=0.4)
        extremes = [circle(UP, polar.min()), circle(UP, polar.max())]
        for ring in extremes:
            sphere.curve(ring, (0.6, 0.2), color=INK, lw=0.7, ls=DASHED)
        sphere.path(path, COOL)
        sphere.triad("xyz", self.down)
        left.set_title(f"from 25° {word} the horizon. The dot is the start", y=1.0, **NOTE)
        view = camera(side * UP, np.eye(3)[1])
        flat = path @ view[:2].T
        near = 0.625 * np.ptp(flat, axis=0).max()
        enlarged = 1e-6 < near < 0.4
        centre = (flat.max(0) + flat.min(0)) / 2 if enlarged else np.zeros(2)
        disc = View(right, view, near if enlarged else 1.12, centre)
        for ring, style in [(circle(UP), "-"), *((ring, DASHED) for ring in extremes)]:
            draw_line(right, disc.flat(ring), color=FAINT, lw=0.9, ls=style)
        right.plot([-1, 1, np.nan, 0, 0], [0, 0, np.nan, -1, 1], color=FAINT, lw=0.4, alpha=0.6)
        disc.path(path, COOL)
        disc.triad("xy")
        zoom = f", enlarged {_enlargement(1.12 / near)}" if enlarged else ""
        right.set_title(f"from {word}{zoom}; dashed: θ {angle_range(polar)}", y=1.0, **NOTE)
        return figure

    def ellipsoids(self, inertia: np.ndarray) -> "Picture | None":
        """ω in the body frame on the ellipsoids of energy and momentum, seen from its side."""
        time, omega = self.times.time, self.omega
        energies, fastest = omega**2 @ inertia, np.linalg.norm(omega, axis=1).max()
        if fastest == 0:
            return None
        at = 0 if energies[0] > 1e-3 * energies.max() else int(energies.argmax())
        energy = np.sqrt(energies[at] / inertia)
        momentum = np.linalg.norm(inertia * omega[at]) / inertia
        order, mean = np.argsort(inertia, kind="stable"), omega.mean(0) / fastest
        eye = np.array([0.5, 0.75, 0.45])[np.argsort(order)]
        view = camera(eye * np.where(mean < -1e-6, -1.0, 1.0) + 0.6 * mean, np.eye(3)[order[2]])
        depth = np.minimum(omega / energy**2 @ view[2], omega / momentum**2 @ view[2])
        flat = omega @ view[:2].T
        whole = [
            max(np.linalg.norm(semi * side) for semi in (energy, momentum)) for side in view[:2]
        ]
        half = 1.06 * np.minimum(np.maximum(whole, np.abs(flat).max(0)), 2.5 * fastest)
        half = np.maximum(half, 0.8 * half[::-1])
        near, middle = 0.75 * np.ptp(flat, axis=0).max(), (flat.max(0) + flat.min(0)) / 2
        title = f"energy (blue), momentum (red), t = {time[at]:g} s; dot: start"
        boxes = [(half, np.zeros(2), title)]
        if 1e-6 * half.max() < near < 0.2 * half.max():
            zoom = f"the path, enlarged {_enlargement(half.max() / near)}"
            boxes.append((np.full(2, near), middle, zoom))
        figure, axes = self.with_curves("omega", "ω in the body frame", len(boxes))
        for axis, (half, centre, title) in zip(axes, boxes, strict=True):
            picture = View(axis, view, half, centre)
            picture.ellipsoids(np.stack([energy, momentum]), [COOL, WARM])
            picture.path(omega, INK, depth)
            picture.triad(("ω₁", "ω₂", "ω₃"))
            axis.set_title(title, **NOTE)
        return figure

    def with_curves(self, family: str, title: str, count: int) -> "tuple[Picture, list[Axes]]":
        """A figure with curves against time on the left, and the axes of its pictures."""
        width = SERIES + SIDE * count
        figure = new_figure(width, SIDE, layout=None, title=self.title(title))
        draw_rows(figure, self.rows(self.panels[family]), (0.0, 0.02, SERIES, SIDE - 0.35))
        size = np.array([width, SIDE] * 2)
        boxes = [
            np.array([SERIES + SIDE * k + 0.7, 0.5, SIDE - 0.8, SIDE - 1.15]) for k in range(count)
        ]
        return figure, [figure.add_axes(tuple(box / size)) for box in boxes]

    def path(self) -> "Picture | None":
        """Coordinates of the centre of mass against time, its path in a vertical plane and from
        above."""
        position, least, down = self.stacked(*"xyz"), self.panels["position"][0].least, self.down
        if not np.ptp(position, axis=0).max() > least:
            return None
        up = UP if down is None else -down
        level = position - position.mean(0)
        level -= np.outer(level @ up, up)
        along = np.linalg.eigh(level.T @ level - (level**2).sum() * np.outer(up, up))[1][:, -1]
        still = np.ptp(level @ along) < least
        plain = [
            unit
            for unit in np.eye(3)
            if abs(unit @ up) < 1e-9 and (still or abs(unit @ along) > 0.9998)
        ]
        along = plain[0] if plain else along * np.sign(along[np.abs(along).argmax()])
        planes = [("in the vertical plane", along, up)]
        if np.ptp(level @ np.cross(up, along)) > least:
            first = along if abs(up[2]) < 1 - 1e-9 else np.eye(3)[0]
            planes.append(("from above", first, np.cross(up, first)))
        figure, axes = self.with_curves("position", "path of the centre of mass", len(planes))
        for axis, (title, right, upward) in zip(axes, planes, strict=True):
            _draw_plane(axis, title, position, np.stack([right, upward]), least)
        return figure


def _draw_plane(
    axis: "Axes", title: str, position: np.ndarray, plane: np.ndarray, least: float
) -> None:
    """The path in one plane, with equal scales if possible. Otherwise the title states the
    distortion."""
    flat = position @ plane.T
    span, centre = np.ptp(flat, axis=0), (flat.max(0) + flat.min(0)) / 2
    half = 0.55 * span
    if min(span) < least or max(span) < 8 * min(span):
        half = np.full(2, max(half))
        axis.set_aspect("equal")
    else:
        ratio = _enlargement(max(span) / min(span))
        title += f"; drawn {ratio} too {'wide' if span[1] > span[0] else 'tall'}"
    shown, width = path_style(flat, half)
    draw_line(axis, flat[shown], COOL, width)
    axis.plot(*flat[0], "o", color=WARM, ms=5, zorder=4)
    names = []
    for side in plane:
        vector = ", ".join(f"{part:.3g}" for part in side + 0.0)
        is_axis = side.max() > 1 - 1e-9
        names.append(f"{'xyz'[side.argmax()] if is_axis else f'along ({vector})'} (m)")
    axis.set(xlabel=names[0], ylabel=names[1])
    (left, low), (right, high) = centre - half, centre + half
    axis.axis((left, right, low, high))
    axis.set_title(f"{title}; dot: start", **NOTE)
    axis.locator_params(nbins=4)
    for line in (axis.xaxis, axis.yaxis):
        line.set_major_formatter("{x:.6g}")
    open_axis(axis, labelsize=TEXT)


def _enlargement(factor: float) -> str:
    """An enlargement to two digits."""
    return f"×{float(f'{factor:.2g}'):,g}"


def timeline(columns: Mapping[str, np.ndarray]) -> Timeline:
    time = columns["time"]
    return Timeline(np.ones(len(time), bool), time, np.zeros(len(time), int), "s")


def body_panels(system: BodySystem, columns: Mapping[str, np.ndarray]) -> dict[str, list[Panel]]:
    """Panels by what they show: angles, omega, position, energy, invariants."""
    families: dict[str, list[Panel]] = {}
    if "theta" in columns:
        families["angles"] = _angle_panels(columns)
    if "omega_body_1" in columns:
        omega = [(f"ω{'₁₂₃'[k - 1]}", columns[f"omega_body_{k}"]) for k in (1, 2, 3)]
        families["omega"] = [Panel("angular velocity in the body frame", omega, "rad/s")]
    if system.translates:
        position = np.stack([columns[key] for key in "xyz"])
        least = 1e-11 * np.ptp(position, axis=1).max() + 1e-13 * np.abs(position).max()
        families["position"] = [
            Panel(f"{key} of the centre of mass", [("", values)], "m", least=least)
            for key, values in zip("xyz", position, strict=True)
            if np.ptp(position) > 0
        ]
    energies = [(name, columns[name]) for name in ("kinetic", "potential", "energy")]
    families["energy"] = [Panel("energies", energies, "J")]
    errors = [
        (LABELS.get(name, name.removesuffix("_error")), np.abs(values))
        for name, values in columns.items()
        if name.endswith("_error") and np.isfinite(values).any()
    ]
    families["invariants"] = [error_panel(errors)] if errors else []
    return families


def error_panel(errors: list[tuple[str, np.ndarray]]) -> Panel:
    """Relative errors of what is conserved, on a logarithmic axis."""
    rounding = float(np.finfo(float).eps)
    title = f"relative errors (dotted: rounding, {rounding:.1e})"
    curves = [(label, np.maximum(error, FLOOR)) for label, error in errors]
    return Panel(title, curves, log=True, level=rounding, zero=FLOOR)


def _angle_panels(columns: Mapping[str, np.ndarray]) -> list[Panel]:
    """The Euler angles: φ and ψ continuous over full rotations."""
    angles = {name: columns[name].copy() for name in ("phi", "theta", "psi")}
    phi, theta, psi = angles.values()
    # at θ = 0 or 180° only the sum or the difference of φ and ψ is defined: φ has its value in the
    # next sample
    for k in np.flatnonzero(np.sin(theta[:-1]) < 1e-12)[::-1]:
        psi[k] += (phi[k] - phi[k + 1]) * np.sign(np.cos(theta[k]))
        phi[k] = phi[k + 1]
    found = []
    for name, angle in zip("φθψ", (np.unwrap(phi), theta, np.unwrap(psi)), strict=True):
        degrees = np.degrees(angle)
        change = angle_range(degrees)
        if name != "θ" and np.ptp(degrees) > 1e-5:
            first, last = np.round(degrees[[0, -1]], 6) + 0.0
            change = f"from {first:.6g}° to {last:.6g}°"
        found.append(Panel(f"{name}, {change}", [("", degrees)], "degrees", least=1e-5))
    return found


def angle_range(degrees: np.ndarray) -> str:
    """A range of degrees as text, with enough digits to distinguish its ends."""
    low, high = degrees.min(), degrees.max()
    if high - low < 1e-5:
        size = f" to {high - low:.0e}°" if high > low else ""
        return f"{round(low, 6) + 0.0:.8g}°, constant{size}"
    digits = int(np.clip(2 - np.floor(np.log10(high - low)), 1, 8))
    return f"from {low:.{digits}f}° to {high:.{digits}f}°"
