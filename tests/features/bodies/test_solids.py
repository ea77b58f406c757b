"""Homogeneous solids: moments against integrals over their volume, outlines on their surface,
Lamb's added mass."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial.transform import Rotation
from scipy.special import elliprd
from support.common import ROOT

from rigidmd.features.bodies.assemble import build_body
from rigidmd.features.bodies.keys.solids import COMPONENTS_PER_DIMENSION as NUMBERS
from rigidmd.features.bodies.keys.solids import SOLIDS, added_mass_of_ellipsoid, solid
from rigidmd.mechanics.inertia import inertia_tensor
from rigidmd.scene import Scene

MASS = 2.5
DIMENSIONS = {
    "cylinder": {"radius_m": 0.7, "height_m": 1.9},
    "cone": {"radius_m": 0.7, "height_m": 1.9},
    "sphere": {"radius_m": 1.3},
    "cuboid": {"lengths_m": [0.4, 1.1, 2.3]},
    "ellipsoid": {"semi_axes_m": [0.4, 1.1, 2.3]},
    "disk": {"radius_m": 0.7},
    "ring": {"radius_m": 0.7},
    "rod": {"length_m": 1.9},
}


def gauss(low, high):
    """Nodes and weights between two limits, exact for polynomials up to the 15th power."""
    node, weight = np.polynomial.legendre.leggauss(8)
    return (low + high) / 2 + (high - low) / 2 * node, (high - low) / 2 * weight


def of_revolution(profile, low, high):
    """Weights and points of a body of revolution about axis 3 whose radius at height z is
    profile(z)."""
    z, along = gauss(low, high)
    r, across = gauss(0, 1)
    angle = 2 * np.pi * np.arange(8) / 8
    z, r, angle = np.meshgrid(z, r, angle, indexing="ij")
    weight = along[:, None, None] * across[:, None] * r * profile(z) ** 2
    points = np.stack([r * profile(z) * np.cos(angle), r * profile(z) * np.sin(angle), z], axis=-1)
    return weight.ravel(), points.reshape(-1, 3)


def cuboid(lengths):
    """Weights and points of a box."""
    (x, wx), (y, wy), (z, wz) = (gauss(-length / 2, length / 2) for length in lengths)
    points = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.einsum("i,j,k->ijk", wx, wy, wz).ravel(), points


def cloud(shape):
    """Weights and points that integrate over the solid of DIMENSIONS, wherever its coordinates are
    easiest."""
    d = DIMENSIONS[shape]
    match shape:
        case "cylinder":
            return of_revolution(lambda z: np.full_like(z, d["radius_m"]), 0, d["height_m"])
        case "cone":  # on its tip
            return of_revolution(lambda z: d["radius_m"] * z / d["height_m"], 0, d["height_m"])
        case "sphere":
            return of_revolution(
                lambda z: np.sqrt(d["radius_m"] ** 2 - z**2), -d["radius_m"], d["radius_m"]
            )
        case "cuboid":
            return cuboid(d["lengths_m"])
        case "ellipsoid":
            weight, points = of_revolution(lambda z: np.sqrt(1 - z**2), -1, 1)
            return weight, points * d["semi_axes_m"]
        case "disk":
            weight, points = of_revolution(lambda z: np.full_like(z, d["radius_m"]), 0, 1)
            return weight, points * [1, 1, 0]
        case "ring":
            angle = 0.3 + 2 * np.pi * np.arange(7) / 7
            return np.ones(7), d["radius_m"] * np.stack(
                [np.cos(angle), np.sin(angle), 0 * angle], axis=-1
            )
        case "rod":
            weight, points = cuboid([1, 1, d["length_m"]])
            return weight, points * [0, 0, 1]


def off_the_surface(shape, points):
    """How far points are from the surface of the solid of DIMENSIONS, in a measure that is 0 on
    it."""
    d = DIMENSIONS[shape]
    r, z = np.hypot(points[:, 0], points[:, 1]), points[:, 2]
    match shape:
        case "cylinder":
            return np.maximum(r / d["radius_m"], 2 * np.abs(z) / d["height_m"]) - 1
        case "cone":
            height = z / d["height_m"] + 0.75
            return np.maximum(r / d["radius_m"] - height, height - 1)
        case "sphere":
            return np.linalg.norm(points, axis=1) / d["radius_m"] - 1
        case "cuboid":
            return np.abs(2 * points / d["lengths_m"]).max(axis=1) - 1
        case "ellipsoid":
            return np.linalg.norm(points / d["semi_axes_m"], axis=1) - 1
        case "disk":
            return np.abs(z) + np.maximum(r / d["radius_m"] - 1, 0)
        case "ring":
            return np.abs(z) + np.abs(r / d["radius_m"] - 1)
        case "rod":
            return r + np.maximum(2 * np.abs(z) / d["length_m"] - 1, 0)


def test_the_table_states_what_a_scene_must_check():
    assert set(DIMENSIONS) == set(SOLIDS)
    for shape, dimensions in DIMENSIONS.items():
        assert set(SOLIDS[shape].dimensions) == set(dimensions)
        assert all(np.size(value) == NUMBERS[name] for name, value in dimensions.items())


@pytest.mark.parametrize("shape", DIMENSIONS)
def test_moments_are_integrals_over_the_solid(shape):
    weight, points = cloud(shape)
    masses = MASS * weight / weight.sum()
    points = points - masses @ points / MASS
    expected = inertia_tensor(masses, points)
    found = solid(shape, MASS, DIMENSIONS[shape]).inertia
    assert np.diag(found) == pytest.approx(expected, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("shape", DIMENSIONS)
def test_volumes_are_integrals_too(shape):
    weight, _ = cloud(shape)
    step = {
        "cuboid": 1.0,
        "ellipsoid": 2 * np.pi / 8 * np.prod(DIMENSIONS["ellipsoid"]["semi_axes_m"]),
    }
    unit = SOLIDS[shape]
    volume = unit.volume * unit.scale(DIMENSIONS[shape]).prod()
    thin = shape in ("disk", "ring", "rod")
    assert volume == pytest.approx(
        0.0 if thin else weight.sum() * step.get(shape, 2 * np.pi / 8), rel=1e-12
    )


# --- bodies of several solids ---------------------------------------------------------------------

EULER = [20.0, 50.0, -30.0]
#: One solid of each shape, at two tilts and more.
PARTS = [
    {
        "shape": "cone",
        "density_kg_m3": 3.0,
        "axis": [1.0, 2.0, -2.0],
        "position_m": [0.3, -1.0, 2.0],
    },
    {"shape": "cuboid", "mass_kg": 0.7, "euler_angles_deg": EULER, "position_m": [-2.0, 0.4, 0.1]},
    {"shape": "ellipsoid", "density_kg_m3": 0.5, "euler_angles_deg": [-100.0, 130.0, 75.0]},
    {"shape": "cylinder", "mass_kg": 1.9, "axis": [0.0, -3.0, 0.0], "position_m": [0.0, 0.0, -4.0]},
    {"shape": "disk", "mass_kg": 0.2, "axis": [0.1, 0.2, -3.0]},
    {"shape": "ring", "mass_kg": 0.4, "position_m": [1.0, 1.0, 1.0]},
    {"shape": "rod", "mass_kg": 0.3, "axis": [-1.0, 0.0, 1.0], "position_m": [0.0, 2.0, 0.0]},
    {"shape": "sphere", "density_kg_m3": 0.1, "position_m": [0.5, 0.5, -0.5]},
]
PARTS = [part | DIMENSIONS[part["shape"]] for part in PARTS]
RUN = {"duration_s": 1.0, "timestep_s": 0.01}
VOLUMES = {
    "cone": np.pi * 0.7**2 * 1.9 / 3,
    "ellipsoid": 4 / 3 * np.pi * 0.4 * 1.1 * 2.3,
    "sphere": 4 / 3 * np.pi * 1.3**3,
}


def points_of(part):
    """Masses and points of a solid of a body, from its cloud, by SciPy's rotations."""
    weight, points = cloud(part["shape"])
    mass = part.get("mass_kg") or part["density_kg_m3"] * VOLUMES[part["shape"]]
    masses = mass * weight / weight.sum()
    axis = np.array([part.get("axis", [0.0, 0.0, 1.0])]) / np.linalg.norm(
        part.get("axis", [0.0, 0.0, 1.0])
    )
    rotation, _ = Rotation.align_vectors(axis, [[0.0, 0.0, 1.0]])
    if "euler_angles_deg" in part:
        rotation = Rotation.from_euler("ZXZ", part["euler_angles_deg"], degrees=True)
    return masses, rotation.apply(points - masses @ points / mass) + part.get(
        "position_m", [0.0, 0.0, 0.0]
    )


@pytest.mark.parametrize("pinned", [False, True])
@pytest.mark.parametrize(
    "parts", [PARTS, PARTS[:2], PARTS[3:5], PARTS[6:7] * 2], ids=["all", "two", "tilted", "rods"]
)
def test_a_body_of_solids_is_the_integral_over_them(parts, pinned):
    system = build_body(Scene.from_dict({"body": {"solids": parts, "pinned": pinned}, "run": RUN}))
    masses, points = (
        np.concatenate(columns) for columns in zip(*map(points_of, parts), strict=True)
    )
    centre = masses @ points / masses.sum()
    assert system.mass == pytest.approx(masses.sum(), rel=1e-12)
    assert system.centre == pytest.approx(centre if pinned else np.zeros(3), abs=1e-12)
    tensor = system.axes @ np.diag(system.inertia) @ system.axes.T
    expected = inertia_tensor(masses, points if pinned else points - centre)
    assert tensor == pytest.approx(expected, abs=1e-12 * np.abs(expected).max())
    outline = system.points[pinned:] + (
        0 if pinned else centre
    )  # the first point of a pinned body is its pivot
    first = outline[: len(SOLIDS[parts[0]["shape"]].outline)] - parts[0]["position_m"]
    if "axis" in parts[0]:  # reaches as far along its axis as it is long
        height = DIMENSIONS[parts[0]["shape"]].get(
            "height_m", DIMENSIONS[parts[0]["shape"]].get("length_m")
        )
        axis = np.array(parts[0]["axis"]) / np.linalg.norm(parts[0]["axis"])
        assert np.ptp(first @ axis) == pytest.approx(height, rel=1e-12)
        if parts[0]["shape"] == "cone":
            assert (first @ axis).min() == pytest.approx(
                -0.75 * height, rel=1e-12
            )  # from its tip to its base


def test_a_t_handle_has_the_moments_of_its_two_cylinders():
    system = build_body(Scene.read(ROOT / "systems" / "t_handle.toml"))
    (m, r, h), (n, s, k) = (
        (2700 * np.pi * 0.006**2 * 0.08, 0.006, 0.08),
        (2700 * np.pi * 0.005**2 * 0.05, 0.005, 0.05),
    )
    reduced = m * n / (m + n) * 0.031**2
    along, across = m * r * r / 2, m * (3 * r * r + h * h) / 12
    expected = [
        along + n * (3 * s * s + k * k) / 12 + reduced,
        across + n * s * s / 2,
        across + n * (3 * s * s + k * k) / 12 + reduced,
    ]
    assert system.mass == pytest.approx(m + n, rel=1e-14)
    assert system.inertia == pytest.approx(expected, rel=1e-13)
    assert (system.axes == np.eye(3)).all()


def test_one_solid_among_solids_is_the_solid():
    one = {"shape": "cone", "radius_m": 0.03, "height_m": 0.06}
    table = {"mass_kg": 0.2, "solid": one, "pinned": True, "centre_of_mass_m": [0.0, 0.0, 0.045]}
    parts = {"solids": [one | {"mass_kg": 0.2, "position_m": [0.0, 0.0, 0.045]}], "pinned": True}
    single, several = (
        build_body(Scene.from_dict({"body": body, "run": RUN})) for body in (table, parts)
    )
    assert several.inertia == pytest.approx(single.inertia, rel=1e-15)
    assert several.points == pytest.approx(single.points, abs=1e-17)
    assert several.inertia[0] == several.inertia[1]


@pytest.mark.parametrize("shape", DIMENSIONS)
def test_outline_lies_on_the_solid_and_spans_it(shape):
    outline = solid(shape, MASS, DIMENSIONS[shape]).outline
    assert 12 <= len(outline) <= 40
    assert len(np.unique(outline.round(9), axis=0)) == len(outline)
    assert np.abs(off_the_surface(shape, outline)).max() < 1e-12
    _, points = cloud(shape)
    reach = np.ptp(points, axis=0)
    assert np.all(np.ptp(outline, axis=0) >= reach * (1 - 1e-12))
    assert outline[:, :2].mean(axis=0) == pytest.approx([0, 0], abs=1e-12)


def test_cone_stands_on_its_tip():
    cone = solid("cone", 1.0, {"radius_m": 2.0, "height_m": 4.0})
    assert cone.inertia == pytest.approx([3 / 20 * 8, 3 / 20 * 8, 3 / 10 * 4])
    lowest = cone.outline[cone.outline[:, 2].argmin()]
    assert lowest == pytest.approx([0, 0, -3])
    top = cone.outline[cone.outline[:, 2] > 0.9]
    assert top[:, 2] == pytest.approx(np.ones(len(top)))
    assert np.hypot(top[:, 0], top[:, 1]).max() == pytest.approx(2)


def test_moments_that_are_equal_are_the_same_number():
    for shape in ("cylinder", "cone", "sphere", "disk", "ring", "rod"):
        inertia = solid(shape, 0.1, dict.fromkeys(SOLIDS[shape].dimensions, 1 / 3)).inertia
        assert inertia[0] == inertia[1]
    assert np.ptp(solid("sphere", 0.1, {"radius_m": 1 / 3}).inertia) == 0
    assert solid("rod", 0.1, {"length_m": 1 / 3}).inertia[2] == 0


def test_added_mass_of_a_sphere_is_half_the_fluid_it_displaces():
    mass, inertia = added_mass_of_ellipsoid([0.3, 0.3, 0.3], 1000.0)
    assert mass == pytest.approx(np.full(3, 0.5 * 4 / 3 * np.pi * 0.3**3 * 1000), rel=1e-14)
    assert np.array_equal(inertia, np.zeros(3))


@pytest.mark.parametrize("ratio", [1.5, 2.0, 10.0])
def test_added_mass_of_prolate_spheroids_in_closed_form(ratio):
    """Lamb, Hydrodynamics, art. 114-115: k1, k2, k' in parts of the displaced fluid's mass and
    moment of inertia."""
    e2 = 1 - 1 / ratio**2
    e = e2**0.5
    alpha = 2 * (1 - e2) / e**3 * (np.arctanh(e) - e)
    beta = 1 / e2 - (1 - e2) / e**3 * np.arctanh(e)
    turning = e2**2 * (beta - alpha) / ((2 - e2) * (2 * e2 - (2 - e2) * (beta - alpha)))
    mass, inertia = added_mass_of_ellipsoid([ratio, 1.0, 1.0], 1.0)
    displaced = 4 / 3 * np.pi * ratio
    assert mass / displaced == pytest.approx(
        [alpha / (2 - alpha), beta / (2 - beta), beta / (2 - beta)], rel=1e-12
    )
    assert inertia[1:] / (displaced * (1 + ratio**2) / 5) == pytest.approx(
        np.full(2, turning), rel=1e-12
    )
    assert inertia[0] == 0


@pytest.mark.parametrize(
    "semi_axes", [(1.0, 2.0, 3.5), (0.02, 1.0, 0.3), (4e-9, 1e-9, 2e-9), (50.0, 1.0, 8.0)]
)
def test_added_mass_of_general_ellipsoids_is_lambs_formula(semi_axes):
    a, b, c = semi_axes
    size = max(semi_axes)

    def coefficient(axis):  # l = size² u² / (1 - u²) takes 0 ... infinity to 0 ... 1
        own, others = (semi_axes[axis] / size) ** 2, (np.array(semi_axes) / size) ** 2

        def integrand(u):
            l = u**2 / (1 - u**2)  # noqa: E741
            return 2 * u / (1 - u**2) ** 2 / ((own + l) * np.sqrt(np.prod(others + l)))

        return a * b * c / size**3 * quad(integrand, 0, 1, epsabs=0, epsrel=1e-12, limit=200)[0]

    alpha, beta, gamma = (coefficient(axis) for axis in range(3))
    assert alpha + beta + gamma == pytest.approx(2)
    displaced = 4 / 3 * np.pi * 7.0 * a * b * c
    mass, inertia = added_mass_of_ellipsoid(semi_axes, 7.0)
    assert mass / displaced == pytest.approx([k / (2 - k) for k in (alpha, beta, gamma)], rel=1e-8)

    def turning(b, c, beta, gamma):
        return (
            displaced
            / 5
            * (b**2 - c**2) ** 2
            * (gamma - beta)
            / (2 * (b**2 - c**2) + (b**2 + c**2) * (beta - gamma))
        )

    expected = [turning(b, c, beta, gamma), turning(c, a, gamma, alpha), turning(a, b, alpha, beta)]
    assert inertia / displaced / size**2 == pytest.approx(
        np.array(expected) / displaced / size**2, rel=1e-8
    )


def test_added_mass_of_a_thin_disk():
    mass, inertia = added_mass_of_ellipsoid([0.5, 0.5, 0.5e-9], 3.0)
    assert mass[2] == pytest.approx(8 / 3 * 3.0 * 0.5**3, rel=1e-8)
    assert inertia[:2] == pytest.approx(
        np.full(2, 16 / 45 * 3.0 * 0.5**5), rel=1e-8
    )  # Lamb, art. 108
    assert inertia[2] == 0
    assert mass[0] == pytest.approx(0, abs=1e-8)


@pytest.mark.parametrize("difference", [1e-3, 1e-6, 1e-9, 1e-12, 1e-15])
def test_added_inertia_of_almost_equal_axes_keeps_its_digits(difference):
    b, c = 1 + difference, 1 - difference
    _, inertia = added_mass_of_ellipsoid([1.0, b, c], 1.0)
    # Next to the sphere near = 2/5, far = 4/15, alpha = 2/3: the moment is displaced mass (b² -
    # c²)² / 15.
    leading = 4 / 3 * np.pi / 15 * ((b - c) * (b + c)) ** 2
    assert inertia[0] == pytest.approx(leading, rel=10 * difference**2 + 1e-14, abs=0)


def test_added_inertia_passes_smoothly_through_equal_axes():
    """Lamb's differences are good to 1e-11 where b and c differ by 1e-4: there both forms must
    agree."""
    a, b, c = 3.0, 1.0001, 1.0
    beta, gamma = (
        2 / 3 * a * b * c * elliprd(*others) for others in ((a**2, c**2, b**2), (a**2, b**2, c**2))
    )
    expected = (
        (b**2 - c**2) ** 2 * (gamma - beta) / (2 * (b**2 - c**2) + (b**2 + c**2) * (beta - gamma))
    )
    _, inertia = added_mass_of_ellipsoid([a, b, c], 1.0)
    assert inertia[0] == pytest.approx(4 / 3 * np.pi * a * b * c / 5 * expected, rel=1e-10)
