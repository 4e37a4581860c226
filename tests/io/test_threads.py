import subprocess
import sys
import threading
import time

import pytest
import torch

from tests.commands import ROOT
from vg2gt.kernels import threads
from vg2gt.kernels.threads import parallel_for


@pytest.fixture(params=["team", "pool"])
def two_threads(request, monkeypatch):
    """Two threads, those of OpenMP or, where it has no entry point, our own."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    if request.param == "pool":
        monkeypatch.setattr(threads, "_openmp_team", lambda: None)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("two_threads")
def test_every_item_is_taken_once_and_by_two_threads():
    seen, takers = [], set()

    def take(item):
        seen.append(item)
        takers.add(threading.get_ident())
        time.sleep(0.005)

    parallel_for(range(40), take)
    assert (sorted(seen), len(takers)) == (list(range(40)), 2)


@pytest.mark.usefixtures("two_threads")
def test_an_error_is_raised_and_the_next_loop_runs():
    def refuse(item):
        if item == 3:
            raise ValueError("item 3")

    with pytest.raises(ValueError, match="item 3"):
        parallel_for(range(8), refuse)
    seen = []
    parallel_for(range(8), seen.append)
    assert sorted(seen) == list(range(8))


INTERRUPTED = """
import os, random, signal, threading, time
import torch
from vg2gt.kernels.threads import parallel_for

def interrupt():
    time.sleep(2e-4 + 2e-3 * random.random())
    os.kill(os.getpid(), signal.SIGINT)

signal.signal(signal.SIGINT, signal.default_int_handler)  # what a shell starts in the background ignores it
torch.set_num_threads(2)
random.seed(0)
parallel_for(range(2), lambda _: None)
for _ in range(40):
    thread = threading.Thread(target=interrupt)
    try:
        thread.start()
        end = time.monotonic() + 10
        while time.monotonic() < end:
            parallel_for(range(2), lambda _: None)
        raise SystemExit("an interruption was lost")
    except KeyboardInterrupt:
        thread.join()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere torch's OpenMP has no such entry point")
def test_no_interruption_is_lost():
    """It may be raised as a thread enters the loop's function, where ctypes only reports it."""
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED], cwd=ROOT, capture_output=True, text=True, timeout=200, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
