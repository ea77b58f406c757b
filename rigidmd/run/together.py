"""Several runs at once in one process, a thread each."""

import contextlib
import signal
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import cast

from rigidmd.compile.machine import MOST_THREADS
from rigidmd.run.results import Results
from rigidmd.run.signals import signal_handler, stop_signals
from rigidmd.run.simulation import Simulation

#: Seconds between two looks at who has asked to stop.
POLL_INTERVAL = 0.2


def run_together(simulations: Sequence[Simulation], jobs: int | None = None) -> list[Results | None]:
    """Run simulations at once, each on one thread; their results in the same order, with the bits of `run`.

    Many small systems use the cores better so than one after another on all cores: a thread waits for no other, and
    the steps of one run go on while another is looked at.

    jobs : runs at a time; default: as many as there are cores

    Ctrl-C and SIGTERM stop all at their next looks; what had not begun is None in the list. A second Ctrl-C raises
    KeyboardInterrupt then. If a run fails, the others go on, and the first error is raised at the end, with a note on
    the runs that failed. The simulations keep to one thread, in their summaries and scenes too.
    """
    simulations = list(simulations)
    if strange := [one for one in simulations if not isinstance(one, Simulation)]:
        raise TypeError(f"{strange[0]!r:.60} is not a Simulation")
    if len({id(one) for one in simulations}) < len(simulations):
        raise ValueError("a simulation is given twice; make one for each run")
    if jobs is not None and jobs < 1:
        raise ValueError(f"jobs = {jobs}: at least one run at a time")
    for one in simulations:
        one.take_threads(1)
    begun: list[Simulation] = []
    asked: list[int] = []  # the signals that end runs, so far

    def run(one: Simulation) -> Results | None:
        if asked:
            return None
        begun.append(one)
        return one.run(progress=False)

    def stop_all() -> None:
        for one in begun:
            one.stop(asked[0])

    def stop(number: int) -> None:
        again = bool(asked) and number == signal.SIGINT
        asked.append(number)
        stop_all()
        if again:
            raise KeyboardInterrupt

    def ask_for_checkpoints(number: int) -> None:
        for one in begun:
            one.ask_for_checkpoint(number)

    with contextlib.ExitStack() as stack:
        stack.enter_context(signal_handler(stop, *stop_signals()))
        if hasattr(signal, "SIGUSR1"):
            stack.enter_context(signal_handler(ask_for_checkpoints, signal.SIGUSR1))
        pool = stack.enter_context(ThreadPoolExecutor(jobs or MOST_THREADS, "run"))
        futures = [pool.submit(run, one) for one in simulations]
        running = set(futures)
        while running:
            _, running = wait(running, POLL_INTERVAL)
            if asked:
                stop_all()  # again and again: one that was just beginning did not hear it
    _raise_first([future.exception() for future in futures])
    return [future.result() for future in futures]


def _raise_first(errors: Sequence[BaseException | None]) -> None:
    """Raise the first error, with a note on which runs failed; nothing if there is none."""
    failed = [k for k, error in enumerate(errors) if error is not None]
    if failed:
        error = cast(BaseException, errors[failed[0]])
        which = ", ".join(str(k + 1) for k in failed)
        error.add_note(f"of {len(errors)} runs at once these failed: {which}; this is the error of the first")
        raise error
