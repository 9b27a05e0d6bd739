"""Tests run serially and under mpirun; every test runs on all ranks."""

import faulthandler
import gc
import os
import sys

os.environ.setdefault("OMP_NUM_THREADS", "1")
# other ranks and runs may compile the same form for longer than the 10 s that DOLFINx waits
os.environ["XDG_CONFIG_HOME"] = f"{os.path.dirname(__file__)}/config"

import pytest
import quick_demos
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from hypothesis.internal.conjecture import providers
from mpi4py import MPI

# a failure on one rank alone must end the test: others would not take part in shrinking it
settings.register_profile(
    "ranks",
    derandomize=True,
    deadline=None,
    database=None,
    max_examples=25,
    phases=[Phase.explicit, Phase.generate],
)
settings.load_profile("ranks")
# newer versions draw from constants of the modules loaded, and ranks do not load the same ones
if hasattr(providers, "_get_local_constants"):
    providers._get_local_constants = lambda none=providers._local_constants: none

LATER = 1.1  # pytest-timeout, which names the test, comes first where it can
STDERR = pytest.StashKey[int]()


def pytest_configure(config):
    config.stash[STDERR] = os.dup(2)  # pytest captures it later


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item):
    """End a test that hangs on all ranks: mpirun ends them when one of them exits.

    A rank that waits for others inside DOLFINx or PETSc holds Python's lock, and pytest-timeout's
    timer is a thread that needs it. This timer is written in C.
    """
    config = item.config
    seconds = float(config.getoption("timeout") or config.getini("timeout"))
    faulthandler.dump_traceback_later(LATER * seconds, exit=True, file=config.stash[STDERR])
    try:
        return (yield)
    finally:
        faulthandler.cancel_dump_traceback_later()


@pytest.fixture(scope="session")
def comm():
    return MPI.COMM_WORLD


@pytest.fixture(scope="session")
def serial_only():
    if MPI.COMM_WORLD.size > 1:
        pytest.skip("knows nothing of ranks, or starts mpirun itself")


@pytest.fixture
def shared_tmp(tmp_path, comm):
    """A temporary folder of rank 0, the same on all ranks."""
    return comm.bcast(tmp_path, root=0)


@pytest.fixture(scope="session")
def quick_demo(tmp_path_factory, comm):
    """What a demo gives at its quick size; each runs once."""
    known = {}

    def of(name):
        if name not in known:
            folder = tmp_path_factory.mktemp(name) if comm.rank == 0 else None
            known[name] = quick_demos.run(name, comm.bcast(folder))
        return known[name]

    return of


@given(st.none())
def draw_nothing(nothing):
    """Hypothesis asks once who refers to its random numbers: of what is frozen nobody knows."""


@pytest.fixture(scope="module", autouse=True)
def keep_what_stays():
    """Modules live as long as the process: to look through them after each test takes longest."""
    draw_nothing()
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def clean_up_together():
    """Options and models of gmsh must not reach the next test: they would decide its mesh sizes."""
    yield
    gmsh = sys.modules.get("gmsh")
    if gmsh is not None and gmsh.isInitialized():
        gmsh.finalize()
    gc.collect()
    MPI.COMM_WORLD.barrier()
