"""The verdict of a run, from its figures and from what the run itself saw; :mod:`checks` has the table."""
