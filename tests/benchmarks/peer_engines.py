"""How each engine runs one job of peers.py, in a process of its own.

    python tests/benchmarks/peer_engines.py           # prints the engines that are installed
    python tests/benchmarks/peer_engines.py FOLDER    # runs a job

reads FOLDER/job.json, and FOLDER/result.json is what came of it; a job with `forces` true also
leaves the forces on molecules at its start, (n, 3) in kJ/mol/Å, in FOLDER/forces.npy. `peers.py`
writes the jobs. A job is: engine, cores, cpus (their numbers), timestep_fs, steps, every (steps
between observations at the energy; 0 for none), options (of the curve), workload (cutoff and so on),
sites (file of the start) and, for rigidmd, its scene.
"""

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from command_line import new_parser, read_options

sys.path.insert(0, str(Path(__file__).parents[1]))

KCAL = 4.184  # kJ
#: Variables that state how many threads there are and how they wait. An engine is given its cores by
#: its own option.
THREADING = ("OMP_NUM_THREADS", "OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "NUMBA_NUM_THREADS")
WARM_UP = 2  # steps before the clock starts, where the engine does not time its own loop
OPENMM_TOLERANCE = (
    2.5e-4  # of PME; the default is 5e-4. Forces are then about as good as the values of the others
)
DSF_ALPHA = 0.2  # 1/Å, damping of LAMMPS's coul/dsf


class Absent(Exception):
    """An engine that is not installed."""


class Failed(Exception):
    """An engine that did not end its run; its last words."""


def environment() -> dict[str, str]:
    """What a user has in his shell: none of what this shell, or rigidmd when it was imported, states
    about threads."""
    return {key: value for key, value in os.environ.items() if key not in THREADING}


def program(name: str, beside: str = sys.executable) -> str:
    """Path of a program, next to another one or on PATH. Raises Absent."""
    found = shutil.which(name, path=str(Path(beside).parent)) or shutil.which(name)
    if found is None:
        raise Absent(f"there is no {name} on PATH")
    return found


def call(command: list, folder: Path, text: str | None = None) -> str:
    """Output of a program that must succeed."""
    done = subprocess.run(
        [str(part) for part in command], cwd=folder, input=text, capture_output=True, text=True
    )
    if done.returncode != 0:
        raise Failed(" | ".join((done.stdout + done.stderr).strip().splitlines()[-12:]))
    return done.stdout


def leapfrog_velocity(job: dict, sites: dict) -> np.ndarray:
    """Velocities half a step before the start, which a leap-frog integrator starts with; Å/ps."""
    return sites["velocity"] - 0.5e-3 * job["timestep_fs"] * sites["kick"]


# Each engine: version() states which one there is, and run(job, sites, folder) returns
#   seconds, timed_steps: of stepping; time_ps, total, potential, kinetic: observations, kJ/mol; settings:
#   what it states it did


class Rigidmd:
    """This engine, by its Python side."""

    precision = "all float64"

    @staticmethod
    def version() -> str:
        import rigidmd

        paths = sorted(Path(rigidmd.__file__).parent.rglob("*.py"))
        digest = hashlib.sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()
        return f"rigidmd {rigidmd.__version__} (sources {digest[:8]})"

    @staticmethod
    def run(job: dict, sites: dict, folder: Path) -> dict:
        from support.common import observe

        from rigidmd import Scene, Simulation
        from rigidmd.core.integrators import SCHEMES
        from rigidmd.units import KJ_PER_MOL

        simulation = Simulation(Scene.from_dict(job["scene"], Path(job["sites"]).parent))
        system, engine, start = simulation.system, simulation.engine, simulation.state
        scheme, dt = SCHEMES[job["options"]["integrator"]], job["timestep_fs"] * 1e-3
        engine.advance(start.copy(), scheme, dt, WARM_UP)
        engine.forget()
        looks, seconds, done, state = [], 0.0, 0, start.copy()

        def look():
            seen = observe(system, engine, state)
            looks.append([x / KJ_PER_MOL for x in (seen.energy, seen.potential, seen.kinetic)])

        look()
        if job["forces"]:
            np.save(folder / "forces.npy", observe(system, engine, state).load.force / KJ_PER_MOL)
        for now in pieces(job):
            began = time.perf_counter()
            engine.advance(state, scheme, dt, done + now)
            seconds += time.perf_counter() - began
            done += now
            if job["every"]:
                look()
        lists = [own.pairs for own in engine.workspaces.values() if hasattr(own, "pairs")]
        settings = f"list {lists[0].cutoff + lists[0].skin:.4g} Å, rebuilt when a site has moved {lists[0].skin / 2:g} Å"
        settings += "".join(f"; {note}" for note in system.notes if note.startswith("pme"))
        return series(job, looks) | {"seconds": seconds, "timed_steps": done, "settings": settings}


class OpenMM:
    """OpenMM's CPU platform: SETTLE or CCMA constraints, leap-frog."""

    precision = "forces float32, state float64"

    @staticmethod
    def version() -> str:
        try:
            import openmm
        except ImportError:
            raise Absent("there is no openmm beside this python") from None
        return f"OpenMM {openmm.Platform.getOpenMMVersion()}"

    @staticmethod
    def run(job: dict, sites: dict, folder: Path) -> dict:
        import openmm

        n, s = sites["position"].shape[:2]
        cutoff = job["workload"]["cutoff"] / 10
        system, force = openmm_system(sites, cutoff, job["options"].get("switch_A"))
        method = "PME" if job["workload"]["pme"] else "CutoffPeriodic"
        force.setNonbondedMethod(getattr(openmm.NonbondedForce, method))
        force.setEwaldErrorTolerance(OPENMM_TOLERANCE)
        force.setUseDispersionCorrection(False)
        force.setReactionFieldDielectric(job["workload"]["permittivity"])
        integrator = openmm.VerletIntegrator(job["timestep_fs"] * 1e-3)
        platform = openmm.Platform.getPlatformByName("CPU")
        context = openmm.Context(system, integrator, platform, {"Threads": str(job["cores"])})

        def begin():
            context.setPositions(sites["position"].reshape(-1, 3) / 10)
            context.setVelocities(leapfrog_velocity(job, sites).reshape(-1, 3) / 10)

        begin()
        integrator.step(WARM_UP)
        begin()
        looks, seconds = [], 0.0

        def look():
            state = context.getState(getEnergy=True)
            potential, kinetic = (
                x._value for x in (state.getPotentialEnergy(), state.getKineticEnergy())
            )
            looks.append([potential + kinetic, potential, kinetic])

        look()
        if job["forces"]:
            on_sites = context.getState(getForces=True).getForces(asNumpy=True)._value / 10
            np.save(folder / "forces.npy", on_sites.reshape(n, s, 3).sum(axis=1))
        for now in pieces(job):
            began = time.perf_counter()
            integrator.step(now)
            seconds += time.perf_counter() - began
            if job["every"]:
                look()
        # platforms/cpu/src/CpuKernels.cpp: a quarter of the cutoff is added; the list lasts until
        # half of that is gone
        settings = (
            f"list {12.5 * cutoff:.4g} Å, rebuilt when an atom has moved {1.25 * cutoff:.3g} Å"
        )
        settings += f", constraint tolerance {integrator.getConstraintTolerance():g}"
        return series(job, looks) | {
            "seconds": seconds,
            "timed_steps": job["steps"],
            "settings": settings,
        }


class Gromacs:
    """GROMACS mdrun: SETTLE or LINCS constraints, leap-frog."""

    precision = "forces and state float32"

    @staticmethod
    def version() -> str:
        said = call([program("gmx"), "--version"], Path())
        found = dict(
            re.findall(r"^(GROMACS version|Precision|SIMD instructions):\s*(\S+)", said, re.M)
        )
        return f"GROMACS {found['GROMACS version']} ({found['Precision']}, {found['SIMD instructions']})"

    @staticmethod
    def run(job: dict, sites: dict, folder: Path) -> dict:
        work, gmx = job["workload"], [program("gmx"), "-quiet", "-nobackup"]
        every = job["every"] or job["steps"]
        options = {
            "integrator": "md",
            "dt": job["timestep_fs"] * 1e-3,
            "nsteps": job["steps"],
            "continuation": "yes",
            "cutoff-scheme": "verlet",
            "nstlist": work["nstlist"],
            "verlet-buffer-tolerance": job["options"]["buffer"],
            "rvdw": work["cutoff"] / 10,
            "rcoulomb": work["cutoff"] / 10,
            "vdw-modifier": "potential-shift",
            "lincs-iter": 2,
            "nstenergy": every,
            "nstcalcenergy": every,
            "nstlog": 0,
        }
        if job["forces"]:
            options |= {"nstfout": job["steps"]}
        if work["pme"]:
            options |= {"coulombtype": "PME"}
        else:
            kind = "reaction-field" if work["charged"] else "cut-off"
            options |= {"coulombtype": kind, "epsilon-rf": work["permittivity"]}
        (folder / "run.mdp").write_text(
            "".join(f"{key} = {value}\n" for key, value in options.items())
        )
        (folder / "run.gro").write_text(gro(sites, leapfrog_velocity(job, sites)))
        (folder / "run.top").write_text(top(sites))
        call(
            [*gmx, "grompp", "-f", "run.mdp", "-c", "run.gro", "-p", "run.top", "-o", "run.tpr"],
            folder,
        )
        threads = ["-ntmpi", 1, "-ntomp", job["cores"], "-pin", "on", "-pinoffset", job["cpus"][0]]
        call([*gmx, "mdrun", "-deffnm", "run", "-notunepme", "-noconfout", *threads], folder)
        if job["forces"]:
            from MDAnalysis.coordinates.TRR import TRRReader

            with TRRReader(str(folder / "run.trr")) as frames:  # its forces are in kJ/mol/Å
                on_sites = frames[0].forces.astype(float)
            np.save(folder / "forces.npy", on_sites.reshape(*sites["position"].shape).sum(axis=1))
        log = (folder / "run.log").read_text()
        ns_per_day = float(re.search(r"^Performance:\s+(\S+)", log, re.M).group(1))
        seconds = job["steps"] * job["timestep_fs"] * 1e-6 / ns_per_day * 86400
        wanted = "Potential\nKinetic-En.\nTotal-Energy\n\n"
        call([*gmx, "energy", "-f", "run.edr", "-o", "run.xvg", "-dp"], folder, wanted)
        lines = [
            line.split()
            for line in (folder / "run.xvg").read_text().splitlines()
            if line[0] not in "#@"
        ]
        looks = [
            [float(total), float(potential), float(kinetic)]
            for _, potential, kinetic, total in lines
        ]
        found = re.findall(
            r"(?:setup:\s+|list: )updated every\s+(\d+) steps, buffer \S+ nm, rlist (\S+) nm", log
        )
        lists = [
            f"{10 * float(radius):.4g} Å every {steps} steps"
            for steps, radius in found[: 1 + ("dual" in log)]
        ]
        settings = "list " + ", pruned to ".join(lists)
        return series(job, looks) | {
            "seconds": seconds,
            "timed_steps": job["steps"],
            "settings": settings,
        }


class Lammps:
    """LAMMPS fix rigid/nve/small, one MPI process a core."""

    precision = "all float64"

    @staticmethod
    def version() -> str:
        said = call([program("lmp"), "-h"], Path())
        return "LAMMPS " + re.search(r"Simulator - (.*)", said).group(1)

    @staticmethod
    def run(job: dict, sites: dict, folder: Path) -> dict:
        work, skin = job["workload"], job["options"]["skin_A"]
        cutoff = work["cutoff"]
        style = (
            f"lj/cut/coul/dsf {DSF_ALPHA} {cutoff} {cutoff}"
            if work["charged"]
            else f"lj/cut {cutoff}"
        )
        if work["pme"]:
            style = f"lj/cut/coul/long {cutoff} {cutoff}"
        coefficients = [
            f"pair_coeff {k + 1} {k + 1} {epsilon / KCAL:.15g} {sigma:.15g}"
            for k, (epsilon, sigma) in enumerate(zip(sites["epsilon"], sites["sigma"], strict=True))
        ]
        (folder / "run.data").write_text(lammps_data(sites))
        script = [
            "units real",
            "atom_style full",
            "boundary p p p",
            "read_data run.data",
            f"pair_style {style}",
            "pair_modify shift yes mix arithmetic",
            *coefficients,
            f"neighbor {skin} bin",
            "neigh_modify exclude molecule/intra all every 1 delay 0 check yes",
            *(
                [
                    f"kspace_style pppm {work['accuracy']:g}",
                    f"kspace_modify gewald {sites['alpha']}",
                ]
                if work["pme"]
                else []
            ),
            "fix 1 all rigid/nve/small molecule",
            f"timestep {job['timestep_fs']}",
            "thermo_style custom step pe ke etotal",
            "thermo_modify norm no format float %.15g",
            f"thermo {job['every'] or job['steps']}",
            *(
                [
                    f"dump 1 all custom {job['steps']} run.forces id fx fy fz",
                    "dump_modify 1 sort id format float %.15g",
                ]
                if job["forces"]
                else []
            ),
            f"run {job['steps']}",
        ]
        (folder / "run.in").write_text("\n".join(script) + "\n")
        lmp = program("lmp")
        shape = sites["position"].shape
        several = [program("mpiexec", beside=lmp), "-n", job["cores"]] if job["cores"] > 1 else []
        said = call([*several, lmp, "-in", "run.in", "-log", "none"], folder)
        if job["forces"]:
            on_sites = np.loadtxt(
                folder / "run.forces", skiprows=9, max_rows=shape[0] * shape[1], usecols=(1, 2, 3)
            )
            np.save(folder / "forces.npy", KCAL * on_sites.reshape(shape).sum(axis=1))
        loop = re.search(r"Loop time of (\S+) on (\d+) procs for (\d+) steps", said)
        if int(loop.group(2)) != job["cores"]:
            raise Failed("this lmp has no MPI")
        table = said[: loop.start()].rpartition("TotEng")[2].splitlines()[1:]
        looks = [
            [float(x) * KCAL for x in (total, pe, ke)]
            for _, pe, ke, total in (line.split() for line in table)
        ]
        settings = f"list {cutoff + skin:g} Å, rebuilt when an atom has moved {skin / 2:g} Å"
        return series(job, looks) | {
            "seconds": float(loop.group(1)),
            "timed_steps": int(loop.group(3)),
            "settings": settings,
        }


ENGINES = {"rigidmd": Rigidmd, "gromacs": Gromacs, "openmm": OpenMM, "lammps": Lammps}


def describe(engine: str) -> str:
    """The version of an engine, or why there is none."""
    try:
        return ENGINES[engine].version()
    except Absent as error:
        return f"{engine} is skipped: {error}"


def openmm_system(sites: dict, cutoff: float, switch: float | None):
    """A system of rigid molecules in a box and its NonbondedForce. cutoff in nm; switch : width of
    the switch before it, Å"""
    import openmm

    n, s = sites["position"].shape[:2]
    system, force = openmm.System(), openmm.NonbondedForce()
    system.setDefaultPeriodicBoxVectors(*np.diag(sites["edges"] / 10))
    force.setCutoffDistance(cutoff)
    if switch:
        force.setUseSwitchingFunction(True)
        force.setSwitchingDistance(cutoff - switch / 10)
    for i in range(n * s):
        k = i % s
        system.addParticle(sites["mass"][k])
        force.addParticle(sites["charge"][k], sites["sigma"][k] / 10, sites["epsilon"][k])
    template = sites["template"] / 10
    for first in range(0, n * s, s):
        for j in range(s):
            for i in range(j):
                system.addConstraint(
                    first + i, first + j, np.linalg.norm(template[i] - template[j])
                )
                force.addException(first + i, first + j, 0, 1, 0)
    system.addForce(force)
    return system, force


def sites_of(system, state) -> dict:
    """Sites of a state of rigidmd with one species, and their parameters, as all engines here take
    them; Å, u, e, kJ/mol."""
    from rigidmd.units import KJ_PER_MOL

    species = system.species[0]
    return {
        "position": system.site_positions(state, wrapped=True).reshape(len(state.position), -1, 3),
        "template": species.positions_body,
        "edges": state.cell.diagonal(),
        "name": np.array(species.site_names),
        "mass": species.masses,
        "charge": species.charges,
        "sigma": np.where(species.epsilon > 0, species.sigma, 1.0),
        "epsilon": species.epsilon / KJ_PER_MOL,
    }


def pieces(job: dict) -> list[int]:
    """Steps between observations; all of them at once where there are none."""
    every = job["every"] or job["steps"]
    whole, rest = divmod(job["steps"], every)
    return [every] * whole + ([rest] if rest else [])


def series(job: dict, looks: list) -> dict:
    """Energies (kJ/mol) at evenly spaced times (ps); a last observation out of step is omitted."""
    looks = looks[: job["steps"] // job["every"] + 1] if job["every"] else looks[:1]
    total, potential, kinetic = np.array(looks).T.tolist()
    times = (np.arange(len(looks)) * job["every"] * job["timestep_fs"] * 1e-3).tolist()
    return {"time_ps": times, "total": total, "potential": potential, "kinetic": kinetic}


def gro(sites: dict, velocity: np.ndarray) -> str:
    """A .gro file in nm and nm/ps with nine decimals; velocities have the width of positions, as
    GROMACS expects."""
    n, s = velocity.shape[:2]
    lines = ["start", str(n * s)]
    for i in range(n * s):
        m, k = divmod(i, s)
        numbers = "".join(f"{x / 10:14.9f}" for x in sites["position"][m, k])
        numbers += "".join(f"{x / 10:14.10f}" for x in velocity[m, k])
        lines.append(
            f"{(m + 1) % 100000:5d}{'MOL':5s}{sites['name'][k]:>5s}{(i + 1) % 100000:5d}{numbers}"
        )
    return "\n".join([*lines, " ".join(f"{edge / 10:.10f}" for edge in sites["edges"])]) + "\n"


def top(sites: dict) -> str:
    """A GROMACS topology of one species: SETTLE for three sites, a constraint for two; a fourth,
    without mass, is a virtual site between the arms of the first."""
    n, s = sites["position"].shape[:2]
    template = sites["template"] / 10
    lines = ["[ defaults ]", "1 2 no", "[ atomtypes ]"]
    kinds = zip(
        sites["name"],
        sites["mass"],
        sites["charge"],
        sites["sigma"] / 10,
        sites["epsilon"],
        strict=True,
    )
    atoms = ["[ moleculetype ]", "MOL 2", "[ atoms ]"]
    for k, (name, mass, charge, sigma, epsilon) in enumerate(kinds, 1):
        lines.append(f"T{k} {mass} 0 {'A' if mass > 0 else 'V'} {sigma:.12g} {epsilon:.12g}")
        atoms.append(f"{k} T{k} 1 MOL {name} 1 {charge} {mass}")
    lines += atoms
    first = np.linalg.norm(template[0] - template[1])
    if s > 2:
        lines += [
            "[ settles ]",
            f"1 1 {first:.12g} {np.linalg.norm(template[1] - template[2]):.12g}",
        ]
        if s == 4:
            arms = template[1] + template[2] - 2 * template[0]
            share = np.linalg.norm(template[3] - template[0]) / np.linalg.norm(arms)
            lines += ["[ virtual_sites3 ]", f"4 1 2 3 1 {share:.12g} {share:.12g}"]
        everyone = range(1, s + 1)
        lines += [
            "[ exclusions ]",
            *(" ".join(map(str, [k, *(j for j in everyone if j != k)])) for k in everyone),
        ]
    else:
        lines += ["[ constraints ]", f"1 2 1 {first:.12g}"]
    return "\n".join([*lines, "[ system ]", "start", "[ molecules ]", f"MOL {n}"]) + "\n"


def lammps_data(sites: dict) -> str:
    """A LAMMPS data file, units real, atom_style full; a type a site. Velocities in Å/fs."""
    n, s = sites["position"].shape[:2]
    lines = ["start", "", f"{n * s} atoms", f"{s} atom types", ""]
    lines += [
        f"0 {float(edge)!r} {x}lo {x}hi" for x, edge in zip("xyz", sites["edges"], strict=True)
    ]
    lines += [
        "",
        "Masses",
        "",
        *(f"{k + 1} {mass}" for k, mass in enumerate(sites["mass"])),
        "",
        "Atoms # full",
        "",
    ]
    for i in range(n * s):
        m, k = divmod(i, s)
        x, y, z = sites["position"][m, k]
        lines.append(f"{i + 1} {m + 1} {k + 1} {sites['charge'][k]} {x:.15g} {y:.15g} {z:.15g}")
    lines += ["", "Velocities", ""]
    for i, (x, y, z) in enumerate(sites["velocity"].reshape(-1, 3) * 1e-3, 1):
        lines.append(f"{i} {x:.15g} {y:.15g} {z:.15g}")
    return "\n".join(lines) + "\n"


def busy(cpus: list[int]) -> float:
    """Seconds that these processors have worked for anyone since they started; 0 where the system
    does not state."""
    try:
        lines = [line.split() for line in Path("/proc/stat").read_text().splitlines()]
    except OSError:
        return 0.0
    rows = [np.array(line[1:9], float) for line in lines if line[0] in {f"cpu{k}" for k in cpus}]
    return sum(row.sum() - row[3] - row[4] for row in rows) / os.sysconf(
        "SC_CLK_TCK"
    )  # less idle and waiting for disks


def main() -> None:
    """Run the job of a folder, or print the engines."""
    parser = new_parser(__doc__)
    parser.add_argument("folder", type=Path, nargs="?")
    folder = read_options(parser).folder
    if folder is None:
        print(*map(describe, ENGINES), sep="\n")
        return
    job = json.loads((folder / "job.json").read_text())
    if hasattr(os, "sched_setaffinity"):  # programs that are started inherit it
        os.sched_setaffinity(0, job["cpus"])
    with np.load(job["sites"], allow_pickle=False) as data:
        sites = dict(data)
    began, worked, own = time.perf_counter(), busy(job["cpus"]), sum(os.times()[:4])
    try:
        result = ENGINES[job["engine"]].run(job, sites, folder)
    except (Failed, Absent) as error:
        sys.exit(str(error))
    whole = (time.perf_counter() - began) * job["cores"]
    others = (busy(job["cpus"]) - worked - (sum(os.times()[:4]) - own)) / whole
    result["others"] = min(1.0, max(0.0, others))
    (folder / "result.json").write_text(json.dumps(result))


if __name__ == "__main__":
    main()
