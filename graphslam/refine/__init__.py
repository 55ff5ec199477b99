"""Layer 5: refinement of the path: one least-squares problem with the scans as measurements."""
