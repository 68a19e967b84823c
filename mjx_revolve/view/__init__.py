"""Analysis and display of episodes: pictures, films, the viewer's page, reports.

Public names are those in `__init__.pyi`; the modules are private and may move between releases.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
