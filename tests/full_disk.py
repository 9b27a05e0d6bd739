"""A disk that is full: no file may grow beyond some bytes."""

import resource
from contextlib import contextmanager


def fill(size):
    """Let writes beyond so many bytes of a file fail, as on a full disk, with EFBIG."""
    _, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, most))


def clear():
    _, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))


@contextmanager
def full(size):
    fill(size)
    try:
        yield
    finally:
        clear()


def left_in(folder, comm):
    """Names and contents of all files, from rank 0."""
    comm.barrier()
    found = {str(f.relative_to(folder)): f.read_bytes() for f in folder.rglob("*") if f.is_file()}
    return comm.bcast(found, root=0)
