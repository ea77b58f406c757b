"""A driver of mixed errors: runs of small random scenes are disturbed, resumed and compared with an
undisturbed run.

    python tests/support/faults.py --minutes 1             random cases, one after another, for a minute
    python tests/support/faults.py --seed 7                one case, with each of its actions: replays a failure
    python tests/support/faults.py --minutes 600 --wide    also barostats, minimisation, PME, mixed precision

A case is a scene and a few actions, all drawn from one seed. Each attempt to run the scene is a
forked process, which fractions the compiled kernels. A error comes at the n-th call of a C function,
or at the n-th one that works on a file: the attempt is killed, stopped, signalled, or finds no workspace
on the disk or in memory. Between attempts files are damaged, replaced by links, pipes and folders,
or a checkpoint is forged. What must hold:

- An attempt ends with a documented exit code, with a sentence where it fails, without a traceback,
  and it ends.
- What is rejected changes no file. Files that a run did not write stay.
- A run that ends has the bits of an undisturbed run. A run whose files are whole can be resumed.
"""

import argparse
import contextlib
import copy
import errno
import fcntl
import functools
import io
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomli_w

from rigidmd.commands import cli
from rigidmd.errors import CheckpointError
from rigidmd.io.checkpoint import read_checkpoint, write_checkpoint

try:
    from _testcapi import remove_mem_hooks, set_nomemory
except ImportError:  # not every Python has it
    set_nomemory = None

CHECKPOINT, PREVIOUS = "checkpoint.npz", "checkpoint_previous.npz"
#: How a process without memory may end besides: no stack can grow, or LLVM and C libraries give up.
CRASHES = (-signal.SIGSEGV, -signal.SIGABRT, -signal.SIGBUS)
FAULTS = (
    "kill",
    "kill",
    "timer",
    "stop",
    "signal",
    "disk",
    "failing",
    "memory",
    "allocation",
    "limit",
)
HANGS = 900.0  # s, after which an attempt has hung, however busy the machine is
#: Functions that work on files, by the name that a C function has.
FILE_CALLS = (
    "write",
    "open",
    "replace",
    "rename",
    "fsync",
    "truncate",
    "ftruncate",
    "mkdir",
    "unlink",
    "flock",
)
#: Of these, functions that may fail where a disk is full or broken.
FAILING = ("write", "open", "replace", "fsync", "truncate", "mkdir")
#: Arrays that nothing else in a checkpoint decides: with other values the run is another one, which
#: must end by itself.
FREE = re.compile(
    r"state/(velocity|angular_momentum_body|energy_ledger|extra_variables|position|rotation)|Sampler/|engine/load|engine/\w+.times"
)

# Scenes


def scene_of(rng: random.Random, wide: bool) -> tuple[str, dict]:
    """Name of the kind and data of a random small scene; all narrow scenes of a kind share their
    kernels."""
    kind = rng.choice(["water", "water", "argon", "top"])
    if kind == "top":
        integrator = rng.choice(["velocity_verlet", "rk4", "dop853"])
        body = {
            "mass_kg": 0.15,
            "inertia_kg_m2": [3e-4, 3.1e-4, 1.2e-4],
            "pinned": True,
            "inertia_about": "pivot",
            "centre_of_mass_m": [0.0, 0.0, 0.04],
        }
        start = {
            "euler_angles_deg": [0.0, rng.uniform(5, 170), 0.0],
            "euler_rates_rad_s": [0.0, 0.0, 60.0],
        }
        run = {"duration_s": rng.choice([0.1, 0.2]), "timestep_s": 0.005, "integrator": integrator}
        output = {"interval_s": rng.choice([0.005, 0.02]), "figures": wide and rng.random() < 0.1}
        data = {"body": body, "gravity": {}, "start": start, "run": run}
        return f"{kind} {integrator}", data | {"output": output | checkpoints(rng)}
    nvt = {"ensemble": "nvt", "temperature_K": 298.0}
    stages = [{"ensemble": "nve"}, nvt]
    if wide:
        npt = nvt | {"ensemble": "npt", "pressure_bar": 1.0, "barostat_interval_ps": 0.007}
        others = [{"ensemble": "nph", "pressure_bar": 1.0}, npt, npt | {"barostat": "monte_carlo"}]
        others += [nvt | {"thermostat": name} for name in ("langevin", "nose_hoover", "andersen")]
        stages += [{"ensemble": "minimise", "max_iterations": 5}, *others]
    chosen = [dict(rng.choice(stages)) for _ in range(rng.randint(1, 3))]
    for stage in chosen:
        if stage["ensemble"] != "minimise":
            stage |= {
                "duration_ps": rng.choice([0.01, 0.02, 0.03]),
                "timestep_fs": rng.choice([1.0, 2.0]),
            }
    output = {
        "log_interval_ps": rng.choice([0.002, 0.005, 0.007]),
        "trajectory_interval_ps": rng.choice([0.004, 0.01, 0.014]),
        "trajectory": "trajectory"
        + rng.choice([".xtc", ".xtc", ".trr", ".gsd", ".traj", ".dcd", ".nc", ".xyz", ".pdb"]),
        "figures": wide and rng.random() < 0.1,
    }
    if output["trajectory"] == "trajectory.dcd":  # frames of it are evenly spaced
        output["trajectory_interval_ps"] = 0.01
    data = {"seed": rng.randrange(10**6), "stages": chosen, "output": output | checkpoints(rng)}
    data["start"] = {"temperature_K": 298.0 if kind == "water" else 90.0}
    if wide:
        data["precision"] = rng.choice(["double", "mixed"])
    if kind == "water":
        data |= {
            "box": {"density_g_cm3": 0.9},
            "molecules": [{"model": "spce", "count": rng.randint(40, 60)}],
        }
        data["forces"] = {"cutoff_A": 5.0, "truncation": "smooth_switch"}
        if wide and rng.random() < 0.3:
            data["forces"] = {"cutoff_A": 5.0, "truncation": "shift", "electrostatics": "pme"}
    else:
        data |= {
            "box": {"lengths_A": 30.0},
            "molecules": [{"model": "argon", "count": rng.randint(10, 40)}],
        }
    return (
        f"{kind} {','.join(stage['ensemble'] for stage in chosen)} {output['trajectory'][10:]}",
        data,
    )


def checkpoints(rng: random.Random) -> dict[str, float]:
    """After every observation, at times that the clock decides, or only where a stage starts and
    ends."""
    return {"checkpoint_minutes": rng.choice([1e-9, 1e-9, 0.001, 60.0])}


# Attempts


class Ended(NamedTuple):
    """How a process ended: its exit code, negative of a signal; what it printed; whether it was
    stopped meanwhile."""

    code: int
    said: str


class Found(Exception):
    """Something that must not be."""


def is_in_memory(owner: Any) -> bool:
    """Whether a method of this object works on no file: it is a text, or the stream on which an
    attempt prints."""
    return isinstance(owner, str | bytes | io.StringIO | io.BytesIO) or owner in (
        sys.__stdout__,
        sys.__stderr__,
    )


def is_elsewhere(frame: Any) -> bool:
    """Whether NumPy's polynomials are at work, which rotate any error into a TypeError, or Python
    reads a version."""
    while frame is not None:
        if re.search("/numpy/polynomial/|/importlib/metadata/", frame.f_code.co_filename):
            return True
        frame = frame.f_back
    return False


class AtCall:
    """A profile function that acts once: at the n-th call of a C function, or of one of some
    names."""

    def __init__(self, names: Sequence[str], count: int, act: Callable[[], None]):
        self._names, self._left, self._act = names, count, act
        self._begun = False  # the command; before that the program starts

    def __call__(self, frame: Any, event: str, called: Any) -> None:
        self._begun |= event == "call" and frame.f_code.co_name in ("_run", "_resume")
        if event != "c_call" or not self._begun or frame.f_code.co_filename == __file__:
            return
        if self._names and (
            called.__name__ not in self._names or is_in_memory(getattr(called, "__self__", None))
        ):
            return
        self._left -= 1
        if self._left <= 0 and not is_elsewhere(frame):
            sys.setprofile(None)
            self._act()


def begun(arguments: Sequence[str], profile: AtCall | None = None) -> tuple[int, int]:
    """A forked process that executes a command: its number, and where it prints."""
    read, write = os.pipe()
    fcntl.fcntl(read, getattr(fcntl, "F_SETPIPE_SZ", 1031), 1 << 20)
    sys.stdout.flush()
    if number := os.fork():
        os.close(write)
        return number, read
    code = 70
    try:
        for stream in (1, 2):
            os.dup2(write, stream)
        sys.stdout = sys.__stdout__ = open(1, "w", closefd=False)  # noqa: SIM115
        sys.stderr = sys.__stderr__ = open(2, "w", closefd=False, buffering=1)  # noqa: SIM115
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.setprofile(profile)
        code = cli.main(list(arguments))
        sys.setprofile(None)
    except BaseException:
        sys.setprofile(None)
        unlimited()
        traceback.print_exc()
        code = 1
    finally:
        unlimited()
        sys.stdout.flush()
        os._exit(code)


def unlimited() -> None:
    """Let a process have memory and files again."""
    if set_nomemory is not None:
        remove_mem_hooks()
    for limit in (resource.RLIMIT_FSIZE, resource.RLIMIT_AS):
        resource.setrlimit(limit, (resource.getrlimit(limit)[1],) * 2)


def waited(number: int, stops: bool = False) -> int | None:
    """The exit code of a process; None if it was stopped. Raises Found if it hangs."""
    end = time.monotonic() + HANGS
    while time.monotonic() < end:
        done, status = os.waitpid(number, os.WNOHANG | (os.WUNTRACED if stops else 0))
        if done:
            return None if os.WIFSTOPPED(status) else os.waitstatus_to_exitcode(status)
        time.sleep(0.003)
    os.kill(number, signal.SIGKILL)
    os.waitpid(number, 0)
    raise Found(f"does not end within {HANGS:g} s")


def said_by(read: int) -> str:
    """What a process that has ended printed."""
    with open(read, "rb") as file:
        return file.read().decode("utf-8", "replace")


# What a folder holds


def contents(folder: Path) -> dict[str, bytes]:
    """The results of a run, which must be the same to the bit."""
    names = ("trajectory", "log", "topology", "motion")
    found = {
        path.name: path.read_bytes()
        for path in folder.iterdir()
        if path.name.startswith(names) and path.is_file()
    }
    if not (folder / "final.npz").exists():  # of a body
        return found
    with np.load(folder / "final.npz") as data:
        return found | {f"final.npz: {name}": data[name].tobytes() for name in data.files}


def everything(folder: Path) -> dict[str, object]:
    """All that is in a folder but for its lock: bytes of files, targets of links, kinds of
    others."""
    return {
        path.name: os.readlink(path)
        if path.is_symlink()
        else path.read_bytes()
        if path.is_file()
        else path.stat().st_mode
        for path in folder.iterdir()
        if path.name != ".rigidmd-lock"
    }


def leaves(value: object, path: tuple = ()) -> list[tuple]:
    """The paths of all values in nested lists and dictionaries."""
    inner = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    return [path, *(leaf for key, part in inner for leaf in leaves(part, (*path, key)))]


def forge(folder: Path, rng: random.Random) -> str:
    """Write a checkpoint with another value, with right checksums; what was changed."""
    kept = read_checkpoint(folder / CHECKPOINT)
    told, arrays = copy.deepcopy(kept.values), dict(kept.arrays)
    if rng.random() < 0.5:
        *way, last = path = rng.choice(leaves(told)[1:])
        holder = functools.reduce(lambda part, key: part[key], way, told)
        numbers = [holder[last] + 1, -holder[last]] if isinstance(holder[last], int | float) else []
        holder[last] = rng.choice(
            [None, "x", [], {}, -1.5, float("nan"), float("inf"), 10**30, 7, -1, True, *numbers]
        )
        name = f"{'.'.join(map(str, path))}: {holder[last]!r:.20}"
    else:
        name = rng.choice(sorted(arrays))
        array = arrays[name].copy()
        flat = array.reshape(-1)
        with np.errstate(all="ignore"):
            changes: dict[str, Callable] = {
                "left out": lambda: None,
                "longer": lambda: np.concatenate([flat, flat[:1]]),
                "shorter": lambda: flat[:-1],
                "text": lambda: array.astype(str),
                "another type": lambda: array.astype(np.float32),
                "plus one": lambda: array + array.dtype.type(1),
                "zero": lambda: 0 * array,
                "huge": lambda: (
                    array + array.dtype.type(1e300 if array.dtype.kind == "f" else 1 << 6)
                ),
                "not a number": lambda: array * np.nan if array.dtype.kind == "f" else -array,
            }
            how = rng.choice(sorted(changes))
            changed = changes[how]()
        if changed is None:
            del arrays[name]
        else:
            arrays[name] = changed
        name += f": {how}"
    write_checkpoint(folder, kept._replace(values=told, arrays=arrays))
    return name


# Cases


class Case:
    """A scene, its undisturbed run, and what happens to another run of it. Raises Found.

    show : called with each action
    """

    def __init__(self, seed: int, root: Path, wide: bool, show: Callable[[str], object]):
        self.rng, self.show, self.actions = random.Random(seed), show, Counter[str]()
        self.kind, data = scene_of(self.rng, wide)
        self.root, self.folder, self.kept = root, root / "run", root / "kept"
        self.is_body = "body" in data
        self.scene = root / "scene.toml"
        self.scene.write_text(tomli_w.dumps(data))
        self.victim = root / "victim"
        self.damage: list[str] = []  # names of files that are not as the run left them
        self.is_external = False  # a checkpoint was forged that may be of another run
        self.has_failed = False  # an attempt
        self.has_previous = (
            False  # a whole checkpoint before the damaged one, so that the run must be resumed
        )
        self.said = ""

    def run(self) -> None:
        """Execute it."""
        self.show(f"{self.kind}: {self.scene.read_text()!r}")
        arguments = [
            "run",
            str(self.scene),
            *([] if self.is_body else ["--threads", "1"]),
            "-o",
            str(self.root / "whole"),
        ]
        with (
            contextlib.redirect_stdout(io.StringIO()),
            contextlib.redirect_stderr(io.StringIO()) as said,
        ):
            code = cli.main(arguments)  # in this process, whose kernels the forked ones will share
        if code != 0:
            raise Found(f"undisturbed run: exit code {code}: {said.getvalue()}")
        self.whole = contents(self.root / "whole")
        for _ in range(self.rng.randint(1, 6)):
            if self.rng.random() < 0.7 and (self.folder / CHECKPOINT).is_file() and not self.damage:
                self._damage()
            fault = self.rng.choice([None, *FAULTS])
            self._attempt(fault)
        if self._attempt(None):  # files that were damaged have been restored
            self._attempt(None)
        self._compare()

    def _command(self) -> list[str]:
        """One of the commands that begin or resume the run, with random threads."""
        threads = (
            []
            if self.is_body or self.rng.random() < 0.2
            else ["--threads", str(self.rng.choice([1, 2]))]
        )
        if (self.folder / "scene.toml").is_file() and self.rng.random() < 0.5:
            return ["resume", str(self.folder), *threads]
        return ["run", str(self.scene), "-o", str(self.folder), "--resume", *threads]

    def _attempt(self, fault: str | None) -> bool:
        """Run or resume, with a error at a random call, and check how it ends; whether the run has
        to be resumed."""
        command = self._command()
        names = FAILING if fault == "failing" else self.rng.choice([(), FILE_CALLS])
        count = int(10 ** (self.rng.uniform(0, 3.3) if names else self.rng.uniform(1, 5.6)))
        act, what, codes = self._fault(fault)
        self.actions[what.split(":")[0]] += 1
        before = self._files()
        number, read = begun(command, AtCall(names, count, act) if act else None)
        code = waited(number, stops=True)
        if code is None:
            code = self._while_stopped(number, has_begun=self._files() != before)
        self.said = said_by(read)
        where = f" at {'file ' if names else ''}call {count}" if act else ""
        self.show(f"{' '.join(command)}; {what}{where}; damaged: {self.damage}; exit code {code}")
        return self._check(code, codes, fault, before)

    def _fault(self, fault: str | None) -> tuple[Callable[[], None] | None, str, set[int]]:
        """What happens at the call, as text, and the exit codes that are right if nothing is
        damaged."""
        rng = self.rng

        def own(sent):
            return lambda: os.kill(os.getpid(), sent)

        if fault == "kill":
            return own(signal.SIGKILL), "kill", {0, -signal.SIGKILL}
        if fault == "timer":  # a moment after the call, also within compiled code
            seconds = rng.uniform(1e-4, 0.02)
            return (
                lambda: signal.setitimer(signal.ITIMER_PROF, seconds),
                "kill by a timer",
                {0, -signal.SIGPROF},
            )
        if fault == "stop":
            return own(signal.SIGSTOP), "stop", {0, 2, -signal.SIGKILL}
        if fault == "signal":
            sent = rng.choice([signal.SIGTERM, signal.SIGINT, signal.SIGUSR1])
            ends = {signal.SIGTERM: {143, -sent}, signal.SIGINT: {130}, signal.SIGUSR1: {-sent}}[
                sent
            ]
            return own(sent), f"signal: {sent.name}", {0, *ends}
        if fault == "disk":
            size = rng.choice([0, 0, 100, 3000, 20_000])
            return (
                lambda: limited(resource.RLIMIT_FSIZE, size),
                f"full disk: files of {size} bytes",
                {0, 2},
            )
        if fault == "failing":
            number = rng.choice([errno.ENOSPC, errno.EIO, errno.EDQUOT])
            return (
                functools.partial(failing, number),
                f"failing call: {errno.errorcode[number]}",
                {0, 2},
            )
        if fault == "memory":
            return functools.partial(_raise, MemoryError), "memory error", {0, 2}
        if fault == "allocation" and set_nomemory is not None:
            skipped = rng.choice([0, 1, 3, 10, 30, 100])
            return (
                lambda: set_nomemory(skipped, skipped + 1),
                f"allocation: {skipped} later",
                {0, 2, *CRASHES},
            )
        if fault == "limit":
            free = rng.choice([0, 100_000, 1_000_000, 10_000_000])
            return (
                lambda: limited(resource.RLIMIT_AS, used() + free),
                f"memory limit: {free} bytes left",
                {0, 2, *CRASHES},
            )
        return None, "no fault", {0}

    def _while_stopped(self, number: int, has_begun: bool) -> int:
        """Try to run in the folder of a process that is stopped; its exit code when it has
        continued, or been killed.

        has_begun : whether it has changed files, so that the other one must be rejected
        """
        second, read = begun(self._command())
        code, said = waited(second), said_by(read)
        self.show(f"  meanwhile another: exit code {code}")
        if code == 0 and not has_begun:
            self._compare()
        elif code != 2 or ("another run is writing" not in said and not self.damage):
            raise Found(f"a second run beside a stopped one: exit code {code}: {said}")
        os.kill(number, self.rng.choice([signal.SIGCONT, signal.SIGCONT, signal.SIGKILL]))
        return waited(number)

    def _files(self) -> dict[str, object]:
        return everything(self.folder) if self.folder.is_dir() else {}

    def _check(self, code: int, codes: set[int], fault: str | None, before: dict) -> bool:
        """Whether an attempt ended as it must. Restores damaged files where it was right to refuse
        them."""
        if fault == "allocation":  # within CPython and libraries a failed one may become any error
            code = CRASHES[0] if code == 1 else code
        elif "Traceback" in self.said or "Exception ignored" in self.said:
            raise Found("a traceback")
        if (
            code == 2
            and self.has_failed
            and "holds no checkpoint" in self.said
            and not {CHECKPOINT, PREVIOUS} & {*before}
        ):
            shutil.rmtree(
                self.folder
            )  # a run that failed before its first checkpoint has to be begun again
            self.damage = []
            return True
        self.has_failed |= code == 2 and fault is not None
        is_refusable = self.damage and not self.has_previous
        self.has_previous = False  # from now on there may be no checkpoint before the damaged one
        allowed = codes | ({2} if is_refusable else set()) | ({1} if self.is_external else set())
        if code not in allowed:
            raise Found(f"exit code {code}, not one of {sorted(allowed)}")
        if code == 2 and not re.search("^rigidmd: ", self.said, re.MULTILINE):
            raise Found("no sentence tells why it ended")
        after = self._files()
        if code in (0, 2) and (
            left := [
                name for name in after.keys() - before if re.match(r"\..*\.[0-9a-f]{16}", name)
            ]
        ):
            raise Found(f"temporary files stay: {left}")
        if code == 2 and fault is None and after != before and "stopped at step" not in self.said:
            changed = [name for name in before | after if before.get(name) != after.get(name)]
            raise Found(f"refused, and files have changed: {changed}")
        if (
            self.folder.is_dir()
            and not (self.folder / "notes.txt").exists()
            and (self.folder / ".rigidmd-run").exists()
        ):
            if "notes.txt" in before:
                raise Found("notes.txt is gone")
            (self.folder / "notes.txt").write_text("of the user")
        if code == 0 and not self.is_external:
            self._compare()
        if self.damage and fault is None:
            self._restore()
            return True
        return False

    def _compare(self) -> None:
        """Raise Found if results differ from the values of the undisturbed run, or files of others have
        changed."""
        found = contents(self.folder)
        unread = {name for name in self.damage if name.startswith("topology")}
        differ = [
            name
            for name in self.whole | found
            if self.whole.get(name) != found.get(name) and name not in unread
        ]
        if differ:
            raise Found(f"other bits: {differ}")
        if self.victim.exists() and self.victim.read_bytes() != b"precious":
            raise Found("a file outside has changed")

    def _damage(self) -> None:
        """Damage files, of which a copy is kept."""
        rng = self.rng
        shutil.rmtree(self.kept, ignore_errors=True)
        shutil.copytree(self.folder, self.kept, symlinks=True)
        names = sorted(path.name for path in self.folder.iterdir() if path.name != "notes.txt")
        growing = [name for name in names if name.startswith(("log", "trajectory"))]
        name = rng.choice([CHECKPOINT, CHECKPOINT, PREVIOUS, *growing, *growing, *names])
        path, how = (
            self.folder / name,
            rng.choice(["flip", "flip", "cut", "link", "pipe", "forge", "forge", "remove"]),
        )
        words = name
        if how == "forge":
            name = CHECKPOINT
            try:
                words = forge(self.folder, rng)
            except CheckpointError as error:
                raise Found(f"a checkpoint that was not damaged cannot be read: {error}") from None
            self.is_external = bool(FREE.match(words))
        elif not path.is_file():
            return
        elif how in ("flip", "cut"):
            data = bytearray(path.read_bytes())
            if data and how == "flip":
                data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
            path.write_bytes(bytes(data if how == "flip" else data[: rng.randrange(len(data) + 1)]))
        else:
            path.unlink()
            if how == "link":
                how = rng.choice(
                    ["link to a file", "link to nothing", "link to a device", "link to a copy"]
                )
                self.victim.write_bytes(b"precious")
                (self.root / "copy").write_bytes((self.kept / name).read_bytes())
                targets = {
                    "file": self.victim,
                    "nothing": self.root / "nothing",
                    "device": "/dev/zero",
                }
                path.symlink_to(targets.get(how.split()[-1], self.root / "copy"))
            elif how == "pipe":
                os.mkfifo(path) if rng.random() < 0.7 else path.mkdir()
        self.damage = [name]
        self.has_previous = (
            name == CHECKPOINT
            and how in ("flip", "cut", "remove")
            and (self.folder / PREVIOUS).is_file()
        )
        self.actions[how] += 1
        self.show(f"{how}: {words}")

    def _restore(self) -> None:
        """Give the run its files back."""
        shutil.rmtree(self.folder)
        shutil.copytree(self.kept, self.folder, symlinks=True)
        self.damage, self.is_external = [], False
        self.show("files are restored")


def limited(limit: int, size: int) -> None:
    resource.setrlimit(limit, (size, resource.getrlimit(limit)[1]))


def used() -> int:
    """Bytes of the address space of this process."""
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


def failing(number: int) -> None:
    raise OSError(number, os.strerror(number))


def _raise(kind: type[Exception]) -> None:
    raise kind


# The program


def main() -> int:
    """Run cases until the time is up; 1 if something was found."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--minutes", type=float, default=1.0, help="how long (default: 1)")
    parser.add_argument("--cases", type=int, help="so many cases, however long they take")
    parser.add_argument(
        "--seed", type=int, help="only the case of this seed, with each of its actions"
    )
    parser.add_argument(
        "--first", type=int, help="the seed of the first case (default: by the clock)"
    )
    parser.add_argument(
        "--wide", action="store_true", help="more ensembles, thermostats, precisions; compiles more"
    )
    parser.add_argument(
        "--keep", type=Path, metavar="FOLDER", help="keep the files of the last case there"
    )
    options = parser.parse_args()
    if options.seed is not None:
        options.cases = 1
    began, cases, actions, failures = time.monotonic(), 0, Counter[str](), 0
    seed = (
        options.seed
        if options.seed is not None
        else options.first
        if options.first is not None
        else int(time.time())
    )
    replay = f"python tests/support/faults.py{' --wide' if options.wide else ''} --seed"
    with tempfile.TemporaryDirectory() as temporary:
        root = options.keep or Path(temporary)
        while True:
            shutil.rmtree(root, ignore_errors=True)
            root.mkdir(parents=True)
            story: list[str] = []
            case = Case(
                seed, root, options.wide, print if options.seed is not None else story.append
            )
            try:
                case.run()
            except (
                Exception
            ) as error:  # also of the driver: what an attempt has left may be anything
                failures += 1
                found = f"FOUND: {error}" if isinstance(error, Found) else traceback.format_exc()
                print(*story, case.said, found, f"replay: {replay} {seed}", sep="\n", flush=True)
            cases, seed = cases + 1, seed + 1
            actions += case.actions
            is_over = time.monotonic() - began > 60 * options.minutes
            if cases == options.cases or (options.cases is None and is_over):
                break
    hours = (time.monotonic() - began) / 3600
    print(f"{cases} cases in {hours:.3f} hours; {failures} failures")
    print("actions: " + ", ".join(f"{count} {name}" for name, count in sorted(actions.items())))
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
