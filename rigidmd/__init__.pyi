"""The public names of rigidmd, and the modules that have them."""

from . import analysis as analysis
from . import view as view
from .assemble.scenes import atoms_of as atoms_of
from .assemble.scenes import resolve as resolve
from .assemble.scenes import scene_from_atoms as scene_from_atoms
from .assemble.user_code.body_pairs import body_pair_potential as body_pair_potential
from .assemble.user_code.force import Force as Force
from .assemble.user_code.pair_potential import PairPotential as PairPotential
from .assemble.user_code.pair_potential import pair_law as pair_law
from .assemble.user_code.pair_potential import pair_potential as pair_potential
from .assemble.user_code.trust import trust as trust
from .dynamics.user_kernels import compiled_force as compiled_force
from .dynamics.user_kernels import compiled_thermostat as compiled_thermostat
from .forces.poses.potential import BodyPairPotential as BodyPairPotential
from .run import Every as Every
from .run import Moment as Moment
from .run import Observer as Observer
from .run import Results as Results
from .run import Simulation as Simulation
from .run import run_together as run_together
from .scene import BodyScene as BodyScene
from .scene import MolecularScene as MolecularScene
from .scene import Scene as Scene
from .scene.integrators import integrator as integrator
from .studies.normal_modes import normal_modes as normal_modes
from .studies.stored_runs import read_run as read_run
from .studies.sweep.coupling import free_energy as free_energy
from .studies.sweep.sweeping import sweep as sweep
from .studies.sweep.windows import pmf as pmf
from .studies.virial import second_virial as second_virial
from .view.plots import LivePlot as LivePlot

__version__: str
