"""General tools, not about driving: files, logs, quoting, markup, geometry, plugins, processes."""
