"""The slow, obvious NumPy version of the forces: every pair of sites, no list, no cells, formulas as on paper.

The oracle against which kernels are checked. It shares no code with them, not even the endings at the cut-off.
"""

import numpy as np

KE = 138935.457644  # u Å³/ps² per e², CODATA 2018


AROUND = np.array(list(np.ndindex(5, 5, 5))) - 2


def quintic(r, start, cutoff):
    t = (r - start) / (cutoff - start)
    return 1 - 10 * t**3 + 15 * t**4 - 6 * t**5


def nonic(r, start, cutoff):
    t = (r - start) / (cutoff - start)
    return 1 - 126 * t**5 + 420 * t**6 - 540 * t**7 + 315 * t**8 - 70 * t**9


SWITCHES = {"switch": quintic, "smooth_switch": nonic}


def inverse_power(r, p, cutoff, start, name):
    """Energy of r^-p with its ending; by the definition of each ending in the manuals."""
    force = p * cutoff ** (-p - 1)
    if name == "plain":
        return r**-p
    if name == "shift":
        return r**-p - cutoff**-p
    if name == "force_shift":
        return r**-p - cutoff**-p + force * (r - cutoff)
    if name in SWITCHES:
        return r**-p * (SWITCHES[name](r, start, cutoff) if r > start else 1.0)
    # force_switch, GROMACS manual eq. 5.30 ff.
    a = -p * ((p + 4) * cutoff - (p + 1) * start) / (cutoff ** (p + 2) * (cutoff - start) ** 2)
    b = p * ((p + 3) * cutoff - (p + 1) * start) / (cutoff ** (p + 2) * (cutoff - start) ** 3)
    c = cutoff**-p - a / 3 * (cutoff - start) ** 3 - b / 4 * (cutoff - start) ** 4
    x = max(0.0, r - start)
    return r**-p - a / 3 * x**3 - b / 4 * x**4 - c


def reaction_field(r, cutoff, start, name, permittivity):
    """Energy of two unit charges (1/Å)."""
    if np.isinf(cutoff):
        return 1 / r
    k = 0.5 if np.isinf(permittivity) else (permittivity - 1) / (2 * permittivity + 1)
    k /= cutoff**3

    def bare(r):
        return 1 / r + k * r**2

    if name == "plain":
        return bare(r)
    if name == "shift":
        return bare(r) - bare(cutoff)
    slope = -1 / cutoff**2 + 2 * k * cutoff
    if name == "force_shift":
        return bare(r) - bare(cutoff) - slope * (r - cutoff)
    if name in SWITCHES:
        return (bare(r) - bare(cutoff)) * (SWITCHES[name](r, start, cutoff) if r > start else 1.0)
    # force_switch: integrate a cubic that takes force and its derivative to zero
    curve = 2 / cutoff**3 + 2 * k
    d = cutoff - start
    a, b = np.linalg.solve([[d**2, d**3], [2 * d, 3 * d**2]], [slope, curve])

    def added(r):
        x = max(0.0, r - start)
        return -a / 3 * x**3 - b / 4 * x**4

    return bare(r) + added(r) - bare(cutoff) - added(cutoff)


class Oracle:
    """Energy of a system by all pairs of sites; forces, torques and virial by central differences of it."""

    def __init__(self, system):
        scene = system.scene
        self.system = system
        self.edges = None
        if np.isfinite(system.space.volume):
            edges = np.zeros((3, 3))
            edges[0, 0], edges[1, 1], edges[2, 2] = system.space[:3]
            if len(system.space) > 3:
                edges[1, 0], edges[2, 0], edges[2, 1] = system.space[3:]
            self.edges = edges
        self.cutoff = system.cutoff
        usual = (
            0.6 * self.cutoff if scene.forces.truncation == "smooth_switch" else max(0.9 * self.cutoff, self.cutoff - 1)
        )
        self.start = scene.forces.switch_start_A or usual
        self.forces = scene.forces
        species = [system.species[k] for k in system.model.species]
        self.charge = np.concatenate([m.charges for m in species])
        self.sigma = np.concatenate([m.sigma for m in species])
        self.epsilon = np.concatenate([m.epsilon for m in species])
        self.owner = system.sites.molecule
        self.offset = system.sites.offset_body

    def sites(self, position, rotation):
        arms = np.einsum("sij,sj->si", rotation[self.owner], self.offset) if len(rotation) else 0.0
        return position[self.owner] + arms

    def distance(self, d):
        """Shortest length of a displacement and its images: those of sites brought near one another, two boxes around."""
        if self.edges is None:
            return np.linalg.norm(d)
        near = d - np.round(d @ np.linalg.inv(self.edges)) @ self.edges
        return np.linalg.norm(near + AROUND @ self.edges, axis=1).min()

    def energy(self, position, rotation):
        """(lennard_jones, coulomb) in u Å²/ps²."""
        x = self.sites(position, rotation)
        f = self.forces
        lj = coulomb = 0.0
        for i in range(len(x)):
            for j in range(i):
                if self.owner[i] == self.owner[j]:
                    continue
                r = self.distance(x[i] - x[j])
                if r >= self.cutoff:
                    continue
                if self.epsilon[i] > 0 and self.epsilon[j] > 0:
                    s = (self.sigma[i] + self.sigma[j]) / 2
                    if f.mixing == "geometric":
                        s = np.sqrt(self.sigma[i] * self.sigma[j])
                    e = np.sqrt(self.epsilon[i] * self.epsilon[j])
                    if np.isinf(self.cutoff):
                        twelve, six = r**-12, r**-6
                    else:
                        twelve = inverse_power(r, 12, self.cutoff, self.start, f.truncation)
                        six = inverse_power(r, 6, self.cutoff, self.start, f.truncation)
                    lj += 4 * e * (s**12 * twelve - s**6 * six)
                if f.electrostatics != "none" and self.charge[i] != 0 and self.charge[j] != 0:
                    u = reaction_field(r, self.cutoff, self.start, f.truncation, f.reaction_field_permittivity)
                    coulomb += KE * self.charge[i] * self.charge[j] * u
        return lj, coulomb
