"""Times of stages, and papers of the methods for ``-citations``."""

from __future__ import annotations

import time
from collections.abc import Iterator, MutableMapping
from contextlib import contextmanager

from petsc4py import PETSc

# --- Timers and log stages --------------------------------------------------------------------


@contextmanager
def stage(name: str, seconds: MutableMapping[str, float]) -> Iterator[None]:
    """Add the wall time of the block to ``seconds[name]``; ``-log_view`` shows it as a stage."""
    log = PETSc.Log.Stage(f"tfeti: {name}")
    start = time.perf_counter()
    log.push()
    try:
        yield
    finally:
        log.pop()
        seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - start


# --- Citations of the methods used ------------------------------------------------------------

TOTAL_FETI = """@article{DostalHorakKucera2006,
  title = {Total {FETI} -- an easier implementable variant of the {FETI} method
    for numerical solution of elliptic {PDE}},
  author = {Dost{\\'a}l, Zden{\\v{e}}k and Hor{\\'a}k, David and Ku{\\v{c}}era, Radek},
  journal = {Communications in Numerical Methods in Engineering},
  volume = {22}, pages = {1155--1162}, year = {2006}
}
"""
FIXING_NODES = """@article{BrzobohatyEtAl2011,
  title = {Cholesky decomposition with fixing nodes to stable computation of a generalized
    inverse of the stiffness matrix of a floating structure},
  author = {Brzobohat{\\'y}, Tom{\\'a}{\\v{s}} and Dost{\\'a}l, Zden{\\v{e}}k
    and Kozubek, Tom{\\'a}{\\v{s}} and Kov{\\'a}{\\v{r}}, Petr
    and Markopoulos, Alexandros},
  journal = {International Journal for Numerical Methods in Engineering},
  volume = {88}, pages = {493--509}, year = {2011}
}
"""
SMALSE = """@book{Dostal2009,
  title = {Optimal Quadratic Programming Algorithms},
  author = {Dost{\\'a}l, Zden{\\v{e}}k},
  publisher = {Springer}, year = {2009}
}
"""
SCALABLE_CONTACT = """@article{DostalHorak2007,
  title = {Theoretically supported scalable {FETI} for numerical solution of variational
    inequalities},
  author = {Dost{\\'a}l, Zden{\\v{e}}k and Hor{\\'a}k, David},
  journal = {SIAM Journal on Numerical Analysis},
  volume = {45}, pages = {500--513}, year = {2007}
}
"""
MPRGP = """@article{DostalSchoberl2005,
  title = {Minimizing quadratic functions subject to bound constraints with the rate of
    convergence and finite termination},
  author = {Dost{\\'a}l, Zden{\\v{e}}k and Sch{\\"o}berl, Joachim},
  journal = {Computational Optimization and Applications},
  volume = {30}, pages = {23--43}, year = {2005}
}
"""
PCPG = """@article{FarhatMandelRoux1994,
  title = {Optimal convergence properties of the {FETI} domain decomposition method},
  author = {Farhat, Charbel and Mandel, Jan and Roux, Fran{\\c{c}}ois-Xavier},
  journal = {Computer Methods in Applied Mechanics and Engineering},
  volume = {115}, pages = {365--385}, year = {1994}
}
"""
SEMISMOOTH = """@article{HintermullerItoKunisch2002,
  title = {The primal-dual active set strategy as a semismooth {Newton} method},
  author = {Hinterm{\\"u}ller, Michael and Ito, Kazufumi and Kunisch, Karl},
  journal = {SIAM Journal on Optimization},
  volume = {13}, pages = {865--888}, year = {2002}
}
"""
ALART_CURNIER = """@article{AlartCurnier1991,
  title = {A mixed formulation for frictional contact problems prone to {Newton} like solution
    methods},
  author = {Alart, Pierre and Curnier, Alain},
  journal = {Computer Methods in Applied Mechanics and Engineering},
  volume = {92}, pages = {353--375}, year = {1991}
}
"""
ACTIVE_FRICTION = """@article{HueberStadlerWohlmuth2008,
  title = {A primal-dual active set algorithm for three-dimensional contact problems with
    {Coulomb} friction},
  author = {H{\\"u}eber, Stefan and Stadler, Georg and Wohlmuth, Barbara I.},
  journal = {SIAM Journal on Scientific Computing},
  volume = {30}, pages = {572--596}, year = {2008}
}
"""
DUAL_MORTAR = """@article{Wohlmuth2000,
  title = {A mortar finite element method using dual spaces for the {Lagrange} multiplier},
  author = {Wohlmuth, Barbara I.},
  journal = {SIAM Journal on Numerical Analysis},
  volume = {38}, pages = {989--1012}, year = {2000}
}
"""
TOTAL_BETI = """@article{BouchalaDostalSadowska2009,
  title = {Scalable Total {BETI} based algorithm for {3D} coercive contact problems of linear
    elastostatics},
  author = {Bouchala, Ji{\\v{r}}{\\'i} and Dost{\\'a}l, Zden{\\v{e}}k and Sadowsk{\\'a}, Marie},
  journal = {Computing},
  volume = {85}, pages = {189--217}, year = {2009}
}
"""

# of each method, what a paper that uses it should cite
PAPERS = {
    "tfeti": (TOTAL_FETI, FIXING_NODES),
    "pcpg": (PCPG,),
    "newton": (SEMISMOOTH, PCPG),
    "smalse": (SCALABLE_CONTACT, SMALSE, MPRGP),
    "newton on friction": (ALART_CURNIER, ACTIVE_FRICTION),
    "mortar": (DUAL_MORTAR,),
    "boundary elements": (TOTAL_BETI,),
}


def cite(*methods: str) -> None:
    """Let ``-citations`` print the papers of these methods, each once.

    Args:
        methods: Names in ``PAPERS``; those of methods without a paper are passed over.
    """
    for method in methods:
        for paper in PAPERS.get(method, ()):
            PETSc.Sys.registerCitation(paper)
