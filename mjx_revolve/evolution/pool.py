"""Old names of `evolution.executor`, for one release."""

from mjx_revolve.evolution.executor import Executor as Pool
from mjx_revolve.evolution.executor import make_executor as make_pool

__all__ = ["Pool", "make_pool"]
