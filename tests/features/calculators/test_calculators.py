"""Forces on rigid molecules from calculators of ASE."""

import re

import numpy as np
import pytest
import tomli_w
from ase import units
from ase.calculators.calculator import Calculator, all_changes
from ase.calculators.lj import LennardJones
from ase.calculators.tip3p import TIP3P
from ase.calculators.tip4p import TIP4P
from support.ase_models import ase_sites
from support.common import site, small_scene

import rigidmd
from rigidmd import Scene, Simulation
from rigidmd.commands.cli import main
from rigidmd.errors import SceneError, SimulationError
from rigidmd.features.calculators.calculator import CalculatorForce

NO_FORCES = {"lennard_jones": False, "electrostatics": "none"}
#: Two sites, far enough from each other for ASE, which has a Lennard-Jones energy within molecules
#: too.
ROD = {
    "name": "rod",
    "sites": [
        site(f"A{k}", 40.0, [x, 0, 0], element="Ar", sigma_A=3.4, epsilon_kJ_mol=1.0)
        for k, x in enumerate((-1.9, 1.9))
    ],
}


def waters(model, count=4, **tables):
    stages = [{"duration_ps": 0.1, "timestep_fs": 1.0}]
    return small_scene(
        {model: count}, None, start={"temperature_K": 300.0}, stages=stages, **tables
    )


@pytest.mark.parametrize(("model", "calculator"), [("tip3p", TIP3P), ("tip4p", TIP4P)])
def test_the_first_steps_are_those_of_the_built_in_model(model, calculator):
    """TIP4P has a massless site, which is not among the atoms."""
    scene = waters(model)
    data = scene.model_dump(exclude_defaults=True) | {
        "molecules": [ase_sites(model) | {"count": 4}]
    }
    built_in = Simulation(Scene.from_dict(data)).run()
    data = scene.model_dump(exclude_defaults=True) | {"forces": NO_FORCES}
    force = CalculatorForce(calculator(rc=1e4, width=1.0))
    found = Simulation(Scene.from_dict(data), forces=[force]).run()
    assert len(force.atoms) == 12
    moved = np.abs(found.state.position - built_in.system.state.position).max()
    assert moved > 0.1
    assert np.abs(found.state.position - built_in.state.position).max() < 1e-9
    assert np.abs(found.state.rotation - built_in.state.rotation).max() < 1e-9
    assert found["potential"] == pytest.approx(built_in["potential"], rel=1e-9)


def rods(**forces):
    """Rods and argon in a triclinic box, with a barostat for its three edges."""
    stage = {
        "ensemble": "npt",
        "temperature_K": 120.0,
        "pressure_bar": 500.0,
        "timestep_fs": 2.0,
        "duration_ps": 0.2,
    }
    argon = {"name": "argon", "sites": [ROD["sites"][0] | {"position_A": [0.0, 0.0, 0.0]}]}
    return Scene.from_dict(
        {
            "box": {"lengths_A": [20.0, 21.0, 22.0], "angles_deg": [80.0, 75.0, 85.0]},
            "molecules": [ROD | {"count": 40}, argon | {"count": 30}],
            "forces": {"cutoff_A": 8.0, "electrostatics": "none", "tail_correction": False}
            | forces,
            "start": {"temperature_K": 120.0},
            "seed": 5,
            "precision": "double",
            "stages": [stage | {"pressure_coupling": "anisotropic"}],
            "output": {"trajectory": False, "log_interval_ps": 0.02},
        }
    )


def test_energy_pressure_and_a_barostat_in_a_triclinic_box_are_those_of_the_built_in_forces():
    built_in = Simulation(rods(truncation="shift")).run()
    force = CalculatorForce(LennardJones(sigma=3.4, epsilon=units.kJ / units.mol, rc=8.0))
    found = Simulation(rods(lennard_jones=False), forces=[force]).run()
    inside = found["LennardJones"][0] - built_in["potential"][0]  # of the pairs within rods
    assert found["LennardJones"] - inside == pytest.approx(built_in["potential"], rel=1e-7)
    assert np.abs(np.diff(found["pressure"])).max() > 10
    assert found["pressure"] == pytest.approx(built_in["pressure"], rel=1e-6)
    assert found.state.cell == pytest.approx(built_in.state.cell, rel=1e-8)
    assert not np.allclose(found.state.cell, found.system.state.cell, rtol=1e-4)
    assert found.state.position == pytest.approx(built_in.state.position, abs=1e-7)


class Springs(Calculator):
    """Springs between all atoms. Counts its calls; `wrong` forces, random noise of energies, or an
    error on request."""

    implemented_properties = ["energy", "forces"]  # noqa: RUF012

    def __init__(self, wrong=1.0, noise=0.0, fails_at=np.inf):
        super().__init__()
        self.wrong, self.noise, self.fails_at, self.calls = wrong, noise, fails_at, 0
        self.rng = np.random.default_rng(0)

    def calculate(self, atoms=None, properties=("energy",), system_changes=all_changes):
        super().calculate(atoms, properties, system_changes)
        self.calls += 1
        if self.calls > self.fails_at:
            raise RuntimeError("no\n convergence")
        apart = self.atoms.positions[:, None] - self.atoms.positions
        noise = self.noise * self.rng.standard_normal()
        self.results = {
            "energy": 5e-4 * (apart**2).sum() + noise,
            "forces": -2e-3 * self.wrong * apart.sum(axis=1),
        }


def springs(**tables):
    return waters("tip4p", forces=NO_FORCES, **tables)


def test_there_is_one_call_for_each_new_configuration():
    calculator = Springs()
    simulation = Simulation(springs(), forces=[CalculatorForce(calculator, name="springs")])
    simulation.step(10)
    before = calculator.calls
    simulation.step(50)
    assert calculator.calls == before + 50
    results = simulation.run()
    calls, seconds = results.summary["forces_by_python"]["springs"]
    assert calls >= calculator.calls
    assert seconds > 0
    assert np.abs(results["drift"]).max() < 1e-3 * results["kinetic"].mean()


def start(energy_noise_eV=0.0, **options):
    Simulation(
        springs(), forces=[CalculatorForce(Springs(**options), energy_noise_eV=energy_noise_eV)]
    ).step()


def test_forces_that_are_not_the_derivative_are_refused_and_noise_may_be_given():
    with pytest.raises(SceneError, match="is not the derivative of the energy"):
        start(wrong=1.01)
    with pytest.raises(SceneError, match="is not the derivative of the energy"):
        start(noise=1e-5)
    start(1e-4, noise=1e-5)
    with pytest.raises(SceneError, match="is not the derivative of the energy"):
        start(1e-4, noise=1e-5, wrong=1.2)


def test_an_error_of_the_calculator_names_step_and_atoms():
    with pytest.raises(
        SceneError,
        match=r"calculator Springs raised RuntimeError: no convergence at step 0; the closest",
    ):
        start(fails_at=0)
    calculator = Springs()
    simulation = Simulation(springs(), forces=[CalculatorForce(calculator)])
    simulation.step(20)
    calculator.fails_at = calculator.calls + 5
    with pytest.raises(
        SimulationError,
        match=r"at step 2[4-6]; the closest atoms of different .* of molecule \d and [OH] of",
    ):
        simulation.step(20)


def test_a_calculator_without_stress():
    liquid = {
        "box": {"lengths_A": 12.0},
        "molecules": [{"model": "tip4p", "count": 8}],
        "forces": NO_FORCES | {"cutoff_A": 5.0},
    }
    npt = {"ensemble": "npt", "temperature_K": 300.0, "pressure_bar": 1.0, "duration_ps": 0.01}
    for stages, match in (
        ([npt], "changes the box, and the calculator has no stress"),
        ([npt | {"ensemble": "nvt"}], None),
    ):
        stages[0].pop("pressure_bar", None) if match is None else None
        scene = Scene.from_dict(liquid | {"stages": stages, "output": {"trajectory": False}})
        force = CalculatorForce(TIP3P(rc=5.0))
        if match is not None:
            with pytest.raises(SceneError, match=match):
                Simulation(scene, forces=[force])
        else:
            notes = Simulation(scene, forces=[force]).run().summary["notes"]
            assert "TIP3P has no stress: the pressure does not include it" in notes


@pytest.mark.parametrize(
    "given", [{"calculator": 3}, {"calculator": Springs(), "energy_noise_eV": -1.0}]
)
def test_arguments_that_cannot_be(given):
    with pytest.raises(ValueError, match="must be a"):
        CalculatorForce(**given)


def test_a_run_resumes_with_the_same_bits(tmp_path):
    scene = springs()
    whole = Simulation(scene, tmp_path / "whole", forces=[CalculatorForce(Springs())]).run()
    Simulation(scene.with_end(0.05), tmp_path / "run", forces=[CalculatorForce(Springs())]).run()
    again = Scene.read(tmp_path / "run" / "scene.toml").with_end(0.1)
    results = Simulation(
        again, tmp_path / "run", forces=[CalculatorForce(Springs())], resume=True
    ).run()
    assert np.array_equal(results.state.position, whole.state.position)
    assert np.array_equal(results["Springs"][[0, -1]], whole["Springs"])


def test_a_scene_names_a_calculator_in_a_trusted_file(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "forces.py").write_text(
        f"# {tmp_path}\nfrom ase.calculators.tip3p import TIP3P\nfrom rigidmd.ase import CalculatorForce\n\n"
        "def waters(cutoff):\n    return CalculatorForce(TIP3P(rc=cutoff))\n"
    )
    custom = {"module": "forces.py", "name": "waters", "parameters": {"cutoff": 1e4}}
    data = waters("tip3p").model_dump(exclude_defaults=True) | {
        "forces": NO_FORCES | {"custom": [custom]}
    }
    (tmp_path / "s.toml").write_text(tomli_w.dumps(data))
    assert main(["run", "s.toml"]) == 2
    assert "forces.py is Python code" in capsys.readouterr().err
    assert main(["run", "s.toml", "--trust", "forces.py", "-v"]) == 0
    assert re.search(r"forces +waters: \d+ calls, [0-9.]+ s", capsys.readouterr().out)


def test_water_by_a_semi_empirical_method():
    """GFN2-xTB conserves the energy of two rigid waters at 2 fs, with the random error of its
    iterations."""
    tblite = pytest.importorskip("tblite.ase")
    calculator = tblite.TBLite(method="GFN2-xTB", verbosity=0, accuracy=0.1)
    force = CalculatorForce(calculator, energy_noise_eV=1e-6)
    data = waters("tip3p", 2, forces=NO_FORCES).model_dump(exclude_defaults=True)
    data["stages"] = [{"duration_ps": 0.06, "timestep_fs": 2.0}]
    results = rigidmd.Simulation(Scene.from_dict(data), forces=[force]).run()
    assert np.abs(results["drift"]).max() < 0.02 * results["kinetic"].max()


class Misshapen(Springs):
    """Springs whose values are changed from a call on."""

    def __init__(self, change, begins=0):
        super().__init__()
        self.change, self.begins = change, begins

    def calculate(self, atoms=None, properties=("energy",), system_changes=all_changes):
        super().calculate(atoms, properties, system_changes)
        if self.calls > self.begins:
            self.results["forces"] = self.change(self.results["forces"])


class WrongEnergy(Misshapen):
    """Energies of another kind."""

    def calculate(self, atoms=None, properties=("energy",), system_changes=all_changes):
        super().calculate(atoms, properties, system_changes)
        self.results["energy"] = self.results["free_energy"] = self.energy


@pytest.mark.parametrize("energy", ["5", 5 + 1e-3j, np.array([1.0, 2.0]), None])
def test_energies_that_are_not_a_real_number_are_refused(energy):
    calculator = WrongEnergy(lambda forces: forces)
    calculator.energy = energy
    with pytest.raises(SceneError, match=r"returned .* as energy|energy of the shape \(2,\)"):
        Simulation(springs(), forces=[CalculatorForce(calculator)]).step()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda forces: forces[0], r"forces of the shape \(3,\), not \(12, 3\)"),
        (lambda forces: forces[:1], r"forces of the shape \(1, 3\), not \(12, 3\)"),
        (lambda forces: forces[:, :1], r"forces of the shape \(12, 1\), not \(12, 3\)"),
        (lambda forces: 0.0, r"forces of the shape \(\), not \(12, 3\)"),
        (lambda forces: forces + 1e-3j, "masked or complex values as forces"),
        (lambda forces: np.ma.masked_less(forces, 0.0), "masked or complex values as forces"),
        (lambda forces: forces * np.nan, "which are not finite numbers"),
        (lambda forces: [["a"] * 3] * 12, "not real numbers"),
        (lambda forces: forces.astype(str), "not real numbers"),
    ],
)
def test_forces_of_another_shape_or_kind_are_refused_at_any_step(change, words):
    with pytest.raises(SceneError, match=words):
        Simulation(springs(), forces=[CalculatorForce(Misshapen(change))]).step()
    calculator = Misshapen(change, np.inf)
    simulation = Simulation(springs(), forces=[CalculatorForce(calculator)])
    simulation.step(5)
    calculator.begins = calculator.calls + 2
    with pytest.raises(SimulationError, match=words):
        simulation.step(10)
