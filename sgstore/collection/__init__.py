"""More than one machine: the same questions over a collection of stores.

A collection is a folder, or a place in an object store. It has *bundles*, ordinary stores of some hundreds of
traces that never change, and a *catalogue* that says what is in them. ``_place`` reads and writes such places,
``_catalogue`` the snapshots of the catalogue, ``_pack`` makes bundles of stores and of landed segments, and
looks after them.

A question is compiled once against the whole, then asked of each bundle that may answer it, by an engine
(``_engines``: processes of this machine, Ray, Spark) that runs ``_worker``; ``_questions`` makes one answer of
theirs.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
