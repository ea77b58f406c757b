"""The public names of rigidmd, and the modules that have them."""

from .assemble.scenes import scene_from_atoms as scene_from_atoms
from .assemble.scenes import to_atoms as to_atoms
from .features import view as view
from .features.analysis import analysis as analysis
from .features.free_energy.lambda_sweep import free_energy as free_energy
from .features.free_energy.virial import second_virial as second_virial
from .features.free_energy.windows import pmf as pmf
from .features.potentials.poses.potential import BodyPairPotential as BodyPairPotential
from .features.potentials.user_code.body_pairs import body_pair_potential as body_pair_potential
from .features.potentials.user_code.force import Force as Force
from .features.potentials.user_code.kernels import compiled_force as compiled_force
from .features.potentials.user_code.kernels import compiled_thermostat as compiled_thermostat
from .features.potentials.user_code.pair_potential import PairPotential as PairPotential
from .features.potentials.user_code.pair_potential import pair_potential as pair_potential
from .features.potentials.user_code.trust import trust_file as trust_file
from .features.studies.normal_modes import normal_modes as normal_modes
from .features.studies.stored_runs import read_run as read_run
from .features.studies.sweep.sweeping import sweep as sweep
from .features.view.plots import LivePlot as LivePlot
from .run import Every as Every
from .run import Moment as Moment
from .run import Observer as Observer
from .run import Results as Results
from .run import Simulation as Simulation
from .run import run_together as run_together
from .run.kind import with_defaults as with_defaults
from .scene import BodyScene as BodyScene
from .scene import MolecularScene as MolecularScene
from .scene import Scene as Scene
from .scene.integrators import register_integrator as register_integrator

__version__: str
