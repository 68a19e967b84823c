"""The kinematic trees of robots, as the step traverses them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, Self

from jaxtyping import Array, Float

from mjx_revolve.engine.level import Level, Thrusters
from mjx_revolve.engine.meetings import Meetings
from mjx_revolve.engine.variation import Variation
from mjx_revolve.water.world import World


class Tree(Protocol):
    """Robots for the step: `SingleTree`, one robot, or `BatchedTrees`, many different ones.

    The step is written once, for this interface. How values of the bodies below the root are
    stored is the tree's own: by levels or by rows. "Joint values" are such values of the hinges.
    Passes are those of Featherstone (2008, Rigid Body Dynamics Algorithms): forward from the root
    to the tips, backward from the tips to the root.
    """

    @property
    def world(self) -> World:
        """The world around the robots."""

    @property
    def root(self) -> Level:
        """Constants of the roots."""

    @property
    def thrusters(self) -> Thrusters:
        """The robots' thrusters."""

    @property
    def carries(self) -> bool:
        """Whether any part has added mass."""

    @property
    def meets(self) -> bool:
        """Whether boxes of one robot can meet."""

    def meetings(self, like: Array) -> Meetings:
        """Which boxes of the robots can meet; `like` `[lanes]`."""

    @property
    def touches(self) -> bool:
        """Whether any body can touch the bed."""

    def with_variation(self, variation: Variation | None) -> Self:
        """The same robots with other coefficients, which may be traced; None: with their own."""

    def joints_to_tree(self, values: Float[Array, "nhinge lanes"]) -> Any:
        """Joint values from values in each robot's own order."""

    def tree_to_joints(self, values: Any, like: Array) -> Float[Array, "nhinge lanes"]:
        """Joint values in each robot's own order; `[0, lanes]`, as `like`, without hinges."""

    def split_rows(self, rows: Float[Array, "rows lanes"]) -> Any:
        """Joint values from values in the plant's order."""

    def join_rows(self, values: Any, like: Array) -> Float[Array, "rows lanes"]:
        """Joint values in the plant's order; `[0, lanes]`, as `like`, without hinges."""

    def stack_saved(self, saved: Any, select: Callable[[Any], Any], like: Array) -> Any:
        """Values that `select` takes from those saved by `forward_pass`, in the plant's order.

        None without hinges.
        """

    def at_lanes(self, which: Array | None) -> Self:
        """Some of the robots, None for all, for passes that read no constants of theirs."""

    def saved_at_lanes(self, saved: Any, select: Callable[[Any], Any], which: Array | None) -> Any:
        """Values that `select` takes from those saved by a pass, for the lanes `which` only."""

    def hinge_positions(self, which: Array | None) -> Any:
        """Of some of the robots: joint values of the hinges' places in their parents' frames."""

    def unstack_parts(self, groups: tuple[Array, ...]) -> tuple[Any, ...]:
        """`[npart, nbody, lanes]` of each group of parts, as a pass saves them."""

    def stack_parts(self, saved: Any, select: Callable[[Any], Any]) -> tuple[Any, ...]:
        """The inverse of `unstack_parts`, for values that `select` takes from those of a pass."""

    def fully_submerged(self, lanes: tuple[int, ...], dtype: Any) -> tuple[Any, Any]:
        """`State.submerged` of parts that are wholly under water, with memories of 0."""

    def map(self, fun: Callable[..., Any], *xs: Any) -> Any:
        """`fun` (level, a value of each of `xs`) for the bodies below the root, element-wise."""

    def forward_pass(self, fun: Callable[..., Any], root: Any, *xs: Any) -> Any:
        """From the root to the tips.

        Args:
            fun: (level, its parents' values, a value of each of `xs`) → (its own values for its
                children, values to save).
            root: the root's value.
            *xs: joint values, or what passes saved.

        Returns:
            The saved values of the bodies below the root.
        """

    def backward_pass(self, fun: Callable[..., Any], zero: Any, *xs: Any) -> tuple[Any, Any, Any]:
        """From the tips to the root.

        Args:
            fun: (level, sum of its children's values or None without any, a value of each of `xs`)
                → (its values for its parent, values to save, terms of a sum over all bodies).
            zero: such values and such terms that are zero, in numbers.
            *xs: as for `forward_pass`.

        Returns:
            The sum of the values of the root's children (None without any), the saved values, and
            the sums `[lanes]` (those of `zero` without bodies below the root).
        """
