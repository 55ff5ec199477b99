"""Folders whose files are written together, each state committed as a whole."""
