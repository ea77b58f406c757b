"""Smooth particle mesh Ewald: the reciprocal part of an Ewald sum on a grid, by fast Fourier
transforms.

    charges -> grid -> Fourier transform, times the influence function -> potential on the grid ->
    forces

See the theory chapter `interactions`. The work is divided into blocks: planes, rows of Fourier
components, and sites. Sites are sorted by planes and strips of planes, and each plane is written by
one block. The number of blocks does not depend on the number of threads, so the result is the same
bit for bit. This module needs rocket-fft. Only scenes with PME import it.
"""

from fractions import Fraction
from math import comb, factorial, pi
from typing import NamedTuple

import numpy as np
from rocket_fft import c2c, c2r, r2c

from rigidmd.compile import (
    BLOCKS,
    MOST_BLOCKS,
    Code,
    Pass,
    call_blocks,
    chosen_by_type,
    kernel,
    load_arguments,
    pack_arguments,
    task,
)
from rigidmd.compile.simd import load_eight, load_four, store, sum_lanes
from rigidmd.core.state import NOT_FINITE, TALLY_SIZE
from rigidmd.forces.ewald.direct_sum import add_k_vector, invert_cell
from rigidmd.forces.ewald.errors import aliases
from rigidmd.forces.ewald.smooth import InverseR, Smooth, strength_times_square
from rigidmd.forces.neighbors.sites import (
    BodySites,
    CentralSites,
    load_pass,
    locate_site,
    sum_passes,
    virial_buffer,
)
from rigidmd.forces.neighbors.space import follow_cell
from rigidmd.forces.terms import FORCES_ONLY, TALLIED, Evaluation, Setup, TermPasses

STRIP = 4  # rows of a strip, whose sites are consecutive in the order
PLANES = 16  # of a block, if there are more blocks than the minimum
SERIAL_POINTS = 16**3  # up to this number of grid points there is one block


def weights(order: int) -> np.ndarray:
    """(order, order) coefficients [j, t] of u'^j in the weight of grid point floor(x) + t, u' = x -
    floor(x) - 1/2. The cardinal B-spline M_p of an order p is a polynomial of degree p - 1 between
    neighbouring points, p points wide and p - 2 times differentiable (Essmann et al. 1995, eq.
    4.1). Each is an exact fraction, which is rounded once."""
    middles = [order - Fraction(1, 2) - t for t in range(order)]
    return np.array(
        [[float(_b_spline_coefficient(order, j, x)) for x in middles] for j in range(order)]
    )


def _b_spline_coefficient(order: int, j: int, x: Fraction) -> Fraction:
    """The j-th derivative of M_p at x over j!, of a sum of truncated powers (eq. 4.1)."""
    powers = [
        (-1) ** k * comb(order, k) * (x - k) ** (order - 1 - j) for k in range(order + 1) if k < x
    ]
    return comb(order - 1, j) * sum(powers, Fraction(0)) / factorial(order - 1)


class Spline(NamedTuple):
    """Splines of one order, with weights as vectors: four numbers up to order 4, eight up to order
    8."""

    nodes: tuple[int, ...]  # 0 ... order - 1; its length is a constant at compile time
    value: np.ndarray  # (width order,) coefficients of the weights, see `weights`
    slope: np.ndarray  # (width (order - 1),) coefficients of their derivatives


class PmeMesh(NamedTuple):
    """The grid and its arrays. Rows are longer than the grid, so that splines do not wrap
    around."""

    points: np.ndarray  # (3,) number along a, b, c
    # (2,) of planes and rows in `flat`. As products of the shape they would cost a multiplication
    # for each row
    strides: np.ndarray
    bounds: np.ndarray  # (3, blocks + 1) of planes, rows of Fourier components and sites
    cell: np.ndarray  # (3, 3)
    reciprocal: np.ndarray  # (3, 3) rows 2 pi times the reciprocal edges, 1/Å
    force: np.ndarray  # (s, 3)
    corner: np.ndarray  # (s, 3) int32 first grid point to which a site is spread
    # (s, 4) position of a site minus corner minus 1/2, in grid cells; its charge
    offset: np.ndarray
    # (blocks, n_a, strips) of the sites of a block: how many have their corner in a strip; then
    # where in `order` the next one goes
    next_of_strip: np.ndarray
    order: np.ndarray  # (s,) int32 sites sorted by the strip of their corner
    first: np.ndarray  # (n_a + 1,) plane p has sites order[first[p]] ... order[first[p + 1] - 1]
    grid: np.ndarray  # (n_a, n_b + order - 1, n_c + width) charges, then potential
    flat: np.ndarray  # the same memory, with one index
    spectrum: np.ndarray  # (n_a, n_b, n_c//2 + 1)
    influence: np.ndarray  # (n_a, n_b, n_c//2 + 1) potential over charge, by Fourier component
    alias: np.ndarray  # (3, 6, most points) errors.Aliases of the axes
    axes: np.ndarray  # (3, 1) indices of the axes, for the transforms
    tallies: np.ndarray  # (blocks, 10)
    virial: np.ndarray  # see `virial_buffer`
    not_finite: np.ndarray  # (blocks,) whether a position is not finite
    weight: np.ndarray  # (blocks, 64) the weights of one site, which are read one by one


class Pme(NamedTuple):
    smooth: Smooth
    charge: np.ndarray  # (s,) as in `direct_sum.EwaldSum`
    sites: BodySites | CentralSites
    grid: tuple[int, int, int]  # points along a, b, c
    order: int  # of the splines

    @property
    def acts_on_charges(self) -> bool:
        return isinstance(self.smooth, InverseR)

    def workspace(self, setup: Setup) -> "PmeWorkspace":
        grid, order = self.grid, self.order
        kind = np.dtype(setup.dtype)
        pair = np.complex64 if kind == np.float32 else np.complex128
        s = len(self.charge)
        width = 4 if order <= 4 else 8
        usable_blocks = min(max(BLOCKS, grid[0] // PLANES), MOST_BLOCKS, grid[0] // order)
        blocks = max(1, usable_blocks) if np.prod(grid) > SERIAL_POINTS else 1
        value = np.zeros((order, width))
        value[:, :order] = weights(order)
        slope = value[1:] * np.arange(1, order)[:, None]
        spline = Spline(tuple(range(order)), value.ravel().astype(kind), slope.ravel().astype(kind))
        table = np.zeros((3, 6, max(grid)))
        for d in range(3):
            table[d, :, : grid[d]] = aliases(grid[d], order)
        padded = np.zeros((grid[0], grid[1] + order - 1, grid[2] + width), kind)
        spectrum_shape = (grid[0], grid[1], grid[2] // 2 + 1)
        mesh = PmeMesh(
            points=np.array(grid, np.int64),
            strides=np.array([padded[0].size, padded[0, 0].size]),
            bounds=np.linspace(0, [grid[0], grid[1], s], blocks + 1).astype(np.int64).T.copy(),
            cell=np.zeros((3, 3)),
            reciprocal=np.zeros((3, 3)),
            force=np.zeros((s, 3)),
            corner=np.zeros((s, 3), np.int32),
            offset=np.zeros((s, 4), kind),
            next_of_strip=np.zeros((blocks, grid[0], (grid[1] - 1) // STRIP + 1), np.int64),
            order=np.zeros(s, np.int32),
            first=np.zeros(grid[0] + 1, np.int64),
            grid=padded,
            flat=padded.reshape(-1),
            spectrum=np.zeros(spectrum_shape, pair),
            influence=np.zeros(spectrum_shape, kind),
            alias=table,
            axes=np.arange(3)[:, None],
            tallies=np.zeros((blocks, TALLY_SIZE)),
            virial=virial_buffer(),
            not_finite=np.zeros(blocks, np.bool_),
            weight=np.zeros((blocks, 64), kind),
        )
        return PmeWorkspace(self.smooth, self.charge, self.sites, spline, mesh)


class PmeWorkspace(NamedTuple):
    smooth: Smooth
    charge: np.ndarray
    sites: BodySites | CentralSites
    spline: Spline
    mesh: PmeMesh
    code: Code | None = None

    @property
    def site_force(self) -> np.ndarray:
        """Forces (s, 3) on its sites as last evaluated, lab frame, u Å/ps²."""
        return self.mesh.force

    @property
    def _content(self) -> tuple:
        return self.smooth, self.charge, self.spline, self.mesh

    def with_code(self) -> "PmeWorkspace":
        return self._replace(code=Code(influence=(_set_influence, self._content)))

    def passes(self, into: Evaluation) -> TermPasses:
        """The influence function, if the cell has changed. Positions, charges on the grid, and the
        forces."""
        mesh, content, sites = self.mesh, self._content, self.sites
        blocks = len(mesh.tallies)
        follow = (self.code, *content, into.state)
        plain, tallied = (self.smooth, mesh, None), (self.smooth, mesh, mesh.tallies)
        across = "transform across planes, times influence"
        return TermPasses(
            cell=[Pass("influence function, if the cell has changed", _follow_cell, follow)],
            positions=[
                Pass(
                    "positions in grid cells",
                    _find_cells,
                    (sites, into.state, self.charge, mesh),
                    blocks,
                ),
                Pass("first site of each strip", _find_first_sites, (mesh, into.status)),
                Pass("sort sites by strip", _sort_sites, (mesh,), blocks),
            ],
            forces=[
                Pass("charges on the grid, transform of planes", _spread_charges, content, blocks),
                Pass(across, _convolve, plain, blocks, FORCES_ONLY),
                Pass(f"{across}, energy and virial", _convolve, tallied, blocks, TALLIED),
                Pass("transform of planes to the potential", _transform_back, content, blocks),
                Pass("forces on sites", _interpolate_forces, content, blocks),
                *sum_passes(sites, into, mesh.force, mesh),
            ],
            loads=[load_pass(sites, into, mesh.force)],
        )


@task(count_references=False)
def _follow_cell(arguments, block):
    """Set the influence function, if the cell has changed."""
    code, smooth, charge, spline, mesh, state = load_arguments(arguments)
    if follow_cell(state.cell, mesh.cell):
        invert_cell(mesh.cell, mesh.reciprocal)
        call_blocks(
            code, "influence", pack_arguments((smooth, charge, spline, mesh)), len(mesh.tallies)
        )


@task(count_references=False)
def _set_influence(arguments, block):
    """The influence function for a block of rows: k² g U²/(sum U² sum k² U²), with g of the
    kernel."""
    smooth, _charge, _spline, mesh = load_arguments(arguments)
    b, of = mesh.reciprocal, mesh.alias
    volume = (
        8
        * pi**3
        / abs(
            b[0, 0] * (b[1, 1] * b[2, 2] - b[1, 2] * b[2, 1])
            - b[0, 1] * (b[1, 0] * b[2, 2] - b[1, 2] * b[2, 0])
            + b[0, 2] * (b[1, 0] * b[2, 1] - b[1, 1] * b[2, 0])
        )
    )
    for x in range(mesh.spectrum.shape[0]):
        for y in range(mesh.bounds[1, block], mesh.bounds[1, block + 1]):
            for z in range(mesh.spectrum.shape[2]):
                at = (x, y, z)
                square = weakened = 0.0
                for d in range(3):
                    for e in range(3):
                        metric = b[d, 0] * b[e, 0] + b[d, 1] * b[e, 1] + b[d, 2] * b[e, 2]
                        if d == e:
                            other, last = (d + 1) % 3, (d + 2) % 3
                            square += metric * of[d, 0, at[d]] ** 2
                            weakened += (
                                metric
                                * of[d, 5, at[d]]
                                * of[other, 3, at[other]]
                                * of[last, 3, at[last]]
                            )
                        else:
                            last = 3 - d - e
                            square += metric * of[d, 1, at[d]] * of[e, 1, at[e]]
                            weakened += (
                                metric * of[d, 4, at[d]] * of[e, 4, at[e]] * of[last, 3, at[last]]
                            )
                unaliased = of[0, 2, x] * of[1, 2, y] * of[2, 2, z]
                whole = of[0, 3, x] * of[1, 3, y] * of[2, 3, z]
                mesh.influence[x, y, z] = 0.0
                if x + y + z > 0:
                    g = strength_times_square(smooth, square, volume)
                    mesh.influence[x, y, z] = g * unaliased / (whole * weakened)


@task(count_references=False)
def _find_cells(arguments, block):
    """Grid cells of the sites of a block, and their number in each strip."""
    sites, state, charge, mesh = load_arguments(arguments)
    mesh.not_finite[block] = False
    mesh.next_of_strip[block] = 0
    strips = mesh.next_of_strip[block]
    b, points = mesh.reciprocal, mesh.points
    for n in range(mesh.bounds[2, block], mesh.bounds[2, block + 1]):
        i = np.uint64(n)
        r = locate_site(sites, state, sites.molecule[i], n)
        offset, cell = mesh.offset[i], mesh.corner[i]
        for d in range(3):
            turns = (r[0] * b[d, 0] + r[1] * b[d, 1] + r[2] * b[d, 2]) * (0.5 / pi)
            x = (turns - np.floor(turns)) * points[d]
            if not abs(x) < 1e9:
                mesh.not_finite[block] = True
                return
            corner = np.int32(x)
            offset[d] = x - corner - 0.5
            cell[d] = corner if corner < points[d] else 0
        offset[3] = charge[i]
        strips[np.uint32(cell[0]), np.uint32(cell[1]) // np.uint32(STRIP)] += 1


@task(count_references=False)
def _find_first_sites(arguments, block):
    """Where the sites of each strip and block start in the order, if all are on the grid."""
    mesh, status = load_arguments(arguments)
    for b in range(len(mesh.not_finite)):
        if mesh.not_finite[b]:
            status[0] = NOT_FINITE
            return
    begin = 0
    for plane in range(mesh.points[0]):
        mesh.first[plane] = begin
        for strip in range(mesh.next_of_strip.shape[2]):
            for b in range(len(mesh.not_finite)):
                count = mesh.next_of_strip[b, plane, strip]
                mesh.next_of_strip[b, plane, strip] = begin
                begin += count
    mesh.first[mesh.points[0]] = begin


@task(count_references=False)
def _sort_sites(arguments, block):
    """Enter the sites of a block into the order by strips. The sort is stable."""
    (mesh,) = load_arguments(arguments)
    following = mesh.next_of_strip[block]
    for i in range(mesh.bounds[2, block], mesh.bounds[2, block + 1]):
        plane, strip = mesh.corner[i, 0], mesh.corner[i, 1] // STRIP
        mesh.order[following[plane, strip]] = i
        following[plane, strip] += 1


@chosen_by_type(inline=True, count_references=False)
def load_vector(spline, array, index):
    """Numbers of an array from an index on, as a vector of four or eight, as the weights of the
    spline."""
    if spline.types[0].count <= 4:
        return lambda spline, array, index: load_four(array, index)
    return lambda spline, array, index: load_eight(array, index)


@kernel(inline=True, count_references=False)
def weights_at(spline, offset):
    """Weights of the grid points from the corner on, as a vector."""
    return _polynomials(spline, spline.value, spline.nodes, offset)


@kernel(inline=True, count_references=False)
def slopes_at(spline, offset):
    """Derivatives of these weights, per grid cell."""
    return _polynomials(spline, spline.slope, spline.nodes[1:], offset)


@kernel(inline=True, count_references=False)
def _polynomials(spline, coefficients, powers, offset):
    """Polynomials in `offset`, one in each lane, from coefficients (powers width,). powers : a
    tuple, whose length is a constant at compile time, so that the loop is unrolled"""
    terms = len(powers)
    width = len(coefficients) // terms
    found = load_vector(spline, coefficients, width * (terms - 1))
    for j in range(terms - 2, -1, -1):
        found = found * offset + load_vector(spline, coefficients, width * j)
    return found


@task(count_references=False)
def _spread_charges(arguments, block):
    """Spread charges over the planes of a block, and Fourier transform the planes."""
    _smooth, _charge, spline, mesh = load_arguments(arguments)
    low, high = mesh.bounds[0, block], mesh.bounds[0, block + 1]
    na, nb, nc = mesh.points[0], mesh.points[1], mesh.points[2]
    order = len(spline.nodes)
    grid, flat = mesh.grid, mesh.flat
    plane_size, row = mesh.strides[0], mesh.strides[1]
    weight = mesh.weight[block]
    grid[low:high] = 0
    for before in range(1 - order, min(high - low, na + 1 - order)):
        corner = low + before
        corner += na if corner < 0 else 0
        # the planes of these sites that are in the block
        first, end = max(0, -before), min(order, high - low - before)
        if high - low == na:
            first, end = 0, order
        for n in range(mesh.first[corner], mesh.first[corner + 1]):
            i = np.uint64(mesh.order[n])
            offset, cell = mesh.offset[i], mesh.corner[i]
            store(weight, 0, weights_at(spline, offset[0]))
            store(weight, 8, weights_at(spline, offset[1]))
            z = weights_at(spline, offset[2]) * offset[3]
            at = cell[1] * row + cell[2]
            for j in range(first, end):
                plane = corner + j
                plane -= na if plane >= na else 0
                begin = plane * plane_size + at
                charge = z * weight[np.uint64(j)]
                for k in range(order):
                    here = begin + k * row
                    store(flat, here, load_vector(spline, flat, here) + charge * weight[8 + k])
    for plane in range(low, high):
        for k in range(order - 1):
            for c in range(nc + order - 1):
                grid[plane, k, c] += grid[plane, nb + k, c]
        for b in range(nb):
            for c in range(order - 1):
                grid[plane, b, c] += grid[plane, b, nc + c]
    r2c(grid[low:high, :nb, :nc], mesh.spectrum[low:high], mesh.axes[2], True, 1.0, 1)
    c2c(mesh.spectrum[low:high], mesh.spectrum[low:high], mesh.axes[1], True, 1.0, 1)


@task(count_references=False)
def _convolve(arguments, block):
    smooth, mesh, tallies = load_arguments(arguments)
    convolve_block(smooth, mesh, tallies, block)


@kernel(inline=True, count_references=False)
def convolve_block(smooth, mesh, tallies, block):
    """Multiply a block of rows by the influence function. Energy and virial into `tallies` unless
    None."""
    low, high = mesh.bounds[1, block], mesh.bounds[1, block + 1]
    spectrum, of, b = mesh.spectrum, mesh.alias, mesh.reciprocal
    if tallies is not None:
        tallies[block] = 0.0
    c2c(spectrum[:, low:high], spectrum[:, low:high], mesh.axes[0], True, 1.0, 1)
    for x in range(spectrum.shape[0]):
        for y in range(low, high):
            for z in range(spectrum.shape[2]):
                value = spectrum[x, y, z]
                strength = mesh.influence[x, y, z]
                spectrum[x, y, z] = value * strength
                if tallies is not None and x + y + z > 0:
                    # components n_c and -n_c are stored once, unless they are the same
                    multiplicity = 0.5 if z == 0 or 2 * z == mesh.points[2] else 1.0
                    real, imaginary = float(value.real), float(value.imag)
                    energy = multiplicity * strength * (real * real + imaginary * imaginary)
                    add_k_vector(
                        tallies[block], energy, (of[0, 0, x], of[1, 0, y], of[2, 0, z]), b, smooth
                    )
    c2c(spectrum[:, low:high], spectrum[:, low:high], mesh.axes[0], False, 1.0, 1)


@task(count_references=False)
def _transform_back(arguments, block):
    """Transform the planes of a block back to the potential."""
    _smooth, _charge, spline, mesh = load_arguments(arguments)
    low, high = mesh.bounds[0, block], mesh.bounds[0, block + 1]
    nb, nc = mesh.points[1], mesh.points[2]
    order = len(spline.nodes)
    grid = mesh.grid
    c2c(mesh.spectrum[low:high], mesh.spectrum[low:high], mesh.axes[1], False, 1.0, 1)
    c2r(mesh.spectrum[low:high], grid[low:high, :nb, :nc], mesh.axes[2], False, 1.0, 1)
    for plane in range(low, high):
        for b in range(nb):
            for c in range(order - 1):
                grid[plane, b, nc + c] = grid[plane, b, c]
        for k in range(order - 1):
            for c in range(nc + order - 1):
                grid[plane, nb + k, c] = grid[plane, k, c]


@task(count_references=False)
def _interpolate_forces(arguments, block):
    """Forces on the sites of a block: minus the gradient of the potential at each site, times its
    charge."""
    _smooth, charge, spline, mesh = load_arguments(arguments)
    na = mesh.points[0]
    order = len(spline.nodes)
    flat = mesh.flat
    plane_size, row = mesh.strides[0], mesh.strides[1]
    weight = mesh.weight[block]
    for n in range(mesh.bounds[2, block], mesh.bounds[2, block + 1]):
        i = np.uint64(mesh.order[n])
        offset, cell = mesh.offset[i], mesh.corner[i]
        store(weight, 0, weights_at(spline, offset[0]))
        store(weight, 8, weights_at(spline, offset[1]))
        store(weight, 16, slopes_at(spline, offset[0]))
        store(weight, 24, slopes_at(spline, offset[1]))
        z = weights_at(spline, offset[2])
        dz = slopes_at(spline, offset[2])
        at = cell[1] * row + cell[2]
        nothing = z * 0.0
        along_a = nothing
        along_b = nothing
        along_c = nothing
        for j in range(order):
            plane = cell[0] + j
            plane -= na if plane >= na else 0
            begin = plane * plane_size + at
            even = nothing
            tilted = nothing
            for k in range(order):
                potential = load_vector(spline, flat, begin + k * row)
                even = even + potential * weight[8 + k]
                tilted = tilted + potential * weight[24 + k]
            along_a = along_a + even * weight[16 + j]
            along_b = along_b + tilted * weight[j]
            along_c = along_c + even * weight[j]
        ga = -charge[i] * mesh.points[0] * sum_lanes(along_a * z) * (0.5 / pi)
        gb = -charge[i] * mesh.points[1] * sum_lanes(along_b * z) * (0.5 / pi)
        gc = -charge[i] * mesh.points[2] * sum_lanes(along_c * dz) * (0.5 / pi)
        for k in range(3):
            mesh.force[i, k] = (
                ga * mesh.reciprocal[0, k] + gb * mesh.reciprocal[1, k] + gc * mesh.reciprocal[2, k]
            )
