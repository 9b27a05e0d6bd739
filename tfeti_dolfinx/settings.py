"""Settings of a solve, and what they make: subdomains with their K⁺, and the dual problem."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from tfeti_dolfinx.constraints.rows import Constraints
from tfeti_dolfinx.contact.tools import Tools
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.extensions import Extensions
from tfeti_dolfinx.feti.dual import Dual, FeasibleLaw
from tfeti_dolfinx.feti.operator import PRECONDITIONERS
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.options import Options
from tfeti_dolfinx.solve.solver import resolved
from tfeti_dolfinx.subdomains.block import RigidBlock, SubdomainData, mode_names
from tfeti_dolfinx.subdomains.factor import added_options, say_if_not_cholmod
from tfeti_dolfinx.subdomains.kplus import TOLERANCES as INVERSES
from tfeti_dolfinx.subdomains.kplus import InverseFactory
from tfeti_dolfinx.subdomains.local_operators import LocalChoice
from tfeti_dolfinx.subdomains.mixed import MIXED
from tfeti_dolfinx.subdomains.sparse_block import EqualSubdomains, SparseBlock, outline
from tfeti_dolfinx.subdomains.subdomains import MakeBlock, Subdomains

# a tangent of Newton's method serves this part of the multiplications of a stiffness that stays
OF_TANGENT = 5


@dataclass(frozen=True)
class Settings:
    """Settings of a solve, and what they make."""

    options: Options  # options
    prefix: str  # prefix of all options
    factor_options: Mapping[str, Any]  # options that PETSc's factors read, without prefix
    extensions: Extensions  # parts that the program brings

    @property
    def given(self) -> dict[str, Any]:
        """The settings that ranks must share: a monitor of one rank would wait for the others.

        Parts of one's own count by their presence: a rank may bring another callable.
        """
        parts = {f.name: getattr(self.extensions, f.name) for f in fields(self.extensions)}
        return {
            "petsc_options": {**asdict(self.options), "of factors": dict(self.factor_options)},
            "petsc_options_prefix": self.prefix,
            "extensions": {
                name: "not given" if part is None else "given" for name, part in parts.items()
            },
        }

    def inverse_factory(self) -> InverseFactory:
        """Return a factory of the subdomains' generalised inverses."""
        own, options = self.extensions, self.options
        # SMALSE-M multiplies by F itself, as clusters do when they make theirs
        plain = options.qp_type == "smalse" or own.subdomains is not None
        mixed = not plain and options.local_type != "explicit"
        mixed &= "mixed_precision" not in options.without and options.number >= MIXED.rtol
        return InverseFactory(own.kplus, f"{self.prefix}sub_", mixed=mixed)

    def make_subdomains(
        self,
        data: Iterable[SubdomainData],
        dofs: TornDofs,
        equals: EqualSubdomains,
        tools: Tools,
        replaced: Callable[[MakeBlock], MakeBlock] | None = None,
        is_tangent: bool = False,
    ) -> Subdomains:
        """Make a Block of each subdomain, whose data is let go then, and one of all. Collective.

        ``replaced`` takes the factory of Blocks to one that makes some of them otherwise; of
        ``tools`` those with free motions get Blocks. Stiffnesses that ``equals`` knows are shared,
        unless the type of local operators is another; tangents do not stay.
        """
        own, options, decomposition = self.extensions, self.options, dofs.decomposition
        expected = options.local_multiplications // (OF_TANGENT if is_tangent else 1)
        choice = LocalChoice(options.local_type, expected)
        found = equals if choice.type in ("auto", "shared") else None
        keeps = own.subdomains is not None or "soft_springs" in options.without
        equals.factory.soft = 0.0 if keeps else INVERSES.weak if is_tangent else INVERSES.soft
        if equals.factory.mixed and found is not None and decomposition.mesh.geometry.dim == 3:
            outlines = Counter(map(outline, np.split(dofs.points(), dofs.node_offsets[1:-1])))
            equals.factory.shared = {one for one, count in outlines.items() if count > 1}
        make = own.block or (lambda item: SparseBlock(item, equals.factory, found))
        make = make if replaced is None else replaced(make)
        kind = Subdomains if own.subdomains is None else own.subdomains(dofs, decomposition)
        rigid, names = list[RigidBlock](), tools.free_names
        if names and own.subdomains is not None:
            raise InputError(
                f"{names[0]}: a rigid body with free motions goes with no other kind of "
                "Subdomains, as clusters are; expected a motion by a law, or none of them"
            )
        if tools.num_local:  # the last rank has their Blocks
            load, K, k = tools.load, tools.stiffness, tools.law.shape[1]
            rigid = [
                RigidBlock(tools.bodies[i].name, load[at], tools.mode[at], k, K[np.ix_(at, at)])
                for i, at in tools.unknowns.items()
            ]
        if dofs.comm.rank == 0:
            say_if_not_cholmod()
        bodies = decomposition.body_of_subdomain[decomposition.subdomains]
        bodies = np.append(bodies, decomposition.num_bodies + np.arange(len(rigid)))
        with added_options(self.prefix, self.factor_options):
            with raised_on_all_ranks(dofs.comm):
                blocks = [make(item) for item in data]
            count = decomposition.num_bodies + len(names)
            return kind([*blocks, *rigid], bodies, count, dofs.comm, choice)

    def make_dual(
        self,
        constraints: Constraints,
        subdomains: Subdomains,
        dofs: TornDofs,
        feasible: FeasibleLaw,
        rigid_names: Sequence[str] = (),
    ) -> tuple[Dual, Options]:
        """Return the dual problem, and the options with what ``auto`` stands for. Collective.

        Raise an InputError where the solver cannot keep the rows, or takes no preconditioner of
        one's own; else as ``Dual``.
        """
        gdim = dofs.V.mesh.geometry.dim
        options = resolved(self.options, constraints.contact_rows, self.prefix)
        preconditioner = self.extensions.preconditioner
        if preconditioner is not None and options.pc_type == "none":
            raise InputError(
                f"extensions: a preconditioner is given, but -{self.prefix}pc_type is none, as "
                "auto is with smalse; expected qp_type newton or pcpg, and pc_type auto"
            )
        with added_options(self.prefix, self.factor_options):
            dual = Dual(
                constraints,
                subdomains,
                ([*dofs.decomposition.body_names, *rigid_names], mode_names(gdim, dofs.bs)),
                preconditioner=preconditioner or PRECONDITIONERS.get(options.pc_type),
                prefix=self.prefix,
                feasible=feasible,
                deflation=self.extensions.deflation,
                without=options.without,
                recycle=options.recycle,
                dimension=gdim,
            )
        if options.pc_type == "auto":
            late = "" if dual.late is None else "late "
            options = replace(options, pc_type=f"{late}dirichlet")
        return dual, options
