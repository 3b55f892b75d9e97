"""Tools that know nothing about driving: files, logs, quoting, markup, geometry, plugins, processes."""
