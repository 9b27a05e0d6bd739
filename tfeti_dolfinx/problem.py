"""The user's door: a contact problem from forms, conditions and contacts to a solution."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.assembly import Forms
from tfeti_dolfinx.checks import checked_type
from tfeti_dolfinx.compat import require_real_petsc
from tfeti_dolfinx.contact.search import ContactPartner, ContactSearch, checked_contacts
from tfeti_dolfinx.dual.dual import Dual
from tfeti_dolfinx.errors import ConvergenceError, InputError, NoSolutionError
from tfeti_dolfinx.fields import Stress, check_stress, checked_thickness
from tfeti_dolfinx.form_checks import check_same_space, displacement_space
from tfeti_dolfinx.gluing.constraints import Constraints
from tfeti_dolfinx.gluing.glue import glue
from tfeti_dolfinx.gluing.prescribed import checked_conditions
from tfeti_dolfinx.gluing.spectrum import extreme_eigenvalues, require_slepc
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.options import factor_options, parse_options
from tfeti_dolfinx.report import Report
from tfeti_dolfinx.report_filling import fill_result, fill_sizes
from tfeti_dolfinx.solution import Solution
from tfeti_dolfinx.solver import conclude, resolve_types, solve_dual
from tfeti_dolfinx.subdomains.build import sparse_blocks, trace_parts
from tfeti_dolfinx.subdomains.factor import added_options
from tfeti_dolfinx.subdomains.kernel import mode_names
from tfeti_dolfinx.subdomains.sparse_block import Counters, SparseBlock
from tfeti_dolfinx.timing import stage

MAX_ROUNDS = 20


class ContactProblem:
    """Linear elasticity with contact on a torn mesh, solved by Total FETI.

    Mirrors ``dolfinx.fem.petsc.LinearProblem``. Creation and all methods are collective. A whole
    example stands at the top of the package.

    Args:
        a: Bilinear form on a Lagrange space of the torn mesh.
        L: Linear form; for no load ``ufl.ZeroBaseForm((v,))``.
        bcs: Dirichlet conditions; their values hold on all torn copies of a node.
        contacts: Obstacles and pairs of surfaces; none for a linear problem.
        decomposition: The torn mesh.
        stress: From a displacement to its 3×3 stress in UFL, for stress fields.
        thickness: What the forms were multiplied with, a number or a scalar in UFL: a thickness
            in 2D, 2πr if axisymmetric. Contact pressures are forces over areas times it.
        u: Function that takes the solution; default a new one.
        petsc_options: Options, with or without the prefix; the command line beats them.
        petsc_options_prefix: Prefix of the options.
        form_compiler_options: As in DOLFINx.
        jit_options: As in DOLFINx.

    Attributes:
        u: The displacement.
        report: Sizes, counters, residuals and times.

    Raises:
        InputError: Something given does not fit; the message names it.
    """

    def __init__(
        self,
        a: ufl.Form,
        L: ufl.Form,
        bcs: Sequence[fem.DirichletBC],
        contacts: Sequence[ContactPartner],
        decomposition: Decomposition,
        *,
        stress: Stress | None = None,
        thickness: Any = 1.0,
        u: fem.Function | None = None,
        petsc_options: Mapping[str, Any] | None = None,
        petsc_options_prefix: str = "tfeti_",
        form_compiler_options: dict[str, Any] | None = None,
        jit_options: dict[str, Any] | None = None,
    ) -> None:
        require_real_petsc()
        self.options = parse_options(petsc_options, petsc_options_prefix)
        checked_type(
            decomposition, Decomposition, "decomposition", "what decompose or read_gmsh return"
        )
        if self.options.bbt:
            require_slepc(decomposition.comm)
        self.decomposition = decomposition
        self.contacts = checked_contacts(contacts)
        V = displacement_space(a, decomposition)
        self.bcs = checked_conditions(bcs, V)
        self.u = fem.Function(V, name="displacement") if u is None else self._checked_u(u, V)
        self._stress = check_stress(stress, self.u, decomposition)
        self._thickness = checked_thickness(thickness, decomposition)
        self.report = Report(seconds=dict(decomposition.seconds))
        self._prefix = petsc_options_prefix
        self._factor_options = factor_options(petsc_options, petsc_options_prefix)
        self._solution: Solution | None = None
        self._constraints: Constraints | None = None
        self._blocks: list[SparseBlock] | None = None  # a rank may have none of them
        self._dual: Dual | None = None
        with stage("assembly", self.report.seconds):
            self._forms = Forms(a, L, V, decomposition, form_compiler_options, jit_options)
        with stage("gluing", self.report.seconds):
            self.dofs = TornDofs(V, decomposition)

    @property
    def solution(self) -> Solution:
        """Fields and contact states.

        Raises:
            InputError: There is none before ``solve``.
        """
        if self._solution is None:
            raise InputError("there is no solution yet; expected a call of solve() before")
        return self._solution

    def solve(self) -> fem.Function:
        """Solve the problem.

        Returns:
            The displacement, on the torn mesh.

        Raises:
            InputError: Dirichlet values, contacts, stiffness or load do not fit.
            NoSolutionError: The problem has no solution.
            ConvergenceError: The solver stopped before its tolerance.
            FactorError: A matrix could not be factored.
        """
        self.destroy()
        self.report.reset()
        with stage("assembly", self.report.seconds):
            self._K, self._f = self._forms.stiffness(), self._forms.load()
        with stage("contact", self.report.seconds):
            diagonal = self.dofs.to_primal(self._K.diagonal())
            search = ContactSearch(self.contacts, self.dofs, self.decomposition, diagonal)
            self._settled = search.contacts
        previous = None
        for _ in range(MAX_ROUNDS):
            self._glue(search)
            try:
                previous = self._solve_rows(previous)
                late = self._take_in_overlapping(search)
            except NoSolutionError as error:  # on all ranks: what is far may hold the body yet
                if search.is_exhausted:
                    self.report.converged_reason = "NO_SOLUTION"
                    if unmet := search.unmet():
                        text = f"{error}; of the contacts meet nobody: {', '.join(unmet)}"
                        raise NoSolutionError(text) from error
                    raise
                with stage("contact", self.report.seconds):
                    late = search.widen()
            else:
                if late == 0:
                    break
            self.report.late_contact_rows += late
        else:
            raise ConvergenceError(f"nodes out of reach still overlap after {MAX_ROUNDS} rounds")
        search.warn_of_unmet()
        if self.options.view and self.decomposition.comm.rank == 0:
            print(self.options.view_text(self._prefix), self.report, sep="\n", flush=True)
        return self.u

    def _checked_u(self, u: fem.Function, V: fem.FunctionSpace) -> fem.Function:
        checked_type(u, fem.Function, "u", "a dolfinx.fem.Function on the space of a")
        check_same_space(u.function_space, V, "u", "the space of a")
        return u

    def destroy(self) -> None:
        """Destroy the PETSc objects; solution and report stay. ``solve`` makes them anew."""
        for item in (self._dual, *(self._blocks or ()), self._constraints):
            if item is not None:
                item.destroy()
        self._dual, self._blocks, self._constraints = None, None, None

    def _glue(self, search: ContactSearch) -> None:
        """Rows of B for the present conditions."""
        with stage("gluing", self.report.seconds):
            if self._constraints is not None:
                self._constraints.destroy()
            self.report.unmet_contacts = search.unmet()
            records, weights = search.records, self._weights()
            self._gluing = glue(self.dofs, self.bcs, records, search.length, weights)
            self._constraints = self._gluing.constraints
        fill_sizes(self.report, self.dofs, self.decomposition, self._gluing)
        if self.options.bbt:
            with stage("spectrum", self.report.seconds):
                self.report.spectrum = extreme_eigenvalues(self._constraints)

    def _take_in_overlapping(self, search: ContactSearch) -> int:
        """Give rows to nodes that have come to overlap without one; how many."""
        tolerance = self.report.tolerances["penetration"]
        with stage("contact", self.report.seconds):
            u = self.dofs.to_primal(self.u.x.array)
            return search.take_in_overlapping(u, tolerance)

    def _weights(self) -> Array:
        """D for the scaling of B: the diagonal of K over its smallest entry, or ones."""
        if self.options.scaling == "multiplicity":
            return np.ones(self.dofs.num_nodes * self.dofs.bs)
        diagonal = self.dofs.to_primal(self._K.diagonal())
        positive = diagonal > 0.0  # what is not is reported when Blocks are built
        lowest = float(np.min(diagonal[positive], initial=np.inf))
        lowest = self.decomposition.comm.allreduce(lowest, op=MPI.MIN)
        return np.where(positive, diagonal / lowest, 1.0)

    def _solve_rows(self, previous: Solution | None) -> Solution:
        """Solve with the present rows, from an earlier solution on."""
        gluing, report, comm = self._gluing, self.report, self.decomposition.comm
        rows = comm.allreduce(len(gluing.inequalities.rows))
        qp_type, pc_type = resolve_types(self.options, rows, self._prefix)
        with added_options(self._prefix, self._factor_options):
            blocks = self._build_blocks()
            with stage("dual", report.seconds):
                dual = self._build_dual(blocks, pc_type)
        with stage("qp", report.seconds):
            start = None
            if previous is not None:
                start = (gluing.multipliers(previous.gluing, previous.lam), previous.mu)
            result, accuracy = solve_dual(dual, self.options, qp_type, start)
        with stage("recovery", report.seconds):
            u = np.concatenate([np.empty(0), *accuracy.u])
            self.u.x.array[:] = self.dofs.to_dolfinx(u)
            self._solution = Solution(
                u=self.u,
                dofs=self.dofs,
                decomposition=self.decomposition,
                gluing=gluing,
                lam=np.array(result.lam.array_r),
                mu=result.mu,
                stress=self._stress,
                contacts=self._settled,
                thickness=self._thickness,
            )
        fill_result(report, self.solution, dual, result, accuracy, self._counters)
        result.destroy()
        conclude(result, accuracy, self.options, comm)
        return self.solution

    def _build_blocks(self) -> list[SparseBlock]:
        """Blocks for the present trace; factors are made once."""
        trace = self._gluing.constraints.trace
        if self._blocks is not None:
            with stage("subdomains", self.report.seconds):
                for block, part in zip(self._blocks, trace_parts(self.dofs, trace), strict=True):
                    block.retrace(part)
            return self._blocks
        self._counters = Counters()
        with stage("subdomains", self.report.seconds):
            self._blocks = sparse_blocks(
                self.dofs,
                self.decomposition,
                self._K,
                self._f,
                trace,
                self._counters,
                self.options.kplus_type,
                f"{self._prefix}sub_",
            )
        return self._blocks

    def _build_dual(self, blocks: list[SparseBlock], pc_type: str) -> Dual:
        """The dual problem of the present rows."""
        if self._dual is not None:
            self._dual.destroy()
        decomposition = self.decomposition
        self._dual = Dual(
            constraints=self._gluing.constraints,
            blocks=blocks,
            body_of_block=decomposition.body_of_subdomain[decomposition.subdomains],
            body_names=decomposition.body_names,
            mode_names=mode_names(decomposition.mesh.geometry.dim, self.dofs.bs),
            pc_type=pc_type,
            options_prefix=self._prefix,
        )
        return self._dual
