"""Mistakes with what a problem takes for another solve."""

from mistakes.conditions import exterior

FLOOR = "obstacle of surface 'bottom'"


def updated(**made):
    """Solve, take what is made from the scene, solve again."""

    def do(s):
        problem = s.problem(contacts=[s.floor])
        problem.solve()
        problem.update(**{name: make(s) for name, make in made.items()})
        problem.solve()

    return do


def gaps(value):
    return updated(gap=lambda s: value)


FORMS_AGAIN = {
    r"stiffness is from a space of degree 2 .*; expected a, a space of degree 1": updated(
        stiffness=lambda s: s.a_on(s.space("Lagrange", 2, (2,)))
    ),
    r"Dirichlet condition 0 prescribes 2 facets that lie on tears": updated(
        values=lambda s: [exterior(s)]
    ),
}

GAPS_AGAIN = {
    r"gap is \[0.1\]; expected a dictionary": gaps([0.1]),
    r"contact 'lid': there is none; expected a position or a name": gaps({"lid": 0.1}),
    r"gap: contact 0 is there twice, by position and by name": gaps({0: 0.1, FLOOR: 0.2}),
}

TABLES = ("FORMS_AGAIN", "GAPS_AGAIN")
