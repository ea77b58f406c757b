"""Meshes of bodies and solids: closed surfaces, inertia, edges."""

import numpy as np
import pytest
from support.common import ROOT

from rigidmd import Scene, Simulation
from rigidmd.commands import cli
from rigidmd.features.bodies.assemble import build_body
from rigidmd.features.bodies.keys.solids import SOLIDS, solid
from rigidmd.features.bodies.mesh import UNITS, mesh_of
from rigidmd.mechanics.inertia import shifted_inertia


def volume(mesh):
    """For a closed surface whose faces are seen counterclockwise from outside."""
    corners = [mesh.vertices[face] for face in mesh.faces]
    return sum(p[0] @ np.cross(p[k], p[k + 1]) / 6 for p in corners for k in range(1, len(p) - 1))


@pytest.mark.parametrize("shape", ["cylinder", "cone", "cuboid", "sphere", "ellipsoid"])
def test_the_drawn_surface_is_that_of_the_solid(shape):
    sizes = {
        "radius_m": 2.0,
        "height_m": 3.0,
        "lengths_m": [1.0, 2.0, 3.0],
        "semi_axes_m": [1.0, 2.0, 3.0],
    }
    given = {key: sizes[key] for key in SOLIDS[shape].dimensions}
    body = {"mass_kg": 1.0, "solid": {"shape": shape, **given}}
    scene = Scene.from_dict({"body": body, "run": {"duration_s": 1.0, "timestep_s": 0.1}})
    mesh = mesh_of(build_body(scene))
    known = {
        "cylinder": np.pi * 12,
        "cone": np.pi * 4,
        "cuboid": 6,
        "sphere": np.pi * 32 / 3,
        "ellipsoid": np.pi * 8,
    }
    assert volume(mesh) == pytest.approx(known[shape], rel=0.04)
    assert 0 < sum(mesh.painted) < len(mesh.faces)
    outline = solid(shape, 1.0, given).outline
    assert np.allclose(np.ptp(outline, axis=0), np.ptp(mesh.vertices, axis=0), rtol=0.01)


def inertia_of_mesh(mesh, mass):
    """Centre (3,) and inertia tensor (3, 3) about it, of a homogeneous body inside a closed
    surface."""
    products, first, whole = np.zeros((3, 3)), np.zeros(3), 0.0
    for face in mesh.faces:
        p = mesh.vertices[face]
        for k in range(1, len(p) - 1):
            corners = np.stack([p[0], p[k], p[k + 1]])
            part, total = np.linalg.det(corners) / 6, corners.sum(axis=0)
            whole, first = whole + part, first + part * total / 4
            products += part / 20 * (corners.T @ corners + np.outer(total, total))
    centre = first / whole
    products = mass / whole * products - mass * np.outer(centre, centre)
    return centre, np.trace(products) * np.eye(3) - products


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(("across", "along"), [(1.0, 1.9), (1.0, 0.3), (1.0, 1.0)])
@pytest.mark.parametrize("offset", [0.0, -3.0, 3.0])
def test_a_symmetric_body_is_drawn_as_the_solid_of_revolution_of_its_inertia(
    axis, across, along, offset
):
    moments, centre = np.full(3, across), np.zeros(3)
    moments[axis], centre[axis] = along, offset
    body = {
        "mass_kg": 2.0,
        "inertia_kg_m2": moments.tolist(),
        "pinned": True,
        "centre_of_mass_m": centre.tolist(),
    }
    mesh = mesh_of(
        build_body(Scene.from_dict({"body": body, "run": {"duration_s": 1.0, "timestep_s": 0.1}}))
    )
    assert mesh.stem == (offset != 0)
    if not mesh.stem:
        place, tensor = inertia_of_mesh(mesh, 2.0)
        assert np.allclose(place, centre, atol=1e-9)
        assert np.allclose(
            tensor, np.diag(moments), rtol=0.05, atol=0.02
        )  # of polygons of 24 sides
        return
    assert (
        np.linalg.norm(mesh.vertices, axis=1).min() < 1e-12
    )  # it reaches to the pivot, with a tip
    flat = np.delete(mesh.vertices, axis, axis=1)
    assert np.allclose(
        np.ptp(flat, axis=0), 2 * np.linalg.norm(flat, axis=1).max(), rtol=0.02
    )  # round about the axis
    assert (
        np.sign(mesh.vertices[:, axis]).sum() * np.sign(offset) > 0
    )  # on the side of the centre of mass


@pytest.mark.parametrize(
    ("drawn_as", "about"),
    [
        ("ellipsoid", "the ellipsoid of the same mass and inertia"),
        ("cuboid", "the cuboid of the same mass and inertia"),
        ("top", "the cylinder of the same mass and inertia, on a stem"),
        ({"shape": "cone", "radius_m": 0.04, "height_m": 0.06}, "a cone"),
        ({"shape": "ring", "radius_m": 0.04}, "a ring"),
    ],
)
def test_a_scene_chooses_what_a_body_is_drawn_as(drawn_as, about):
    system = build_body(
        Scene.read(ROOT / "systems" / "heavy_top_3.toml", {"output.drawn_as": drawn_as})
    )
    mesh = mesh_of(system)
    assert mesh.about == about
    if about == "a cone":  # on its tip
        assert np.linalg.norm(mesh.vertices, axis=1).min() < 1e-12
        assert np.isclose(mesh.vertices[:, 2].max(), 0.06)
    elif drawn_as in ("ellipsoid", "cuboid"):
        place, tensor = inertia_of_mesh(mesh, 0.15)
        assert np.allclose(place, [0, 0, 0.04])
        assert np.allclose(np.diag(tensor), [0.66e-4, 0.66e-4, 1.2e-4], rtol=0.06)


CYLINDER = {
    "shape": "cylinder",
    "radius_m": 1.0,
    "height_m": 2.0,
    "axis": [1.0, -1.0, 0.5],
    "mass_kg": 1.0,
}
TILTED = [
    {
        "shape": "cuboid",
        "lengths_m": [0.3, 1.0, 2.0],
        "euler_angles_deg": [20.0, 50.0, -30.0],
        "density_kg_m3": 1.0,
    },
    {
        "shape": "cone",
        "radius_m": 0.5,
        "height_m": 1.5,
        "axis": [1.0, 2.0, -2.0],
        "density_kg_m3": 1.0,
        "position_m": [1.0, -1.0, 2.0],
    },
]


@pytest.mark.parametrize("pinned", [False, True])
@pytest.mark.parametrize("solids", [None, TILTED], ids=["handle", "tilted"])
def test_a_body_of_solids_is_drawn_as_its_solids(solids, pinned):
    """For one density, the drawn surface has the centre and the inertia of the body."""
    parts = {} if solids is None else {"body.solids": solids}
    system = build_body(
        Scene.read(ROOT / "systems" / "t_handle.toml", parts | {"body.pinned": pinned})
    )
    mesh = mesh_of(system)
    assert mesh.about == "its solids"
    place, tensor = inertia_of_mesh(mesh, system.mass)
    assert np.allclose(place, system.centre, atol=0.01 * mesh.reach)
    known = system.axes @ np.diag(system.inertia) @ system.axes.T
    known = shifted_inertia(known, -system.mass, system.centre)
    assert np.allclose(tensor, known, atol=0.04 * known.max())
    corners = [
        mesh.vertices[face] for face in mesh.faces
    ]  # short, as those at the back are drawn first
    sides = [
        np.linalg.norm(np.roll(face, -1, axis=0) - face, axis=1).max()
        for face in corners
        if len(face) == 4
    ]
    assert max(sides) < 0.16 * mesh.reach


@pytest.mark.parametrize(
    ("sets", "expected"),
    [
        (["output.drawn_as=tpo"], "did you mean top?"),
        (["output.drawn_as.shape=cone"], "a cone has height_m and radius_m, not none"),
        (
            ["output.drawn_as=top", "body.inertia_kg_m2=[3e-4,3.2e-4,1e-4]"],
            "a top has two equal moments of inertia",
        ),
    ],
)
def test_a_shape_that_a_body_cannot_be_drawn_as(sets, expected, capsys):
    arguments = [word for text in sets for word in ("--set", text)]
    assert cli.main(["check", str(ROOT / "systems" / "heavy_top_3.toml"), *arguments]) == 2
    assert expected in capsys.readouterr().err


def test_a_point_at_rest_is_drawn(tmp_path):
    scene = {"body": {"mass_kg": 1.0}, "start": {"position_m": [0, 0, 100]}}
    scene["run"] = {"duration_s": 0.1, "timestep_s": 0.01}
    Simulation(Scene.from_dict(scene), tmp_path / "rest").run()
    assert cli.main(["view", str(tmp_path / "rest")]) == 0


def test_a_body_without_a_solid_is_drawn_as_the_cuboid_of_its_inertia():
    lengths = np.array([1.0, 2.0, 3.0])
    inertia = 2.0 / 12 * (lengths @ lengths - lengths**2)
    scene = Scene.from_dict(
        {
            "body": {"mass_kg": 2.0, "inertia_kg_m2": inertia.tolist()},
            "run": {"duration_s": 1.0, "timestep_s": 0.1},
        }
    )
    mesh = mesh_of(build_body(scene))
    assert np.allclose(np.ptp(mesh.vertices, axis=0), lengths)
    assert volume(mesh) == pytest.approx(6.0)
    assert set(UNITS) < set(SOLIDS)


@pytest.mark.parametrize(
    ("body", "edges"),
    [
        ({"mass_kg": 1.0, "solid": {"shape": "cuboid", "lengths_m": [1.0, 2.0, 3.0]}}, 12),
        ({"mass_kg": 1.0, "solid": {"shape": "cylinder", "radius_m": 1.0, "height_m": 2.0}}, 36),
        ({"mass_kg": 1.0, "solid": {"shape": "ring", "radius_m": 1.0}}, 24),
        ({"mass_kg": 1.0, "solid": {"shape": "rod", "length_m": 1.0}}, 12),
        ({"solids": [CYLINDER, CYLINDER | {"position_m": [0.0, 5.0, 0.0]}]}, 36 + 1 + 36),
        (
            {
                "solids": [CYLINDER, TILTED[0], TILTED[0] | {"position_m": [9.0, 0.0, 0.0]}],
                "pinned": True,
            },
            1 + 36 + 2 + 24,
        ),
        (
            {
                "points": [
                    {"mass_kg": 1.0, "position_m": [x, x * x, 0.0]} for x in (0.0, 1.0, 2.0, 3.0)
                ]
            },
            3,
        ),
    ],
)
def test_edges_of_solids(body, edges):
    scene = Scene.from_dict({"body": body, "run": {"duration_s": 1.0, "timestep_s": 0.1}})
    assert len(build_body(scene).connections()) == edges
