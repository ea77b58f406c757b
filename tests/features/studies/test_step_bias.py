"""What the step adds to the means of one run: `features/studies/step_bias.py`."""

import numpy as np
import pytest

from rigidmd.core import integrators
from rigidmd.core.quantities import QUANTITIES
from rigidmd.features.studies.step_bias import (
    BAR_NM3,
    GAS_CONSTANT,
    Conditions,
    Production,
    Series,
    bias_of,
    biases_of,
    kinetic_part,
    moments_of_run,
    slopes,
)

#: An oscillator and a planar rotor that are coupled: U = K x²/2 + V (1 - cos a) + C x sin a.
MASS, INERTIA, K, V, C = 2.0, 0.05, 900.0, 6.0, 12.0
TEMPERATURE = 300.0
THERMAL = GAS_CONSTANT * TEMPERATURE
STEP = 0.004  # ps
#: Numbers of the shadow Hamiltonian, and of the kinetic energy where the thermostat acts.
SCHEMES = {
    "velocity_verlet": (1 / 12, -1 / 24, 0.0),
    "baoab": (1 / 12, -1 / 24, 1 / 8),
    "position_verlet": (-1 / 24, 1 / 12, 0.0),
}
COLUMNS = {"U": 1.0, "U by momenta": np.nan, "x": np.nan, "x²": np.nan, "cos a": np.nan}


def conditions_of(scheme):
    return Conditions(STEP, TEMPERATURE, 0.0, 1, 1, (1, 1), *SCHEMES[scheme])


def configurations():
    """All x and a on a grid, with U, squares of force and torque over mass and inertia, and the
    second derivatives over them."""
    x, a = np.meshgrid(np.linspace(-0.5, 0.5, 801), np.linspace(-np.pi, np.pi, 721)[:-1])
    x, a = x.ravel(), a.ravel()
    energy = K * x**2 / 2 + V * (1 - np.cos(a)) + C * x * np.sin(a)
    force = K * x + C * np.sin(a)
    torque = V * np.sin(a) + C * x * np.cos(a)
    curvatures = K / MASS, (V * np.cos(a) - C * x * np.sin(a)) / INERTIA
    mixed = C * np.cos(a) / np.sqrt(MASS * INERTIA)
    return x, a, energy, (force**2 / MASS, torque**2 / INERTIA), curvatures, mixed


def exact_bias(scheme, factor):
    """Means of U, x, x², cos a over the shadow Hamiltonian less those over the Hamiltonian, for
    a step that is shorter by a factor, times the square of the factor."""
    drift, kick, correction = SCHEMES[scheme]
    x, a, energy, squares, curvatures, _ = configurations()
    observed = np.array([energy, x, x**2, np.cos(a)])
    weight = np.exp(-energy / THERMAL)
    weight /= weight.sum()
    dt2 = (STEP / factor) ** 2
    all_squares = squares[0] + squares[1]
    hotter = 2 * (drift - correction) * (weight @ all_squares) / (2 * THERMAL) * dt2
    shadow = energy + dt2 * (drift * THERMAL * sum(curvatures) + kick * all_squares)
    shifted = np.exp(-shadow / THERMAL / (1 + hotter))
    return factor**2 * (observed @ (shifted / shifted.sum()) - observed @ weight)


def sampled(scheme, count, seed=3):
    """Independent samples of the Hamiltonian, columns and their series."""
    rng = np.random.default_rng(seed)
    correction = SCHEMES[scheme][2]
    x, a, energy, squares, curvatures, mixed = configurations()
    weight = np.exp(-energy / THERMAL)
    chosen = rng.choice(len(x), count, p=weight / weight.sum())
    momenta = np.sqrt(THERMAL) * rng.standard_normal((2, count))  # over the roots of the masses
    squares = squares[0][chosen], squares[1][chosen]
    curvature = curvatures[0] * momenta[0] ** 2 + curvatures[1][chosen] * momenta[1] ** 2
    curvature += 2 * mixed[chosen] * momenta[0] * momenta[1]
    kinetic = 0.5 * momenta**2
    seen = kinetic + correction * STEP**2 * np.array(squares)
    zero = np.zeros(count)
    series = Series(energy[chosen], zero, (seen[0], seen[1]), squares, curvature, 0.1)
    at = x[chosen], a[chosen]
    values = [energy[chosen]] * 2 + [at[0], at[0] ** 2, np.cos(at[1])]
    return np.array(values), series


@pytest.mark.parametrize("scheme", SCHEMES)
def test_the_bias_of_a_coupled_oscillator_and_rotor_is_that_of_its_shadow_hamiltonian(scheme):
    """Exact means by sums over a grid, at a step of an eighth, where first order is all."""
    values, series = sampled(scheme, 400_000)
    found = bias_of(values, series, conditions_of(scheme), list(COLUMNS.values()))
    of_u, *others = exact_bias(scheme, 8.0)
    exact = dict(zip(COLUMNS, [of_u, of_u, *others], strict=True))
    for name, bias, error in zip(COLUMNS, found.value, found.sampling, strict=True):
        assert abs(bias - exact[name]) < 4 * error, (name, bias, error, exact[name])
        size = max(abs(exact[name]), 0.02 * np.std(values[list(COLUMNS).index(name)]))
        assert error < size, (name, error, size)


def test_errors_of_a_bias_are_those_of_repeated_runs():
    found = [
        bias_of(*sampled("velocity_verlet", 2000, seed), conditions_of("velocity_verlet"), columns)
        for columns in [list(COLUMNS.values())]
        for seed in range(40)
    ]
    scatter = np.std([one.value for one in found], axis=0, ddof=1)
    errors = np.sqrt(np.mean([one.sampling**2 for one in found], axis=0))
    assert np.all(np.abs(np.log(errors / scatter)) < np.log(1.5))


#: Energies of a liquid that relax linearly: kinetic energies of translation and rotation with
#: thermostats of this rate, and the potential energy, which exchanges heat with both.
RATE, EXCHANGE = 20.0, (6.0, 30.0)  # 1/ps
FREEDOM, CAPACITY = (300, 300), 900  # in k/2


def relaxing(samples, interval, seed):
    """Changes (3, samples) of K of translation and rotation and of U in the canonical ensemble, and
    of the means of U for a relative change of each set temperature."""
    rng = np.random.default_rng(seed)
    sizes = np.array([*FREEDOM, CAPACITY]) / 2 * THERMAL**2  # variances
    conductance = np.zeros((3, 3))
    for k, rate in enumerate(EXCHANGE):
        flow = np.zeros(3)
        flow[[k, 2]] = 1, -1
        conductance += rate * sizes[k] * np.outer(flow, flow)
    conductance += np.diag([RATE * sizes[0], RATE * sizes[1], 0.0])
    matrix = conductance / sizes  # decay of the means
    set_points = RATE * np.diag([FREEDOM[0], FREEDOM[1], 0.0])[:, :2] / 2 * THERMAL
    response = np.linalg.solve(matrix, set_points)[2]
    values, vectors = np.linalg.eig(matrix)
    decay = (vectors * np.exp(-values * interval)) @ np.linalg.inv(vectors)
    root = np.linalg.cholesky(np.diag(sizes) - decay @ np.diag(sizes) @ decay.T)
    noise = rng.standard_normal((samples, 3)) @ root.T
    series = np.empty((samples, 3))
    state = np.sqrt(sizes) * rng.standard_normal(3)
    for k in range(samples):
        state = decay @ state + noise[k]
        series[k] = state
    return series.T, response


def test_two_thermostats_have_two_shifts():
    """The mean of U with thermostats of translation and rotation at different temperatures of the
    shadow Hamiltonian, in a liquid whose response to each is known. The sum of squares is all in
    rotation, and does not fluctuate."""
    (one, other, potential), response = relaxing(100_000, 0.02, 5)
    total = sum(response)
    assert total == pytest.approx(CAPACITY * THERMAL / 2)  # heat capacity
    assert response[1] > 1.5 * response[0]
    constant = np.ones(len(one))
    squares = 0.0 * constant, 1e5 * constant
    series = Series(potential, 0.0 * constant, (one, other), squares, 0.0 * constant, 0.02)
    at = Conditions(STEP, TEMPERATURE, 0.0, 1, 1, FREEDOM, 0.0, 0.0, -1 / 8, rates=(RATE, RATE))
    hotter = 2 / 8 * 1e5 / FREEDOM[1] / THERMAL
    found, *without = (slopes(of, at, [0.0]) for of in moments_of_run(potential[None], series, at))
    error = 3 * np.std([of.value for of in without])
    expected = response[1] * hotter
    assert abs(found.value[0] - expected) < 4 * error
    assert error < 0.1 * expected
    # without a known response the mean of both shifts, which it may miss by half their difference
    unknown = at._replace(rates=(0.0, 0.0))
    of_mean = slopes(next(moments_of_run(potential[None], series, unknown)), unknown, [0.0])
    assert of_mean.value[0] == pytest.approx(total * hotter / 2, rel=0.05)
    assert abs(of_mean.value[0] - expected) > 3 * error
    assert of_mean.missed[0] == pytest.approx(total * hotter / 4, rel=0.05)


@pytest.mark.parametrize("name", integrators.SCHEMES)
def test_numbers_of_the_shadow_hamiltonian_are_those_of_an_oscillator(name):
    """A step of unit mass and frequency conserves p² (1/2 + shadow_correction dt²) + x² (1/2 +
    shadow_squares dt²)."""
    scheme, h = integrators.SCHEMES[name], 0.01
    step = np.eye(2)
    for flow in scheme.flows:
        if flow.kind == integrators.DRIFT:
            step = [[1.0, flow.fraction * h], [0.0, 1.0]] @ step
        elif flow.kind == integrators.KICK:
            kick = flow.fraction * h * (1 - flow.gradient * h * h)
            step = [[1.0, 0.0], [-kick, 1.0]] @ step
    ratio = -step[1, 0] / step[0, 1]
    difference = scheme.shadow_squares - scheme.shadow_correction
    assert (ratio - 1) / h**2 == pytest.approx(2 * difference, abs=1e-3)
    if name in SCHEMES:
        assert (scheme.shadow_correction, scheme.shadow_squares) == pytest.approx(SCHEMES[name][:2])


def test_a_pressure_at_zero_has_the_exact_kinetic_part():
    """N kT/V of the same volumes, also where the total momentum is kept at zero, and the noise of
    momenta is in no error at zero."""
    rng, count, moving = np.random.default_rng(2), 4000, 20
    freedom = (3 * moving - 3, 0)
    volume = 3.0 + 0.1 * rng.standard_normal(count)
    kinetic = THERMAL / 2 * rng.chisquare(freedom[0], count)
    exact = moving * THERMAL / volume / BAR_NM3
    virial = 1e-3 * rng.standard_normal(count)
    pressure = exact * kinetic / (freedom[0] * THERMAL / 2) + virial
    potential, nothing = rng.standard_normal(count), np.zeros(count)
    series = Series(
        potential, volume, (kinetic, nothing), (nothing + 1.0, nothing), nothing + 1.0, 0.1
    )
    at = Conditions(
        STEP, TEMPERATURE, 0.0, moving, moving, freedom, *SCHEMES["baoab"], has_barostat=True
    )
    columns = {"pressure": pressure, "volume": volume}
    rest = pressure - kinetic_part(QUANTITIES["pressure"], Production(at, series, columns))
    assert rest == pytest.approx(exact + virial, rel=1e-9)
    found = biases_of(Production(at, series, columns), QUANTITIES)["pressure"]
    assert found[2] < 0.3 * found[1]
    assert pressure.mean() - found[0] == pytest.approx((exact + virial).mean(), abs=4 * found[2])
