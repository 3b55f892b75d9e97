"""Test sets: coverage of scene classes, selection of test cases, locks, comparison of two stores."""
