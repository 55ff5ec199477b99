"""Submaps and streams in, a solved graph out, submap by submap; no files, and no words for the terminal."""
