"""Checks of users' compiled forces and thermostats before the first step: what cannot be compiled,
indices beyond an array, and momenta that are not finite or whose energy is not in the ledger. Each
message names the function and its line."""

import linecache
import re
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rigidmd.compile.sources import PACKAGE
from rigidmd.core.state import HEAT, TALLY_SIZE, State, no_load
from rigidmd.engines.cpu.engine import CompileError
from rigidmd.engines.system import System
from rigidmd.errors import SceneError
from rigidmd.features.potentials.user_code.kernels import FORCES, THERMOSTATS, with_checked_indices
from rigidmd.scene.molecules import name_of

#: Largest difference by rounding between a change of the kinetic energy and of the ledger, as a
#: fraction of the energy.
LEDGER_ERROR = 1e-9


def check_compiled_code(system: System, state: State) -> list[str]:
    """Call each user-defined compiled force and thermostat once, with index checks, on copies of
    the state. Returns notes. Raises SceneError with all errors."""
    faults, notes = [], []
    for name, term in system.terms.items():
        if function := FORCES.get(type(term)):
            arguments = term, state.copy(), no_load(state), np.zeros(TALLY_SIZE)
            faults += _faults(name, function, arguments)
    for name, thermostat, h in _thermostats(system):
        after = state.copy()
        function = THERMOSTATS[type(thermostat)]
        if wrong := _faults(name, function, (thermostat, system.model, after, h, 0)):
            faults += wrong
        elif _kinetic_energy(system, state) == 0:
            continue  # at rest, a factor of the momenta may be infinite
        elif not after.is_finite:
            faults.append(
                f"{name}: {_place(function)} makes momenta that are not finite, in a time of"
                f" {h:g} ps"
            )
        elif (missing := _missing_heat(system, state, after)) is not None:
            change, heat, kinetic = missing
            notes.append(
                f"{name} changes the kinetic energy by {change / kinetic:.2g} of it and adds"
                f" {heat / kinetic:.2g} to state.energy_ledger[0]: the conserved energy will drift"
                " by the difference"
            )
    if faults:
        raise SceneError(system.scene.source, list(dict.fromkeys(faults)))
    return list(dict.fromkeys(notes))


def _thermostats(system: System) -> Iterator[tuple[str, NamedTuple, float]]:
    """The user's thermostat in each stage of motion: its name, the NamedTuple, the time of its flow
    (ps)."""
    if system.thermostat is None:
        return
    for k, stage in enumerate(system.scene.stages):
        if stage.is_minimisation or stage.is_auto:
            continue
        thermostat = system.user_thermostat(k)
        if thermostat is not None and type(thermostat) in THERMOSTATS:
            name = f"thermostat {name_of(system.thermostat)}"
            yield name, thermostat, float(stage.step)


def _faults(name: str, function: Callable, arguments: tuple) -> list[str]:
    """The error of a function that cannot be compiled, or reads or writes beyond an array."""
    arguments_for_python = tuple(
        part.copy() if isinstance(part, State) else part for part in arguments
    )
    try:
        with_checked_indices(function)(*arguments)
    except CompileError as error:
        return [f"{name}: {_place(function)} cannot be compiled{describe_compile_error(error)}"]
    except IndexError:
        hint = "masses and moments are by species: model.mass[model.species[m]]"
        return [
            f"{name}: {_place_of_index_error(function, arguments_for_python)} has an index beyond"
            f" an array; {hint}"
        ]
    return []


def _missing_heat(system: System, before: State, after: State) -> tuple[float, float, float] | None:
    """Change of the kinetic energy, the heat in the ledger, and the kinetic energy, if the first
    two differ."""
    old, new = _kinetic_energy(system, before), _kinetic_energy(system, after)
    change = new - old
    heat = float(after.energy_ledger[HEAT] - before.energy_ledger[HEAT])
    return (
        (change, heat, max(old, new)) if abs(change - heat) > LEDGER_ERROR * max(old, new) else None
    )


def _kinetic_energy(system: System, state: State) -> float:
    """Kinetic energy of all molecules (u Å²/ps²)."""
    model = system.model
    moving = model.mass[model.species] @ (state.velocity**2).sum(axis=1)
    momentum = state.angular_momentum_body
    turning = (momentum**2 * model.inverse_inertia[model.species]).sum() if len(momentum) else 0.0
    return 0.5 * float(moving + turning)


def describe_compile_error(error: CompileError) -> str:
    """Where in the user's code a function cannot be compiled, and why."""
    text = re.sub(r"\x1b\[[\d;]*m", "", str(error))  # Numba's colours, where colorama is installed
    files = re.findall(r'File "(?!<)([^"]+)", line (\d+)', text)
    of_user = [(file, int(line)) for file, line in files if _is_of_user(file)]
    where = f" ({_quoted(*of_user[0])})" if of_user else ""
    if plain := re.findall(r"Untyped global name '(\w+)'", text):
        return (
            f"{where}: it uses {plain[-1]}, which is not compiled: if it is a function, put"
            " numba.njit before it"
        )
    if bound := re.search(
        r"Cannot bind 'args=(.*?) kws=.*?' to signature '(\(.*?\))' due to \"TypeError: (.*?)\"",
        text,
    ):
        callee = re.search(r"<function (\w+) at", text[bound.end() :])
        return (
            f"{where}: {callee[1] if callee else 'a function'}{bound[2]} is called with wrong"
            f" arguments: {bound[3]}"
        )
    if unknown := re.search(r"Unknown attribute '(\w+)' of type (\w+)", text):
        return f"{where}: Numba knows no attribute {unknown[1]!r} of {unknown[2]}"
    if unknown := re.findall(r">>> (\S.*)", text):
        return f"{where}: Numba knows no {_short(unknown[-1])}"
    sentences = [line.strip() for line in text.splitlines() if line.strip()]
    causes = [line for line in sentences if not line.startswith(("Failed in", "During"))]
    return f"{where}: {_short((causes or sentences)[0])}"


def _short(text: str) -> str:
    """Text of Numba without the fields of NamedTuples."""
    while (shorter := re.sub(r"\b([A-Z]\w*)\((?:[^()]|\([^()]*\))*\)", r"\1", text)) != text:
        text = shorter
    return text if len(text) < 300 else f"{text[:300]} ..."


def _is_of_user(file: str) -> bool:
    """Whether a file that Numba names, perhaps relative to the working directory, is not of rigidmd
    or of Numba."""
    path = Path(file).resolve()
    return not path.is_relative_to(PACKAGE) and "site-packages" not in path.parts


def _quoted(file: str, line: int) -> str:
    """A line of a file, with its text."""
    text = linecache.getline(file, line).strip()
    return f"line {line} of {Path(file).name}" + (f": `{text}`" if text else "")


def _place(function: Callable) -> str:
    """The name of a function, and where it is defined."""
    code = getattr(function, "py_func", function).__code__
    return f"{code.co_name} (line {code.co_firstlineno} of {Path(code.co_filename).name})"


def _place_of_index_error(function: Callable, arguments: tuple) -> str:
    """The line of an index beyond an array, if the function runs as Python too, or else where it is
    defined."""
    plain = getattr(function, "py_func", function)
    try:
        plain(*arguments)
    except IndexError as error:
        frames = [
            frame
            for frame in traceback.extract_tb(error.__traceback__)
            if _is_of_user(frame.filename)
        ]
        if frames:
            return f"{plain.__name__} ({_quoted(frames[-1].filename, frames[-1].lineno or 0)})"
    except Exception:  # what only compiled code can do
        pass
    return _place(function)
