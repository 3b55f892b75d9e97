"""Programs around the library: command line, web page, AI assistant, notebook, pytest plugin, reports."""
