"""Collections of stores: the same queries over several stores and machines.

A collection is a folder, or a prefix in an object store. It has *bundles*, which are immutable
stores of some hundreds of traces, and a *catalogue* of their contents. ``_place`` reads and writes
such places, ``_catalogue`` the snapshots of the catalogue. ``_pack`` makes bundles of stores and of
landed segments, and maintains them.

A query is compiled once against the whole collection. An engine (``_engines``: local processes,
Ray, Spark) then runs ``_worker`` on each bundle that may have results. ``_questions`` merges the
results.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
