"""The controllers by name. JAX is imported when one is made, not when a configuration is read."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any, NamedTuple


class ControllerKind(NamedTuple):
    """A kind of controller.

    Attributes:
        path: `module.function` in this package. The function takes a plant, and by their
            names those settings of a `ControllerConfig` that its signature has.
        settings: names of the settings that only this kind, or few kinds, use.
        fixed: further arguments, which are no settings.
    """

    path: str
    settings: tuple[str, ...] = ()
    fixed: Mapping[str, Any] = {}

    @property
    def make(self) -> Callable[..., Any]:
        """The function."""
        module, name = self.path.split(".")
        return getattr(import_module(f"mjx_revolve.control.{module}"), name)


_WAVES = "max_frequency", "amplitude"
_NETWORK = "joint_network.make_joint_network", (*_WAVES, "sensors", "hidden", "messages")
CONTROLLERS: dict[str, ControllerKind] = {
    "cpg": ControllerKind("cpg.make_cpg", _WAVES),
    "sine": ControllerKind("sine.make_sine", (*_WAVES, "harmonics")),
    "feedback": ControllerKind("feedback.make_feedback", ("gain", "depth")),
    "mlp": ControllerKind(*_NETWORK),
    "rnn": ControllerKind(*_NETWORK, {"recurrent": True}),
    "sensory_cpg": ControllerKind("sensory_cpg.make_sensory_cpg", (*_WAVES, "sensors", "gain")),
    "splines": ControllerKind("splines.make_splines", (*_WAVES, "points")),
    "brain": ControllerKind("neurons.make_neural_network", (*_WAVES, "points")),
}
"""`brain` runs what the robot's own file has, a network or splines."""
