"""sgstore: find the driving scenes that matter.

Traces go in, scene graphs are kept, frames are found by what happens in them, test sets come out.

::

    import sgstore

    with sgstore.open("drives.sgstore", create=True) as store:
        store.ingest("monday.mcap")
        for match in store.find("MATCH (e:Ego)-[:near_coll]->(p:Person)"):
            print(match.trace, match.t, match.p_name)

Names are imported when they are first used, so that ``import sgstore`` costs nothing.
"""

import lazy_loader

__version__ = "0.2.0.dev0"

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def load_ipython_extension(ipython: object) -> None:
    """Make ``%%sgql`` and pictures of graphs known to a notebook: ``%load_ext sgstore``."""
    from sgstore.apps.notebook import load

    load(ipython)


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module 'sgstore' has no attribute {name!r}")
    return _load(name)
