"""Sets of tests: coverage, selection, locks, and the difference between stores."""
