"""Tests run serially and under mpirun; every test runs on all ranks."""

import gc
import os

# a compiled form must not be taken from, or leave a lock in, a cache that another run shares
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
from hypothesis import settings
from mpi4py import MPI

settings.register_profile("ranks", derandomize=True, deadline=None, database=None)
settings.load_profile("ranks")


@pytest.fixture(scope="session")
def comm():
    return MPI.COMM_WORLD


@pytest.fixture(scope="session")
def serial_only():
    if MPI.COMM_WORLD.size > 1:
        pytest.skip("starts mpirun itself")


@pytest.fixture
def shared_tmp(tmp_path, comm):
    """A temporary folder of rank 0, the same on all ranks."""
    return comm.bcast(tmp_path, root=0)


@pytest.fixture(autouse=True)
def collect_garbage_together():
    yield
    gc.collect()
    MPI.COMM_WORLD.barrier()
