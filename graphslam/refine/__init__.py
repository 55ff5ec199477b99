"""Refinement: one least-squares problem over all steps, with the scans themselves as measurements."""
