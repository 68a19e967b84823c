"""Massively parallel evolution of modular robots under water, in JAX and MuJoCo MJX.

Public names are those of this package and of its subpackages `body`, `water`, `engine`, `control`,
`episodes`, `evolution`, `genotypes`, `formats`, `fitting` and `view`, each listed in an
`__init__.pyi`. The modules inside the subpackages are private and may move between releases.

A name is imported when it is first used, so importing the package, or starting one of its command
lines, loads neither JAX nor MuJoCo.
"""

from mjx_revolve.inputs.early_sigint import watch_imports

watch_imports()  # before anything that takes time to import

import lazy_loader  # noqa: E402

__version__ = "0.2.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__ += ["__version__"]
