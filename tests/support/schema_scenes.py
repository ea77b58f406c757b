"""Small scenes that together set every key of the schema that holds a number;
tests/end_to_end/test_schema_walk.py changes them."""

ARGON = """
seed = 5
threads = 1
[[molecules]]
model = "argon"
count = 20
[box]
lengths_A = [16.0, 16.0, 17.0]
angles_deg = [90.0, 90.0, 88.0]
[forces]
cutoff_A = 6.0
switch_start_A = 5.0
truncation = "switch"
skin_A = 0.8
[start]
temperature_K = 90.0
[[integrators]]
name = "mine"
steps = [0.6, -0.2, 0.6]
order = 2
[[stages]]
ensemble = "nve"
integrator = "mine"
timestep_fs = 2.0
duration_ps = 0.004
[run]
remove_momentum_interval_ps = 0.1
[output]
log_interval_ps = 0.002
pressure_tensor = true
pressure_tensor_interval_ps = 0.002
trajectory_interval_ps = 0.002
checkpoint_minutes = 10.0
figures = false
[watch]
move = 0.5
turn_rad = 1.0
kick = 10.0
energy = 0.5
volume = 100.0
orthogonality = 1e-6
"""
BAROSTATS = """
seed = 5
threads = 1
[[molecules]]
model = "argon"
count = 20
[box]
density_g_cm3 = 0.5
[forces]
cutoff_A = 6.0
[start]
temperature_K = 90.0
[[stages]]
name = "flow"
ensemble = "npt"
timestep_fs = 2.0
duration_ps = 0.004
temperature_K = [90.0, 95.0]
pressure_bar = [1.0, 2.0, 3.0]
pressure_coupling = "anisotropic"
thermostat_time_ps = 0.1
barostat_time_ps = 0.5
compressibility_per_bar = 1e-4
[[stages]]
name = "moves"
ensemble = "npt"
timestep_fs = 2.0
duration_ps = 0.004
temperature_K = 90.0
pressure_bar = 1.0
thermostat = "nose_hoover"
nose_hoover_links = 3
barostat = "monte_carlo"
barostat_interval_ps = 0.002
[output]
figures = false
trajectory = false
[[integrators]]
name = "mine"
kicks = [0.5, 0.5]
drifts = [1.0]
gradients = [0.0, 0.0]
order = 2
"""
#: Sites of a scene, Coulomb forces by plain Ewald sums with their own settings.
IONS = """
seed = 5
threads = 1
[[molecules]]
name = "rod"
count = 8
masses_u = { A = 15.0 }
[[molecules.sites]]
name = "A"
element = "N"
mass_u = 14.0
position_A = [0.0, 0.0, 0.0]
charge_e = 0.2
sigma_A = 3.0
epsilon_kJ_mol = 0.5
parameters = { c = 1.0 }
[[molecules.sites]]
name = "B"
element = "O"
mass_u = 16.0
position_A = [0.0, 0.0, 1.2]
charge_e = -0.2
sigma_A = 3.1
epsilon_kcal_mol = 0.1
parameters = { c = 2.0 }
[[molecules]]
model = "argon"
count = 4
frozen = [1, 2]
[[molecules]]
name = "bead"
count = 2
[[molecules.sites]]
name = "Xe"
element = "Xe"
mass_u = 131.3
position_A = [0.0, 0.0, 0.0]
sigma_A = 4.0
epsilon_K = 200.0
[box]
lengths_A = 18.0
[forces]
cutoff_A = 7.0
electrostatics = "ewald"
ewald_cutoff_A = 7.0
ewald_alpha_per_A = 0.4
ewald_k_max = [7, 7, 7]
ewald_k2_max = 40
ewald_surface_permittivity = 80.0
[[forces.pairs]]
sites = ["A", "Ar"]
sigma_A = 3.2
epsilon_kJ_mol = 0.4
[[forces.custom]]
name = "soft"
energy = "c*k*exp(-r/s)"
parameters = { k = 2.0, s = 0.5 }
mixing = { c = "geometric" }
sites = ["A", "B"]
cutoff_A = 6.0
switch_start_A = 5.0
truncation = "switch"
[[forces.custom.pairs]]
sites = ["A", "B"]
parameters = { c = 1.5 }
[start]
temperature_K = 90.0
[[stages]]
ensemble = "nvt"
thermostat = "langevin"
friction_translation_per_ps = 1.0
friction_rotation_per_ps = 2.0
temperature_K = 90.0
duration_ps = 0.004
timestep_fs = 2.0
[output]
figures = false
trajectory = false
"""
FIELDS = """
seed = 5
threads = 1
[[molecules]]
model = "spce"
count = 8
[box]
lengths_A = [28.0, 20.0, 34.0]
periodic = true
[forces]
cutoff_A = 7.0
electrostatics = "reaction_field"
reaction_field_permittivity = 80.0
[fields]
electric_V_per_nm = [0.0, 0.1, 0.2]
gravity_m_s2 = [0.0, 0.0, -9.81]
[[fields.walls]]
axis = "z"
kind = "lj93"
positions_A = [0.0, 24.0]
sigma_A = 3.0
epsilon_kJ_mol = 1.0
cutoff_A = 8.0
[[fields.walls]]
axis = "x"
kind = "harmonic"
acts_on = "centres"
positions_A = [1.0, 19.0]
stiffness_kJ_mol_A2 = 2.0
[[fields.restraints]]
molecules = [1, 2]
stiffness_kJ_mol_A2 = [1.0, 2.0, 3.0]
position_A = [10.0, 10.0, 10.0]
[start]
temperature_K = 300.0
[[stages]]
ensemble = "minimise"
max_iterations = 2
force_limit_kJ_mol_A = 0.1
torque_limit_kJ_mol = 0.1
[[stages]]
ensemble = "nvt"
thermostat = "hybrid_monte_carlo"
trajectory_steps = 2
momentum_refreshment = 0.5
temperature_K = 300.0
duration_ps = 0.004
timestep_fs = 2.0
[output]
figures = false
trajectory = false
"""
MESH = """
seed = 5
threads = 1
[[molecules]]
model = "spce"
count = 27
[box]
lengths_A = [18.0, 18.0, 18.0]
vacuum_A = 30.0
[forces]
cutoff_A = 7.0
electrostatics = "pme"
ewald_slab = "z"
dispersion = "pme"
dispersion_accuracy = 1e-4
ewald_accuracy = 1e-4
pme_order = 5
[start]
temperature_K = 300.0
[[stages]]
ensemble = "nvt"
thermostat = "andersen"
thermostat_time_ps = 0.5
temperature_K = 300.0
duration_ps = 0.004
timestep_fs = 2.0
[output]
figures = false
trajectory = false
"""
#: Changes of these scenes for keys that exclude others; None removes a key.
VARIANTS = {
    "grids": (
        MESH,
        {
            "box.vacuum_A": None,
            "forces.ewald_slab": None,
            "forces.dispersion_accuracy": None,
            "forces.dispersion_beta_per_A": 0.4,
            "forces.dispersion_order": 5,
            "forces.dispersion_grid": [20, 20, 20],
            "forces.ewald_accuracy": None,
            "forces.ewald_alpha_per_A": 0.4,
            "forces.pme_grid": [20, 20, 20],
        },
    ),
    "sphere": (
        IONS,
        {
            "forces.ewald_k_max": None,
            "forces.ewald_k2_max": None,
            "forces.ewald_k_radius_per_A": 2.5,
        },
    ),
    "damped": (
        FIELDS,
        {
            "forces.electrostatics": "damped_shifted_force",
            "forces.reaction_field_permittivity": None,
            "forces.damping_per_A": 0.2,
            "stages.1.thermostat": None,
            "stages.1.trajectory_steps": None,
            "stages.1.momentum_refreshment": None,
            "fields.electric_frequency_per_ps": 0.5,
            "fields.electric_phase_deg": 30.0,
        },
    ),
    "coupled": (
        ARGON,
        {
            "coupling": {
                "species": "argon",
                "lambda": 0.3,
                "charges_from": 0.6,
                "lambdas": [0.2, 0.8],
            },
        },
    ),
    "energy": (
        ARGON,
        {
            "stages.0.integrator": "auto",
            "stages.0.timestep_fs": None,
            "stages.0.energy_error_kT": 1e-3,
        },
    ),
    "trajectory": (
        ARGON,
        {
            "stages.0.integrator": "auto",
            "stages.0.timestep_fs": None,
            "stages.0.trajectory_error": 1e-3,
        },
    ),
    "bias": (
        ARGON,
        {
            "stages.0.ensemble": "nvt",
            "stages.0.integrator": "auto",
            "stages.0.timestep_fs": None,
            "stages.0.temperature_K": 90.0,
            "stages.0.bias_kT": 1e-2,
        },
    ),
    "cell": (
        FIELDS,
        {
            "fields": None,
            "stages.0.pressure_bar": 1.0,
            "stages.0.pressure_limit_bar": 1e5,
            "forces.reaction_field_permittivity": 78.0,
        },
    ),
    "ranks": (
        ARGON,
        {
            "run": None,
            "engine": {"name": "lammps", "ranks": 1},
            "stages.0.integrator": "velocity_verlet",
            "integrators": None,
            "watch": None,
            "forces.skin_A": None,
        },
    ),
    "file": (
        ARGON,
        {
            "box": None,
            "molecules.0.count": None,
            "structure": {"file": "argon.xyz", "frame": 1, "repeat": [2, 2, 2], "tolerance": 0.1},
        },
    ),
}
MOLECULES = {"argon": ARGON, "barostats": BAROSTATS, "ions": IONS, "fields": FIELDS, "mesh": MESH}

TOP = """
[body]
mass_kg = 0.5
inertia_kg_m2 = [1.0e-3, 1.2e-3, 0.6e-3]
pinned = true
centre_of_mass_m = [0.0, 0.0, 0.05]
[start]
euler_angles_deg = [10.0, 30.0, 20.0]
euler_rates_rad_s = [1.0, 0.5, 60.0]
[gravity]
acceleration_m_s2 = [0.0, 0.0, -9.81]
[friction]
viscous_N_m_s = [1e-5, 2e-5, 3e-5]
dry_N_m = [1e-5, 1e-5, 1e-5]
[[applied]]
from_s = 1e-4
to_s = 2e-3
force_N = [0.1, 0.0, 0.2]
at_m = [0.0, 0.0, 0.1]
[[applied]]
times_s = [0.0, 1e-3]
torque_N_m = [[0.0, 0.0, 0.1], [0.0, 0.1, 0.0]]
[run]
timestep_s = 1e-4
duration_s = 2e-4
[output]
figures = false
interval_s = 1e-4
trajectory_A_per_m = 30.0
checkpoint_minutes = 1.0
axis = [0.0, 0.0, 1.0]
[output.drawn_as]
shape = "cone"
radius_m = 0.03
height_m = 0.08
[watch]
energy = 0.5
orthogonality = 1e-8
turn_rad = 1.0
"""
SWIMMER = """
[body]
mass_kg = 0.5
[body.solid]
shape = "ellipsoid"
semi_axes_m = [0.1, 0.2, 0.3]
[start]
quaternion_wxyz = [0.5, 0.5, 0.5, 0.5]
angular_velocity_body_rad_s = [1.0, 2.0, 3.0]
position_m = [0.1, 0.2, 0.3]
velocity_m_s = [0.3, 0.2, 0.1]
[gravity]
acceleration_m_s2 = [0.0, 0.0, -9.81]
[fluid]
linear_resistance_kg_s = [0.1, 0.2, 0.3]
quadratic_resistance_kg_m = [0.1, 0.2, 0.3]
linear_rotational_resistance_N_m_s = [1e-4, 2e-4, 3e-4]
quadratic_rotational_resistance_N_m_s2 = [1e-4, 2e-4, 3e-4]
displaced_mass_kg = 0.4
centre_of_buoyancy_m = [0.0, 0.0, 0.02]
added_mass_kg = [0.1, 0.2, 0.3]
added_inertia_kg_m2 = [1e-3, 2e-3, 3e-3]
[run]
timestep_s = 1e-3
duration_s = 2e-3
relative_tolerance = 1e-8
absolute_tolerance = 1e-10
integrator = "dop853"
[output]
figures = false
"""
SATELLITE = """
[body]
inertia_tensor_kg_m2 = [[2.0, 0.1, 0.0], [0.1, 3.0, 0.2], [0.0, 0.2, 4.0]]
mass_kg = 10.0
[start]
yaw_pitch_roll_deg = [10.0, 20.0, 30.0]
angular_velocity_lab_rad_s = [0.1, 0.2, 0.3]
[[wheels]]
axis = [0.0, 0.6, 0.8]
momentum_kg_m2_s = 0.5
motor_torque_N_m = 0.01
from_s = 0.0
to_s = 1.0
[frame]
angular_velocity_rad_s = [0.0, 0.1, 0.2]
angular_acceleration_rad_s2 = [0.0, 0.01, 0.0]
origin_acceleration_m_s2 = [0.1, 0.0, 0.0]
[run]
timestep_s = 0.01
duration_s = 0.02
[output]
figures = false
"""
SKATER = """
[body]
mass_kg = 60.0
[start]
rotation = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
project = true
angular_velocity_body_rad_s = [0.1, 0.2, 3.0]
[changing_inertia]
times_s = [0.0, 1.0]
inertia_kg_m2 = [[15.0, 15.0, 1.3], [15.0, 15.0, 1.0]]
[[wheels]]
axis = [0.0, 0.0, 1.0]
momentum_kg_m2_s = 0.5
times_s = [0.0, 1.0]
motor_torque_N_m = [0.0, 0.1]
[run]
timestep_s = 0.01
duration_s = 0.02
[output]
figures = false
"""
BODIES = {"top": TOP, "swimmer": SWIMMER, "satellite": SATELLITE, "skater": SKATER}
BODY_VARIANTS = {
    "points": (
        SKATER,
        {
            "changing_inertia": None,
            "wheels": None,
            "body": {
                "points": [
                    {"mass_kg": 1.0, "position_m": [0.0, 0.0, 0.0]},
                    {"mass_kg": 2.0, "position_m": [1.0, 0.0, 0.0]},
                    {"mass_kg": 3.0, "position_m": [0.0, 1.0, 0.2]},
                ]
            },
            "start.rotation": None,
            "start.project": None,
            "start.attitude_matrix": [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]],
        },
    ),
    "rod": (
        SKATER,
        {
            "changing_inertia": None,
            "wheels": None,
            "body.solid": {"shape": "rod", "length_m": 1.0},
            "frame": {
                "times_s": [0.0, 1.0],
                "angular_velocity_rad_s": [[0.0, 0.0, 0.1], [0.0, 0.1, 0.1]],
            },
            "start.angular_velocity_body_rad_s": [0.1, 0.2, 0.0],
        },
    ),
    "cylinder": (
        SKATER,
        {
            "wheels": None,
            "changing_inertia": None,
            "body.solid": {"shape": "cylinder", "radius_m": 0.1, "height_m": 0.3},
        },
    ),
    "cuboid": (
        SKATER,
        {
            "wheels": None,
            "changing_inertia": None,
            "body.solid": {"shape": "cuboid", "lengths_m": [0.4, 0.3, 1.7]},
        },
    ),
    "submerged": (
        SWIMMER,
        {
            "fluid": {"density_kg_m3": 1000.0},
        },
    ),
    "auto energy": (
        TOP,
        {"friction": None, "applied": None, "run.integrator": "auto", "run.energy_error": 1e-6},
    ),
    "auto trajectory": (
        TOP,
        {"friction": None, "applied": None, "run.integrator": "auto", "run.trajectory_error": 1e-6},
    ),
}
