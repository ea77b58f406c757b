"""Checkpoints: damaged ones and ones of other versions are refused, and no number in them is trusted."""

import contextlib
import copy
import functools
import hashlib
import json
import shutil
import zipfile

import numpy as np
import pytest
from support.common import small_scene
from support.scenes import NVT, forty_waters
from support.stops import contents, everything, stopped_at, top

from rigidmd.assemble.build import build
from rigidmd.commands import cli
from rigidmd.core.quantities import QUANTITIES
from rigidmd.core.state import State
from rigidmd.engines.samples import numbers
from rigidmd.errors import CheckpointError, OutputError, SimulationError
from rigidmd.io import checkpoint
from rigidmd.io.checkpoint import Checkpoint, read_checkpoint, write_checkpoint
from rigidmd.io.folder import CHECKPOINT, PREVIOUS
from rigidmd.run import Every, Simulation
from rigidmd.run.resume import state_from
from rigidmd.scene import Scene


def test_a_checkpoint_of_another_version_is_refused(again, printed):
    kept = read_checkpoint(again / "run" / CHECKPOINT)
    for schema, age in ((1, "an earlier"), (3, "an earlier"), (99, "a later")):
        name_of_values = "values" if schema > 3 else "told"
        values = np.frombuffer(json.dumps(kept.values | {"schema": schema}).encode(), np.uint8)
        for name in (CHECKPOINT, PREVIOUS):
            with zipfile.ZipFile(again / "run" / name, "w") as archive:
                for member, array in {name_of_values: values, **kept.arrays}.items():
                    with archive.open(f"{member}.npy", "w") as file:
                        np.lib.format.write_array(file, array)
            with zipfile.ZipFile(again / "run" / name, "a") as archive:
                archive.writestr("contents", checkpoint._contents(archive))
        before = everything(again / "run")
        assert (
            f"was written by {age} rigidmd (version {schema} of the format"
            in printed("resume", again / "run", code=2).err
        )
        assert everything(again / "run") == before


def altered(array: np.ndarray) -> dict[str, np.ndarray]:
    """An array with other values: every kind of change that its type can hold."""
    changed = {
        "longer": np.concatenate([array.reshape(-1), array.reshape(-1)[:1]]),
        "text": array.astype(str),
    }
    changed["of another type"] = array.astype(
        np.float32 if array.dtype == np.float64 else np.float64
    )
    if array.ndim:
        changed["shorter"] = array[:-1]
    values = {"off by one": lambda x: x + 1, "negative": lambda x: -x - 1, "zero": lambda x: 0 * x}
    if array.dtype.kind == "f":
        values |= {
            "nan": lambda x: x * np.nan,
            "infinite": lambda x: x + np.inf,
            "huge": lambda x: x + 1e300,
        }
    else:
        values |= {
            "huge": lambda x: np.iinfo(array.dtype).max,
            "lowest": lambda x: np.iinfo(array.dtype).min,
        }
    with np.errstate(all="ignore"):
        for name, function in values.items():
            for place in (np.s_[...], *([0] if array.size > 1 else [])):
                changed[f"{name}, {'all' if place is ... else 'first'}"] = other = array.copy()
                flat = other.reshape(-1)
                flat[place] = function(flat[place])
    return {
        name: other
        for name, other in changed.items()
        if array.size and not np.array_equal(array, other)
    }


def leaves(value: object, path: tuple = ()) -> list[tuple]:
    """The paths of all values in nested lists and dictionaries, and of these."""
    inner = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    return [path, *(leaf for key, part in inner for leaf in leaves(part, (*path, key)))]


def changes_of(kept: Checkpoint) -> list[tuple[str, Checkpoint]]:
    """A checkpoint with one value changed, in every way."""
    found = []
    for name, array in kept.arrays.items():
        for kind, other in altered(array).items():
            found.append((f"{name}: {kind}", Checkpoint(kept.values, kept.arrays | {name: other})))
        found.append(
            (
                f"{name}: left out",
                Checkpoint(kept.values, {k: a for k, a in kept.arrays.items() if k != name}),
            )
        )
    for path in leaves(kept.values)[1:]:
        *way, last = path
        whole = functools.reduce(lambda part, key: part[key], way, kept.values)[last]
        others = [
            None,
            "x",
            [],
            {},
            [None],
            -1.5,
            float("nan"),
            float("inf"),
            10**30,
            -(10**30),
            40,
            7,
            -1,
        ]
        others += [whole + 1, -whole, whole + 0.5] if isinstance(whole, int | float) else []
        for other in others:
            told = copy.deepcopy(kept.values)
            functools.reduce(lambda part, key: part[key], way, told)[last] = other
            if other != whole:
                found.append(
                    (f"{'.'.join(map(str, path))}: {other!r:.20}", Checkpoint(told, kept.arrays))
                )
    return found


@pytest.mark.parametrize("kept", [[], [0], [1, 2, 3, 4], [-1, 0], [True, 0], ["0", 0], {}, "ab", 3])
@pytest.mark.parametrize("owner", ["LogFile", "Frames"])
def test_sizes_that_are_none_cut_no_file(owner, kept, again):
    found = read_checkpoint(again / "run" / CHECKPOINT)
    found.values["of"][owner]["kept"] = kept
    write_checkpoint(again / "run", found)
    before = everything(again / "run")
    assert cli.main(["resume", str(again / "run")]) == 2
    assert everything(again / "run") == before


@pytest.mark.parametrize(
    ("kind", "count"),
    [("molecules", 25), ("verlet", 60), ("dop853", 60)]
    + [
        pytest.param(kind, 10**6, marks=pytest.mark.soak)
        for kind in ("molecules", "verlet", "dop853", "rk4")
    ],
)
def test_wrong_numbers_in_a_checkpoint_do_no_harm(kind, count, tmp_path):
    """With right checksums, as only a forger writes them: rejected with a sentence and without a
    change of a file, or another run, which ends by itself. No crash, no hang, no other error."""
    data = (
        forty_waters(NVT | {"duration_ps": 0.06}, threads=1)
        if kind == "molecules"
        else top(kind.replace("verlet", "velocity_verlet"))
    )
    stop = stopped_at({20} if kind == "molecules" else {30})
    stop.interval = 0.001 if kind == "molecules" else 0.005
    look = Every(stop.interval, lambda moment: None)
    run = tmp_path / "run"
    Simulation(Scene.from_dict(data), run, observers=stop).run()
    shutil.copytree(run, tmp_path / "kept")
    kept = read_checkpoint(run / CHECKPOINT)
    Simulation(Scene.from_dict(data), run, observers=look, resume=True).run()
    wrong, refused = [], 0
    changes = changes_of(kept)
    for k in np.random.default_rng(count).permutation(len(changes))[:count].tolist():
        name, changed = changes[k]
        shutil.rmtree(run)
        shutil.copytree(tmp_path / "kept", run)
        before = everything(run)
        write_checkpoint(run, changed)
        with contextlib.suppress(FileNotFoundError):
            before |= {file: (run / file).read_bytes() for file in (CHECKPOINT, PREVIOUS)}
        try:
            simulation = Simulation(
                Scene.from_dict(data), run, observers=look, resume=True, warn=lambda sentence: None
            )
            simulation.run()
        except CheckpointError:
            refused += 1
            if everything(run) != before:
                wrong.append(f"{name}: refused, and files have changed")
        except OutputError as error:
            refused += 1
            if "has changed or is damaged" not in str(error) and "shorter than it was" not in str(
                error
            ):
                wrong.append(f"{name}: {error}")
        except SimulationError:
            pass
        except Exception as error:
            wrong.append(f"{name}: {error!r}")
    assert not wrong, f"{len(wrong)} of {count}, {refused} refused:\n" + "\n".join(wrong)
    assert refused > 0


def test_kept_forces_that_are_not_numbers_are_refused(again, printed):
    kept = read_checkpoint(again / "run" / CHECKPOINT)
    lost = np.full_like(kept.arrays["engine/load.force"], np.nan)
    write_checkpoint(
        again / "run", Checkpoint(kept.values, kept.arrays | {"engine/load.force": lost})
    )
    before = everything(again / "run")
    said = printed("resume", again / "run", code=2).err
    assert "its state has another force than was kept with it" in said
    assert everything(again / "run") == before


@pytest.mark.parametrize("damage", ["flipped", "cut", "empty"])
def test_a_damaged_checkpoint_gives_way_to_the_one_before(damage, again, printed):
    path = again / "run" / CHECKPOINT
    data = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        longest = max(archive.infolist(), key=lambda info: info.compress_size)
    data[longest.header_offset + longest.compress_size // 2] ^= (
        4  # headers have bits without meaning
    )
    path.write_bytes(
        {"flipped": bytes(data), "cut": bytes(data[: len(data) // 3]), "empty": b""}[damage]
    )
    said = printed("resume", again / "run").err
    assert "checkpoint.npz: is damaged" in said and "The checkpoint before it is used" in said
    shutil.copy(again / "run" / CHECKPOINT, again / "run" / "kept.npz")
    for name in (CHECKPOINT, PREVIOUS):
        (again / "run" / name).write_bytes(b"nothing")
    before = contents(again / "run")
    assert cli.main(["resume", str(again / "run")]) == 2
    assert contents(again / "run") == before


def test_every_flipped_bit_of_a_checkpoint_is_seen(again):
    whole = (again / "run" / CHECKPOINT).read_bytes()
    kept = read_checkpoint(again / "run" / CHECKPOINT)
    rng = np.random.default_rng(1)
    for place in rng.integers(0, len(whole), 200).tolist():
        data = bytearray(whole)
        data[place] ^= 1 << int(rng.integers(8))
        (again / "bad.npz").write_bytes(bytes(data))
        try:
            found = read_checkpoint(again / "bad.npz")
        except CheckpointError:
            continue
        # bits of the archive that mean nothing, such as times
        assert found.values == kept.values
        pairs = [(found.arrays[name], array) for name, array in kept.arrays.items()]
        assert all(np.array_equal(one, other, equal_nan=True) for one, other in pairs)


@pytest.mark.parametrize("size", [10, 300_000])
def test_an_array_of_another_checkpoint_is_seen(size, tmp_path):
    """Each array is right by itself, whatever its size; together they are of two runs."""
    for folder, value in (("one", 1.0), ("two", 2.0)):
        (tmp_path / folder).mkdir()
        arrays = {"a": np.full(size, value), "b": np.full(7, value)}
        write_checkpoint(tmp_path / folder, Checkpoint({"of": {}}, arrays))
    one, two = (tmp_path / folder / CHECKPOINT for folder in ("one", "two"))
    assert np.array_equal(read_checkpoint(one).arrays["a"], np.ones(size))
    with zipfile.ZipFile(one) as first, zipfile.ZipFile(two) as second:
        members = {name: first.read(name) for name in first.namelist()}
        members["a.npy"] = second.read("a.npy")
    with zipfile.ZipFile(one, "w") as mixed:
        for name, content in members.items():
            mixed.writestr(name, content)
    with pytest.raises(CheckpointError, match="its contents differ from those that were written"):
        read_checkpoint(one)


def test_a_folder_without_a_checkpoint(again, printed):
    for name in (CHECKPOINT, PREVIOUS):
        (again / "run" / name).unlink()
    assert (
        "holds no checkpoint (it holds final.npz, log.csv"
        in printed("resume", again / "run", code=2).err
    )
    assert "is not the folder of a run" in printed("resume", again, code=2).err


def test_a_checkpoint_of_other_columns_has_another_schema():
    """The table of samples has no names: a change of the columns needs a new number here and there."""
    digest = hashlib.sha256(" ".join(numbers(QUANTITIES)).encode()).hexdigest()[:8]
    assert (checkpoint.SCHEMA, digest) == (7, "82843b72")


def test_a_checkpoint_gives_back_all_of_a_state():
    system = build(small_scene({"spce": 3}, 12.0, forces={"cutoff_A": 5.0}))
    rng = np.random.default_rng(1)
    state = system.state._replace(extra_variables=rng.standard_normal(12))
    for array in (state.position, state.velocity, state.angular_momentum_body, state.energy_ledger):
        array[:] = rng.standard_normal(array.shape)
    found = state_from(
        {name: array.copy() for name, array in zip(State._fields, state, strict=True)}, state
    )
    for name, a, b in zip(state._fields, found, state, strict=True):
        assert a.tobytes() == b.tobytes(), name
