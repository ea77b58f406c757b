"""The run time that `rigidmd check` expects, from measured costs of pairs and k-space sums.

On other processors, and for small systems, it is right to a factor of about two.
"""

from math import inf, isfinite, pi, prod

import numpy as np

from rigidmd.compile.machine import usable_threads
from rigidmd.engines.system import System
from rigidmd.forces.neighbors.pair_loop import PairForces
from rigidmd.scene.stage import Stage

#: Time of a pair in a list, ns, by precision. Two cores of an AMD EPYC with AVX2 make 4300 steps/s
#: of 216 SPC/E with PME, and 300 of 4096: here 4000 and 200.
PAIR_NS = {"mixed": 1.8, "double": 3.6}
MOLECULE_NS = 60.0  # of a molecule in a step, besides its forces
THREADS_EXPONENT = 0.6  # the speed grows with this power of the number of threads
MINIMISATION = 150  # force evaluations of a minimisation
START_S = 5.0  # imports, loading of compiled code, figures


def expected_seconds(system: System) -> float | None:
    """The run time of a scene with its compiled code in the cache, s. None if it is not known: for
    external engines, user-defined forces, and stages that choose their step."""
    scene, stages = system.scene, system.scene.stages
    if scene.engine.is_external or system.user_terms or any(stage.is_auto for stage in stages):
        return None
    pairs = sum(
        _k_space(term) if name.endswith("reciprocal") else _pairs(system, term)
        for name, term in system.terms.items()
    )
    step = PAIR_NS[system.precision] * pairs + MOLECULE_NS * len(system.model.species)
    threads = usable_threads(scene.threads) ** THREADS_EXPONENT
    return START_S + 1e-9 * step / threads * sum(map(_evaluations, stages))


def _evaluations(stage: Stage) -> int:
    if stage.is_minimisation:
        return MINIMISATION
    return stage.steps * stage.scheme.force_evaluations


def _pairs(system: System, term: object) -> float:
    """The cost of a term of the forces, in pairs."""
    if isinstance(term, PairForces):
        sites = len(term.group)
        reach = getattr(term.potential, "cutoff", inf) + system.scene.forces.skin_A
        near = 4 / 3 * pi * reach**3 / _volume(system, reach) if reach < inf else 1.0
        return sites**2 / 2 * min(1.0, near)
    return 0.0


def _volume(system: System, reach: float) -> float:
    """The volume of the box, or that in which molecules without a box are within reach."""
    if isfinite(system.space.volume):
        return system.space.volume
    return float(np.prod(np.ptp(system.state.position, axis=0) + reach))


def _k_space(term: object) -> float:
    """The cost of sums in reciprocal space, in pairs. Loaded here, as few scenes need them."""
    from rigidmd.forces.ewald.direct_sum import EwaldSum
    from rigidmd.forces.ewald.pme import Pme

    if isinstance(term, Pme):  # as in `forces.ewald.errors`
        return len(term.charge) * (20 + 2.4 * term.order**2) + 8 * prod(term.grid)
    if isinstance(term, EwaldSum):
        return len(term.charge) * term.k_vectors.total / 2
    return 0.0


def in_words(seconds: float) -> str:
    """A duration with one significant digit: 40 s, 3 min, 2 h, 5 days."""
    units = (("days", 86400.0), ("h", 3600.0), ("min", 60.0))
    unit, size = next((entry for entry in units if seconds >= 1.5 * entry[1]), ("s", 1.0))
    return f"{float(f'{seconds / size:.1g}'):g} {unit}"
