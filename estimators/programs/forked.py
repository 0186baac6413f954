"""A child process forked from a clean one, which has imported this package and holds no run.

The clean one is Python's fork server, and is told neither the command line nor the main module.
The child's bytes are read as such: nothing of it is unpickled.
"""

import atexit
import gc
import importlib
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from multiprocessing import forkserver, parent_process
from multiprocessing.connection import Connection
from threading import Thread
from types import ModuleType
from typing import Any, BinaryIO

from estimators.programs.program import ProgramError, environment

Answer = Callable[[BinaryIO, BinaryIO], None]  # from what is asked to what is answered


class Forked:
    """A child that answers, in a process group of its own.

    Parameters
    ----------
    answer
        Runs in the child, until nothing more is asked.
    preload
        Module of this package that the server imports as well, if it is not there yet.

    Raises
    ------
    ProgramError
        If it cannot be started.
    """

    def __init__(self, answer: Answer, preload: str) -> None:
        context, variables = multiprocessing.get_context("forkserver"), environment()
        context.set_forkserver_preload([answer.__module__, preload, "numba"])
        (asked, self.stdin), (self.stdout, answers), (self.stderr, complaints) = (
            context.Pipe(duplex=False) for _ in range(3)
        )
        given = (answer, asked, answers, complaints, variables)
        self._process = context.Process(target=_become, args=given)
        try:
            with _nothing_told(variables):
                self._process.start()
        except (OSError, EOFError) as error:
            raise ProgramError(f"no process can be forked for the estimator ({error})") from error
        atexit.register(self.end)  # before Python waits for it
        assert self._process.pid is not None
        self.pid = self._process.pid
        for pipe in (asked, answers, complaints):
            pipe.close()

    def ended(self) -> int | None:
        """Exit code; None if it still runs."""
        return self._process.exitcode

    def end(self) -> float:
        """End it with its group; its processor time is known only before."""
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, signal.SIGKILL)
        self._process.kill()  # it may not have made its group yet
        self._process.join()
        atexit.unregister(self.end)
        return 0.0


@contextmanager
def _nothing_told(variables: Mapping[str, str]) -> Iterator[None]:
    """Start the server if need be, and hide what a new process is told of this one."""
    main, words, added = sys.modules["__main__"], sys.argv, variables.keys() - os.environ.keys()
    method = multiprocessing.get_start_method(allow_none=True)
    sys.modules["__main__"], sys.argv = ModuleType("__main__"), []
    multiprocessing.set_start_method("forkserver", force=True)  # joblib's own is unknown there
    try:
        os.environ.update({name: variables[name] for name in added})
        try:
            forkserver.ensure_running()
        finally:
            for name in added:
                del os.environ[name]
        yield
    finally:
        sys.modules["__main__"], sys.argv = main, words
        multiprocessing.set_start_method(method, force=True)


def _become(
    answer: Answer,
    asked: Connection,
    answers: Connection,
    complaints: Connection,
    variables: Mapping[str, str],
) -> None:
    """Be the child; what it prints is a complaint."""
    os.setsid()
    Thread(target=_end_with, args=(parent_process(),), daemon=True).start()
    for output in (1, 2):
        os.dup2(complaints.fileno(), output)
    os.environ.clear()
    os.environ.update(variables)
    importlib.invalidate_caches()  # of files that are younger than the server
    gc.freeze()
    questions, said = os.fdopen(asked.fileno(), "rb"), os.fdopen(answers.fileno(), "wb")
    answer(questions, said)  # the pipes are closed with the process


def _end_with(parent: Any) -> None:
    """End with the process that asks, with the group."""
    parent.join()
    os.killpg(0, signal.SIGKILL)
