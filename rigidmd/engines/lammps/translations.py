"""What LAMMPS can express, and how."""

from rigidmd.engines.external import SPLIT, Key, Limit, Translations, is_langevin, moves
from rigidmd.forces.potentials.truncation import TRUNCATIONS

_INTEGRATOR, *_LIMITS = moves("LAMMPS", "rigid bodies")

TRANSLATIONS = Translations(
    "LAMMPS",
    scene=(
        Key("forces.truncation", {  # pair style of Lennard-Jones forces
            "plain": "lj/cut", "shift": "lj/cut", "force_shift": "lj/smooth/linear", "force_switch": "lj/gromacs",
            "switch": "lj/mdf", "smooth_switch": "table",
        }, matters=lambda view: view.is_truncated),
        Key("forces.reaction_field_truncation", dict.fromkeys((None, *TRUNCATIONS), "table")),
        Key("forces.electrostatics", {  # kspace style
            **dict.fromkeys(("none", "coulomb", "reaction_field", "damped_shifted_force"), ""), "ewald": "ewald",
            "pme": "pppm",
        }, matters=lambda view: view.coulomb),
        Key("forces.ewald_truncation", {None: "", "plain": ""},
            "LAMMPS has no shift of the real-space energy; take 'plain'", lambda view: view.has_ewald_sum),
        Key("run.remove_momentum_interval_ps", {None: "", False: ""},
            "LAMMPS removes no momentum of rigid bodies; leave it out"),
    ),
    stage=(
        Key("ensemble", {"nve": "nve", "nvt": "nvt", "npt": "npt", "nph": "nph"}),
        Key("thermostat", {None: "", "nose_hoover": "", "langevin": ""},
            "LAMMPS has nose_hoover and langevin for rigid bodies"),
        Key("barostat", {None: ""}, "LAMMPS has its own for rigid bodies; leave barostat out"),
        Key("pressure_coupling", {"isotropic": "iso", "semi_isotropic": "couple xy", "anisotropic": "couple none"},
            "LAMMPS' barostat for rigid bodies keeps the angles of the box"),
        _INTEGRATOR, Key("rotor", SPLIT, "LAMMPS' rotation is split"),
    ),
    limits=(
        Limit("forces.tail_correction with a barostat: LAMMPS' barostat for rigid bodies does not know its pressure",
            lambda view: view.has_barostat and view.system.tail is not None),
        Limit("a barostat for bodies and points together: LAMMPS' fix rigid/npt moves the box for one of them",
            lambda view: view.has_barostat and view.is_body.any() and (~view.is_body & ~view.frozen).any()),
    ),
    stage_limits=(
        *_LIMITS,
        Limit("ensemble = 'npt': LAMMPS' barostat for rigid bodies works with nose_hoover only",
            lambda stage: is_langevin(stage) and stage.has_barostat),
    ),
)  # fmt: skip
