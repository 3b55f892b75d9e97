"""General tools without knowledge of driving: files, logs, quoting, markup, geometry, plugins, processes."""
