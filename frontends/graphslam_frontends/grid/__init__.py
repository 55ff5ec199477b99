"""A Rao-Blackwellised particle filter on evidence grids."""
