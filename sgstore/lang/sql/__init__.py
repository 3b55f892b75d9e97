"""From the bound query to SQL: rewriting, the plan, and the statements of each phase."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
