"""Threads: that each block is done once, and that threads that wait leave their cores to
others."""

import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
import pytest
from support.common import ROOT, same_bits, small_scene
from support.processes import search_path
from support.thread_kernels import count_blocks, counted, meet, run_blocks

from rigidmd import Every, Simulation, run_together
from rigidmd.commands.cli import main
from rigidmd.compile import (
    ALWAYS,
    JOINED,
    Code,
    Pass,
    Program,
    call_blocks,
    kernel,
    load_arguments,
    pack_arguments,
    run_passes,
    set_threads,
    task,
)
from rigidmd.compile.machine import MOST_THREADS
from rigidmd.compile.thread_pool import (
    ADDRESS,
    ARGUMENTS,
    BEGUN,
    BLOCKS,
    FIRST_ROW,
    JOB,
    MOST_ROWS,
    ROW,
    STATUS,
    ZERO,
    _add,
    _pool,
    _run_ranges_of_row,
)
from rigidmd.core.integrators import SCHEMES
from rigidmd.errors import SimulationError


@task()
def _count_within(task_arguments, block):
    code, seen = load_arguments(task_arguments)
    call_blocks(code, "count", pack_arguments((seen[block], 10)), seen.shape[1])


@kernel(from_python=True)
def _run_within(code, inner, seen):
    call_blocks(code, "within", pack_arguments((inner, seen)), len(seen))


@pytest.fixture(autouse=True)
def _all_threads_again():
    yield
    set_threads(MOST_THREADS)


@pytest.mark.parametrize("threads", [1, 2, MOST_THREADS])
@pytest.mark.parametrize(("blocks", "work"), [(0, 0), (2, 0), (16, 10), (16, 10_000), (1000, 100)])
def test_every_block_is_done_once(threads, blocks, work):
    set_threads(min(threads, MOST_THREADS))
    seen = counted(blocks, work, 200)
    assert (seen[:, 0] == 200).all()
    assert seen[:, 1] == pytest.approx([sum(np.sqrt(np.arange(work) + b)) for b in range(blocks)])


def test_every_block_is_done_once_by_many_more_threads():
    """As on a machine with 24 cores. Few blocks are usual: a small PME grid has three."""
    script = "from support.thread_kernels import counted; assert all((counted(n, 10, 2000)[:, 0] == 2000).all() for n in range(1, 9))"
    done = subprocess.run(
        [sys.executable, "-c", script],
        env=os.environ | {"NUMBA_NUM_THREADS": "24"} | search_path(ROOT / "tests"),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr


@task()
def _note(task_arguments, block):
    order = load_arguments(task_arguments)
    order[0] += 1
    order[order[0]] = block


@kernel(from_python=True)
def _run_alone(cells, job, own, threads):
    return _run_ranges_of_row(cells, job, 0, 1, own, threads)


@pytest.mark.parametrize(
    ("own", "threads", "begun", "expected"),
    [
        (0, 2, [0] * 6, [0, 1, 2, 3, 4, 5]),
        (1, 2, [0] * 6, [5, 4, 3, 2, 1, 0]),
        (0, 2, [0, 4, 2, 0, 4, 4], [0, 2, 3]),  # the others have begun
        (2, 3, [0] * 6, [4, 5, 0, 1, 2, 3]),
        (1, 3, [0] * 6, [3, 2, 1, 0, 5, 4]),
        (1, 2, [4, 4, 6, 4, 8, 6], []),  # the job has ended, others have begun
        (3, 8, [0] * 6, [2, 1, 0, 5, 4, 3]),  # more threads than blocks
        (1, 16, [0] * 6, [0, 5, 4, 3, 2, 1]),  # more than twice as many
    ],
)
def test_each_thread_begins_with_its_fraction_and_continues_with_what_is_left(
    own, threads, begun, expected
):
    cells, order = np.zeros(FIRST_ROW + ROW, np.int64), np.zeros(7, np.int64)
    code = Code(note=(_note, order))
    struct = code.to_struct(order)
    cells[JOB], cells[STATUS] = 4, cells.ctypes.data + 8 * ZERO
    cells[FIRST_ROW:][[ADDRESS, ARGUMENTS, BLOCKS]] = code.address("note"), struct.address, 6
    cells[FIRST_ROW + BEGUN :][:6] = begun
    assert _run_alone(cells.ctypes.data, 4, own, threads) == (len(expected), False)
    assert order[1 : order[0] + 1].tolist() == expected
    assert _run_alone(cells.ctypes.data, 2, own, threads) == (0, True)  # of an earlier job


@task()
def _enter(task_arguments, block):
    """Enter a number and the block into the next line of a log, after some work."""
    number, work, log, status = load_arguments(task_arguments)
    total = 0.0
    for n in range(work):
        total += np.sqrt(n + block)
    at = _add(log.ctypes.data, 0, 1) + 1
    log[at, 0], log[at, 1], log[at, 2] = number, block, total
    if number == 9:
        status[0] = 9


@kernel(from_python=True)
def _run_program(rows):
    return run_passes(rows, rows.arguments, ALWAYS)


def entered(rows: list[tuple[int, int, int, int, int]]) -> tuple[np.ndarray, int]:
    """The lines that passes (number, blocks, job, chain, work) enter, and their status."""
    status = np.zeros(1, np.int64)
    log = np.zeros((1 + sum(row[1] for row in rows), 3), np.int64)
    passes = [
        Pass("", _enter, (number, work, log, status), blocks, job=job, chain=chain)
        for number, blocks, job, chain, work in rows
    ]
    program = Program(passes, ALWAYS, status)
    program.bind(passes)
    found = _run_program(program.rows)
    return log[1 : 1 + log[0, 0], :2], found


#: number, blocks, job, chain: a grid with serial passes, two chains of pairs, sums on molecules
ROWS = [
    *((0, 3, 0, 0), (1, 1, 0, 0)),
    *((2, 8, 1, 0), (3, 1, 1, 0), (4, 8, 1, 0), (5, 1, 1, 0)),
    *((6, 16, 1, 1), (7, 16, 1, 1), (8, 5, 1, 2), (10, 2, 1, 2)),
    *((11, 6, 2, JOINED), (12, 6, 2, JOINED), (13, 4, 2, JOINED), (14, 1, 0, 0), (15, 9, 3, 0)),
]


@pytest.mark.parametrize("threads", [1, 2, MOST_THREADS])
@pytest.mark.parametrize("work", [0, 3000])
def test_passes_follow_those_of_their_chain_and_all_of_earlier_jobs(threads, work):
    set_threads(min(threads, MOST_THREADS))
    for _ in range(30):
        lines, status = entered([(*row, work) for row in ROWS])
        assert status == 0
        moments: dict[int, list[int]] = {}
        for moment, (number, _) in enumerate(lines.tolist()):
            moments.setdefault(number, []).append(moment)
        for number, blocks, job, chain in ROWS:
            assert sorted(lines[lines[:, 0] == number, 1].tolist()) == list(range(blocks))
            for before, _, job_before, chain_before in ROWS:
                if before < number and (job_before, chain_before) == (job, chain) != (2, JOINED):
                    assert max(moments[before]) < min(moments[number])
                if before < number and (job_before != job or job == 0):
                    assert max(moments[before]) < min(moments[number])
        for block in range(6):
            first, second = (lines.tolist().index([number, block]) for number in (11, 12))
            assert second == first + 1 if threads == 1 else first < second
        if threads < 6:  # joined: a thread begins no second block before it has ended the first
            assert min(moments[12]) < max(moments[11])
        assert max(moments[12]) < min(moments[13])  # it has other blocks


@pytest.mark.parametrize(
    ("threads", "callers", "polls"), [("2", 1, 1000), ("7", 2, 2), ("24", 2, 20)]
)
def test_random_jobs_run_each_block_once_in_its_order(threads, callers, polls):
    command = [sys.executable, "-m", "support.random_jobs", "2", str(callers), str(polls)]
    environment = os.environ | {"NUMBA_NUM_THREADS": threads} | search_path(ROOT / "tests")
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(MOST_THREADS == 1, reason="one core")
@pytest.mark.parametrize(("chains", "expected"), [((0, 1), [1, 1]), ((0, 0), [0, 1])])
def test_two_chains_run_at_the_same_time_and_one_in_its_order(chains, expected):
    """Passes of two chains that wait for each other would otherwise hang until the test times out."""
    begun = np.zeros(4, np.int64)
    most = 10**12 if chains == (0, 1) else 1000
    passes = [
        Pass("", meet, (which, begun.ctypes.data, most), job=1, chain=chain)
        for which, chain in enumerate(chains)
    ]
    program = Program(passes, ALWAYS, np.zeros(1, np.int64))
    program.bind(passes)
    assert _run_program(program.rows) == 0
    assert begun[2:].tolist() == expected


@pytest.mark.parametrize("threads", [1, MOST_THREADS])
def test_no_block_is_called_after_a_pass_has_failed(threads):
    """Not even in the same job: they would read what it has left. The pool is then free."""
    set_threads(threads)
    for _ in range(20):
        rows = [(9, 1, 1, 0, 0), (1, 40, 1, 0, 0), (3, 200, 1, 1, 100), (2, 3, 0, 0, 0)]
        lines, status = entered(rows)
        assert status == 9
        assert {1, 2}.isdisjoint(lines[:, 0])
    assert (counted(16, 10, 10)[:, 0] == 10).all()


def test_a_job_of_more_rows_than_the_pool_has_is_several_jobs():
    set_threads(MOST_THREADS)
    rows = [(n + 20, 2, 1, n % 7, 0) for n in range(2 * MOST_ROWS + 5)]
    lines, _ = entered(rows)
    assert sorted(lines.tolist()) == [[number, block] for number, *_ in rows for block in (0, 1)]


def test_a_block_may_have_blocks_of_its_own():
    inner, seen = Code(count=(count_blocks, (np.zeros((1, 2)), 10))), np.zeros((20, 30, 2))
    _run_within(Code(within=(_count_within, (inner, seen))), inner, seen)
    assert (seen[:, :, 0] == 1).all()


@numba.njit(nogil=True)
def _run_freely(code, seen, work, times):
    run_blocks(code, seen, work, times)


def test_two_calling_threads_at_once_each_have_their_blocks_done_once():
    """Without Python's lock, so that each finds the pool busy with the other."""
    found = [np.zeros((16, 2)), np.zeros((40, 2))]
    code = Code(count=(count_blocks, (found[0], 10)))
    both = [threading.Thread(target=_run_freely, args=(code, seen, 10, 20_000)) for seen in found]
    for one in both:
        one.start()
    for one in both:
        one.join()
    assert all((seen[:, 0] == 20_000).all() for seen in found)


def short_runs(count=2, seed=1, **own):
    """Runs of 500 argon for 1 ps, with a seed each."""
    own = {
        "stages": [{"ensemble": "nve", "duration_ps": 1.0}],
        "start": {"temperature_K": 90.0},
    } | own
    own = {"output": {"trajectory": False}} | own
    return [
        Simulation(small_scene({"argon": 500}, 30.0, seed=seed + k, **own)) for k in range(count)
    ]


def test_simulations_at_once_have_the_bits_of_each_alone():
    alone = [simulation.run().state for simulation in short_runs(3)]
    together = run_together(short_runs(3))
    for a, b in zip(alone, together, strict=True):
        assert same_bits(a, b.state)
        assert b.summary["threads"] == 1
    assert [r.state.step[0] for r in run_together(short_runs(3), jobs=1)] == [
        s.step[0] for s in alone
    ]


def test_simulations_on_all_threads_at_once_have_the_bits_of_each_alone():
    alone = [simulation.run().state for simulation in short_runs()]
    together = [None, None]

    def run(k, simulation):
        together[k] = simulation.run().state

    both = [threading.Thread(target=run, args=one) for one in enumerate(short_runs())]
    for one in both:
        one.start()
    for one in both:
        one.join()
    for a, b in zip(alone, together, strict=True):
        assert same_bits(a, b)


def test_other_threads_read_energies_while_a_run_begins_and_continues():
    """Two threads that use one engine at once end in a crash, or in another run."""
    stages = [{"ensemble": "nvt", "temperature_K": 90.0, "duration_ps": 4.0, "timestep_fs": 10.0}]
    scene = small_scene({"argon": 40}, 20.0, stages=stages, output={"log_interval_ps": 0.01})
    alone = Simulation(scene).run()
    simulation = Simulation(scene)
    has_ended = threading.Event()

    def read() -> int:
        count = 0
        while not has_ended.is_set():
            values = simulation.energy, simulation.observation.potential, *simulation.forces.flat
            assert np.isfinite(values).all()
            count += 1
        return count

    with ThreadPoolExecutor(2) as pool:
        readers = [pool.submit(read) for _ in range(2)]
        try:
            results = simulation.run()
        finally:
            has_ended.set()
        assert all(reader.result() > 1 for reader in readers)
    assert results.state.position.tobytes() == alone.state.position.tobytes()


def test_other_threads_of_python_continue_while_steps_are_taken():
    [simulation] = short_runs(1)
    engine, state = simulation.engine, simulation.state.copy()
    row = SCHEMES["velocity_verlet"]
    engine.advance(state, row, 1e-3, 1)
    for attempt in range(
        1, 51
    ):  # a busy machine may leave this thread aside during a call, not during all of them
        mover, seen = (
            threading.Thread(target=engine.advance, args=(state, row, 1e-3, 1000 * attempt)),
            set(),
        )
        mover.start()
        while mover.is_alive():
            seen.add(int(state.step[0]))
            time.sleep(0)
        mover.join()
        assert state.step[0] == 1000 * attempt
        if (
            len(seen) >= 20
        ):  # with Python's lock only the steps at which the compiled code returns could be seen
            break
    assert len(seen) >= 20


def test_what_runs_together_is_stopped_together():
    def end(moment):
        if moment.step == 100:
            os.kill(os.getpid(), signal.SIGTERM)

    stages = [{"ensemble": "nve", "duration_ps": 1e5}]
    scene = short_runs(1, stages=stages)[0].scene
    runs = [Simulation(scene, observers=Every(0.1, end)), *short_runs(2, stages=stages)]
    first, second, third = run_together(runs, jobs=2)
    assert first.interrupted and second.interrupted and third is None
    assert first.signal == signal.SIGTERM
    assert 100 <= first.state.step[0] < 1e8


def test_an_observer_may_end_a_run():
    scene = short_runs(1)[0].scene
    simulation = Simulation(
        scene, observers=Every(0.2, lambda moment: moment.step and simulation.stop())
    )
    results = simulation.run()
    assert results.interrupted and results.signal is None
    assert results.state.time[0] == pytest.approx(0.2)


def test_a_second_ctrl_c_is_an_interrupt_and_all_runs_still_end():
    def press_twice(moment):
        if moment.step == 100:  # this run cannot end before both have come
            for _ in range(2):
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(0.1)

    stages = [{"ensemble": "nve", "duration_ps": 1e5}]
    scene = short_runs(1, stages=stages)[0].scene
    runs = [Simulation(scene, observers=Every(0.1, press_twice)), *short_runs(1, stages=stages)]
    with pytest.raises(KeyboardInterrupt):
        run_together(runs)
    assert runs[0].state.step[0] == 100
    assert runs[1].state.step[0] < 1e8  # 0 if it was still about to begin


def test_each_run_writes_its_files_as_if_alone(tmp_path):
    runs = [
        Simulation(
            small_scene({"argon": 100}, 20.0, seed=seed, output={"trajectory_interval_ps": 0.002}),
            tmp_path / str(seed),
        )
        for seed in range(4)
    ]
    for results in run_together(runs, jobs=4):
        assert all(path.is_file() for path in results.files)
        assert len(results.universe().trajectory) == 3
    everything = ("ignore", None, Warning, None, 0)
    assert everything not in warnings.filters


def test_one_that_fails_takes_no_other_with_it():
    hot = {
        "start": {"temperature_K": 90.0},
        "stages": [{"ensemble": "nve", "duration_ps": 1.0, "timestep_fs": 900.0}],
    }
    runs = [*short_runs(1, **hot), *short_runs(1, seed=2)]
    with pytest.raises(SimulationError) as error:
        run_together(runs)
    assert any("of 2 runs at once these failed: 1" in note for note in error.value.__notes__)
    assert runs[1].state.time[0] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("twice", "jobs", "word"), [(True, None, "twice"), (False, 0, "jobs is 0: at least 1")]
)
def test_what_cannot_run_together_is_refused(twice, jobs, word):
    runs = short_runs(1)
    with pytest.raises(ValueError, match=word):
        run_together(runs * 2 if twice else runs, jobs)


HELPER = """
import time
from rigidmd.compile import set_threads
from rigidmd.compile.thread_pool import FIRST_THREAD, LINE, SLEEPS, _pool
from support.thread_kernels import met
set_threads(1)
assert met(1000) == [0, 1]
set_threads(2)
assert met(10**12) == [1, 1]
while not _pool.cells[FIRST_THREAD + LINE + SLEEPS]:
    time.sleep(0.01)
assert met(10**12) == [1, 1]
"""


def test_a_helper_helps_then_sleeps_and_is_woken():
    """Two blocks that wait for each other need two threads. Where no helper comes, this hangs until
    its limit."""
    environment = os.environ | {"NUMBA_NUM_THREADS": "2"} | search_path(ROOT / "tests")
    done = subprocess.run(
        [sys.executable, "-c", HELPER], env=environment, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_forked_process_starts_its_own_threads():
    seen = np.zeros((16, 2))
    code = Code(count=(count_blocks, (seen, 10)))
    child = os.fork()
    if child == 0:
        done = 1
        try:
            run_blocks(code, seen, 10, 100)  # without helpers, then with new ones
            set_threads(MOST_THREADS)
            run_blocks(code, seen, 10, 100)
            done = 0 if (seen[:, 0] == 200).all() and _pool.started == MOST_THREADS else 2
        finally:
            os._exit(done)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert (counted(16, 10, 100)[:, 0] == 100).all()


ALONE = """
import threading
from rigidmd.compile import set_threads
from support.thread_kernels import counted
set_threads(1)
counted(16)
assert threading.active_count() == 1, threading.enumerate()
"""


def test_one_thread_that_is_requested_has_no_helpers():
    environment = os.environ | search_path(ROOT / "tests")
    done = subprocess.run(
        [sys.executable, "-c", ALONE], env=environment, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")


MORE = """
import numpy as np, sys
from support.thread_kernels import counted
assert (counted(64, 100, 2000)[:, 0] == 2000).all()
"""


@pytest.mark.parametrize("threads", ["7", "32"])
def test_there_may_be_more_threads_than_cores_and_the_process_ends(threads):
    environment = os.environ | {"NUMBA_NUM_THREADS": threads} | search_path(ROOT / "tests")
    done = subprocess.run(
        [sys.executable, "-c", MORE], env=environment, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_importing_changes_no_variable_of_threads(tmp_path):
    code = "import os; before = dict(os.environ); import rigidmd.compile; assert dict(os.environ) == before"
    subprocess.run(
        [sys.executable, "-c", code], env=os.environ | {"RIGIDMD_CACHE": str(tmp_path)}, check=True
    )


def test_benchmarks_measure_what_a_user_gets(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "tests" / "benchmarks")
    from peer_engines import environment

    for name in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
        monkeypatch.setenv(name, "2")
        assert name not in environment()
    assert environment()["PATH"] == os.environ["PATH"]


def test_check_states_how_many_threads_compute(capsys):
    command = [sys.executable, "-m", "rigidmd", "check", "systems/water.toml", "--set", "threads=7"]
    environment = os.environ | {"NUMBA_NUM_THREADS": "2"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert "computing: 2 threads, mixed precision" in done.stdout, done.stderr
    assert main(["check", str(ROOT / "systems" / "water.toml"), "--set", "threads=1"]) == 0
    assert "computing: 1 thread, mixed precision" in capsys.readouterr().out
