"""What happened over time in the traces of a store: sequences of patterns, and checks.

Conditions on single frames come from the store by SQL, as columns; what they make over time is worked out by
:mod:`sgstore.temporal`, a trace at a time, so that memory does not grow with the number of traces.
"""
