"""The slow, obvious NumPy version of the forces: every pair of sites, no list, no cells, formulas
as on paper.

The oracle against which kernels are checked. It has no common code with them, not even the truncations at
the cutoff.
"""

import numpy as np
from scipy.special import erf, erfc

KE = 138935.457644  # u Å³/ps² per e², CODATA 2018


AROUND = np.array(list(np.ndindex(5, 5, 5))) - 2


def nearest(d, cell):
    """Shortest image of a displacement (3,) in a cell (3, 3), rows a, b, c: brought near, then two
    cells around."""
    if cell is None:
        return d
    images = d - np.round(d @ np.linalg.inv(cell)) @ cell + AROUND @ cell
    return images[np.argmin((images**2).sum(axis=1))]


def quintic(r, start, cutoff):
    t = (r - start) / (cutoff - start)
    return 1 - 10 * t**3 + 15 * t**4 - 6 * t**5


def nonic(r, start, cutoff):
    t = (r - start) / (cutoff - start)
    return 1 - 126 * t**5 + 420 * t**6 - 540 * t**7 + 315 * t**8 - 70 * t**9


SWITCHES = {"switch": quintic, "smooth_switch": nonic}


def inverse_power(r, p, cutoff, start, name):
    """Energy of r^-p with its truncation; by the definition of each truncation in the manuals."""
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
    """Energy of a system by all pairs of sites; forces, torques and virial by central differences
    of it."""

    def __init__(self, system):
        scene = system.scene
        self.system = system
        self.cell = None
        if np.isfinite(system.space.volume):
            self.cell = np.diag(np.array(system.space[:3]))
            self.cell[[1, 2, 2], [0, 0, 1]] = system.space[3:] or 0.0
        self.cutoff = system.cutoff
        usual = (
            0.6 * self.cutoff
            if scene.forces.truncation == "smooth_switch"
            else max(0.9 * self.cutoff, self.cutoff - 1)
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

    def energy(self, position, rotation):
        """(lennard_jones, coulomb) in u Å²/ps²."""
        x = self.sites(position, rotation)
        f = self.forces
        lj = coulomb = 0.0
        for i in range(len(x)):
            for j in range(i):
                if self.owner[i] == self.owner[j]:
                    continue
                r = np.linalg.norm(nearest(x[i] - x[j], self.cell))
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
                    u = reaction_field(
                        r, self.cutoff, self.start, f.truncation, f.reaction_field_permittivity
                    )
                    coulomb += KE * self.charge[i] * self.charge[j] * u
        return lj, coulomb


class EwaldOracle:
    """Ewald sums term by term: all pairs of sites by scipy's erfc, all k-vectors by complex
    exponentials, any cell.

    x (s, 3) sites with molecules whole, q (s,) in e, owner (s,), cell (3, 3) rows a, b, c; energies
    in u Å²/ps².
    """

    def __init__(self, x, q, owner, cell, alpha, cutoff, inside):
        """inside(n) states which integer vectors n (..., 3), up to 20 on each axis, are summed."""
        self.x, self.q, self.owner, self.cell = (
            np.array(x),
            np.array(q) * np.sqrt(KE),
            np.array(owner),
            np.array(cell),
        )
        self.alpha, self.cutoff, self.inside = alpha, cutoff, inside
        self.volume = abs(np.linalg.det(cell))

    def pairs(self):
        """(i, j, distance of the nearest image, whether they are of one molecule) of all pairs."""
        for i in range(len(self.x)):
            for j in range(i):
                same = self.owner[i] == self.owner[j]
                d = self.x[i] - self.x[j]
                yield i, j, np.linalg.norm(d if same else nearest(d, self.cell)), same

    @property
    def real(self):
        return sum(
            self.q[i] * self.q[j] * erfc(self.alpha * r) / r
            for i, j, r, same in self.pairs()
            if not same and r < self.cutoff
        )

    @property
    def reciprocal(self):
        n = np.stack(np.meshgrid(*[np.arange(-20, 21)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        n = n[self.inside(n) & n.any(axis=1)]
        k = 2 * np.pi * n @ np.linalg.inv(self.cell).T
        k2 = (k**2).sum(axis=1)
        s = np.exp(1j * k @ self.x.T) @ self.q
        return (
            2
            * np.pi
            / self.volume
            * np.sum(np.exp(-k2 / (4 * self.alpha**2)) / k2 * np.abs(s) ** 2)
        )

    @property
    def self(self):
        return -self.alpha / np.sqrt(np.pi) * self.q @ self.q

    @property
    def intramolecular(self):
        return -sum(
            self.q[i] * self.q[j] * erf(self.alpha * r) / r
            for i, j, r, same in self.pairs()
            if same
        )

    @property
    def background(self):
        return -np.pi / (2 * self.volume * self.alpha**2) * self.q.sum() ** 2

    def surface(self, permittivity):
        return 2 * np.pi / ((2 * permittivity + 1) * self.volume) * np.sum((self.q @ self.x) ** 2)

    @property
    def total(self):
        return self.real + self.reciprocal + self.self + self.intramolecular + self.background
