"""General tools that know nothing of driving: files, logs, quoting, markup, geometry, plugins, processes."""
