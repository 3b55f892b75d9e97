"""The store: one DuckDB file, and the only room that knows DuckDB.

``file`` is its face · ``access`` lets readers and writers share the file ·
``shape`` looks whether it is one of ours, ``guarding`` what may be opened · ``rows`` runs statements, users'
too · ``traces`` names traces and frames · ``scenes`` puts one graph together · ``packing`` turns the graphs
of a block into columns and masks · ``segment`` builds a trace aside, in tables that wait in ``staging`` and a
``folder`` beside the store; ``payloads`` joins its messages to its frames, ``sealed`` is what is ready, with
``checksums``, and ``publishing`` brings it in · ``verifying`` looks whether all is as it was published ·
``schema`` makes an empty store from ``schema.sql`` · ``parquet`` writes rows to a file · ``joining`` brings
users' own tables beside the store.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
