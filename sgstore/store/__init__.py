"""The store: one DuckDB file. Only this package uses DuckDB.

Reading: ``_file`` has the main class, :class:`StoreFile`. ``_locking`` shares the file between readers and
writers, and ``_schema`` checks it against ``schema.sql`` before the first read. ``_rows`` runs SQL statements
and converts their rows; ``_given`` creates their temporary tables, and ``_steps`` makes them interruptible.
``_traces`` finds traces and frames by name, ``_graphs`` reads graphs, ``_catalog`` describes the store for the
query compiler, ``_joins`` joins user tables, ``_encounters`` computes measures of later encounters, and
``_contents`` computes digests of frames.

Writing: ``_packing`` converts the graphs of a block to columns and masks. ``_write`` builds a trace outside the
store, as arrays in a file of ``_staging``; ``_columns`` sorts them and computes checksums. ``_payloads`` joins
messages to frames, and ``_publish`` adds the trace to the store. ``_classes`` adds frame classes, ``_derive``
adds derived sets of relations; ``_similarity`` compares frames. ``_verify`` verifies a store; ``_rebuild``
creates and rewrites stores.

Collections: ``_bundles`` copies traces into new stores and describes their content, ``_landed`` keeps segments
before that, and ``_merge`` merges the results of several bundles.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
