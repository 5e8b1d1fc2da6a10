"""A renderer that plans beside one that leaves nothing out, and how far they may be apart."""

import numpy as np

from cldof import LayeredFrame, Lens, Renderer
from cldof.planner import MAX_CHANGE, FramePlan

__all__ = ["ROUNDING", "Pair", "check"]

# Means of equal numbers differ by rounding; windows of recursive filters begin elsewhere.
ROUNDING = 4e-6

Pair = tuple[Renderer, Renderer]


def check(pair: Pair, frame: LayeredFrame, lens: Lens) -> FramePlan:
    planned, full = (renderer.render(frame, lens) for renderer in pair)
    plan = planned.plan
    brightest = max(1.0, float(frame.color.max()))
    change = float(np.abs(planned.image - full.image).max())
    assert change <= plan.error_bound + ROUNDING * brightest, plan.explain()
    assert plan.error_bound <= MAX_CHANGE, plan.explain()
    return plan
