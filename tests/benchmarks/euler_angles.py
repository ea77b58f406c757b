"""The picture of the frames and of the 3-1-3 Euler angles.

    python tests/benchmarks/euler_angles.py

writes euler_angles.png in rigidmd/docs/images, or the folder of --to.
"""

from pathlib import Path

import numpy as np
from command_line import new_parser, read_options
from matplotlib.figure import Figure

from rigidmd.features.view.figures.style import COOL, INK, PALETTE, WARM

LAB, BODY = COOL, WARM
ANGLES = {"phi": PALETTE["navy"], "theta": PALETTE["green"], "psi": PALETTE["amber"]}
PHI, THETA, PSI = np.radians([40.0, 40.0, 52.0])
X, Y, Z = np.eye(3)


def about(axis, angle):
    """The rotation matrix about lab axis 0 or 2."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    rotation = np.eye(3)
    rotation[[i, i, j, j], [i, j, i, j]] = (
        np.cos(angle),
        -np.sin(angle),
        np.sin(angle),
        np.cos(angle),
    )
    return rotation


Q = about(2, PHI) @ about(0, THETA) @ about(2, PSI)
NODE = about(2, PHI) @ X
#: Rows: to the right, upwards and towards the eye.
VIEW = np.array(
    [[-np.sin(0.593), np.cos(0.593), 0.0], [0.0, 0.0, 0.0], [np.cos(0.593), np.sin(0.593), 0.55]]
)
VIEW[2] /= np.linalg.norm(VIEW[2])
VIEW[1] = np.cross(VIEW[2], VIEW[0])

figure = Figure(figsize=(7.2, 5.4))
axes = figure.add_axes((0, 0, 1, 1))
axes.set(xlim=(-1.5, 1.62), ylim=(-1.0, 1.34))
axes.set_aspect("equal")
axes.axis("off")


def flat(points):
    return np.asarray(points) @ VIEW[:2].T


def disc(first, second, color):
    angle = np.linspace(0, 2 * np.pi, 361)[:, None]
    edge = np.cos(angle) * first + np.sin(angle) * second
    depth = edge @ VIEW[2]
    axes.fill(*flat(edge).T, color=color, alpha=0.07, lw=0)
    for front, alpha, dashes in ((depth >= 0, 0.9, "-"), (depth < 0, 0.45, (0, (4, 3)))):
        axes.plot(
            *np.where(front[:, None], flat(edge), np.nan).T,
            color=color,
            alpha=alpha,
            lw=1.0,
            ls=dashes,
        )


def arrow(tip, color, label, shift, width=2.0):
    style = {
        "arrowstyle": "-|>,head_width=0.28,head_length=0.6",
        "color": color,
        "lw": width,
        "shrinkA": 0,
        "shrinkB": 0,
    }
    axes.annotate("", flat(tip), flat(np.zeros(3)), arrowprops=style, zorder=5)
    axes.text(
        *(flat(tip) + shift), label, color=color, fontsize=17, ha="center", va="center", zorder=6
    )


def arc(start, toward, angle, radius, color, label, reach=1.22, part=0.5):
    """The angle from a unit vector towards a perpendicular one."""
    s = np.linspace(0, angle, 60)[:, None]
    path = radius * (np.cos(s) * start + np.sin(s) * toward)
    wedge = np.vstack([np.zeros(3), path])
    axes.fill(*flat(wedge).T, color=color, alpha=0.22, lw=0, zorder=2)
    style = {
        "arrowstyle": "-|>,head_width=0.2,head_length=0.45",
        "color": color,
        "lw": 1.8,
        "shrinkA": 0,
        "shrinkB": 0,
    }
    axes.plot(*flat(path[:-3]).T, color=color, lw=1.8, zorder=4)
    axes.annotate("", flat(path[-1]), flat(path[-4]), arrowprops=style, zorder=4)
    middle = reach * radius * (np.cos(part * angle) * start + np.sin(part * angle) * toward)
    axes.text(*flat(middle), label, color=color, fontsize=18, ha="center", va="center", zorder=6)


disc(X, Y, LAB)
disc(Q[:, 0], Q[:, 1], BODY)
line = np.array([-1.0, 1.25])[:, None] * NODE
axes.plot(*flat(line).T, color=INK, lw=1.2, ls=(0, (6, 3)), zorder=3)
axes.text(
    *(flat(1.36 * NODE) - (0.0, 0.01)),
    "line of nodes",
    color=INK,
    fontsize=12,
    ha="center",
    va="center",
)
for axis, name, shift in ((X, "x", (-0.08, -0.03)), (Y, "y", (0.08, 0.0)), (Z, "z", (-0.08, 0.03))):
    arrow(1.25 * axis, LAB, f"${name}$", np.array(shift))
for k, shift in enumerate(((0.08, 0.05), (-0.06, 0.07), (0.08, 0.05))):
    arrow(1.25 * Q[:, k], BODY, f"${k + 1}$", np.array(shift))
across = np.cross(Z, NODE)
arc(X, Y, PHI, 0.55, ANGLES["phi"], r"$\varphi$")
arc(Z, -across, THETA, 0.72, ANGLES["theta"], r"$\theta$", 1.14)
arc(NODE, np.cross(Q[:, 2], NODE), PSI, 0.55, ANGLES["psi"], r"$\psi$", 1.28, 0.38)
axes.plot(0, 0, "o", color=INK, ms=5, zorder=7)
axes.text(-1.45, 1.24, "lab frame: $x$, $y$, $z$", color=LAB, fontsize=13, va="center")
axes.text(-1.45, 1.11, "body frame: 1, 2, 3", color=BODY, fontsize=13, va="center")
axes.text(
    -1.45,
    -0.92,
    r"$x_\mathrm{lab} = Q\,x_\mathrm{body}$,   $Q = R_z(\varphi)\,R_x(\theta)\,R_z(\psi)$",
    color=INK,
    fontsize=13,
)


if __name__ == "__main__":
    images = Path(__file__).parents[2] / "rigidmd" / "docs" / "images"
    figure.savefig(read_options(new_parser(__doc__), images).to / "euler_angles.png", dpi=130)
