"""Front ends with a single map over the whole log: baselines to compare submaps with."""
