"""The table of drag laws: what worlds and modules can choose.

A new law is a value in a file of its own, and its name in `DRAG_LAWS`.
"""

from __future__ import annotations

from mjx_revolve.water.cross_flow import CROSS_FLOW
from mjx_revolve.water.face_drag import FACES
from mjx_revolve.water.fin_wake import FIN_WAKE
from mjx_revolve.water.fossen import FOSSEN
from mjx_revolve.water.laws import BodyDragLaw, DragLaw, Export, PartDragLaw, find_law
from mjx_revolve.water.lift_drag import LIFT_DRAG
from mjx_revolve.water.mujoco_drag import ELLIPSOID, INERTIA_BOX
from mjx_revolve.water.plate_wake import PLATE_WAKE

OFF = PartDragLaw(
    name="off",
    summary="no drag",
    steepest=0.0,
    mjcf=Export("", missing="modules without drag next to others with it"),
    sdf=Export(""),
)

_LAWS = (FACES, LIFT_DRAG, FOSSEN, CROSS_FLOW, PLATE_WAKE, FIN_WAKE, INERTIA_BOX, ELLIPSOID, OFF)
DRAG_LAWS: dict[str, DragLaw] = {law.name: law for law in _LAWS}
"""The drag laws by the names that worlds and modules give."""


def find_drag_law(name: str) -> DragLaw:
    """The drag law of a name; an unknown one is an `InputError`."""
    return find_law(DRAG_LAWS, name)


def drags_whole_bodies(name: str) -> bool:
    """Whether the drag law of a name acts on a moving body as a whole, not on its parts."""
    return isinstance(find_drag_law(name), BodyDragLaw)


def is_extrapolated(name: str) -> bool:
    """Whether a step takes the drag law of a name explicitly, but in the middle of the step."""
    law = find_drag_law(name)
    return law.explicit and law.steepest is not None
