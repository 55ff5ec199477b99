"""Scan and map matching: where one cloud lies in another, how sure that is, and where else it might lie."""
