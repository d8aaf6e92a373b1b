"""Networks trained side by side: each lane is a process that trains its networks one after the other."""

from __future__ import annotations

import multiprocessing as mp
import signal
import sys
import time
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import Any

from twin.robot import TwinError

Lane = Sequence[tuple[str, dict[str, Any]]]
"""Names of networks, and what their configs are made of."""

POLL_S = 0.2
STOP_S = 20.0
"""How long a lane may take to stop when another one failed."""


def run_lanes(lanes: Sequence[Lane], *, at_once: int) -> None:
    """Run the lanes, ``at_once`` of them at a time.

    Raises TwinError with the message of the first lane that fails, once the others have stopped; what they had kept is
    kept. Ctrl-C stops them all.
    """
    waiting, running = list(lanes), {}
    context = mp.get_context("spawn")
    try:
        while waiting or running:
            while waiting and len(running) < max(1, at_once):
                ours, theirs = context.Pipe(duplex=False)
                process = context.Process(target=_run, args=(waiting.pop(0), theirs))
                process.start()
                theirs.close()
                running[process] = ours
            for process in [p for p in running if not p.is_alive()]:
                _check(process, running.pop(process))
            time.sleep(POLL_S)
    finally:
        for process in running:
            process.terminate()
        for process in running:
            process.join(STOP_S)


def _check(process: Any, messages: Connection) -> None:
    """Raise TwinError when a lane has failed."""
    process.join()
    if process.exitcode == 0:
        return
    try:
        why = str(messages.recv())
    except EOFError:
        why = f"a training process ended with code {process.exitcode}; the same command goes on from its checkpoint"
    raise TwinError(why)


def _run(lane: Lane, messages: Connection) -> None:
    """A lane's process. It leaves Ctrl-C to its parent, which ends it."""
    from twin.training import train_network

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    try:
        for network, said in lane:
            train_network(network, said)
    except TwinError as error:
        messages.send(str(error))
        sys.exit(1)
