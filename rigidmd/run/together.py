"""Several runs at once in one process, a thread each."""

import contextlib
import signal
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, wait

from rigidmd.compile.machine import MOST_THREADS
from rigidmd.run.results import Results
from rigidmd.run.signals import signal_handler, stop_signals
from rigidmd.run.simulation import Simulation

#: Seconds between two checks for signals.
POLL_INTERVAL = 0.2


def run_together(simulations: Sequence[Simulation], jobs: int | None = None) -> list[Results | None]:
    """Run simulations at once, each on one thread; their results in the same order, with the bits of `run`.

    For many small systems this is faster than one run after another on all cores: no thread waits for another, and the
    steps of one run continue while the observers of another are called.

    jobs : runs at a time; default: the number of cores

    Ctrl-C and SIGTERM stop all runs at their next observations; a run that had not begun is None in the list. A second
    Ctrl-C then raises KeyboardInterrupt. If a run fails, the others continue, and the first error is raised at the end,
    with a note on the runs that failed. Summaries and scenes of the simulations have one thread.
    """
    simulations = list(simulations)
    if wrong := [value for value in simulations if not isinstance(value, Simulation)]:
        raise TypeError(f"{wrong[0]!r:.60} is not a Simulation")
    if len(set(map(id, simulations))) < len(simulations):
        raise ValueError("a simulation is given twice; make one for each run")
    if jobs is not None and jobs < 1:
        raise ValueError(f"jobs = {jobs}: at least one run at a time")
    for simulation in simulations:
        simulation.take_threads(1)
    begun: list[Simulation] = []
    received: list[int] = []  # the signals that end runs, so far

    def run(simulation: Simulation) -> Results | None:
        if received:
            return None
        begun.append(simulation)
        return simulation.run(progress=False)

    def stop_all() -> None:
        for simulation in begun:
            simulation.stop(received[0])

    def stop(number: int) -> None:
        again = bool(received) and number == signal.SIGINT
        received.append(number)
        stop_all()
        if again:
            raise KeyboardInterrupt

    def ask_for_checkpoints(number: int) -> None:
        for simulation in begun:
            simulation.ask_for_checkpoint(number)

    with contextlib.ExitStack() as stack:
        stack.enter_context(signal_handler(stop, *stop_signals()))
        if hasattr(signal, "SIGUSR1"):
            stack.enter_context(signal_handler(ask_for_checkpoints, signal.SIGUSR1))
        pool = stack.enter_context(ThreadPoolExecutor(jobs or MOST_THREADS, "run"))
        futures = [pool.submit(run, simulation) for simulation in simulations]
        running = set(futures)
        while running:
            _, running = wait(running, POLL_INTERVAL)
            if received:
                stop_all()  # repeatedly: a run that was just beginning may have missed it
    failed = {k: error for k, future in enumerate(futures, 1) if (error := future.exception()) is not None}
    if failed:
        error, which = next(iter(failed.values())), ", ".join(map(str, failed))
        error.add_note(f"of {len(futures)} runs at once these failed: {which}; this is the error of the first")
        raise error
    return [future.result() for future in futures]
