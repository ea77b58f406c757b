"""Figures of a single body: path of its axis, Euler angles, ellipsoids, path in space, errors of
the invariants."""

from typing import TYPE_CHECKING

import numpy as np

from rigidmd.engines.body_motion import Motion, drawn_axis
from rigidmd.engines.body_system import BodySystem
from rigidmd.figures.style import (
    COLORS,
    COOL,
    FAINT,
    INK,
    UP,
    WARM,
    camera,
    circle,
    draw_front_and_back,
    globe,
    new_figure,
    thin_series,
)
from rigidmd.mechanics.free_rotor import SplitRotor
from rigidmd.mechanics.translation import InertialFrame

if TYPE_CHECKING:
    from rigidmd.figures.picture import Picture

NOTE = {"loc": "left", "fontsize": 9, "color": FAINT}
DASHED = (0, (5, 4))
LABELS = {"L_lab": "L in the lab", "L_size": "|L|", "L_z": "L_z", "L_3": "L_3"}
OMEGA = ("ω₁ (rad/s)", "ω₂ (rad/s)", "ω₃ (rad/s)")
FIGURES = ("axis", "angles", "ellipsoids", "omega", "path", "invariants")
#: Lines with more points are rasterised in the SVG; level at which an error of exactly 0 is drawn.
MOST_POINTS, FLOOR = 10_000, 1e-17


def body_figures(system: BodySystem, samples: Motion) -> dict[str, "Picture"]:
    """The figures of FIGURES that the columns allow, under a title with the name of the run; none
    for two samples."""
    if len(samples) <= 2:
        return {}
    columns, gravity, figures = dict(samples.columns), system.scene.gravity, {}
    if system.rotates:  # omega along the principal axes, where it lies on ellipsoids
        omega = np.stack([samples[f"omega_body_{k}"] for k in (1, 2, 3)], axis=-1) @ system.axes
        columns |= {f"omega_body_{k + 1}": omega[:, k] for k in range(3)}
    down = None
    if gravity is not None and np.any(gravity.acceleration_m_s2):
        down = np.array(gravity.acceleration_m_s2) / np.linalg.norm(gravity.acceleration_m_s2)
    if "q11" in columns:
        figures["axis"] = _axis_figure(columns, np.asarray(drawn_axis(system), float), down)
    if "phi" in columns:
        figures["angles"] = _angles_figure(columns)
    if "omega_body_1" in columns:
        # omega stays on ellipsoids if the inertia is constant, the frame does not rotate, and no
        # torque acts
        steady = isinstance(system.body.rotor, SplitRotor) and isinstance(
            system.body.frame, InertialFrame
        )
        if steady and "L_size" in samples.invariants and np.min(system.inertia) > 0:
            figures["ellipsoids"] = _ellipsoids_figure(columns, np.asarray(system.inertia, float))
        else:
            omega = [columns[f"omega_body_{i}"] for i in "123"]
            fastest = max(np.abs(part).max() for part in omega)
            figures["omega"] = figure = new_figure(8, 6.4, title="ω in the body frame")
            cells, span = figure.add_gridspec(3, 1), 2 * fastest or 1.0
            _draw_series(figure, cells, columns["time"], omega, OMEGA, 1e-9 * fastest, span)
    if system.translates:
        figures["path"] = _path_figure(columns, down)
    figures["invariants"] = _invariants_figure(columns, samples.invariants)
    figures = {stem: figure for stem, figure in figures.items() if figure is not None}
    for figure in figures.values():
        figure.suptitle(
            f"{system.scene.name}: {figure.get_suptitle()}",
            color=INK,
            x=0.01,
            ha="left",
            fontsize=11,
        )
    return figures


def _axis_figure(columns: dict[str, np.ndarray], axis_body: np.ndarray, down: np.ndarray | None):
    """The body axis on the unit sphere and seen along z, enlarged if it stays in a small part of
    the disc."""
    path = np.stack(
        [sum(columns[f"q{i}{j}"] * axis_body[j - 1] for j in (1, 2, 3)) for i in (1, 2, 3)], axis=-1
    )
    polar = np.degrees(np.arctan2(np.hypot(path[:, 0], path[:, 1]), path[:, 2]))
    side, word = (1.0, "above") if path[:, 2].mean() > -1e-9 else (-1.0, "below")
    azimuth, lift = np.arctan2(path[0, 1], path[0, 0]) - np.radians(25), side * np.radians(25)
    eye = np.array([np.cos(azimuth) * np.cos(lift), np.sin(azimuth) * np.cos(lift), np.sin(lift)])
    sphere, disc = (figure := new_figure(10, 5.4, title="path of the body axis")).subplots(1, 2)
    view, half = camera(eye, UP), np.full(2, 1.12)
    _shade(sphere, [(np.ones(3), FAINT)], view, half, np.zeros(2))
    for ring in globe():
        draw_front_and_back(sphere, ring, view, ring @ eye, (0.45, 0.12), color=FAINT, lw=0.4)
    for ring in (extremes := [circle(UP, polar.min()), circle(UP, polar.max())]):
        draw_front_and_back(
            sphere, ring, view, ring @ eye, (0.6, 0.2), color=INK, lw=0.7, ls=DASHED
        )
    _draw_path(sphere, path, view, path @ eye, half, np.zeros(2), COOL)
    _triad(sphere, view, "xyz", down)
    sphere.set_title(f"from 25° {word} the horizon", y=1.0, **NOTE)
    view = camera(side * UP, np.eye(3)[1])
    flat = path @ view[:2].T
    centre, near = (flat.max(0) + flat.min(0)) / 2, 0.625 * np.ptp(flat, axis=0).max()
    enlarged = 1e-6 < near < 0.4
    centre, half = (centre, np.full(2, near)) if enlarged else (np.zeros(2), half)
    for ring, style in [(circle(UP), "-"), *((ring, DASHED) for ring in extremes)]:
        disc.plot(*view[:2] @ ring.T, color=FAINT, lw=0.9, ls=style)
    disc.plot([-1, 1, np.nan, 0, 0], [0, 0, np.nan, -1, 1], color=FAINT, lw=0.4, alpha=0.6)
    _draw_path(disc, path, view, path @ view[2], half, centre, COOL)
    _triad(disc, view, "xy")
    zoom = f", enlarged {_enlargement(1.12 / near)}" if enlarged else ""
    disc.set_title(f"from {word}{zoom}; dashed: its θ {_range(polar)}", y=1.0, **NOTE)
    _label_start(figure)
    return figure


def _label_start(figure) -> None:
    """A legend outside of the panels: the dot is the start."""
    from matplotlib.lines import Line2D

    dot = Line2D([], [], color=WARM, marker="o", ms=5, ls="none", label="start")
    figure.legend(
        handles=[dot], loc="outside upper right", frameon=False, fontsize=9, labelcolor=FAINT
    )


def _angles_figure(columns: dict[str, np.ndarray]):
    """The Euler angles against time: φ and ψ continuous over full rotations, θ with at least a
    minimum span."""
    time, theta = columns["time"], np.degrees(columns["theta"])
    phi, psi = columns["phi"].copy(), columns["psi"].copy()
    # at θ = 0 or 180° only the sum or the difference of φ and ψ is defined: φ has its value in the
    # next sample
    for k in np.flatnonzero(np.sin(columns["theta"][:-1]) < 1e-12)[::-1]:
        psi[k] += (phi[k] - phi[k + 1]) * np.sign(np.cos(columns["theta"][k]))
        phi[k] = phi[k + 1]
    angles = [np.degrees(np.unwrap(phi)), theta, np.degrees(np.unwrap(psi))]
    figure = new_figure(8, 6.4, title="Euler angles (3-1-3)")
    beyond_turn = [np.ptp(angle) > 360 for angle in angles]
    drawn = [
        angle / 360 if many else angle for angle, many in zip(angles, beyond_turn, strict=True)
    ]
    labels = [
        f"{name} ({'turns' if many else '°'})"
        for name, many in zip("φθψ", beyond_turn, strict=True)
    ]
    panels = _draw_series(
        figure, figure.add_gridspec(3, 1), time, drawn, labels, 1e-5, 1.0, (COOL, WARM, COOL)
    )
    panels[1].set_title(_range(theta), **NOTE)
    for panel, angle in zip(panels[::2], angles[::2], strict=True):
        first, last = np.round(angle[[0, -1]], 6) + 0.0
        text = f"from {first:.6g}° to {last:.6g}°: {(last - first) / 360:+.4g} turns"
        panel.set_title(text if np.ptp(angle) > 1e-5 else _range(angle), **NOTE)
    speed = (
        np.sqrt(sum(columns[f"omega_body_{i}"] ** 2 for i in "123"))
        if "omega_body_1" in columns
        else 0 * time
    )
    note = ""
    if (speed[1:] * np.diff(time)).max() > np.pi:
        note = "the body rotates by more than 180° between samples: not all rotations are counted"
    elif np.abs(np.diff(angles[0])).max() > 90:
        note = "φ and ψ jump where θ passes 0° or 180°: they are undefined there"
    if note:
        figure.supxlabel(note, fontsize=9, color=WARM, x=0.01, ha="left")
    return figure


def _ellipsoids_figure(columns: dict[str, np.ndarray], inertia: np.ndarray):
    """ω in the body frame on the ellipsoids of energy and momentum, seen from its side."""
    time, omega = columns["time"], np.stack([columns[f"omega_body_{i}"] for i in "123"], axis=-1)
    energies, fastest = omega**2 @ inertia, np.linalg.norm(omega, axis=1).max()
    if fastest == 0:
        return None
    at = 0 if energies[0] > 1e-3 * energies.max() else int(energies.argmax())
    energy, momentum = (
        np.sqrt(energies[at] / inertia),
        np.linalg.norm(inertia * omega[at]) / inertia,
    )
    order, mean = np.argsort(inertia, kind="stable"), omega.mean(0) / fastest
    eye = np.array([0.5, 0.75, 0.45])[np.argsort(order)]
    view = camera(eye * np.where(mean < -1e-6, -1.0, 1.0) + 0.6 * mean, np.eye(3)[order[2]])
    depth = np.minimum(omega / energy**2 @ view[2], omega / momentum**2 @ view[2])
    flat = omega @ view[:2].T
    whole = [max(np.linalg.norm(semi * side) for semi in (energy, momentum)) for side in view[:2]]
    half = 1.06 * np.minimum(np.maximum(whole, np.abs(flat).max(0)), 2.5 * fastest)
    half = np.maximum(half, 0.8 * half[::-1])
    near, middle = 0.75 * np.ptp(flat, axis=0).max(), (flat.max(0) + flat.min(0)) / 2
    boxes = [
        (
            half,
            np.zeros(2),
            f"from the side of ω; energy (blue), momentum (red), t = {time[at]:g} s",
        )
    ]
    if 1e-6 * half.max() < near < 0.2 * half.max():
        boxes.append(
            (np.full(2, near), middle, f"the path, enlarged {_enlargement(half.max() / near)}")
        )
    figure = new_figure(6.2 + 4 * len(boxes), 5, title="ω in the body frame")
    cells = figure.add_gridspec(3, len(boxes) + 1, width_ratios=[1.25, 1, 1][-len(boxes) - 1 :])
    for column, (half, centre, title) in enumerate(boxes):
        axis = figure.add_subplot(cells[:, column])
        _shade(axis, [(energy, COOL), (momentum, WARM)], view, half, centre)
        _draw_path(axis, omega, view, depth, half, centre, INK)
        _triad(axis, view, ("ω₁", "ω₂", "ω₃"))
        axis.set_title(title, **NOTE)
    _draw_series(
        figure, cells[:, -1].subgridspec(3, 1), time, omega.T, OMEGA, 1e-9 * fastest, 2 * fastest
    )
    _label_start(figure)
    return figure


def _path_figure(columns: dict[str, np.ndarray], down: np.ndarray | None):
    """Coordinates of the centre of mass against time, its path in a vertical plane and from
    above."""
    position = np.stack([columns[key] for key in "xyz"], axis=-1)
    span = np.ptp(position, axis=0).max()
    least = 1e-11 * span + 1e-13 * np.abs(position).max()
    if not span > least:
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
    figure = new_figure(4.2 + 3.8 * len(planes), 4.6, title="path of the centre of mass")
    cells = figure.add_gridspec(3, len(planes) + 1)
    labels, stack = ("x (m)", "y (m)", "z (m)"), cells[:, 0].subgridspec(3, 1)
    _draw_series(figure, stack, columns["time"], position.T, labels, least, span)
    for column, (title, right, upward) in enumerate(planes, start=1):
        _draw_plane(figure.add_subplot(cells[:, column]), title, position, right, upward, least)
    _label_start(figure)
    return figure


def _draw_plane(
    axis, title: str, position: np.ndarray, right: np.ndarray, up: np.ndarray, least: float
) -> None:
    """The path in one plane, with equal scales if possible; otherwise the title states the
    distortion."""
    flat = np.stack([position @ right, position @ up], axis=-1)
    span, centre = np.ptp(flat, axis=0), (flat.max(0) + flat.min(0)) / 2
    half = 0.55 * span
    if min(span) < least or max(span) < 8 * min(span):
        half = np.full(2, max(half))
        axis.set_aspect("equal")
    else:
        title += (
            f"; drawn {_enlargement(max(span) / min(span))} too"
            f" {'wide' if span[1] > span[0] else 'tall'}"
        )
    shown, style = _path_style(flat, half)
    axis.plot(*flat[shown].T, color=COOL, **style)
    axis.plot(*flat[0], "o", color=WARM, ms=5)
    for which, side in (("x", right), ("y", up)):
        vector = ", ".join(f"{part:.3g}" for part in side + 0.0)
        axis.set(
            **{
                f"{which}label": (
                    f"{'xyz'[side.argmax()] if side.max() > 1 - 1e-9 else f'along ({vector})'} (m)"
                )
            }
        )
    axis.axis(np.stack([centre - half, centre + half], axis=1).ravel())
    axis.set_title(title, **NOTE)
    axis.locator_params(axis="x", nbins=4)
    axis.ticklabel_format(useOffset=False)
    axis.spines[["top", "right"]].set_visible(False)


def _invariants_figure(columns: dict[str, np.ndarray], invariants: list[str]):
    """The errors of the invariants and of the rotation matrix on a logarithmic scale."""
    errors = {}
    for name in [*invariants, "orthogonality"]:
        error = np.abs(columns.get(f"{name}_error", np.nan))
        if np.isfinite(error).any():
            errors[LABELS.get(name, name.replace("_", " "))] = np.where(
                np.isfinite(error), error, np.nan
            )
    if not errors:
        return None
    axis = (figure := new_figure(8, 4.6, title="errors of the invariants")).subplots()
    size = -(-len(columns["time"]) // 300)
    for color, (label, error) in zip(COLORS, errors.items(), strict=False):
        largest = np.fmax.reduceat(error, np.arange(0, len(error), size))
        bound = f"at most {np.nanmax(error):.1e}" if np.nanmax(error) > 0 else "exactly 0"
        axis.plot(
            columns["time"][::size],
            np.maximum(largest, FLOOR),
            color=color,
            lw=1.0,
            label=f"{label}: {bound}",
        )
    axis.axhline(np.finfo(float).eps, color=FAINT, lw=0.8, ls=":")
    axis.set_yscale("log")
    # as in the legend; powers of ten as formulas are slow to draw
    axis.yaxis.set_major_formatter("{x:.0e}")
    axis.set_ylim(FLOOR / 2, max(1e-13, 5 * max(np.nanmax(error) for error in errors.values())))
    note = f"largest of each {size} samples; " if size > 1 else ""
    axis.set_title(
        f"{note}dotted: rounding, 2.2e-16; an error of exactly 0 is drawn at {FLOOR:.0e}",
        y=1.0,
        **NOTE,
    )
    axis.set(xlabel="time (s)", ylabel="relative error", xmargin=0)
    axis.legend(frameon=False, fontsize=9, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    axis.spines[["top", "right"]].set_visible(False)
    return figure


def _draw_series(
    figure, cells, time, series, labels, least: float, shown: float, colors=(COOL,) * 3
) -> list:
    """Panels above one another against time; a curve that varies by less than `least` gets a span
    of `shown`."""
    panels = []
    for row, (values, label, color) in enumerate(zip(series, labels, colors, strict=True)):
        panel = figure.add_subplot(cells[row])
        low, high = values.min(), values.max()
        moves = high - low > least
        dense = moves and np.abs(np.diff(values)).sum() > 300 * (high - low)
        panel.plot(*thin_series(time, values), color=color, lw=0.9, alpha=0.5 if dense else 1.0)
        margin = 0.06 * (high - low) if moves else shown / 2
        panel.set(ylim=(low - margin, high + margin), ylabel=label, xmargin=0)
        panel.tick_params(labelbottom=row == len(labels) - 1)
        panel.spines[["top", "right"]].set_visible(False)
        panel.ticklabel_format(axis="y", useOffset=False)
        panels.append(panel)
    panels[-1].set_xlabel("time (s)")
    return panels


def _shade(
    axis,
    solids: list[tuple[np.ndarray, str]],
    view: np.ndarray,
    half: np.ndarray,
    centre: np.ndarray,
) -> None:
    """An image of ellipsoids (semi-axes, colour) about the origin, lit from the upper left."""
    from matplotlib.colors import to_rgb

    x, y = (
        np.linspace(c - h, c + h, int(500 * h / half.max()))
        for c, h in zip(centre, half, strict=True)
    )
    base = x[None, :, None] * view[0] + y[:, None, None] * view[1]
    light = 0.55 * view[2] + 0.65 * view[1] - 0.5 * view[0]
    nearest = np.full(base.shape[:2], -np.inf)
    image = np.zeros((*nearest.shape, 4))
    for semi, color in solids:
        weight = semi**-2.0
        a, b, c = view[2] ** 2 @ weight, base @ (weight * view[2]), base**2 @ weight - 1
        depth = (np.sqrt(np.maximum(b * b - a * c, 0)) - b) / a
        normal = (base + depth[..., None] * view[2]) * weight
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True).clip(1e-300)
        tint = 0.38 - 0.28 * np.clip(normal @ light, 0, 1)[..., None]
        visible = (b * b >= a * c) & (depth > nearest + 1e-6 * half.max())
        image[visible, :3] = (1 - tint * (1 - np.array(to_rgb(color))))[visible]
        image[visible, 3] = 1.0
        nearest[visible] = depth[visible]
        axis.plot(*view[:2] @ (semi * circle(view[2] / semi)).T, color=color, lw=0.8, alpha=0.6)
    axis.imshow(
        image, origin="lower", extent=(x[0], x[-1], y[0], y[-1]), interpolation="bilinear", zorder=0
    )


def _draw_path(
    axis, points: np.ndarray, view: np.ndarray, depth: np.ndarray, half, centre, color: str
) -> None:
    """Draw a path in space with a dot at its start; longer paths are thinner."""
    flat = points @ view[:2].T
    shown, style = _path_style(flat, half.max())
    draw_front_and_back(axis, points[shown], view, depth[shown], (0.95, 0.25), color=color, **style)
    axis.plot(*flat[0], "o", color=WARM, ms=5, alpha=1.0 if depth[0] >= 0 else 0.5, zorder=4)
    axis.axis(np.stack([centre - half, centre + half], axis=1).ravel())
    axis.set_aspect("equal")
    axis.set_axis_off()


def _triad(axis, view: np.ndarray, names, down: np.ndarray | None = None) -> None:
    """The axes of the picture as small arrows in its lower left corner, and the direction of
    gravity."""
    vectors = [(vector, name, INK) for vector, name in zip(np.eye(3), names, strict=False)]
    for vector, name, color in vectors if down is None else [*vectors, (0.8 * down, "g", WARM)]:
        tip = 30 * (view[:2] @ vector)
        style = {
            "xycoords": "axes fraction",
            "textcoords": "offset points",
            "color": color,
            "fontsize": 9,
        }
        if np.linalg.norm(tip) > 2:
            arrow = {"arrowstyle": "<-", "color": color, "lw": 0.8}
            axis.annotate("", (0.1, 0.1), xytext=tip, arrowprops=arrow, **style)
            axis.annotate(name, (0.1, 0.1), xytext=1.35 * tip, ha="center", va="center", **style)


def _path_style(flat: np.ndarray, half) -> tuple[np.ndarray, dict]:
    """Points of a path to draw, about one per pixel, and the line style, thinner for longer
    paths."""
    way = np.concatenate([[0.0], np.linalg.norm(np.diff(flat, axis=0) / half, axis=1).cumsum()])
    shown = np.flatnonzero(np.diff(np.floor(800 * way), prepend=-1.0) > 0)
    return shown, {
        "lw": max(0.25, 1.7 / (1 + way[-1] / 60)),
        "rasterized": len(shown) > MOST_POINTS,
    }


def _range(degrees: np.ndarray) -> str:
    """A range of degrees as text, with enough digits to distinguish its ends."""
    low, high = degrees.min(), degrees.max()
    if high - low < 1e-5:
        return (
            f"{round(low, 6) + 0.0:.8g}°, constant{f' to {high - low:.0e}°' if high > low else ''}"
        )
    digits = int(np.clip(2 - np.floor(np.log10(high - low)), 1, 8))
    return f"from {low:.{digits}f}° to {high:.{digits}f}°"


def _enlargement(factor: float) -> str:
    """An enlargement to two digits."""
    return f"×{float(f'{factor:.2g}'):,g}"
