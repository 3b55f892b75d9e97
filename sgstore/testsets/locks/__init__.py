"""Locks: test sets as text with digests of the content of every case.

``_text`` reads and writes the text. ``_cases`` makes cases of a store or collection, and finds them
again. ``_sets`` has union, intersection and difference. ``_verify`` finds changes.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
