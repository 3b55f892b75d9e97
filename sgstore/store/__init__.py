"""The store: one DuckDB file. Only this package uses DuckDB.

Reading: ``_file`` is the face, :class:`StoreFile`. ``_locking`` lets readers and writers share the file,
and ``_schema`` compares it with ``schema.sql`` before anything is read. ``_rows`` runs statements, users'
too, and makes tables and files of their rows; ``_given`` has tables that they are given, and ``_steps``
lets a signal end them. ``_traces`` finds traces and frames by their names, ``_graphs`` reads graphs,
``_catalog`` tells the compiler of queries what there is, ``_joins`` brings users' own tables beside
the store, ``_encounters`` has measures of what was recorded later, and ``_contents`` makes digests
of frames.

Writing: ``_packing`` turns the graphs of a block into columns and masks. ``_write`` builds a trace aside,
in arrays that wait in a file of ``_staging``, sorted and summed by ``_columns``; ``_payloads`` joins its
messages to its frames, and ``_publish`` brings it into the store. ``_classes`` adds classes of frames,
``_derive`` other sets of relations; ``_similarity`` compares frames. ``_verify`` looks whether all is as it
was published, ``_rebuild`` makes stores, and makes them anew.

Collections: ``_bundles`` copies traces into stores of their own and says what is in them, ``_landed`` keeps
segments that wait for that, and ``_merge`` makes one answer of those of several bundles.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
