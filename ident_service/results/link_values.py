"""Name implausible link values, as information without a verdict: no torque depends on them.

Motion shows base parameters; of the bodies behind them one near to likely bodies is chosen (`model/likely_bodies.py`).
Where data press against the feasible set, little is left to choose from, and a link may come out as heavy as the arm or
as a point beside it. Readers of a mass in a URDF should know.
"""

from __future__ import annotations

import numpy as np

from ident_service.estimation.identify import Estimate
from ident_service.model.likely_bodies import likely_bodies, lines_of
from ident_service.results.evidence.bodies import ellipsoid

MASSES = 10.0  # factor above or below a likely mass
_REACH = 1.0 / 3.0  # of the arm's, from a likely centre, or the link's own length
_SIZE, _TIMES = 0.5, 3.0  # of the arm's reach, and times a likely size

WHAT_THEN = (
    "Link values are chosen among bodies that move alike: torques are right all the same, but do not take these for the"
    " arm's. Bounds in joints.*.body and constraints.total_mass, or a prior, tell more."
)


def implausible_links(estimate: Estimate) -> tuple[str, ...]:
    """Return the links whose chosen values are implausible: which value, and beside which bound.

    Args:
        estimate: with link values; one without, or with values that a prior or custom knowledge asked for, has none
            to name.
    """
    if estimate.delta is None or estimate.nearest_to is None:
        return ()
    model = estimate.model
    chain, layout = model.chain, model.layout
    likely = likely_bodies(model).delta
    reach = float(np.linalg.norm([*chain.translation[1:], *chain.link_translation], axis=1).sum())
    found = []
    for link, name in enumerate(chain.names):
        place = layout.inertial(link)
        (mass, center, axes), (usual, middle, shape) = ellipsoid(estimate.delta[place]), ellipsoid(likely[place])
        wrong = []
        if not usual / MASSES <= mass <= usual * MASSES:
            wrong.append(f"{mass:.2g} kg, where {usual / MASSES:.2g} to {usual * MASSES:.2g} kg are likely")
        own = max(float(np.linalg.norm(np.subtract(line.end, line.start))) for line in lines_of(model, link))
        away, most = float(np.linalg.norm(center - middle)), max(own, _REACH * reach)
        if away > most:
            wrong.append(f"its centre {away:.2g} m from a likely place, where {most:.2g} m would be much")
        if axes is not None and shape is not None:
            size, most = (float(np.linalg.norm(one, axis=1).max()) for one in (axes, shape))
            most = max(_SIZE * reach, _TIMES * most)
            if size > most:
                wrong.append(f"an inertia as of a body that reaches {size:.2g} m, where {most:.2g} m would be much")
        if wrong:
            found.append(f"{name}: its link has {'; '.join(wrong)}")
    return tuple(found)
