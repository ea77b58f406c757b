"""A free body, its run and its end, in a fluid and with a rotor."""

import numpy as np
from scipy.integrate import quad, solve_ivp

from rigidmd.features.bodies.assemble import build_body
from rigidmd.mechanics.rotation import from_vector, hat
from rigidmd.run import Simulation
from rigidmd.scene import Scene
from support.scenes import PINNED

FREE = {
    "body": {"mass_kg": 2.0, "inertia_kg_m2": [0.5, 0.7, 0.9]},
    "start": {
        "quaternion_wxyz": [0.3, -0.2, 0.5, 0.7],
        "angular_velocity_body_rad_s": [1.0, -2.0, 3.0],
        "position_m": [1.0, 2.0, 3.0],
        "velocity_m_s": [0.5, -0.4, 0.3],
    },
    "gravity": {"acceleration_m_s2": [1.0, 2.0, -9.0]},
    "run": {"duration_s": 1.0, "timestep_s": 0.01},
    "output": {"trajectory": False, "interval_s": 0.1},
}


def simulate(data, applied=None, **changes):
    scene = Scene.from_dict(
        {k: dict(v) if isinstance(v, dict) else v for k, v in data.items()},
        overrides={k.replace("__", "."): v for k, v in changes.items()},
    )
    return Simulation(scene, applied=applied).run()


def end(results):
    q = np.array([results[f"q{i}{j}"][-1] for i in (1, 2, 3) for j in (1, 2, 3)]).reshape(3, 3)
    x, v, w = (
        np.array([results[name][-1] for name in names])
        for names in (("x", "y", "z"), ("vx", "vy", "vz"), [f"omega_body_{k}" for k in (1, 2, 3)])
    )
    return x, v, q, w


def solve(slopes, y, t):
    return solve_ivp(slopes, (0, t), y, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]


FLUID = {
    "linear_resistance_kg_s": [1.0, 2.0, 3.0],
    "quadratic_resistance_kg_m": [0.5, 0.2, 0.7],
    "linear_rotational_resistance_N_m_s": [0.1, 0.2, 0.3],
    "quadratic_rotational_resistance_N_m_s2": [0.05, 0.02, 0.03],
    "displaced_mass_kg": 1.5,
    "centre_of_buoyancy_m": [0.01, -0.02, 0.05],
    "added_mass_kg": [0.3, 0.6, 0.9],
    "added_inertia_kg_m2": [0.05, 0.1, 0.15],
}


def kirchhoff_end(t):
    """P' = P x w + f, L' = L x w + P x v + n in the body frame, straight from the ledger."""
    m, i = (
        2 + np.array(FLUID["added_mass_kg"]),
        np.array([0.5, 0.7, 0.9]) + FLUID["added_inertia_kg_m2"],
    )
    system = build_body(Scene.from_dict(FREE))
    q, g = system.state.rotation[0], np.array([1.0, 2.0, -9.0])
    a, b, c, d = (np.array(FLUID[k]) for k in list(FLUID)[:4])
    arm = np.array(FLUID["centre_of_buoyancy_m"])

    def slopes(_, y):
        q, p, angular = y[3:12].reshape(3, 3), y[12:15], y[15:]
        v, w = p / m, angular / i
        lift = -1.5 * q.T @ g
        f = 2 * q.T @ g + lift - (a + b * np.linalg.norm(v)) * v
        n = np.cross(arm, lift) - (c + d * np.linalg.norm(w)) * w
        return np.concatenate(
            [
                q @ v,
                (q @ hat(w)).ravel(),
                np.cross(p, w) + f,
                np.cross(angular, w) + np.cross(p, v) + n,
            ]
        )

    y = [[1.0, 2.0, 3.0], q.ravel(), m * (q.T @ [0.5, -0.4, 0.3]), i * [1.0, -2.0, 3.0]]
    y = solve(slopes, np.concatenate(y), t)
    return y[:3], y[3:12].reshape(3, 3) @ (y[12:15] / m), y[3:12].reshape(3, 3), y[15:] / i


ROTOR = {
    "wheels": [
        {
            "axis": [0.0, 1.0, 2.0],
            "momentum_kg_m2_s": 1.5,
            "motor_torque_N_m": [0.0, 1.0, -1.0],
            "times_s": [0.2, 0.5, 0.9],
        },
        {"axis": [1.0, 0.0, 0.0], "motor_torque_N_m": 0.7, "from_s": 0.3, "to_s": 0.6},
    ],
    "friction": {"viscous_N_m_s": [0.2, 0.2, 0.2]},
    "frame": {
        "angular_velocity_rad_s": [0.3, -0.2, 0.5],
        "origin_acceleration_m_s2": [1.0, 0.5, 0.2],
    },
    "applied": [
        {"torque_N_m": [0.5, 0.2, -0.3]},
        {
            "axes": "body",
            "force_N": [1.0, 2.0, -1.0],
            "at_m": [0.2, 0.0, 0.1],
            "torque_N_m": [0.0, 0.1, 0.0],
        },
        {
            "force_N": [[0.0, 0.0, 1.0], [0.0, 3.0, 1.0]],
            "times_s": [0.0, 1.0],
            "at_m": [0.0, 0.3, 0.0],
        },
    ],
}


def rotor_end(t_end):
    """All of ROTOR seen from axes that do not rotate: what is fixed in the frame rotates with it."""
    i = build_body(Scene.from_dict(PINNED)).inertia
    axes = build_body(Scene.from_dict(PINNED)).axes
    tensor = axes @ np.diag(i) @ axes.T
    turning, arm = np.array([0.3, -0.2, 0.5]), np.array([0.1, 0.2, 0.3])
    slant = np.array([0.0, 1.0, 2.0]) / 5**0.5

    def rotors(t):
        torque = quad(
            lambda s: np.interp(s, [0.2, 0.5, 0.9], [0, 1, -1]),
            0,
            t,
            points=[0.2, 0.5, 0.9] if t > 0 else None,
            epsabs=1e-13,
        )[0]
        return (1.5 + torque) * slant + 0.7 * np.clip(t - 0.3, 0, 0.3) * np.array([1.0, 0, 0])

    def slopes(t, y):
        q, angular = y[:9].reshape(3, 3), y[9:12]
        frame = from_vector(turning * t)
        w = np.linalg.solve(tensor, angular - rotors(t))
        weight = 2 * (np.array([0, 0, -9.81]) - [1.0, 0.5, 0.2])
        n = np.cross(arm, q.T @ frame @ weight) + q.T @ frame @ [0.5, 0.2, -0.3]
        n += np.cross([0.2, 0.0, 0.1], [1.0, 2.0, -1.0]) + np.array([0.0, 0.1, 0.0])
        n += np.cross([0.0, 0.3, 0.0], q.T @ frame @ [0.0, 3 * t, 1.0])
        n -= 0.2 * (w - q.T @ turning)
        return np.concatenate([(q @ hat(w)).ravel(), np.cross(angular, w) + n])

    start = build_body(Scene.from_dict(PINNED))
    q = start.state.rotation[0] @ axes.T
    w = np.array([1.0, -2.0, 3.0]) + q.T @ turning
    y = np.concatenate([q.ravel(), tensor @ w + rotors(0)])
    for a, b in ((0, 0.2), (0.2, 0.3), (0.3, 0.5), (0.5, 0.6), (0.6, 0.9), (0.9, t_end)):
        y = solve_ivp(slopes, (a, b), y, method="DOP853", rtol=1e-11, atol=1e-11).y[:, -1]
    q, angular = y[:9].reshape(3, 3), y[9:]
    w = np.linalg.solve(tensor, angular - rotors(t_end)) - q.T @ turning
    return from_vector(-turning * t_end) @ q, w
