"""The verdict of a run, from its stored metrics and from findings during the run; :mod:`checks` has the table."""
