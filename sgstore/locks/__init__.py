"""Locks: test sets as text that says what was in every case.

``_text`` is the text, written and read · ``_cases`` makes cases of what a store or a collection holds, and
finds them there again · ``_sets`` unites, intersects, subtracts · ``_verify`` tells what is not as it was.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
