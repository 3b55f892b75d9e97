"""Programs around the library: command line, explorer, assistant, notebook, pytest, reports."""
